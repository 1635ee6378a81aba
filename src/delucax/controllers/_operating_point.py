"""Checks of the linear dynamics for which a regulator is designed."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .._check import check_instance, is_concrete
from .._check_models import check_time_invariant
from .._controller import AbstractController, wrong_observation
from .._jax import compiled_unless_on_host, host_unless_traced, xp
from .._typing import Array, Difference
from ..dynamics import LinearDynamics, linearize, OperatingPoint
from ..math._norms import relative_drift
from ..systems import LinearSystem


_EQUILIBRIUM_TOLERANCE = 1e-4
"""The largest relative residual of an equilibrium: users may give few digits."""


def linear_at(
    dynamics: Any, point: Any, difference: Difference | None, where: str
) -> tuple[Any, Difference | None]:
    """`dynamics` linearised at `point`, if any, and the difference of their states."""
    if point is None:
        return dynamics, difference
    hint = " (`delucax.trim` computes one)"
    check_instance(point, OperatingPoint, "point", where, hint)
    sizes = (dynamics.state_size,), (dynamics.control_size,)
    if (point.x.shape, point.u.shape) != sizes:
        raise ValueError(
            f"{where}: point must have x of shape {sizes[0]} and u of shape "
            f"{sizes[1]}, got {point.x.shape} and {point.u.shape}."
        )
    # Linear dynamics have no angles, so their default stays subtraction.
    if difference is None and not isinstance(dynamics, LinearDynamics | LinearSystem):
        difference = dynamics.difference
    return linearize(dynamics, x=point), difference


def check_linear_state_feedback(
    dynamics: Any, where: str, *, time_invariant: bool = False
) -> None:
    """Raise unless the dynamics are linear and observe their state."""
    hint = (
        " (`delucax.linearize` makes one of any dynamics, `delucax.c2d` of a linear "
        "system)"
    )
    check_instance(dynamics, LinearDynamics, "dynamics", where, hint)
    if time_invariant:
        check_time_invariant(dynamics, "dynamics", where)
    C, n = dynamics.C, dynamics.state_size
    if C is None:
        return
    # The values of a traced C are unknown: only its shape is checked.
    if C.shape != (n, n) or is_concrete(C) and not np.array_equal(C, np.eye(n)):
        raise ValueError(
            f"{where}: dynamics must observe their state (C the identity), because "
            f"{where} acts on the state itself, got a C of shape {C.shape}. If only "
            "C x is measured, use `delucax.controllers.LQG`, or `OutputFeedback` with "
            "a Kalman filter. If the state is measured, leave C out."
        )


def operating_state(
    dynamics: LinearDynamics, difference: Difference | None, where: str
) -> Float[Array, "*T n"]:
    """The state of the operating point, or an error unless the dynamics rest there.

    Time-varying dynamics must go from the operating point of each step to the next one.
    """
    x_ref, x_next = dynamics.x_ref, dynamics.x_next
    A, B, u_ref = dynamics.A, dynamics.B, dynamics.u_ref
    x, hint = x_ref, ""
    if dynamics.is_time_varying:
        if x_ref.shape[0] == 1:
            return x_ref
        rule = f"{where}: dynamics must go from each operating point to the next"
        x_next, after = x_next[:-1], x_ref[1:]
        A, B, x, u_ref = (a[:-1] for a in (A, B, x_ref, u_ref))
    else:
        rule = f"{where}: dynamics must rest at their operating point (x_next = x_ref)"
        hint = " `delucax.trim(system, x=..., u=...)` computes a point of rest."
        after = x_ref
    if difference is None:
        moved = _relative_drift(x_next, after, A, B, x, u_ref)
    else:
        drift = _drift(difference, x_next, after)
        moved = _relative_drift(drift, jnp.zeros_like(drift), A, B, x, u_ref)
    if not is_concrete(moved):
        # `not <=` instead of `>`, so that a NaN raises.
        moves = ~(moved <= _EQUILIBRIUM_TOLERANCE)
        return eqx.error_if(x_ref, moves, f"{rule}.")
    if not float(moved) <= _EQUILIBRIUM_TOLERANCE:
        raise ValueError(
            f"{rule}, got x_ref {x_ref} and x_next {x_next}. The relative residual is "
            f"{float(moved):.1e}, and may be {_EQUILIBRIUM_TOLERANCE:g} at most.{hint}"
        )
    return x_ref


@eqx.filter_jit
def _drift(difference: Difference, x_next: Array, after: Array) -> Array:
    """The difference of a pair of states, or of a pair at each time."""
    off = difference if x_next.ndim == 1 else jax.vmap(difference)
    return off(x_next, after)


@host_unless_traced
@compiled_unless_on_host
def _relative_drift(x_next, after, A, B, x, u):
    """The residual of an equilibrium, relative to the terms that it is a sum of."""
    # The derivative of x_next - x by (x, u).
    J = xp.concatenate([A - xp.eye(A.shape[-1], dtype=A.dtype), B], axis=-1)
    return relative_drift(x_next - after, J, x, u, is_map=True)


def deviation(x: Array, x_ref: Array, difference: Difference | None) -> Array:
    """`x - x_ref`, or the difference that was given in place of subtraction."""
    return x - x_ref if difference is None else difference(x, x_ref)


def check_state(controller: AbstractController, y: Array, size: int) -> None:
    """Raise unless the observation has the size of the state."""
    if y.shape != (size,):
        raise wrong_observation(controller, size, y)
