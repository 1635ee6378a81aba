"""The scoreboard: every task with every controller that suits it.

Each controller has one recipe for all tasks. `python -m delucax run scoreboard` runs
it. `python -m benchmarks.scoreboard` makes the committed results and their page.
"""

import functools
import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array

from .. import controllers
from .._controller import AbstractController
from .._results import RESULTS
from ..controllers import mlp_policy, OpenLoop, Zero
from ..disturbances import Gaussian, Zero as Undisturbed
from ..environments import Environment, make, registered, UniformState
from ..experiments import experiment
from ..lung import BreathCost, Breathing
from ..planning import AbstractPlanner, CEM, ILQR, ilqr, MPPI, SQP
from ..simulation import rollout
from ..training import actor_critic, expected_cost, fit, PPO, SHAC


# For every training: the optimiser steps on the gradient, the episodes in a step, and
# the most steps of an episode. PPO and SHAC get as many steps of the environment.
TRAINING_STEPS, EPISODES, LONGEST = 200, 32, 100
# The number of trained controllers of each kind.
TRAINING_SEEDS = 3


class EnergyPumping(AbstractController):
    """Full force in the direction of motion, which pumps energy into a swing. It is the
    best known first guess for the mountain cars."""

    push: Array

    def __call__(self, t, y, state):
        return jnp.where(y[1] < 0, -self.push, self.push), state


class Unsuitable(Exception):
    """A method does not apply to a task."""


@functools.cache
def task_of(name: str) -> Environment:
    """The task of a name. Its random parts are drawn from a fixed key."""
    options: dict[str, Any] = {}
    if name == "neural":
        options = dict(width=8, key=jax.random.key(0))
    elif name == "lds":
        start, w = UniformState(-jnp.ones(4), jnp.ones(4)), Gaussian(0.1, size=4)
        options = dict(states=4, controls=2, key=jax.random.key(0))
        options |= dict(initial_state=start, disturbance=w, spectral_radius=1.05)
    return make(name, **options)


def is_disturbed(name: str) -> bool:
    """Whether the task draws disturbances, which only a plan knows in advance."""
    return not isinstance(task_of(name).disturbance, Undisturbed)


@functools.cache
def _local(name: str) -> controllers.LocalModel:
    return controllers.local_model(task_of(name))


def _regulator(
    name: str, env: Environment, design: Callable[..., Any], **options: Any
) -> Any:
    """A design from the linear model and the curvature of the cost."""
    dynamics, Q, R, S = _local(name)
    weights = (Q, R, S)
    if design is controllers.HInfinity:
        if np.any(S):
            raise Unsuitable("the cost weights products of state and control")
        weights = (Q, R)
    return design(dynamics, *weights, difference=env.dynamics.difference, **options)


def _following(name: str, env: Environment) -> Any:
    """A PID that follows the waveform of a ventilator."""
    if not isinstance(env.cost, BreathCost):
        raise Unsuitable("the cost follows no waveform")
    waveform = env.cost.waveform
    return Breathing(controllers.LeakyPID(dt=env.dt, reference=waveform), waveform)


def _learning(
    name: str, env: Environment, learner: Callable[..., Any], **options: Any
) -> Any:
    """An online learner on top of the LQR."""
    return learner(env.dynamics, env.cost, base=agent_of(name, "LQR"), **options)


def _receding(
    name: str,
    env: Environment,
    kind: type[AbstractPlanner],
    real_time: bool = False,
    **options: Any,
) -> Any:
    """MPC, with the cost-to-go of the LQR if the LQR suits the task."""
    bounds = env.control_bounds
    if kind in (MPPI, CEM) and bounds is not None:
        low, high = (np.asarray(bound, float) for bound in bounds)
        width = high - low
        options["scale"] = np.where(np.isfinite(width), width / 4, 1.0)
    how: dict[str, Any] = dict(real_time=real_time, throw=False)
    lqr = _suited(name, "LQR")
    return controllers.local_mpc(env, lqr, planner=kind(**options), **how)


def _seeds() -> Any:
    """A key for each of the controllers that are trained as a batch."""
    return jax.random.split(jax.random.key(1), TRAINING_SEEDS)


def _by_gradient(env: Environment, network: Callable[..., Any], **options: Any) -> Any:
    """Networks that are trained by gradient descent through the rollout."""
    keys, horizon = _seeds(), min(env.horizon, LONGEST)
    loss = expected_cost(env, batch=EPISODES, horizon=horizon, gradient_decay=0.95)
    models = eqx.filter_vmap(lambda key: network(env, key=key, **options))(keys)
    return _fitted(loss, models, TRAINING_STEPS, keys)


def _gru(env: Environment, key: Any) -> Any:
    sizes = env.feature_size, env.control_size
    bounds = env.control_bounds
    if bounds is not None and not np.all(np.isfinite(bounds)):
        bounds = None
    return controllers.GRU(*sizes, 32, features=env.encode, bounds=bounds, key=key)


def _by_actor_critic(env: Environment, method: type[PPO] | type[SHAC]) -> Any:
    """MLPs that are trained by reinforcement learning."""
    head, keys = "gaussian" if method is PPO else "deterministic", _seeds()
    shape: dict[str, Any] = dict(width=32, depth=1, head=head)
    models = eqx.filter_vmap(lambda key: actor_critic(env, **shape, key=key))(keys)
    loss = method(env, EPISODES, min(env.horizon, LONGEST), discount=0.95)
    steps = TRAINING_STEPS
    if isinstance(loss, PPO):
        steps *= loss.epochs * loss.minibatches
    policy = _fitted(loss, models, steps, keys).policy
    return policy.base if method is PPO else policy


def _fitted(loss: Any, models: Any, steps: int, keys: Any) -> Any:
    """Train the models with Adam, all in one program."""
    adam = optax.adam(optax.cosine_decay_schedule(0.01, steps))
    optimiser = optax.chain(optax.clip_by_global_norm(1.0), adam)
    options: Any = dict(key=keys, progress=False, throw=False)
    return fit(loss, models, optimiser, steps, **options).model


FAMILIES: dict[str, dict[str, Callable[[str, Environment], Any]]] = {
    "Feedback": {
        "zero": lambda name, env: controllers.Zero(env.control_size),
        "PID": _following,
        "LQR": lambda name, env: _regulator(name, env, controllers.LQR),
        "FiniteHorizonLQR": lambda name, env: _regulator(
            name, env, controllers.FiniteHorizonLQR, horizon=env.horizon
        ),
        "HInfinity": lambda name, env: _regulator(name, env, controllers.HInfinity),
    },
    "Online learning": {
        "GPC": lambda name, env: _learning(name, env, controllers.gpc),
        "Adaptive": lambda name, env: controllers.Adaptive(agent_of(name, "GPC")),
        "NeuralGPC": lambda name, env: _learning(
            name, env, controllers.neural_gpc, key=jax.random.key(0)
        ),
        "DRC": lambda name, env: _learning(name, env, controllers.drc),
        "SFC": lambda name, env: _learning(name, env, controllers.sfc),
        "DSC": lambda name, env: _learning(name, env, controllers.sfc, double=True),
        "BPC": lambda name, env: controllers.BPC(env.dynamics, agent_of(name, "LQR")),
    },
    "Planning": {
        "MPC": lambda name, env: _receding(name, env, ILQR, max_iterations=8),
        "SQP": lambda name, env: _receding(name, env, SQP, max_iterations=8),
        "RTI": lambda name, env: _receding(name, env, SQP, real_time=True),
        "MPPI": lambda name, env: _receding(name, env, MPPI, samples=128, iterations=3),
        "CEM": lambda name, env: _receding(name, env, CEM, samples=128, iterations=3),
    },
    "Training": {
        "affine": lambda name, env: _by_gradient(env, mlp_policy, width=1, depth=0),
        "MLP": lambda name, env: _by_gradient(env, mlp_policy, width=32, depth=1),
        "GRU": lambda name, env: _by_gradient(env, _gru),
        "SHAC": lambda name, env: _by_actor_critic(env, SHAC),
        "PPO": lambda name, env: _by_actor_critic(env, PPO),
    },
}
"""The methods by family. Each method makes a controller for the task of a name."""


TRAINED = tuple(FAMILIES["Training"])


@functools.cache
def agent_of(name: str, method: str) -> Any:
    """The controller of a method, designed at the operating point of the task, or the
    batch of trained controllers.

    **Raises:** `Unsuitable` if the task lacks what the method needs.
    """
    (maker,) = (family[method] for family in FAMILIES.values() if method in family)
    try:
        return maker(name, task_of(name))
    except (ValueError, RuntimeError) as error:
        raise Unsuitable(str(error)) from error


METHODS = (*(name for family in FAMILIES.values() for name in family), "plan")
# The number of seeds that are run and timed in one batch.
BATCH = 8
# The least time to measure [s].
TIMED = 0.3


# The methods whose controls start the plan, beside zero control.
GUIDES = ("MLP", "GRU", "MPC")
PUMPED = ("mountain_car", "mountain_car_discrete")


def _planned(env: Environment, guides: list[Any], key: Any) -> Any:
    """The best controls of iLQR for a known start and known disturbances. It starts
    from zero control and from each guide. If the controls of a guide cost less, they
    are taken."""
    best, least = None, np.inf
    for agent in (Zero(env.control_size), *guides):
        run: Any = rollout(env, agent, key=key, throw=False)
        guess = jnp.nan_to_num(run.controls)
        options: Any = dict(bounds=env.control_bounds, max_iterations=100, throw=False)
        options["w"] = run.disturbances if env.disturbance_size else None
        plan = ilqr(env.dynamics, env.cost, run.states[0], guess, **options)
        for controls in (guess, plan.controls):
            cost = float(_cost(env, OpenLoop(controls), key))
            if np.isfinite(cost) and cost < least:
                best, least = controls, cost
    if best is None:
        raise Unsuitable("no plan was found")
    return OpenLoop(best)


def _members(agent: Any, method: str) -> list[Any]:
    """The controllers of a batch, one for each training, or the single controller."""
    if method not in TRAINED:
        return [agent]
    of = lambda k: jax.tree.map(lambda a: a[k] if eqx.is_array(a) else a, agent)
    return [of(k) for k in range(TRAINING_SEEDS)]


def _suited(task: str, method: str) -> Any:
    """The controller of a method (the first if several are trained), or `None` if it
    does not suit the task."""
    try:
        return _members(agent_of(task, method), method)[0]
    except Unsuitable:
        return None


@eqx.filter_jit
def _cost(env: Environment, agent: Any, key: Any) -> Any:
    run: Any = rollout(env, agent, key=key, keep=(), throw=False)
    # A learner that refuses an update keeps its weights, and the run goes on.
    refused = run.result == RESULTS.update_refused
    return jnp.where(run.failed & ~refused, jnp.nan, run.total_cost)


@eqx.filter_jit
def _costs(env: Environment, agent: Any, keys: Any) -> Any:
    return jax.vmap(lambda key: _cost(env, agent, key))(keys)


def _keys(block: int) -> Any:
    """The keys of the episodes of a block of seeds."""
    seeds = range(block * BATCH, (block + 1) * BATCH)
    return jax.vmap(jax.random.key)(jnp.array(seeds))


def costs_of(task: str, agent: AbstractController) -> list[float]:
    """The costs of your own controller, from the starts of the scoreboard."""
    return np.asarray(_costs(task_of(task), agent, _keys(0))).tolist()


@functools.cache
def _batch(task: str, method: str, block: int) -> tuple[Any, float | None]:
    """The costs of a block of seeds, with a row for each training, and the microseconds
    per step of the first controller."""
    env, keys = task_of(task), _keys(block)
    if method == "plan":
        guides = [agent for name in GUIDES if (agent := _suited(task, name))]
        if task in PUMPED:
            guides.append(EnergyPumping(jnp.ones(1)))
        plans = [_planned(env, guides, key) for key in keys]
        pairs = zip(plans, keys, strict=True)
        return np.array([[_cost(env, plan, key) for plan, key in pairs]]), None
    agents, best, spent = _members(agent_of(task, method), method), np.inf, 0.0
    costs = np.array([_costs(env, agent, keys) for agent in agents])
    while spent < TIMED:
        begin = time.perf_counter()
        jax.block_until_ready(_costs(env, agents[0], keys))
        took = time.perf_counter() - begin
        best, spent = min(best, took), spent + took
    return costs, 1e6 * best / (BATCH * env.horizon)


@experiment.parametrize("task", [name for name in registered() if "/" not in name])
@experiment.parametrize("method", METHODS)
@experiment.seeds(BATCH)
def scoreboard(task: str, method: str, seed: int) -> dict[str, Any]:
    """The cost of an episode (the median over several trainings), the cost of each
    training, and the microseconds per step."""
    try:
        batch, speed = _batch(task, method, seed // BATCH)
    except Unsuitable as error:
        nothing = dict.fromkeys(("cost", "trainings", "us_per_step"))
        return nothing | {"unsuitable": str(error)[:200]}
    costs = batch[:, seed % BATCH].astype(float)
    middle = float(np.median(np.where(np.isfinite(costs), costs, np.inf)))
    trainings = costs.tolist() if method in TRAINED else None
    return {
        "cost": middle,
        "trainings": trainings,
        "us_per_step": speed,
        "unsuitable": None,
    }
