"""What a learner is given, and the base controller that it gets if it is given none."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..._check import check_count, check_instance, check_positive, is_concrete
from ...dynamics import AbstractDynamics, LinearDynamics, linearize
from .._lqg import LQG
from .._lqr import LQR
from .._scheduled import Scheduled
from ._features import Features
from ._learner import check_scalar_cost, OnlineLearner
from ._loop import Loop
from ._newton import online_newton
from ._policy import LinearPolicy
from ._step_size import adagrad_norm


STEP = 0.15
"""The step of a learner, in units of the control that undoes what it has observed."""
RADIUS = 50.0
"""The largest policy, in the same units."""
OF_OUTPUTS = 4.0
"""The prior of what is learned from nature's outputs, in steps."""


def loop_of(
    dynamics: Any,
    cost: Any,
    base: Any,
    horizon: int | None,
    where: str,
    *,
    echoes: bool | None = None,
) -> Loop:
    """The loop of a learner, with the default base if none is given; it echoes by
    default if the state is not observed."""
    _check_cost(dynamics, cost, where)
    if base is None:
        base = _default_base(dynamics, cost, where)
    if echoes is None:
        echoes = not dynamics.observes_state
    return Loop(dynamics, base, horizon, where, echoes=echoes)


def memory_of(loop: Loop, memory: int | None, where: str) -> int:
    """How many values of its signal a learner keeps: as given, or for as long as they
    matter."""
    return loop.memory() if memory is None else check_count(memory, "memory", where)


def _check_cost(dynamics: Any, cost: Any, where: str) -> None:
    """Raise unless the cost gives a scalar."""
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


def _default_base(dynamics: AbstractDynamics, cost: Any, where: str) -> Any:
    """The regulator for the curvature of the cost at the operating point.

    For each time of time-varying dynamics it is the one that would be best if they
    stayed as they are; where not the state but `C x` is observed, it acts on what a
    Kalman filter for disturbances and sensor noise of unit covariance makes of it.
    """
    linear = isinstance(dynamics, LinearDynamics)
    try:
        x, u = dynamics.equilibrium()
    except ValueError as error:
        raise ValueError(
            f"{where}: base must be given, for dynamics that name no equilibrium to "
            "design one at."
        ) from error
    t = jnp.zeros((), x.dtype)
    Q, R, S = _curvature(dynamics, cost, t, x, u, where)
    if not linear:
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


def linear_learner(
    loop: Loop,
    cost: Any,
    features: Features,
    learning_rate: Any,
    optimiser: Any,
    radius: Any,
    where: str,
) -> OnlineLearner:
    """A learner of a linear map from features to control."""
    start = jnp.zeros((loop.dynamics.control_size, features.size), loop.dtype)
    return OnlineLearner(
        loop,
        cost,
        features,
        LinearPolicy(start, scale(loop, radius, "radius", RADIUS, where)),
        scale(loop, learning_rate, "learning_rate", STEP, where),
        _optimiser(loop, features) if optimiser is None else optimiser,
    )


def _optimiser(loop: Loop, features: Features) -> Any:
    """Newton's step where gradients alone are slow: nature's outputs are much alike
    from step to step, and a response that changes points elsewhere each time."""
    if features.nature:
        return online_newton(OF_OUTPUTS)
    return online_newton() if loop.response is None else adagrad_norm()


def scale(loop: Loop, given: Any, name: str, units: float, where: str) -> Any:
    """A step size or radius: as given, or in units of `1 / reach`."""
    if given is not None:
        check_positive(given, name, where)
        if np.ndim(given):
            raise ValueError(
                f"{where}: {name} must be a number, got shape {np.shape(given)}."
            )
        return given
    if loop.reach is None:
        raise ValueError(
            f"{where}: {name} must be given, for dynamics that name no equilibrium."
        )
    reached = loop.reach > 0
    return jnp.where(reached, units / jnp.where(reached, loop.reach, 1), units)
