"""How far along a direction to go."""

from typing import NamedTuple

import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array

from ._lq import Policy
from ._problem import Problem, roll_out


SEARCHES = ("parallel", "backtracking", "deluca")
HALVINGS = 12
"""The shortest step tried is 2^-11 of the full one."""
DELUCA_TRIES = 10
LEAST_SHARE = 1e-4
"""Of the improvement that the model promises, what a step must bring."""


class Found(NamedTuple):
    """The trajectory to go on with."""

    states: Array
    controls: Array
    cost: Array
    gaps: Array | None
    accepted: Array
    length: Array
    rollouts: Array


def search(
    kind: str,
    problem: Problem,
    now: Found,
    policy: Policy,
    penalty: Array,
    rounding: Array,
) -> Found:
    """The first step, of those from long to short, that brings enough; or none.

    What counts is the cost, plus `penalty` times the sum of the gaps where there are
    any. It is known to within `rounding`.
    """
    missed = 0.0 if now.gaps is None else jnp.sum(jnp.abs(now.gaps))
    slack = rounding + 10 * jnp.finfo(now.cost.dtype).eps * jnp.abs(now.cost)

    def trial(length):
        states, controls, cost = roll_out(
            problem, now.states, now.controls, policy.K, policy.k, length, now.gaps
        )
        if kind == "deluca":
            return states, controls, cost, cost <= now.cost
        bent = length * policy.curvature / 2
        promise = length * (penalty * missed - policy.slope - bent)
        gain = now.cost - cost + length * penalty * missed
        enough = gain >= LEAST_SHARE * promise - slack
        return states, controls, cost, enough & jnp.isfinite(cost)

    dtype = now.cost.dtype
    if kind == "deluca":
        # The step that was accepted last is where the next search starts, so that the
        # steps may grow beyond 1.
        tries = jnp.arange(DELUCA_TRIES, dtype=dtype)
        lengths = now.length * 1.1 * 1.1 ** (-(tries**2))
    else:
        lengths = 0.5 ** jnp.arange(HALVINGS, dtype=dtype)
    count = lengths.shape[0]
    if kind == "parallel":
        states, controls, cost, enough = jax.vmap(trial)(lengths)
        best = jnp.argmax(enough)
        accepted, length = enough[best], lengths[best]
        states, controls, cost = states[best], controls[best], cost[best]
        tried = jnp.asarray(count)
    else:

        def body(carry):
            tried, *_ = carry
            return tried + 1, *trial(lengths[tried])

        def going(carry):
            tried, *_, enough = carry
            return ~enough & (tried < count)

        start = (jnp.asarray(0), now.states, now.controls, now.cost, jnp.asarray(False))
        tried, states, controls, cost, accepted = lax.while_loop(going, body, start)
        length = lengths[tried - 1]
    keep = lambda new, old: jnp.where(accepted, new, old)
    return Found(
        keep(states, now.states),
        keep(controls, now.controls),
        keep(cost, now.cost),
        None if now.gaps is None else keep((1 - length) * now.gaps, now.gaps),
        accepted,
        keep(length, now.length),
        now.rollouts + tried,
    )
