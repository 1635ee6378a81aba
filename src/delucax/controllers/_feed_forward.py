"""References and disturbances known in advance, and the feed-forward for them."""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Float

from .._check import as_vector
from .._check_models import output_of
from .._module import function_field, parameter
from .._typing import Difference, RealScalar
from ..dynamics import LinearDynamics
from ..math import matvec
from ..references import Constant
from ._operating_point import deviation


Signal = Callable[[Any], Array]


class KnownSignals(eqx.Module):
    """A state and control to follow, and a disturbance, each known at every time.

    About them the linear dynamics are `e_next = A e + B v + d`, with
    `e = difference(x, r)`, `v = u - u_r`, and `d[k]` the residual of the reference: the
    difference of where the dynamics go from `r[k]` under `u_r[k]` and `w[k]` from
    `r[k+1]`.
    """

    dynamics: LinearDynamics
    reference: Signal | None = function_field()
    control_reference: Signal | None = function_field()
    disturbance: Signal | None = function_field()
    difference: Difference | None = function_field()

    def state(self, t: RealScalar) -> Float[Array, " n"]:
        """`r(t)`."""
        return self.dynamics.x_ref if self.reference is None else self.reference(t)

    def control(self, t: RealScalar) -> Float[Array, " m"]:
        """`u_r(t)`."""
        if self.control_reference is None:
            return self.dynamics.u_ref
        return self.control_reference(t)

    def next_state(self, t: RealScalar) -> Float[Array, " n"]:
        """Where the dynamics go from `r(t)` under `u_r(t)` and the disturbance."""
        point = self.dynamics
        here = deviation(self.state(t), point.x_ref, self.difference)
        # The affine map of the operating point, even where the reference is far away.
        after = point.x_next + matvec(point.A, here)
        after = after + matvec(point.B, self.control(t) - point.u_ref)
        if self.disturbance is None:
            return after
        w = self.disturbance(t)
        return after + (w if point.E is None else matvec(point.E, w))

    def offset(self, t: RealScalar) -> Float[Array, " n"]:
        """`d` at time `t`."""
        ahead = self.state(t + self.dynamics.dt)
        return deviation(self.next_state(t), ahead, self.difference)


def as_signals(
    dynamics: LinearDynamics, given: tuple[Any, Any, Any], where: str
) -> tuple[Signal | None, Signal | None, Signal | None]:
    """The reference, control reference and disturbance that were given, checked at
    time 0."""
    sizes = dynamics.state_size, dynamics.control_size, dynamics.disturbance_size
    names = "reference", "control_reference", "disturbance"
    r, u_r, w = map(functools.partial(as_signal, where), given, sizes, names)
    return r, u_r, w


def as_signal(where: str, value: Any, size: int, name: str) -> Any:
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

    def __call__(self, t: RealScalar) -> Float[Array, " m"]:
        """`v` at time `t`."""
        # The sum is the linear term of the cost to go, of which v = -M p is the best
        # control: p[k] = P d[k] + (A - B K)' p[k+1].
        loop = self.closed_loop.T
        times = t + self.signals.dynamics.dt * jnp.arange(self.steps + 1)
        pushes = jax.vmap(lambda t: self.P @ self.signals.offset(t))(times)
        # A constant push for ever sums to (I - loop)^-1 times it.
        eye = jnp.eye(loop.shape[0], dtype=loop.dtype)
        operator = lx.MatrixLinearOperator(eye - loop)
        ahead = lx.linear_solve(operator, pushes[-1], lx.LU()).value
        back = lambda total, push: (push + loop @ total, None)  # noqa: E731
        # Horner's rule on the powers of the loop, from the last push back to the first.
        ahead, _ = jax.lax.scan(back, ahead, pushes[:-1], reverse=True)
        return -matvec(self.M, ahead)
