"""Zero-order hold inside one solve, exact at the switch.

The solve counts its time `s` in intervals from the start. The switches are then whole
numbers: they are not rounded, and they are constants of the compiled program.
"""

from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array

from .._controller import AbstractController, tallies
from .._integration import AbstractForwardingSolver, evaluate_field, TimeOffset
from ..systems import AbstractSystem
from ._controller_calls import call_controller, check_control, check_state


class Inputs(eqx.Module):
    """The `args` of the solve: everything that you may differentiate with respect to.

    The integer `index` says which control is held. The control itself would not do,
    because the adjoint equations must reach `controls`.
    """

    system: AbstractSystem
    start: TimeOffset  # the time at which the solve starts
    length: Array  # of the horizon
    intervals: int = eqx.field(static=True)
    source: Any  # a controller, or a function of time; None for an array
    memory: Any  # the controller's first state
    controls: Array | None
    disturbances: Array | None
    index: Array
    u: Array | None  # the control that a held controller returned at the last switch

    def since_start(self, s: Array) -> Array:
        """The time that has passed after `s` intervals."""
        # As a fraction of the length, so that the end is not rounded.
        return self.length * (s / self.intervals)

    def control(self, t: Array, x: Array) -> Array:
        """The control at time `t`."""
        if self.u is not None:
            return self.u
        if self.controls is not None:
            return self.controls[self.index]
        if isinstance(self.source, AbstractController):
            y = self.system.observe(t, x)
            u, _ = call_controller(self.source, t, y, self.memory)
        else:
            u = self.source(t)
        check_control(u, self.source, self.system.control_size, "system")
        return u

    def field(self, t: Array, x: Array) -> Array:
        """The vector field at time `t`."""
        u, w = self.control(t, x), None
        if self.disturbances is not None:
            w = self.disturbances[self.index]
        elif self.system.disturbance_names:
            w = jnp.zeros(self.system.disturbance_size, x.dtype)
        return evaluate_field(self.system, t, x, u, w).astype(x.dtype)

    def act(self, s: Array, x: Array, memory: Any) -> tuple[Array, Any]:
        """The control of a held controller at a switch, and its state after it."""
        t = self.start.t + self.since_start(s)
        state = eqx.combine(memory, eqx.filter(self.memory, eqx.is_array, inverse=True))
        u, after = call_controller(self.source, t, self.system.observe(t, x), state)
        check_control(u, self.source, self.system.control_size, "system")
        u = u.astype(x.dtype)
        # The system has no bounds, so the control is applied unchanged, and no cost.
        after = self.source.applied(u, jnp.zeros((), x.dtype), after)
        check_state(self.source, self.memory, after)
        return u, eqx.filter(after, eqx.is_array)


def field(s, x, args):
    """The change of the state per interval, after `s` intervals."""
    dx = args.start.evaluate(args.since_start(s), lambda t: args.field(t, x))
    return args.length / args.intervals * dx


def _of_controller(name: str) -> Any:
    return property(lambda self: getattr(self.controller, name))


class InTime(diffrax.AbstractAdaptiveStepSizeController):
    """A step-size controller in time, inside a solve that counts intervals."""

    controller: diffrax.AbstractAdaptiveStepSizeController
    interval: Array

    rtol = _of_controller("rtol")
    atol = _of_controller("atol")
    norm = _of_controller("norm")

    def wrap(self, direction):
        inside = self.controller.wrap(direction)
        return eqx.tree_at(lambda c: c.controller, self, inside)

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        h = self.interval
        per_time = lambda terms, t, y, args: func(terms, t / h, y, args) / h
        first, state = self.controller.init(
            terms, t0 * h, t1 * h, y0, dt0, args, per_time, error_order
        )
        return first / h, state

    def adapt_step_size(
        self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state
    ):
        h = self.interval
        start, end = t0 * h, t1 * h
        states = y0, y1_candidate, args, y_error, error_order, controller_state
        keep, low, high, *rest = self.controller.adapt_step_size(start, end, *states)
        # A step begins where the last one began or ended; these times are exact.
        begin = jnp.where(low == start, t0, jnp.where(low == end, t1, low / h))
        return keep, begin, high / h, *rest


_index = lambda args: args.index


class SavedState(NamedTuple):
    """A saved state, with the held control and the controller's tallies in the step
    that it comes from."""

    state: Array
    control: Array
    counts: dict[str, Array]


def save_fn(t: Any, x: Any, args: Any) -> SavedState:
    """What a solve with a held controller saves at a time."""
    del t
    # In between, Diffrax saves an interpolation, which `_Ends` has made a SavedState.
    # At the ends of a solve it saves the state itself.
    if isinstance(x, SavedState):
        return x
    return SavedState(x, args.u, _counts(args.memory, x))


def _counts(memory: Any, like: Array) -> dict[str, Array]:
    """A controller's tallies as floating-point numbers, which a solve can save."""
    return {n: count.astype(like.dtype) for n, count in tallies(memory).items()}


class _Ends(diffrax.AbstractLocalInterpolation):
    """The interpolation of a step, with the exact state of the solver at its end."""

    t0: Array
    t1: Array
    inside: diffrax.AbstractLocalInterpolation
    end: Any
    held: tuple[Array, dict[str, Array]] | None

    def evaluate(self, t0, t1=None, left=True):
        if t1 is not None:
            return self.inside.evaluate(t0, t1, left=left)
        # An interpolation only meets the end of its step up to rounding.
        x = jnp.where(t0 == self.t1, self.end, self.inside.evaluate(t0, left=left))
        return x if self.held is None else SavedState(x, *self.held)


class Hold(AbstractForwardingSolver):
    """A solver that uses one control in all stages of a step: that of the interval in
    which the step lies.

    The times of the stages do not determine the interval: the last stage is at the
    switch itself, and rounding may put others beyond it. The interval therefore follows
    from the two ends of the step, and the vector field gets it as an index. Solvers
    that reuse the slope of the last step drop it at a switch. The step-size controller
    ensures that no step crosses a switch.

    With `sampled`, a controller is called at the start of each interval for the control
    to hold. The control and the controller's memory are part of the solver's state, so
    that a rejected step restores them.
    """

    solver: diffrax.AbstractSolver
    intervals: int = eqx.field(static=True)
    sampled: bool = eqx.field(static=True)

    @property
    def interpolation_cls(self):  # pyright: ignore[reportIncompatibleMethodOverride]
        # Diffrax passes the step's `dense_info` as keywords.
        inside = self.solver.interpolation_cls

        def ends(*, t0, t1, inner, end, held):
            return _Ends(t0, t1, inside(t0=t0, t1=t1, **inner), end, held)

        return ends

    def init(self, terms, t0, t1, y0, args):
        args = eqx.tree_at(_index, args, self._interval(t0, t1))
        inner = self.solver.init(terms, t0, t1, y0, args)
        held = (args.u, eqx.filter(args.memory, eqx.is_array)) if self.sampled else None
        # -1 is no interval, so that the first step counts as a switch.
        return inner, jnp.full((), -1, jnp.int32), held

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        inner, last, held = solver_state
        index = self._interval(t0, t1)
        switched = index != last
        args = eqx.tree_at(_index, args, index)
        if self.sampled:

            def act(held):
                _, memory = held
                return args.act(jnp.asarray(index, y0.dtype), y0, memory)

            held = lax.cond(switched, act, lambda held: held, held)
            args = eqx.tree_at(lambda a: a.u, args, held[0])
        # The field jumps at a switch. A solver that keeps its last slope (first same as
        # last) must then evaluate it again.
        y1, error, dense_info, inner, result = self.solver.step(
            terms, t0, t1, y0, args, inner, made_jump | switched
        )
        record = (held[0], _counts(held[1], y1)) if self.sampled else None
        dense_info = dict(inner=dense_info, end=y1, held=record)
        return y1, error, dense_info, (inner, index, held), result

    def func(self, terms, t0, y0, args):
        # A backward solve counts its time down in negative numbers.
        forwards, s = terms.direction == 1, jnp.abs(t0)
        last = interval_before(s, self.intervals)
        index = jnp.where(forwards, interval_from(s, self.intervals), last)
        return self.solver.func(terms, t0, y0, eqx.tree_at(_index, args, index))

    def _interval(self, t0, t1):
        """The interval in which the step from `t0` to `t1` lies.

        A step that begins just before a switch, by rounding, belongs to the interval
        after it.
        """
        # A backward solve counts its time down in negative numbers.
        ends = jnp.abs(t0), jnp.abs(t1)
        low, high = jnp.minimum(*ends), jnp.maximum(*ends)
        index = interval_from(low, self.intervals)
        # The larger part of the step decides.
        later = (high - (index + 1) > (index + 1) - low).astype(index.dtype)
        return jnp.minimum(index + later, self.intervals - 1)


def interval_from(s: Array, intervals: int) -> Array:
    """The interval k with `k <= s < k + 1`."""
    return jnp.clip(jnp.floor(s).astype(jnp.int32), 0, intervals - 1)


def interval_before(s: Array, intervals: int) -> Array:
    """The interval k with `k < s <= k + 1`."""
    return jnp.clip(jnp.ceil(s).astype(jnp.int32) - 1, 0, intervals - 1)


def in_intervals(
    t0: Array, ts: Array, intervals: int, substeps: int, length: Array
) -> Array:
    """The save times `ts`, counted in intervals from `t0`.

    A time within rounding of the end of a fixed step is moved to it, so that the
    interval before it is unambiguous.
    """
    scale = intervals / length
    saves = jnp.clip((ts - t0) * scale, 0, intervals)
    near = jnp.round(saves * substeps) / substeps
    # The rounding of a difference is that of its two times.
    slack = 4 * jnp.finfo(ts.dtype).eps * jnp.maximum(jnp.abs(t0), jnp.abs(ts))
    return jnp.where(jnp.abs(saves - near) <= slack * scale, near, saves)
