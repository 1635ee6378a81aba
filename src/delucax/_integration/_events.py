"""Find where guards cross zero within a step.

A cubic through each guard detects a crossing. Newton's method on the length of the step
locates it.
"""

import functools
from collections.abc import Callable, Iterable
from typing import NamedTuple

import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array

from .._jax import by_components


class Crossings(NamedTuple):
    """The crossings of the guards along a step, one entry for each event. Times are
    fractions of the step. Each guard is multiplied by its `sign`, so that it falls
    where its event fires.

    - `sign`: 1 or -1.
    - `expected`: whether the guard is expected to cross zero.
    - `low`, `high`: the guard falls between these, from positive to negative.
    - `guess`: where the cubic through its values and rates at both ends is zero.
    - `at_once`: whether it starts at zero and crosses there, or is `late`.
    - `late`: whether it is urgent and starts beyond zero.
    - `beyond`: whether it starts beyond zero and is not urgent.
    - `past_end`: whether its value at the end of the step shows the crossing. If not,
        the cubic dips below zero and comes back within the step.
    - `slope`: its change over the step, if the rate at the start were constant.
    - `least_slope`: below this slope the guard grazes zero.
    """

    sign: Array
    expected: Array
    low: Array
    high: Array
    guess: Array
    at_once: Array
    late: Array
    beyond: Array
    past_end: Array
    slope: Array
    least_slope: Array


def pick(rows: Iterable[Array], index: Array) -> Array:
    """The row `index`, by one `where` per row, because a batch of gathers is slow."""
    first, *others = rows
    for i, row in enumerate(others, 1):
        first = jnp.where(index == i, row, first)
    return first


def any_of(flags: Iterable[Array]) -> Array:
    """Whether one of a few flags is set."""
    return functools.reduce(jnp.logical_or, flags)


def least(values: Iterable[Array]) -> tuple[Array, Array]:
    """The smallest of a few values, and its first index."""
    value, *others = values
    index = jnp.asarray(0)
    for i, other in enumerate(others, 1):
        index = jnp.where(other < value, i, index)
        value = jnp.minimum(value, other)
    return value, index


def crossings(
    starts: tuple[Array, Array],
    ends: tuple[Array, Array],
    slack: Array,
    margin: Array,
    directions: Array,
    urgent: Array,
    passing: Array,
    enabled: tuple[Array, Array],
    has_length: Array,
    noise: Array,
) -> Crossings:
    """The crossings of guards along a step.

    **Arguments:**

    - `starts`, `ends`: at each end of the step, the guards and their rates times the
        length of the step.
    - `slack`, `margin`: a guard smaller than this counts as zero at the start, and at
        the end.
    - `directions`: -1 falling, 1 rising, 0 both.
    - `urgent`: the events that also fire at the start of a step if they start beyond
        zero.
    - `passing`: the events that may start beyond zero, and then do not fire.
    - `enabled`: which events are enabled at each end.
    - `has_length`: whether the step is longer than a rounding of its interval. In a
        shorter step no crossing is expected; the next step starts with it.
    - `noise`: the rounding error of the guards.
    """
    (g0, r0), (g1, r1) = starts, ends
    on_guard = jnp.abs(g0) <= slack
    either = directions == 0
    # A guard that may cross either way gets the sign that makes it fall from its start.
    own = jnp.where(jnp.where(on_guard, r0, g0) < 0, -1, 1)
    sign = jnp.where(either, own, -directions).astype(g0.dtype)
    g0, r0, g1, r1 = (sign * a for a in (g0, r0, g1, r1))
    beyond = g0 < -slack
    late = beyond & urgent & enabled[0] & has_length
    at_once = on_guard & (r0 < 0) & ~passing & enabled[0] & has_length | late
    # An event that is already past its guard cannot fire before the guard comes back.
    gone = beyond | on_guard & (r0 < 0)
    # A guard that grazes has no meaningful zero to correct to.
    near = -g0 / jnp.where(r0 < 0, r0, -1)
    small = jnp.abs(near) < jnp.finfo(g0.dtype).eps ** 0.25
    near = jnp.where(small & on_guard, near, 0)
    a = jnp.where(on_guard, 0, g0)
    # Hermite's cubic a + r0 z + c z^2 + d z^3, and where it is smallest and largest. Of
    # each pair of formulas, the one without cancellation is taken.
    c, d = 3 * (g1 - a) - 2 * r0 - r1, 2 * (a - g1) + r0 + r1
    discriminant = c * c - 3 * d * r0
    root = jnp.sqrt(jnp.maximum(discriminant, 0))
    up = c > 0
    total = jnp.where(up, c + root, root - c)
    total = jnp.where(total == 0, 1, total)
    three = jnp.where(d == 0, 1, 3 * d)
    lowest = jnp.where(up, -r0 / total, jnp.where(d == 0, 2, total / three))
    highest = jnp.where(up, jnp.where(d == 0, -1, -total / three), r0 / total)

    def cubic(z):
        return a + z * (r0 + z * (c + z * d)), r0 + z * (2 * c + z * 3 * d)

    inside = lambda z, end: (discriminant > 0) & (z > 0) & (z < end)
    dips = inside(lowest, 1.0) & (cubic(lowest)[0] < 0)
    # A guard that is zero at the end, up to rounding, is left to the start of the next
    # step: whether it is just below zero depends on how a program rounds. A guard that
    # may be on either side fires here, because the next start could not tell. A step
    # that starts and ends on the guard, as one of no length does, crosses nothing.
    margin = jnp.where(on_guard, jnp.maximum(slack, margin), margin)
    ends_on = (g1 <= margin) & (r1 < 0)
    ends_on &= either & ~on_guard | passing & (~on_guard | (r0 > 0))
    ends_beyond = (g1 < -margin) | ends_on
    high = jnp.where(dips, jnp.clip(lowest, 0, 1), 1.0)
    low = jnp.where(inside(highest, high), jnp.clip(highest, 0, 1), 0.0)

    expected = ~gone & (dips | ends_beyond) & (enabled[0] | enabled[1])
    # A few Newton steps from the chord give the start of the search.
    left, right, (v0, v1) = low, high, (cubic(low)[0], cubic(high)[0])
    guess = low + (high - low) * jnp.clip(v0 / jnp.where(v0 > v1, v0 - v1, 1), 0, 1)
    for _ in range(4):
        value, slope = cubic(guess)
        left = jnp.where(value < 0, left, guess)
        right = jnp.where(value < 0, guess, right)
        newton = guess - value / jnp.where(slope == 0, 1, slope)
        good = (newton >= left) & (newton <= right)
        guess = jnp.where(good, newton, (left + right) / 2)
    # The slope at the crossing of a parabola that dips below zero by its rounding.
    curved = 2 * jnp.sqrt(jnp.abs(g1 - a - r0) * noise)
    size = jnp.abs(a) + jnp.abs(g1) + jnp.abs(r0) + jnp.abs(r1)
    least_slope = jnp.maximum(jnp.finfo(g0.dtype).eps ** 0.5 * size, curved)
    return Crossings(
        sign=sign,
        expected=expected & has_length | at_once,
        low=low,
        high=high,
        guess=jnp.where(at_once, near, guess),
        at_once=at_once,
        late=late,
        beyond=beyond & ~either & ~urgent & ~passing & enabled[0],
        past_end=ends_beyond & ~dips,
        slope=r0,
        least_slope=least_slope,
    )


def locate(
    guards: Callable[[Array], tuple[Array, Array]], crossing: Crossings, active: Array
) -> tuple[Array, Array, Array, Array]:
    """The first crossing in a step, by Newton's method on the length of the step within
    a bracket.

    **Arguments:**

    - `guards`: maps a fraction of the step to the guards there, and to their rates
        there times the length of the step.
    - `crossing`: the expected crossings.
    - `active`: whether a crossing is expected. If not, nothing is computed.

    **Returns:** `(share, event, crossed, grazes)`: the fraction of the step at the
    crossing; the index of the event; whether there is a crossing (a cubic may dip below
    zero where the step does not, and `share` is then 1); and whether the guard only
    grazes zero.
    """
    eps = jnp.finfo(crossing.guess.dtype).eps
    # If several guards cross at the same time, the first in order of names is taken.
    start, event = least(jnp.where(crossing.expected, crossing.guess, 2.0))
    # Checked again, because rounding of the guards may differ in the caller's program.
    active = active & any_of(crossing.expected)
    at_once = active & any_of(crossing.at_once)
    past_end = any_of(crossing.expected & crossing.past_end)
    high = jnp.where(past_end, 1.0, 2.0).astype(start.dtype)

    @by_components
    def look(state):
        _, left, right, share, _, _, crossed, count = state
        g, rate = (crossing.sign * a for a in guards(share))
        falling = crossing.expected & (share >= crossing.low)
        below = any_of(falling & (g < 0))
        left, right = jnp.where(below, left, share), jnp.where(below, share, right)
        newton = share - g / jnp.where(rate < 0, rate, -1)
        newton = jnp.where(falling & (rate < 0), newton, 2.0)
        # A guard that does not fall yet can cross only later.
        after, event = least(
            jnp.where(crossing.expected & ~falling, crossing.guess, newton)
        )
        apart = jnp.abs(after - share)
        # Close enough, because Newton's next error is about the square of this step.
        near = apart < 0.3 * eps**0.5
        done = near | (right - left < 2 * eps)
        inside = near | (after > left) & (after < right)
        after = jnp.where(inside, after, (left + jnp.minimum(right, 1)) / 2)
        crossed = crossed | below | near
        slope = pick(rate, event)
        more = ~done & (count < 60)
        return more, left, right, after, event, slope, crossed, count + 1

    left, slope = jnp.zeros_like(start), pick(crossing.slope, event)
    state = (active & ~at_once, left, high, start, event, slope, past_end, 0)
    state = lax.while_loop(lambda state: state[0], look, state)
    _, _, _, share, event, slope, crossed, _ = state
    crossed = active & (crossed | at_once)
    # A guard grazes if its slope is negligible beside its changes along the step.
    grazes = crossed & (-slope < pick(crossing.least_slope, event))
    return jnp.where(crossed, jnp.minimum(share, 1), 1), event, crossed, grazes
