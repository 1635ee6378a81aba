"""An interval of a hybrid system: steps that stop at events, and the jumps there."""

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
    """What comes next: the first step along which a guard crosses zero, if there is one
    before the end.

    - `s`, `x`: the start of that step.
    - `step`: its length and where it leads; `None` where it is all that is left.
    - `x_end`: the state at the end, if nothing happens before it.
    - `expected`, `beyond`: for each guard, whether it crosses zero in it, and whether
        it is beyond zero at the start.
    - `result`: of the solver, up to the end or to that step; `None` if it cannot fail.
    """

    s: Array
    x: Array
    step: tuple[Array, Array] | None
    x_end: Array
    expected: Array
    beyond: Array
    result: Result | None


class HybridFlow(eqx.Module):
    """The steps, guards and resets of a hybrid system with a held control.

    `dynamics` give a step by `flow(args)`, whose `args` are the system, the start, the
    control and the disturbance that is held.
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
        # A start within rounding, or within the error of locating the event before, is
        # on the guard.
        eps = jnp.finfo(x.dtype).eps
        # Each entry is moved by roundings of its own, so that they do not cancel.
        shares = jnp.asarray(1 + np.modf(np.arange(x.size) * 1.618)[0], x.dtype)
        moved = self.args[1].t + s, shares * x
        noise = 32 * eps * jnp.abs(jax.jvp(self.guards, (s, x), moved)[1])
        span = self.dynamics.dt / self.dynamics.substeps
        unit = eps**0.6 * span
        slack = noise + unit * (jnp.abs(r0) + jnp.abs(r1))
        # Less than what counts at the start of the next step.
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
        """What one step to `end` meets."""
        h = end - s
        x_end, result = self.step(s, x, h)
        crossing = frozen(self).crossings(*frozen((s, x, h, x_end)))
        flags = crossing.expected, crossing.beyond
        return Ahead(s, x, None, x_end, *flags, or_none(result))


def ahead_of_steps(plant: HybridFlow, s: Array, x: Array, end: Array) -> Ahead:
    """What the steps of a step-size controller meet from `s` to `end`."""
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
        # A start beyond a guard is that of the first step.
        return i + 1, crossing.expected, jnp.where(i < 0, crossing.beyond, beyond)

    none = jnp.zeros(len(plant.args[0].event_names), bool)
    more = lambda state: ~any_of(state[1]) & (state[0] + 1 < count)
    state = jnp.asarray(-1), none, none
    i, expected, beyond = lax.while_loop(more, look, state)
    i = jnp.maximum(i, 0)
    # What the solver does behind an event is not used.
    result = choose(any_of(expected), RESULTS.successful, result)
    step = times[i + 1] - times[i], states[i + 1]
    return Ahead(times[i], states[i], step, last[0], expected, beyond, result)


def frozen(tree: Any) -> Any:
    """The same without derivatives, which the search for an event must not have."""
    numbers, rest = eqx.partition(tree, eqx.is_inexact_array)
    return eqx.combine(lax.stop_gradient(numbers), rest)


class Outcome(NamedTuple):
    """An interval's end: the state, when it was reached, whether that was before the
    end, what failed, and the events if they are recorded."""

    x: Array
    s: Array
    stopped: Array
    result: Result
    events: Events | None


class _Run(NamedTuple):
    """A run on its way through events: what is ahead and whether that is an event, how
    many there were, whether it stopped, what failed and what is recorded."""

    ahead: Ahead
    expected: Array
    count: Array
    stopped: Array
    result: Result
    events: Events | None


class Intervals(eqx.Module):
    """Intervals of a hybrid system, from event to event.

    - `plant`: its steps, guards and resets.
    - `look_ahead`: `(s, x, end)` to what is ahead.
    - `max_events`: where an interval stops.
    - `until`: an event at which it stops, too.
    """

    plant: HybridFlow
    look_ahead: Callable[[Array, Array, Array], Ahead]
    max_events: int = eqx.field(static=True)
    until: int | None = eqx.field(static=True, default=None)

    def __call__(self, x: Array, dt: Array, substeps: int, record: bool) -> Outcome:
        """`dt` from `x`, or less where it stops before; the state is held then."""
        events = Events.none(self.max_events, x) if record else None
        known = _knows(self.plant.args[0], x)
        result = choose(known, RESULTS.successful, RESULTS.unknown_mode)
        h = jnp.asarray(dt / substeps, x.dtype)

        def stretch(carry, i):
            before, count = carry
            # By products, as a running sum would round anew at each substep.
            end = (i + 1) * h
            run = self._noted(self.look_ahead(i * h, before.x, end), count, *before[2:])
            turn = by_components(functools.partial(self._turn, end))
            run = bounded_while(lambda run: run.expected, turn, run, self.max_events)
            s, x_stop, _, x_end, *_, solved = run.ahead
            result = first_failure(run.result, _unless(run.stopped, solved))
            # Where an earlier substep stopped, that is the end.
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
        """To the first crossing, the jump there, and what is ahead of it."""
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
        # Where a late one fires does not depend on its guard.
        crosses = fires & ~pick(crossing.late, event)
        grazes = crosses & grazes

        length = _length(plant, s, x, share * fh, (event, crosses, grazes))
        # Where nothing fires the step is only cut there, or taken whole.
        length = jnp.where(crosses, length, jnp.where(crossed, share * fh, h))
        x_event, solved = plant.step(s, x, length)
        s_event = s + length
        x_after = jnp.where(fires, plant.reset(event, s_event, x_event), x_event)
        # Located to rounding, it may be just before the step; its time is not.
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
            # Where it stops, what is ahead is that state.
            s_stop = jnp.where(stopped, s_event, ahead.s)
            ahead = ahead._replace(s=s_stop, x=jnp.where(stopped, x_after, ahead.x))
        after = self._noted(ahead, run.count + 1, stopped, result, events)
        # The other members of a batch stay as they are.
        return jax.tree.map(lambda a, b: jnp.where(run.expected, a, b), after, run)

    def _noted(self, ahead, count, stopped, result, events) -> _Run:
        """A run with what is ahead, in which what is wrong with that is noted."""
        going = ~stopped
        over = going & any_of(ahead.expected) & (count >= self.max_events)
        beyond = going & any_of(ahead.beyond)
        # What is wrong with the states comes before what is with derivatives.
        good = (result == RESULTS.successful) | (result == RESULTS.grazing)
        if events is not None:
            kind = jnp.argmax(jnp.where(beyond, ahead.beyond, ahead.expected))
            time = self.plant.args[1].t + ahead.s
            events = events.with_fault(good & (over | beyond), kind, time)
        result = choose(good & over, RESULTS.too_many_events, result)
        result = choose(good & beyond, RESULTS.beyond_guard, result)
        expected = going & ~over & any_of(ahead.expected)
        # Its flags have been used, and a loop carries what it must.
        ahead = ahead._replace(expected=None, beyond=None)
        return _Run(ahead, expected, count, stopped | over, result, events)


def _length(plant, s, x, length, known):
    """The length of a step to an event, with its derivatives, of any order.

    The guard of the step itself is zero at its end (the implicit function theorem).
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
    """The solver's result, of which nothing beyond a stop counts."""
    if result is None:
        return RESULTS.successful
    return choose(stopped, RESULTS.successful, result)


def _knows(system, x) -> Array:
    """Whether the mode in `x` is one of the system's."""
    if not system.mode_names:
        return jnp.asarray(True)
    mode = x[system.state_names.index("mode")]
    return jnp.any(mode == jnp.arange(len(system.mode_names)))
