"""Signals known in advance: what to follow, and what will disturb."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Float

from .._check import as_vector, output_of
from .._module import function_field, parameter
from ..dynamics import LinearDynamics
from ..math import matvec
from ..references import Constant
from ._operating_point import deviation


Signal = Callable[[Any], Array]


class KnownSignals(eqx.Module):
    """A state and control to follow, and a disturbance, each known at every time.

    About them the linear dynamics are `e_next = A e + B v + d`, with
    `e = difference(x, r)`, `v = u - u_r`, and `d[k]` what the reference leaves over:
    the distance from `r[k+1]` to where the dynamics go from `r[k]` under `u_r[k]` and
    `w[k]`.
    """

    dynamics: LinearDynamics
    reference: Signal | None = function_field()
    control_reference: Signal | None = function_field()
    disturbance: Signal | None = function_field()
    difference: Callable[[Array, Array], Array] | None = function_field()

    def check(self, where: str) -> None:
        """Raise unless the signals have the sizes of the dynamics."""
        point = self.dynamics
        as_signal(self.reference, point.state_size, "reference", where)
        push = self.control_reference
        as_signal(push, point.control_size, "control_reference", where)
        as_signal(self.disturbance, point.disturbance_size, "disturbance", where)

    def state(self, t: Any) -> Array:
        """`r(t)`."""
        return self.dynamics.x_ref if self.reference is None else self.reference(t)

    def control(self, t: Any) -> Array:
        """`u_r(t)`."""
        if self.control_reference is None:
            return self.dynamics.u_ref
        return self.control_reference(t)

    def moved(self, t: Any) -> Array:
        """Where the dynamics go from `r(t)` under `u_r(t)` and the disturbance."""
        point = self.dynamics
        here = deviation(self.state(t), point.x_ref, self.difference)
        moved = point.x_next + matvec(point.A, here)
        moved = moved + matvec(point.B, self.control(t) - point.u_ref)
        if self.disturbance is None:
            return moved
        w = self.disturbance(t)
        return moved + (w if point.E is None else matvec(point.E, w))

    def offset(self, t: Any) -> Array:
        """`d` at time `t`."""
        ahead = self.state(t + self.dynamics.dt)
        return deviation(self.moved(t), ahead, self.difference)


def known_signals(
    dynamics: LinearDynamics,
    reference: Any,
    control_reference: Any,
    disturbance: Any,
    difference: Any,
    where: str,
) -> KnownSignals | None:
    """The signals that were given, checked at time 0; `None` if none was."""
    sizes = {
        "reference": (reference, dynamics.state_size),
        "control_reference": (control_reference, dynamics.control_size),
        "disturbance": (disturbance, dynamics.disturbance_size),
    }
    if all(signal is None for signal, _ in sizes.values()):
        return None
    follow, push, disturb = (
        as_signal(*given, name, where) for name, given in sizes.items()
    )
    return KnownSignals(dynamics, follow, push, disturb, difference)


def as_signal(value: Any, size: int, name: str, where: str) -> Any:
    """A vector as a constant signal; a function `t -> vector` with its size checked."""
    if value is None:
        return None
    if not callable(value):
        return Constant(as_vector(value, size, name, where))
    shape = output_of(value, ()).shape
    if shape != (size,):
        raise ValueError(
            f"{where}: {name} must be a vector of size {size}, or a function of time "
            f"that returns one, got shape {shape}."
        )
    return value


class Preview(eqx.Module):
    """The feed-forward of an infinite-horizon regulator,

    `v[k] = -M sum_j (A - B K)'^j P d[k+j]`, `M = (R + B'PB)^-1 B'`,

    with `d` looked up `steps` ahead and taken to stay as it is from there.
    """

    signals: KnownSignals
    P: Float[Array, "n n"] = parameter()
    M: Float[Array, "m n"] = parameter()
    closed_loop: Float[Array, "n n"] = parameter()
    steps: int = eqx.field(static=True)

    def __call__(self, t: Any) -> Array:
        """`v` at time `t`."""
        loop = self.closed_loop.T
        times = t + self.signals.dynamics.dt * jnp.arange(self.steps + 1)
        pushes = jax.vmap(lambda t: self.P @ self.signals.offset(t))(times)
        # A constant push for ever sums to (I - loop)^-1 times it.
        operator = lx.MatrixLinearOperator(
            jnp.eye(loop.shape[0], dtype=loop.dtype) - loop
        )
        ahead = lx.linear_solve(operator, pushes[-1], lx.LU()).value
        back = lambda total, push: (push + loop @ total, None)  # noqa: E731
        ahead, _ = jax.lax.scan(back, ahead, pushes[:-1], reverse=True)
        return -matvec(self.M, ahead)
