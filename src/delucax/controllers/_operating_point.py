"""What the regulators ask of the linear dynamics that they are designed on."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._check import is_concrete
from .._controller import AbstractController, wrong_observation
from .._message import shortened
from ..dynamics import LinearDynamics, linearize, OperatingPoint
from ..math._drift import relative_drift
from ..systems import LinearSystem


_RESTS = 1e-4
"""The share of the terms that move a state which may be left over at an equilibrium,
which may be written in few digits."""


def linear_at(
    dynamics: Any, point: Any, difference: Any, where: str
) -> tuple[Any, Callable[[Array, Array], Array] | None]:
    """`dynamics` linearised at a point that is given, and how their states differ."""
    if point is None:
        return dynamics, difference
    if not isinstance(point, OperatingPoint):
        raise ValueError(
            f"{where}: point must be an OperatingPoint (`delucax.trim` computes one), "
            f"got {shortened(point)}."
        )
    sizes = (dynamics.state_size,), (dynamics.control_size,)
    if (point.x.shape, point.u.shape) != sizes:
        raise ValueError(
            f"{where}: point must have x of shape {sizes[0]} and u of shape "
            f"{sizes[1]}, got {point.x.shape} and {point.u.shape}."
        )
    if difference is None and not isinstance(dynamics, LinearDynamics | LinearSystem):
        difference = getattr(dynamics, "difference", None)
    return linearize(dynamics, x=point), difference


def check_linear(dynamics: Any, where: str) -> None:
    """Raise unless the dynamics are linear."""
    if not isinstance(dynamics, LinearDynamics):
        raise ValueError(
            f"{where}: dynamics must be LinearDynamics (`delucax.linearize` makes "
            "them of any dynamics, `delucax.c2d` of a linear system), got "
            f"{type(dynamics).__name__}."
        )


def check_time_invariant(dynamics: Any, where: str) -> None:
    """Raise unless the dynamics are linear and time-invariant."""
    check_linear(dynamics, where)
    if dynamics.is_time_varying:
        raise ValueError(
            f"{where}: dynamics must be time-invariant, got matrices at "
            f"{dynamics.A.shape[0]} times; `dynamics.at(t)` are those at one time."
        )


def check_observed(dynamics: LinearDynamics, where: str) -> None:
    """Raise unless the dynamics observe their state."""
    C = dynamics.C
    if C is None:
        return
    n = dynamics.state_size
    if C.shape != (n, n) or is_concrete(C) and not np.array_equal(C, np.eye(n)):
        raise ValueError(
            f"{where}: dynamics must observe their state (C the identity), for {where} "
            f"acts on the state itself, got a C of shape {C.shape}. Where only C x is "
            "measured use `delucax.controllers.LQG`, or `OutputFeedback` with a Kalman "
            "filter; where the state is measured leave C out."
        )


def equilibrium(dynamics: LinearDynamics, difference: Any, where: str) -> Array:
    """The operating point, if the dynamics rest there."""
    x_ref, x_next = dynamics.x_ref, dynamics.x_next
    drift = deviation(x_next, x_ref, difference)
    moved = _moved(drift, dynamics.A, dynamics.B, x_ref, dynamics.u_ref)
    rule = f"{where}: dynamics must rest at their operating point (x_next = x_ref)"
    hint = "`delucax.trim(system, x=..., u=...)` computes one that does"
    return _resting(x_ref, moved, rule, f"{hint}; got x_ref {x_ref}, x_next {x_next}")


def path(dynamics: LinearDynamics, difference: Any, where: str) -> Array:
    """The operating points over time, if the dynamics go from each to the next."""
    x_ref, x_next = dynamics.x_ref, dynamics.x_next
    if x_ref.shape[0] == 1:
        return x_ref
    off = jax.vmap(lambda a, b: deviation(a, b, difference))(x_next[:-1], x_ref[1:])
    A, B, u_ref = (a[:-1] for a in (dynamics.A, dynamics.B, dynamics.u_ref))
    moved = _moved(off, A, B, x_ref[:-1], u_ref)
    rule = f"{where}: dynamics must go from each operating point to the next"
    return _resting(x_ref, moved, rule, f"got x_ref {x_ref} and x_next {x_next}")


@jax.jit
def _moved(drift, A, B, x, u):
    """What moves the state, relative to the terms that do."""
    J = jnp.concatenate([A - jnp.eye(A.shape[-1], dtype=A.dtype), B], axis=-1)
    return relative_drift(drift, J, x, u, is_map=True)


def _resting(x_ref: Array, moved: Array, rule: str, rest: str) -> Array:
    """`x_ref`, unless it moves by more than is left of an equilibrium that was computed
    or is written in few digits."""
    moves = ~(moved <= _RESTS)
    if not is_concrete(moves):
        return eqx.error_if(x_ref, moves, rule + ".")
    if moves:
        raise ValueError(
            f"{rule}, to {_RESTS:g} of the terms that move them; the residual is "
            f"{float(moved):.1e}. {rest}."
        )
    return x_ref


def deviation(
    x: Array, x_ref: Array, difference: Callable[[Array, Array], Array] | None
) -> Array:
    """`x - x_ref`, as the system measures it."""
    return x - x_ref if difference is None else difference(x, x_ref)


def check_state(controller: AbstractController, y: Array, size: int) -> None:
    """Raise unless the observation is a state."""
    if y.shape != (size,):
        raise wrong_observation(controller, size, y)
