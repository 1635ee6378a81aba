"""What the regulators ask of the linear dynamics that they are designed on."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._check import is_concrete
from .._controller import AbstractController, wrong_observation
from ..dynamics import LinearDynamics


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
            f"{where}: dynamics must observe their state (C the identity), got a C of "
            f"shape {C.shape} that does not; {where} acts on the state itself."
        )


def equilibrium(dynamics: LinearDynamics, difference: Any, where: str) -> Array:
    """The operating point, if the dynamics rest there."""
    x_ref, x_next = dynamics.x_ref, dynamics.x_next
    drift = jnp.max(jnp.abs(deviation(x_next, x_ref, difference)))
    # What is left of an equilibrium that was computed, or is written in few digits.
    slack = jnp.finfo(x_ref.dtype).eps ** 0.5 * (1 + jnp.max(jnp.abs(x_ref)))
    moves = ~(drift <= slack)
    rule = (
        f"{where}: dynamics must rest at their operating point (x_next = x_ref); "
        "choose an equilibrium as x and u of `delucax.linearize`"
    )
    if not is_concrete(moves):
        return eqx.error_if(x_ref, moves, rule + ".")
    if moves:
        raise ValueError(f"{rule}, got x_ref {x_ref} and x_next {x_next}.")
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
