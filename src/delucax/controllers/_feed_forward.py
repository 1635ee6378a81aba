"""Known references and disturbances, and the feed-forward control for them."""

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
    """A state and a control to follow, and a disturbance, known at every time.

    Relative to these signals the linear dynamics are `e_next = A e + B v + d`, with the
    errors `e = difference(x, r)` and `v = u - u_r`. The residual `d` is the error after
    one step of the dynamics from the reference, under `u_r` and the disturbance.
    """

    dynamics: LinearDynamics
    reference: Signal | None = function_field(of="t")
    control_reference: Signal | None = function_field(of="t")
    disturbance: Signal | None = function_field(of="t")
    difference: Difference | None = function_field(of="a, b")

    def state(self, t: RealScalar) -> Float[Array, " n"]:
        """The reference `r(t)` of the state."""
        return self.dynamics.x_ref if self.reference is None else self.reference(t)

    def control(self, t: RealScalar) -> Float[Array, " m"]:
        """The reference `u_r(t)` of the control."""
        if self.control_reference is None:
            return self.dynamics.u_ref
        return self.control_reference(t)

    def next_state(self, t: RealScalar) -> Float[Array, " n"]:
        """The state that follows `r(t)` under `u_r(t)` and the disturbance."""
        point = self.dynamics
        here = deviation(self.state(t), point.x_ref, self.difference)
        # The dynamics stay linearised at the operating point, however far r is.
        after = point.x_next + matvec(point.A, here)
        after = after + matvec(point.B, self.control(t) - point.u_ref)
        if self.disturbance is None:
            return after
        w = self.disturbance(t)
        return after + (w if point.E is None else matvec(point.E, w))

    def offset(self, t: RealScalar) -> Float[Array, " n"]:
        """The residual `d` at time `t`."""
        ahead = self.state(t + self.dynamics.dt)
        return deviation(self.next_state(t), ahead, self.difference)


def as_signals(
    dynamics: LinearDynamics, given: tuple[Any, Any, Any], where: str
) -> tuple[Signal | None, Signal | None, Signal | None]:
    """The two references and the disturbance as signals, with checked sizes."""
    sizes = dynamics.state_size, dynamics.control_size, dynamics.disturbance_size
    names = "reference", "control_reference", "disturbance"
    r, u_r, w = map(functools.partial(as_signal, where), given, sizes, names)
    return r, u_r, w


def as_signal(where: str, value: Any, size: int, name: str) -> Any:
    """A vector as a constant signal, or a function of time with its size checked."""
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
    r"""The feed-forward control of an infinite-horizon regulator.

    $$v_k = -M \sum_{j \ge 0} ((A - B K)^\top)^j P\, d_{k+j},
    \qquad M = (R + B^\top P B)^{-1} B^\top$$

    It evaluates `d` for `steps` steps ahead and takes it as constant after them.
    """

    signals: KnownSignals
    P: Float[Array, "n n"] = parameter()
    M: Float[Array, "m n"] = parameter()
    closed_loop: Float[Array, "n n"] = parameter()
    steps: int = eqx.field(static=True)

    def __call__(self, t: RealScalar) -> Float[Array, " m"]:
        """The feed-forward control `v` at time `t`."""
        # The sum is the linear term p of the cost to go, and v = -M p the best control:
        # p[k] = P d[k] + (A - B K)' p[k+1].
        loop = self.closed_loop.T
        times = t + self.signals.dynamics.dt * jnp.arange(self.steps + 1)
        pushes = jax.vmap(lambda t: self.P @ self.signals.offset(t))(times)
        # If the last push stays for ever, the rest of the sum is (I - loop)^-1 push.
        eye = jnp.eye(loop.shape[0], dtype=loop.dtype)
        operator = lx.MatrixLinearOperator(eye - loop)
        ahead = lx.linear_solve(operator, pushes[-1], lx.LU()).value
        back = lambda total, push: (push + loop @ total, None)  # noqa: E731
        ahead, _ = jax.lax.scan(back, ahead, pushes[:-1], reverse=True)
        return -matvec(self.M, ahead)
