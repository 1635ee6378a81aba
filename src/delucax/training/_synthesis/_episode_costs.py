"""The costs of episodes, as the search of `synthesise` compares them."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array

from ..._controller import AbstractController
from ..._typing import PRNGKey
from ...controllers import local_mpc, OpenLoop
from ...environments import Environment, randomise
from ...planning import ILQR
from ...simulation import rollout
from .._costs import nan_if_failed


# Costs far above this multiple of the usual cost grow like their logarithm.
_FAR = 20.0
_QUIETLY: Any = dict(keep=(), throw=False)


def tamed(costs: Array, usual: Any) -> Array:
    """Costs, compressed: those far above the usual cost grow like their logarithm only.

    Without this, a single episode in which the plant runs away, at a cost of a million,
    would outweigh all others. A cost that is not finite becomes the largest number.
    """
    far = _FAR * usual
    costs = jnp.nan_to_num(jnp.where(jnp.isnan(costs), jnp.inf, costs))
    # The ratio overflows if a cost is the largest number and the usual cost is small.
    ratio = jnp.nan_to_num(jnp.abs(costs) / far)
    return jnp.sign(costs) * far * jnp.log1p(ratio)


class TamedCost(eqx.Module):
    """The mean tamed cost of several episodes."""

    episode: Any
    usual: Array
    episodes: int = eqx.field(static=True)

    def __call__(self, policy: AbstractController, key: PRNGKey) -> Array:
        keys = jr.split(key, self.episodes)
        return jnp.mean(
            tamed(jax.vmap(lambda key: self.episode(policy, key))(keys), self.usual)
        )


def is_hidden(environment: Environment) -> bool:
    """Whether a policy needs a memory, because an observation is not the state."""
    observes_state = environment.dynamics.observes_state
    return not observes_state or environment.sensor_noise is not None


def on_plants(
    environment: Environment, ranges: dict[str, Any] | None, keys: Array, of: Any
) -> Any:
    """`of(plant, key)` for each key, with plants drawn as in `expected_cost`."""

    def one(key):
        if ranges is None:
            return of(environment, key)
        key, plant_key = jr.split(key)
        return of(randomise(environment, plant_key, ranges), key)

    return jax.vmap(one)(keys)


@eqx.filter_jit
def costs_of(environment, ranges, policy, keys):
    """The total cost of a policy in each episode, or NaN if the rollout fails."""

    def of(plant, key):
        run = rollout(plant, policy, key=key, **_QUIETLY)
        return nan_if_failed(run, run.total_cost)

    return on_plants(environment, ranges, keys, of)


@eqx.filter_jit
def costs_of_mpc(environment, ranges, lqr, keys):
    """The total cost of MPC in each episode, for the plant of that episode."""

    def of(plant, key):
        mpc = local_mpc(plant, lqr, throw=False)
        run = rollout(plant, mpc, key=key, **_QUIETLY)
        return nan_if_failed(run, run.total_cost)

    return on_plants(environment, ranges, keys, of)


@eqx.filter_jit
def costs_of_plan(environment, ranges, policy, keys):
    """The total cost in each episode of a plan that knows the disturbances.

    The planner starts from the controls of the policy. If the plan costs more than the
    policy, the cost of the policy counts.
    """

    def of(plant, key):
        keep = ("states", "controls", "disturbances")
        run: Any = rollout(plant, policy, key=key, keep=keep, throw=False)
        # Where the run diverges, its controls are not finite, and no plan starts there.
        start = jnp.nan_to_num(run.controls)
        given: Any = dict(w=run.disturbances, bounds=plant.control_bounds, throw=False)
        x0, planner = run.states[0], ILQR(max_iterations=100)
        plan = planner(plant.dynamics, plant.cost, x0, start, **given)
        planned = rollout(plant, OpenLoop(plan.controls), key=key, **_QUIETLY)
        costs = (nan_if_failed(each, each.total_cost) for each in (planned, run))
        return jnp.fmin(*costs)

    return on_plants(environment, ranges, keys, of)


@eqx.filter_jit
def first_steps(environment, ranges, keys):
    """Initial states, and under several controls the cost of a step and of an end
    there, and the next state."""
    m, bounds = environment.control_size, environment.control_bounds
    controls = jnp.concatenate([jnp.zeros((1, m)), jr.normal(keys[0], (15, m))])
    if bounds is not None:
        low, high = (jnp.nan_to_num(jnp.broadcast_to(e, m)) for e in bounds)
        controls = jnp.concatenate([controls, low[None], high[None]])

    def of(plant, key):
        x0 = plant.reset(plant.split_key(key)[0])
        steps = jax.vmap(lambda u: plant.step(jnp.zeros(()), x0, u))(controls)
        end = plant.cost.final(plant.horizon * plant.dt, x0)
        return x0, steps.cost + end, steps.state

    return on_plants(environment, ranges, keys, of)
