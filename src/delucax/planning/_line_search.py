"""How far along a direction to go."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array

from ._lq import Policy
from ._problem import Problem, roll_out


SEARCHES = ("parallel", "backtracking")
HALVINGS = 12
"""The shortest step tried is 2^-11 of the full one."""
LEAST_SHARE = 1e-4
"""Of the improvement that the model promises, what a step must bring."""


class Iterate(NamedTuple):
    """The trajectory to go on with."""

    states: Array
    controls: Array
    cost: Array
    gaps: Array | None
    accepted: Array
    rollouts: Array


def first_accepted(
    trial: Callable[[Array], tuple[Any, Array]], count: int, otherwise: Any
) -> tuple[Array, Any, Array]:
    """Of the candidates `0, ..., count - 1`, one after the other, the first that
    `trial` accepts: how many were tried, the last of them, and whether it was accepted.
    `otherwise` has the form of a candidate."""

    def body(carry):
        tried, *_ = carry
        return tried + 1, *trial(tried)

    def going(carry):
        tried, _, accepted = carry
        return ~accepted & (tried < count)

    return lax.while_loop(going, body, (jnp.asarray(0), otherwise, jnp.asarray(False)))


def search(
    kind: str,
    problem: Problem,
    now: Iterate,
    policy: Policy,
    penalty: Array,
    rounding: Array,
) -> Iterate:
    """The first step, of those from long to short, that brings enough; or none.

    What counts is the cost, plus `penalty` times the sum of the gaps where there are
    any. It is known to within `rounding`.
    """
    missed = 0.0 if now.gaps is None else jnp.sum(jnp.abs(now.gaps))
    slack = rounding + 10 * jnp.finfo(now.cost.dtype).eps * jnp.abs(now.cost)
    lengths = 0.5 ** jnp.arange(HALVINGS, dtype=now.cost.dtype)

    def trial(length):
        states, controls, cost = roll_out(
            problem, now.states, now.controls, policy.K, policy.k, length, now.gaps
        )
        curvature = length * policy.curvature / 2
        promise = length * (penalty * missed - policy.slope - curvature)
        gain = now.cost - cost + length * penalty * missed
        enough = gain >= LEAST_SHARE * promise - slack
        return (states, controls, cost), enough & jnp.isfinite(cost)

    last = now.states, now.controls, now.cost
    if kind == "parallel":
        candidates, enough = jax.vmap(trial)(lengths)
        best = jnp.argmax(enough)
        accepted, length, tried = enough[best], lengths[best], jnp.asarray(HALVINGS)
        candidate = jax.tree.map(lambda a: a[best], candidates)
    else:
        step = lambda i: trial(lengths[i])
        tried, candidate, accepted = first_accepted(step, HALVINGS, last)
        length = lengths[tried - 1]
    keep = lambda new, old: jnp.where(accepted, new, old)
    gaps = None if now.gaps is None else keep((1 - length) * now.gaps, now.gaps)
    rollouts = now.rollouts + tried
    states, controls, cost = jax.tree.map(keep, candidate, last)
    return Iterate(states, controls, cost, gaps, accepted, rollouts)
