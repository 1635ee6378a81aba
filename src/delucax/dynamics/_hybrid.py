"""One interval of a hybrid system: steps up to events, and the jumps at them."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._integration import (
    any_of,
    check_returned,
    Crossings,
    crossings,
    evaluate_field,
    locate,
    pick,
    TimeOffset,
)
from .._jax import bounded_while, by_components
from .._results import choose, first_failure, or_none, Result, RESULTS
from ._event_record import Events


class Ahead(NamedTuple):
    """The next step: the first along which a guard crosses zero, if there is one before
    the end.

    - `s`, `x`: time and state at the start of the step.
    - `step`: its length and the state after it; `None` if it goes to the end.
    - `x_end`: the state at the end, if no event fires before.
    - `expected`, `beyond`: for each guard, whether it crosses zero in the step, and
        whether it is beyond zero at the start.
    - `result`: the status of the solver up to the end or to that step; `None` if it
        cannot fail.
    """

    s: Array
    x: Array
    step: tuple[Array, Array] | None
    x_end: Array
    expected: Array
    beyond: Array
    result: Result | None


class HybridFlow(eqx.Module):
    """The steps, guards and resets of a hybrid system under a held control.

    `dynamics.flow(args)` makes the function of one step. `args` holds the system, the
    start time, the control and the held disturbance.
    """

    dynamics: Any
    args: Any
    guard_start: TimeOffset
    in_loop: bool = eqx.field(static=True, default=False)

    @property
    def _system(self):
        return self.args[0]

    def step(self, s: Array, x: Array, h: Array) -> tuple[Array, Result]:
        """One step of the solver."""
        return self.dynamics.flow(self.args, self.in_loop)(s, x, h)

    def guards(self, s: Array, x: Array) -> Array:
        """The guards, shape `(events,)`."""
        given = x, self.args[2]
        call = lambda t: jnp.stack(list(self._system.guards(t, *given))).astype(x.dtype)
        return self.guard_start.evaluate(s, call)

    def look(self, s: Array, x: Array) -> tuple[Array, Array]:
        """The guards and their rates."""
        system, start, u, held = self.args
        dx = start.evaluate(s, lambda t: evaluate_field(system, t, x, u, held))
        return jax.jvp(self.guards, (s, x), (jnp.ones_like(s), dx))

    def enabled(self, s: Array, x: Array) -> Array:
        """Which events are enabled."""
        rows = self._system.enabled(self.args[1].t + s, x, self.args[2])
        return jnp.stack([jnp.asarray(row, bool) for row in rows])

    def reset(self, event: Array, s: Array, x: Array) -> Array:
        """The state after an event."""
        rows = list(self._system.resets(self.args[1].t + s, x, self.args[2]))
        for row in rows:
            check_returned(row, x, self._system, "resets")
        rows = [row.astype(x.dtype) for row in rows]
        return pick(rows, event)

    def crossings(self, s: Array, x: Array, h: Array, x_end: Array) -> Crossings:
        """The crossings along a step from `x` to `x_end`."""
        system = self._system
        directions = system.event_directions or (-1,) * len(system.event_names)
        ends = ((s, x), (s + h, x_end))
        (g0, r0), (g1, r1) = (self.look(*end) for end in ends)
        enabled = self.enabled(*ends[0]), self.enabled(*ends[1])
        # A start counts as on the guard if it is within rounding of it, or within the
        # error of locating the previous event.
        eps = jnp.finfo(x.dtype).eps
        # The rounding of a guard is estimated by moving each entry of the state by a
        # different multiple of eps, so that the effects do not cancel.
        shares = jnp.asarray(1 + np.modf(np.arange(x.size) * 1.618)[0], x.dtype)
        moved = self.args[1].t + s, shares * x
        noise = 32 * eps * jnp.abs(jax.jvp(self.guards, (s, x), moved)[1])
        span = self.dynamics.dt / self.dynamics.substeps
        unit = eps**0.6 * span
        slack = noise + unit * (jnp.abs(r0) + jnp.abs(r1))
        # Smaller than the slack, so that the next step starts on the guard.
        margin = unit / 2 * jnp.abs(r1)
        values = (g0, r0 * h), (g1, r1 * h)
        zero = slack, margin
        long = h > 64 * eps * span
        special = system.urgent_events, system.crossing_events
        named = [[n in names for n in system.event_names] for names in special]
        urgent, passing = map(jnp.array, named)
        kinds = jnp.array(directions), urgent, passing
        return crossings(*values, *zero, *kinds, enabled, long, noise)

    def ahead(self, s: Array, x: Array, end: Array) -> Ahead:
        """The next step, when the whole way to `end` is one step of the solver."""
        h = end - s
        x_end, result = self.step(s, x, h)
        crossing = frozen(self).crossings(*frozen((s, x, h, x_end)))
        flags = crossing.expected, crossing.beyond
        return Ahead(s, x, None, x_end, *flags, or_none(result))


def ahead_of_steps(plant: HybridFlow, s: Array, x: Array, end: Array) -> Ahead:
    """The next step from `s` to `end`, among those of a step-size controller."""
    solution, result = plant.dynamics.solve(s, x, end, plant.args, every_step=True)
    (_, times), (last, states) = solution.ts, solution.ys
    count = solution.stats["num_accepted_steps"]
    still, (still_times, still_states) = frozen((plant, (times, states)))

    def crossings(i):
        t0, t1 = still_times[i], still_times[i + 1]
        return still.crossings(t0, still_states[i], t1 - t0, still_states[i + 1])

    def look(state):
        i, _, beyond = state
        crossing = crossings(i + 1)
        # Only the start of the first step is checked for being beyond a guard.
        return i + 1, crossing.expected, jnp.where(i < 0, crossing.beyond, beyond)

    none = jnp.zeros(len(plant.args[0].event_names), bool)
    more = lambda state: ~any_of(state[1]) & (state[0] + 1 < count)
    state = jnp.asarray(-1), none, none
    i, expected, beyond = lax.while_loop(more, look, state)
    i = jnp.maximum(i, 0)
    # The solve after the event is not used, and so neither is its status.
    result = choose(any_of(expected), RESULTS.successful, result)
    step = times[i + 1] - times[i], states[i + 1]
    return Ahead(times[i], states[i], step, last[0], expected, beyond, result)


def frozen(tree: Any) -> Any:
    """`tree` without derivatives: the search for an event is not differentiated."""
    numbers, rest = eqx.partition(tree, eqx.is_inexact_array)
    return eqx.combine(lax.stop_gradient(numbers), rest)


class Outcome(NamedTuple):
    """The end of an interval: the state, its time, whether the interval stopped before
    its end, the status, and the events if they are recorded."""

    x: Array
    s: Array
    stopped: Array
    result: Result
    events: Events | None


class _Run(NamedTuple):
    """The progress through an interval: the next step and whether an event is expected
    in it, the number of events so far, whether the interval stopped, the status and the
    recorded events."""

    ahead: Ahead
    expected: Array
    count: Array
    stopped: Array
    result: Result
    events: Events | None


class Intervals(eqx.Module):
    """Integrates an interval of a hybrid system from event to event.

    - `plant`: the steps, guards and resets.
    - `look_ahead`: a function `(s, x, end)` that gives the next step.
    - `max_events`: the interval stops after this number of events.
    - `until`: the index of an event at which it also stops.
    """

    plant: HybridFlow
    look_ahead: Callable[[Array, Array, Array], Ahead]
    max_events: int = eqx.field(static=True)
    until: int | None = eqx.field(static=True, default=None)

    def __call__(self, x: Array, dt: Array, substeps: int, record: bool) -> Outcome:
        """The interval of length `dt` from `x`. The state is held if it stops early."""
        events = Events.none(self.max_events, x) if record else None
        known = _knows(self.plant.args[0], x)
        result = choose(known, RESULTS.successful, RESULTS.unknown_mode)
        h = jnp.asarray(dt / substeps, x.dtype)

        def stretch(carry, i):
            before, count = carry
            # By i h, because the rounding of a running sum would grow.
            end = (i + 1) * h
            run = self._noted(self.look_ahead(i * h, before.x, end), count, *before[2:])
            turn = by_components(functools.partial(self._turn, end))
            run = bounded_while(lambda run: run.expected, turn, run, self.max_events)
            s, x_stop, _, x_end, *_, solved = run.ahead
            result = first_failure(run.result, _unless(run.stopped, solved))
            # If an earlier substep stopped, its time and state stay.
            s, x_stop = (
                jnp.where(before.stopped, a, b)
                for a, b in ((before.s, s), (before.x, x_stop))
            )
            x_next = jnp.where(run.stopped, x_stop, x_end).astype(x.dtype)
            s = jnp.where(run.stopped, s, end)
            return (
                Outcome(x_next, s, run.stopped, result, run.events),
                run.count,
            ), None

        start = Outcome(x, jnp.zeros_like(h), jnp.asarray(False), result, events)
        carry = start, jnp.zeros((), jnp.int32)
        if substeps == 1:
            return stretch(carry, jnp.zeros_like(h))[0][0]
        return lax.scan(stretch, carry, jnp.arange(substeps, dtype=x.dtype))[0][0]

    def _turn(self, end: Array, run: _Run) -> _Run:
        """Go to the first crossing, jump there, and look ahead again."""
        plant, (s, x, step, x_end, *_) = self.plant, run.ahead
        h, x_step = (end - s, x_end) if step is None else step
        still, (fs, fx, fh, fx_step) = frozen((plant, (s, x, h, x_step)))
        crossing = still.crossings(fs, fx, fh, fx_step)

        def guards_at(share):
            g, rate = still.look(fs + share * fh, still.step(fs, fx, share * fh)[0])
            return g, rate * fh

        share, event, crossed, grazes = locate(guards_at, crossing, run.expected)
        x_there, _ = still.step(fs, fx, share * fh)
        fires = crossed & pick(still.enabled(fs + share * fh, x_there), event)
        # A late event fires at the start, so its time does not depend on its guard.
        crosses = fires & ~pick(crossing.late, event)
        grazes = crosses & grazes

        length = _length(plant, s, x, share * fh, (event, crosses, grazes))
        # If no event fires, the step is only cut at the crossing, or taken whole.
        length = jnp.where(crosses, length, jnp.where(crossed, share * fh, h))
        x_event, solved = plant.step(s, x, length)
        s_event = s + length
        x_after = jnp.where(fires, plant.reset(event, s_event, x_event), x_event)
        # Rounding may put the event just before the step. The recorded time is not.
        early = lax.stop_gradient(jnp.maximum(s - s_event, 0))
        time, events = plant.args[1].t + (s_event + early), run.events
        result = first_failure(run.result, solved)
        failed = (result == RESULTS.successful) & grazes
        if events is not None:
            events = events.noted(fires, time, event, x_event, x_after)
            events = events.with_fault(failed, event, time)
        result = choose(failed, RESULTS.grazing, result)
        further = self.look_ahead if run.ahead.step is not None else plant.ahead
        ahead = further(s_event, x_after, end)
        stopped = run.stopped
        if self.until is not None:
            stopped = stopped | fires & (event == self.until)
            # After a stop, the state at the event is kept.
            s_stop = jnp.where(stopped, s_event, ahead.s)
            ahead = ahead._replace(s=s_stop, x=jnp.where(stopped, x_after, ahead.x))
        after = self._noted(ahead, run.count + 1, stopped, result, events)
        # Members of a batch without an event stay as they are.
        return jax.tree.map(lambda a, b: jnp.where(run.expected, a, b), after, run)

    def _noted(self, ahead, count, stopped, result, events) -> _Run:
        """The progress with a new next step, and the status of what went wrong."""
        going = ~stopped
        over = going & any_of(ahead.expected) & (count >= self.max_events)
        beyond = going & any_of(ahead.beyond)
        # A fault of the states replaces one that only concerns derivatives.
        good = (result == RESULTS.successful) | (result == RESULTS.grazing)
        if events is not None:
            kind = jnp.argmax(jnp.where(beyond, ahead.beyond, ahead.expected))
            time = self.plant.args[1].t + ahead.s
            events = events.with_fault(good & (over | beyond), kind, time)
        result = choose(good & over, RESULTS.too_many_events, result)
        result = choose(good & beyond, RESULTS.beyond_guard, result)
        expected = going & ~over & any_of(ahead.expected)
        # The flags have been used; without them the loop carries less.
        ahead = ahead._replace(expected=None, beyond=None)
        return _Run(ahead, expected, count, stopped | over, result, events)


def _length(plant, s, x, length, known):
    """The length of the step to an event, with derivatives of any order.

    By the implicit function theorem: the guard is zero at the end of the step.
    """
    given, static = eqx.partition((plant, s, x), eqx.is_array)

    def guard(given, length, event):
        plant, s, x = eqx.combine(given, static)
        x_next, _ = plant.step(s, x, length)
        return pick(plant.guards(s + length, x_next), event)

    @jax.custom_jvp
    def root(given, length, known):
        del given, known
        return length

    @root.defjvp
    def change(primals, tangents):
        given, _, (event, crosses, grazes) = primals
        length = root(*primals)
        along = lambda length: guard(given, length, event)
        _, slope = jax.jvp(along, (length,), (jnp.ones_like(length),))
        of = lambda given: guard(given, length, event)
        _, moved = jax.jvp(of, (given,), (tangents[0],))
        slope = jnp.where(grazes, jnp.nan, slope)
        return length, -moved / jnp.where(crosses, slope, 1)

    return root(given, length, known)


def _unless(stopped, result):
    """The result of the solver, or success after a stop."""
    if result is None:
        return RESULTS.successful
    return choose(stopped, RESULTS.successful, result)


def _knows(system, x) -> Array:
    """Whether the mode in `x` is one of the system's modes."""
    if not system.mode_names:
        return jnp.asarray(True)
    mode = x[system.state_names.index("mode")]
    return jnp.any(mode == jnp.arange(len(system.mode_names)))
