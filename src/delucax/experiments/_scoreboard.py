"""Every task crossed with every controller that suits it.

`python -m delucax run scoreboard` runs it for whoever wants to see; `python -m
benchmarks.scoreboard` runs it for the committed results and their page.
"""

import functools
import time
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

from ..controllers import Deep, GPC, HInfinity, LeakyPID, LQR, Sequence, Zero
from ..disturbances import Gaussian
from ..dynamics import linearize
from ..environments import Environment, make, registered, UniformState
from ..lung import Breathing
from ..planning import ilqr
from ..simulation import rollout
from ..training import expected_cost, fit
from ._experiment import experiment


METHODS = ("zero", "PID", "LQR", "H-infinity", "GPC", "MLP", "plan")
TRAINING_STEPS = 200
# Seeds that are run, and timed, in one batch.
BATCH = 8
REPEATS = 5


def tasks() -> tuple[str, ...]:
    """The named tasks, each once."""
    return tuple(name for name in registered() if "/" not in name)


class Unsuitable(Exception):
    """A controller is not made for such a task."""


def task_of(name: str) -> Environment:
    """The task, with what it needs drawn from a fixed key."""
    if name == "neural":
        return make(name, width=8, key=jax.random.key(0))
    if name != "lds":
        return make(name)
    box = UniformState(-jnp.ones(4), jnp.ones(4))
    return make(
        name,
        key=jax.random.key(0),
        states=4,
        controls=2,
        spectral_radius=1.05,
        initial_state=box,
        disturbance=Gaussian(0.1, size=4),
    )


@functools.cache
def _agent(name: str, method: str) -> Any:
    """A controller with its defaults, designed at the equilibrium or trained.

    **Raises:** `Unsuitable` if it needs what the task has not got.
    """
    env = _task(name)
    if method == "zero":
        return Zero(env.control_size)
    if method == "MLP":
        return _trained(env)
    if method == "PID":
        return _following(env)
    try:
        model, Q, R = _local(name)
        options: dict[str, Any] = {"difference": env.dynamics.difference}
        regulator = LQR(model, Q, R, **options)
        if method == "LQR":
            return regulator
        if method == "H-infinity":
            return HInfinity(model, Q, R, **options)
        return GPC(env.dynamics, env.cost, base=regulator)
    except (ValueError, RuntimeError) as error:
        raise Unsuitable(str(error)) from error


def _following(env: Environment) -> Any:
    """A PID on the waveform that a lung is to breathe as."""
    waveform = getattr(env.cost, "waveform", None)
    if waveform is None:
        raise Unsuitable("the cost follows no waveform")
    return Breathing(LeakyPID(dt=env.dt, reference=waveform), waveform)


@functools.cache
def _local(name: str) -> tuple[Any, Any, Any]:
    """The linear model at the equilibrium and the curvature of the cost there, with
    what a design needs added where it is flat."""
    env = _task(name)
    x, u = env.dynamics.equilibrium()
    model = linearize(env.dynamics, jnp.zeros(()), x, u)
    n = x.shape[0]

    def charged(z: Any) -> Any:
        return env.cost(jnp.zeros(()), x + z[:n], u + z[n:])

    H = np.asarray(jax.hessian(charged)(jnp.zeros(n + u.shape[0]))) / 2
    if not np.all(np.isfinite(H)):
        raise Unsuitable("the cost has no curvature at the equilibrium")
    values, vectors = np.linalg.eigh(H)
    scale = max(values.max(), 1e-3)
    H = vectors * np.clip(values, 1e-4 * scale, None) @ vectors.T
    return model, jnp.asarray(H[:n, :n]), jnp.asarray(H[n:, n:])


def _trained(env: Environment) -> Any:
    """An MLP by gradient descent through the rollout, the same way for every task."""
    init_key, fit_key = jax.random.split(jax.random.key(1))
    network = Deep(env, width=32, depth=1, key=init_key)
    horizon = min(env.horizon, 100)
    loss = expected_cost(env, batch=32, horizon=horizon, gradient_decay=0.95)
    optimiser = optax.chain(
        optax.clip_by_global_norm(1.0),
        optax.adam(optax.cosine_decay_schedule(0.01, TRAINING_STEPS)),
    )
    options = {"key": fit_key, "progress": False, "throw": False}
    return fit(loss, network, optimiser, TRAINING_STEPS, **options).model


@functools.cache
def _task(name: str) -> Environment:
    return task_of(name)


def _planned(env: Environment, network: Any, key: Any) -> Any:
    """The controls that iLQR finds for a run whose start and disturbances it knows,
    from no control and from what the network does."""
    best, least = None, np.inf
    for agent in (Zero(env.control_size), network):
        run: Any = rollout(env, agent, key=key, throw=False)
        guess = jnp.nan_to_num(run.controls)
        plan = ilqr(
            env.dynamics,
            env.cost,
            run.states[0],
            guess,
            w=run.disturbances if env.disturbance_size else None,
            bounds=env.control_bounds,
            max_iterations=100,
            throw=False,
        )
        found = float(_cost(env, Sequence(plan.controls), key))
        if np.isfinite(found) and found < least:
            best, least = plan.controls, found
    if best is None:
        raise Unsuitable("no plan was found")
    return Sequence(best)


@eqx.filter_jit
def _cost(env: Environment, agent: Any, key: Any) -> Any:
    return rollout(env, agent, key=key, keep=(), throw=False).total_cost


@eqx.filter_jit
def _costs(env: Environment, agent: Any, keys: Any) -> Any:
    return jax.vmap(lambda key: _cost(env, agent, key))(keys)


@functools.cache
def _batch(task: str, method: str, block: int) -> tuple[list[float], float | None]:
    """The costs of a block of seeds, and microseconds a step of one of them."""
    env = _task(task)
    seeds = range(block * BATCH, (block + 1) * BATCH)
    keys = jax.vmap(jax.random.key)(jnp.array(seeds))
    if method == "plan":
        network = _agent(task, "MLP")
        plans = [_planned(env, network, key) for key in keys]
        found = [_cost(env, plan, key) for plan, key in zip(plans, keys, strict=True)]
        return [float(cost) for cost in found], None
    agent, best = _agent(task, method), np.inf
    costs = np.asarray(_costs(env, agent, keys))
    for _ in range(REPEATS):
        begin = time.perf_counter()
        jax.block_until_ready(_costs(env, agent, keys))
        best = min(best, time.perf_counter() - begin)
    return costs.tolist(), 1e6 * best / (BATCH * env.horizon)


@experiment.parametrize("task", tasks())
@experiment.parametrize("method", METHODS)
@experiment.seeds(BATCH)
def scoreboard(task: str, method: str, seed: int) -> dict[str, Any]:
    """The cost of an episode, and microseconds a step."""
    try:
        costs, speed = _batch(task, method, seed // BATCH)
    except Unsuitable as error:
        return {"cost": None, "us_per_step": None, "unsuitable": str(error)[:200]}
    return {"cost": costs[seed % BATCH], "us_per_step": speed, "unsuitable": None}
