"""Zero-order hold inside one solve, exact at the switch."""

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
    """The `args` of the solve: all that a gradient may be taken with respect to.

    `index`, an integer, tells which control is held, in place of the control itself, so
    that the adjoint equations reach `controls`.
    """

    system: AbstractSystem
    start: TimeOffset  # the time at which the solve's own begins
    source: Any  # a controller, or a function of time; None for an array
    memory: Any  # the controller's first state
    controls: Array | None
    disturbances: Array | None
    index: Array
    u: Array | None  # the control that a held controller returned at the last switch

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
        t = self.start.t + s
        state = eqx.combine(memory, eqx.filter(self.memory, eqx.is_array, inverse=True))
        u, after = call_controller(self.source, t, self.system.observe(t, x), state)
        check_control(u, self.source, self.system.control_size, "system")
        u = u.astype(x.dtype)
        # Without bounds the control is applied as it is, and there is no cost here.
        after = self.source.applied(u, jnp.zeros((), x.dtype), after)
        check_state(self.source, self.memory, after)
        return u, eqx.filter(after, eqx.is_array)


def field(s, x, args):
    """The vector field at `s` after the start."""
    return args.start.evaluate(s, lambda t: args.field(t, x))


_index = lambda args: args.index


class SavedState(NamedTuple):
    """A saved state with the held control of the step that it comes from, and the
    controller's tallies then."""

    state: Array
    control: Array
    counts: dict[str, Array]


def save_fn(t: Any, x: Any, args: Any) -> SavedState:
    """The function by which a solve with a held controller saves."""
    del t
    # Diffrax saves the state itself at the ends of a solve, and an interpolation, which
    # `_Ends` has completed, in between.
    if isinstance(x, SavedState):
        return x
    return SavedState(x, args.u, _counts(args.memory, x))


def _counts(memory: Any, like: Array) -> dict[str, Array]:
    """A controller's tallies as floating-point numbers, as a solve saves them."""
    return {n: count.astype(like.dtype) for n, count in tallies(memory).items()}


class _Ends(diffrax.AbstractLocalInterpolation):
    """The interpolation of a step, with the solver's own state at its end."""

    t0: Array
    t1: Array
    inside: diffrax.AbstractLocalInterpolation
    end: Any
    held: tuple[Array, dict[str, Array]] | None

    def evaluate(self, t0, t1=None, left=True):
        if t1 is not None:
            return self.inside.evaluate(t0, t1, left=left)
        # An interpolation meets the end of its step to rounding alone.
        x = jnp.where(t0 == self.t1, self.end, self.inside.evaluate(t0, left=left))
        return x if self.held is None else SavedState(x, *self.held)


class Hold(AbstractForwardingSolver):
    """A solver of which each step uses the control of the interval that it lies in.

    The interval cannot be inferred from the times of the stages: the last stage is at
    the switch itself, and rounding puts others beyond it. So it is determined once per
    step, from its two ends, and handed to the vector field as an index. A slope that a
    solver reuses from its last step is dropped at a switch. The step-size controller
    ensures that no step crosses one.

    With `sampled`, a controller is called at the start of each interval for the control
    to hold; the control and the controller's memory are carried in the solver's state,
    so that rejected steps restore them.
    """

    solver: diffrax.AbstractSolver
    switches: Array
    sampled: bool = eqx.field(static=True)

    @property
    def interpolation_cls(self):  # pyright: ignore[reportIncompatibleMethodOverride]
        # Diffrax calls it with the step's `dense_info` as keywords.
        inside = self.solver.interpolation_cls

        def ends(*, t0, t1, inner, end, held):
            return _Ends(t0, t1, inside(t0=t0, t1=t1, **inner), end, held)

        return ends

    def init(self, terms, t0, t1, y0, args):
        args = eqx.tree_at(_index, args, self._interval(terms, t0, t1))
        inner = self.solver.init(terms, t0, t1, y0, args)
        held = (args.u, eqx.filter(args.memory, eqx.is_array)) if self.sampled else None
        # No interval yet, so that the first step counts as a switch.
        return inner, jnp.full((), -1, jnp.int32), held

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        inner, last, held = solver_state
        index = self._interval(terms, t0, t1)
        switched = index != last
        args = eqx.tree_at(_index, args, index)
        if self.sampled:

            def act(held):
                _, memory = held
                return args.act(self.switches[index], y0, memory)

            held = lax.cond(switched, act, lambda held: held, held)
            args = eqx.tree_at(lambda a: a.u, args, held[0])
        # A switch makes the field jump, after which a solver that keeps its last slope
        # (first same as last) evaluates it anew.
        y1, error, dense_info, inner, result = self.solver.step(
            terms, t0, t1, y0, args, inner, made_jump | switched
        )
        record = (held[0], _counts(held[1], y1)) if self.sampled else None
        dense_info = dict(inner=dense_info, end=y1, held=record)
        return y1, error, dense_info, (inner, index, held), result

    def func(self, terms, t0, y0, args):
        forwards = terms.direction == 1
        t = jnp.where(forwards, t0, -t0)
        both = interval_from(self.switches, t), interval_before(self.switches, t)
        args = eqx.tree_at(_index, args, jnp.where(forwards, *both))
        return self.solver.func(terms, t0, y0, args)

    def _interval(self, terms, t0, t1):
        """The interval that the step from `t0` to `t1` lies in.

        A backward solve counts its time down in negative numbers. A step that begins
        one rounding before a switch belongs to what comes after it.
        """
        forwards = terms.direction == 1
        low = jnp.where(forwards, t0, -t1)
        high = jnp.where(forwards, t1, -t0)
        index = interval_from(self.switches, low)
        # The interval in which the larger part of the step lies.
        switch = self.switches[index + 1]
        later = (high - switch > switch - low).astype(index.dtype)
        return jnp.minimum(index + later, self.switches.shape[0] - 2)


def interval_from(switches: Array, t: Array) -> Array:
    """k with `switches[k] <= t < switches[k + 1]`, of equal intervals."""
    count = switches.shape[0] - 1
    # By division, as the intervals are equal: a search would cost a loop per step.
    share = (t - switches[0]) / (switches[-1] - switches[0])
    k = jnp.clip(jnp.floor(share * count).astype(jnp.int32), 0, count - 1)
    # Rounding can put the quotient on the wrong side of a switch, never beyond it.
    k = k + (t >= switches[k + 1]).astype(k.dtype) - (t < switches[k]).astype(k.dtype)
    return jnp.clip(k, 0, count - 1)


def interval_before(switches: Array, t: Array) -> Array:
    """k with `switches[k] < t <= switches[k + 1]`."""
    k = interval_from(switches, t)
    return jnp.maximum(k - (t == switches[k]).astype(k.dtype), 0)
