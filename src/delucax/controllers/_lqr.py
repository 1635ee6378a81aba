"""The linear-quadratic regulator."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._check import is_concrete
from .._controller import AbstractController, wrong_observation
from .._fields import function_field, parameter, weight
from ..dynamics import LinearDynamics
from ..math import matvec
from ..riccati import dare


class LQR(AbstractController):
    """The infinite-horizon linear-quadratic regulator about an operating point,

    `u = u_ref - K difference(x, x_ref)`,

    which minimises the sum over all time of `dx'Q dx + 2 dx'S du + du'R du` on the
    linear dynamics, `dx` and `du` being the deviations from the operating point. The
    minimum is `dx' P dx`; with unit white noise it is `trace(P)` a step.

    **Arguments:**

    - `dynamics`: time-invariant linear dynamics whose operating point is an equilibrium
        and whose state is observed; of [`delucax.linearize`][], for example.
    - `Q`: state weight, shape `(n, n)`, symmetric.
    - `R`: control weight, shape `(m, m)`, symmetric.
    - `S`: cross weight, shape `(n, m)`; zero by default.
    - `difference`: `(x, x_ref) -> deviation`, such as the `difference` of the system
        that was linearised, which wraps angles; subtraction by default.

    **Attributes:** `K`, the gain, trainable, shape `(m, n)`; `P`, the solution of the
    Riccati equation, shape `(n, n)`; `x_ref` and `u_ref`, the operating point.

    **Raises:** `ValueError` if `dynamics` is not linear, is time-varying, does not rest
    at its operating point or does not observe its state, or if a weight does not fit;
    an error at run time if there is no stabilising gain.

    Source: Kalman, 1960.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        env = dlx.make("pendulum")
        upright = dlx.linearize(env.dynamics)
        regulator = dlx.controllers.LQR(
            upright, jnp.eye(2), jnp.eye(1), difference=env.dynamics.difference
        )
        x0 = jnp.array([0.1, 0.0])
        dlx.rollout(env, regulator, key=jax.random.key(0), x0=x0).total_cost
        ```
    """

    K: Float[Array, "m n"] = weight()
    P: Float[Array, "n n"] = parameter()
    x_ref: Float[Array, " n"] = parameter()
    u_ref: Float[Array, " m"] = parameter()
    difference: Callable[[Array, Array], Array] | None = function_field()

    def __init__(
        self,
        dynamics: LinearDynamics,
        Q: Any,
        R: Any,
        S: Any = None,
        *,
        difference: Callable[[Array, Array], Array] | None = None,
    ):
        where = "LQR"
        if not isinstance(dynamics, LinearDynamics):
            raise ValueError(
                f"{where}: dynamics must be LinearDynamics (`delucax.linearize` makes "
                "them of any dynamics, `delucax.c2d` of a linear system), got "
                f"{type(dynamics).__name__}."
            )
        if dynamics.is_time_varying:
            raise ValueError(
                f"{where}: dynamics must be time-invariant, got matrices at "
                f"{dynamics.A.shape[0]} times; `dynamics.at(t)` are those at one time."
            )
        _check_observed(dynamics)
        self.x_ref = _equilibrium(dynamics, difference)
        self.u_ref = dynamics.u_ref
        self.difference = difference
        solution = dare(dynamics.A, dynamics.B, Q, R, S)
        self.K, self.P = solution.K, solution.X

    def __call__(self, t, y, state):
        if y.shape != self.x_ref.shape:
            raise wrong_observation(self, self.x_ref.shape[0], y)
        if self.difference is None:
            deviation = y - self.x_ref
        else:
            deviation = self.difference(y, self.x_ref)
        return (self.u_ref - matvec(self.K, deviation)).astype(y.dtype), state


def _check_observed(dynamics: LinearDynamics) -> None:
    C = dynamics.C
    if C is None:
        return
    n = dynamics.state_size
    if C.shape != (n, n) or is_concrete(C) and not np.array_equal(C, np.eye(n)):
        raise ValueError(
            "LQR: dynamics must observe their state (C the identity), got a C of shape "
            f"{C.shape} that does not; LQR acts on the state itself."
        )


def _equilibrium(dynamics: LinearDynamics, difference: Any) -> Array:
    """The operating point, if the dynamics rest there."""
    x_ref, x_next = dynamics.x_ref, dynamics.x_next
    drift = x_next - x_ref if difference is None else difference(x_next, x_ref)
    drift = jnp.max(jnp.abs(drift))
    # What is left of an equilibrium that was computed, or is written in few digits.
    slack = jnp.finfo(x_ref.dtype).eps ** 0.5 * (1 + jnp.max(jnp.abs(x_ref)))
    moves = ~(drift <= slack)
    rule = (
        "LQR: dynamics must rest at their operating point (x_next = x_ref); choose an "
        "equilibrium as x and u of `delucax.linearize`"
    )
    if not is_concrete(moves):
        return eqx.error_if(x_ref, moves, rule + ".")
    if moves:
        raise ValueError(f"{rule}, got x_ref {x_ref} and x_next {x_next}.")
    return x_ref
