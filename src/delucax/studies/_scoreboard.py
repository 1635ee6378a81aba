"""Every task crossed with the controllers that suit it.

`python -m delucax run scoreboard` runs it; `python -m benchmarks.scoreboard` makes the
committed results and their page.
"""

import functools
import time
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..controllers import OpenLoop, Zero
from ..environments import Environment
from ..experiments import experiment
from ..planning import ilqr
from ..simulation import rollout
from ._listing import task_names
from ._methods import agent_of, FAMILIES, Pump, task_of, Unsuitable


METHODS = (*(name for family in FAMILIES.values() for name in family), "plan")
# Seeds that are run, and timed, in one batch.
BATCH = 8
# Seconds that are timed, at least.
TIMED = 0.3


# What the plan begins at, beside no control.
GUIDES = ("MLP", "GRU", "MPC")
PUMPED = ("mountain_car", "mountain_car_discrete")


def _planned(env: Environment, guides: list[Any], key: Any) -> Any:
    """The controls that iLQR finds for a run whose start and disturbances it knows,
    from no control and from what each of the guides does, if they cost less than that.
    """
    best, least = None, np.inf
    for agent in (Zero(env.control_size), *guides):
        run: Any = rollout(env, agent, key=key, throw=False)
        guess = jnp.nan_to_num(run.controls)
        w = run.disturbances if env.disturbance_size else None
        options: Any = dict(w=w, bounds=env.control_bounds, throw=False)
        problem = env.dynamics, env.cost, run.states[0], guess
        plan = ilqr(*problem, max_iterations=100, **options)
        for controls in (guess, plan.controls):
            cost = float(_cost(env, OpenLoop(controls), key))
            if np.isfinite(cost) and cost < least:
                best, least = controls, cost
    if best is None:
        raise Unsuitable("no plan was found")
    return OpenLoop(best)


def _suited(task: str, method: str) -> Any:
    """The controller, or none if it does not suit."""
    try:
        return agent_of(task, method)
    except Unsuitable:
        return None


@eqx.filter_jit
def _cost(env: Environment, agent: Any, key: Any) -> Any:
    return rollout(env, agent, key=key, keep=(), throw=False).total_cost


@eqx.filter_jit
def _costs(env: Environment, agent: Any, keys: Any) -> Any:
    return jax.vmap(lambda key: _cost(env, agent, key))(keys)


@functools.cache
def _batch(task: str, method: str, block: int) -> tuple[list[float], float | None]:
    """The costs of a block of seeds, and microseconds a step of one of them."""
    env = task_of(task)
    seeds = range(block * BATCH, (block + 1) * BATCH)
    keys = jax.vmap(jax.random.key)(jnp.array(seeds))
    if method == "plan":
        guides = [agent for name in GUIDES if (agent := _suited(task, name))]
        if task in PUMPED:
            guides.append(Pump(jnp.ones(1)))
        plans = [_planned(env, guides, key) for key in keys]
        pairs = zip(plans, keys, strict=True)
        return [float(_cost(env, plan, key)) for plan, key in pairs], None
    agent, best, spent = agent_of(task, method), np.inf, 0.0
    costs = np.asarray(_costs(env, agent, keys))
    while spent < TIMED:
        begin = time.perf_counter()
        jax.block_until_ready(_costs(env, agent, keys))
        took = time.perf_counter() - begin
        best, spent = min(best, took), spent + took
    return costs.tolist(), 1e6 * best / (BATCH * env.horizon)


@experiment.parametrize("task", task_names())
@experiment.parametrize("method", METHODS)
@experiment.seeds(BATCH)
def scoreboard(task: str, method: str, seed: int) -> dict[str, Any]:
    """The cost of an episode, and microseconds a step."""
    try:
        costs, speed = _batch(task, method, seed // BATCH)
    except Unsuitable as error:
        return {"cost": None, "us_per_step": None, "unsuitable": str(error)[:200]}
    return {"cost": costs[seed % BATCH], "us_per_step": speed, "unsuitable": None}
