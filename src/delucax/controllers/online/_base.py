"""What a learner is given, and the base controller of one that is given none."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..._check import check_instance, is_concrete, output_of
from ..._controller import AbstractController
from ...dynamics import AbstractDynamics, LinearDynamics, linearize
from .._lqg import LQG
from .._lqr import LQR
from .._scheduled import Scheduled


def base_for(
    dynamics: AbstractDynamics,
    cost: Callable[..., Array],
    base: AbstractController | None,
    where: str,
) -> AbstractController:
    """The base of a learner with this model and cost, which are checked: as given, or
    the default one."""
    hint = (
        ", the model that it learns with (`delucax.controllers.Explore` identifies one)"
    )
    check_instance(dynamics, AbstractDynamics, "dynamics", where, hint)
    if not callable(cost):
        raise ValueError(
            f"{where}: cost must be a function of (t, y, u), such as one of "
            f"delucax.costs, got {type(cost).__name__}."
        )
    check_scalar_cost(cost, dynamics, where)
    return _default_base(dynamics, cost, where) if base is None else base


def check_scalar_cost(cost: Any, dynamics: AbstractDynamics, where: str) -> None:
    """Raise unless a cost of what `dynamics` show is a scalar."""
    y, u = (dynamics.observation_size,), (dynamics.control_size,)
    try:
        value = output_of(cost, (), y, u)
    except ValueError as error:
        raise ValueError(
            f"{where}: cost must take the observation, of shape {y}, where a state is "
            f"asked for, and a control of shape {u}: {error}"
        ) from error
    got = getattr(value, "shape", None)
    if got != ():
        got = type(value).__name__ if got is None else f"an array of shape {got}"
        raise ValueError(f"{where}: cost must give a scalar, got {got}.")


def _default_base(
    dynamics: AbstractDynamics, cost: Callable[..., Array], where: str
) -> AbstractController:
    """The regulator for the curvature of the cost at the operating point.

    For each time of time-varying dynamics it is the one that would be best if they
    stayed as they are; where not the state but `C x` is observed, it acts on what a
    Kalman filter for disturbances and sensor noise of unit covariance makes of it.
    """
    try:
        x, u = dynamics.equilibrium()
    except ValueError as error:
        raise ValueError(
            f"{where}: base must be given, for dynamics that name no equilibrium to "
            "design one at."
        ) from error
    t = jnp.zeros((), x.dtype)
    Q, R, S = _curvature(dynamics, cost, t, x, u, where)
    if not isinstance(dynamics, LinearDynamics):
        model = linearize(dynamics, t, x, u)
        return LQR(model, Q, R, S, difference=dynamics.difference)
    if not dynamics.is_time_varying:
        if dynamics.observes_state:
            return LQR(dynamics, Q, R, S)
        p, k = dynamics.observation_size, dynamics.disturbance_size
        eye = lambda n: jnp.eye(n, dtype=x.dtype)  # noqa: E731
        return LQG(dynamics, Q, R, eye(k), eye(p), S)
    times = jnp.arange(dynamics.A.shape[0]) * dynamics.dt
    design = eqx.filter_vmap(lambda t: LQR(dynamics.at(t), Q, R, S))
    return Scheduled(design(times), dynamics.dt)


def _curvature(dynamics, cost, t, x, u, where):
    """The second derivatives of the cost, as weights of a regulator."""
    y, n = dynamics.observe(t, x), x.shape[0]

    def charged(z):
        y_here = y + jax.jvp(lambda x: dynamics.observe(t, x), (x,), (z[:n],))[1]
        return cost(t, y_here, u + z[n:])

    H = jax.hessian(charged)(jnp.zeros(n + u.shape[0], x.dtype)) / 2
    Q, R, S = H[:n, :n], H[n:, n:], H[:n, n:]
    if is_concrete(H):
        H = np.asarray(H, float)
        slack = 1e-6 * np.max(np.abs(H), initial=0)
        curved = np.all(np.linalg.eigvalsh(H) >= -slack)
        if not (curved and np.all(np.linalg.eigvalsh(np.asarray(R)) > slack)):
            raise ValueError(
                f"{where}: base must be given, for a cost that is not convex, and "
                "strictly so in u, at the operating point."
            )
    return Q, R, S
