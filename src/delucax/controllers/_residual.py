"""A network around a controller, and the regulator that an environment defines."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array, PyTree

from .._check import as_bounds, bounds_field, check_instance, check_positive
from .._controller import AbstractController, check_controller
from .._typing import PRNGKey, RealScalar
from ..environments import Environment
from ..math import clip
from ._lqr import LQR


class Residual(AbstractController):
    """A controller and a correction that is learned, such as an LQR and a network,

    `u = clip(base(t, y), low, high) + correction(t, y)`.

    **Arguments:**

    - `base`: the controller that works without the correction.
    - `correction`: another one, whose control is added.
    - `bounds`: `(low, high)` to which the control of `base` is clipped, so that the
        correction can undo it; none by default.

    Both are told the control that was applied in all.
    [`delucax.training.fit`][] trains the correction alone by `trainable="correction"`.

    **Raises:** `ValueError` if one of the two is not a controller, or bounds cross.

    Source: Johannink et al., 2019; Silver, Allen, Tenenbaum and Kaelbling, 2018
    (residual policy learning).

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        env = dlx.make("cartpole_linear")
        lqr = dlx.controllers.local_lqr(env)
        network = dlx.controllers.mlp_policy(env, 8, 1, key=jax.random.key(0))
        policy = dlx.controllers.Residual(lqr, network)
        dlx.rollout(env, policy, key=jax.random.key(1), horizon=10).total_cost
        ```
    """

    base: AbstractController
    correction: AbstractController
    bounds: tuple[Array, Array] | None = bounds_field("Residual", default=None)

    def __check_init__(self):
        check_controller(self.base, "base", "Residual")
        check_controller(self.correction, "correction", "Residual")
        as_bounds(self.bounds, "Residual")

    def init(self, *, key: PRNGKey | None = None) -> PyTree:
        first, second = (None, None) if key is None else jr.split(key)
        return self.base.init(key=first), self.correction.init(key=second)

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        base_state, correction_state = state
        u, base_state = self.base(t, y, base_state)
        if self.bounds is not None:
            u = clip(u, *self.bounds)
        change, correction_state = self.correction(t, y, correction_state)
        return (u + change).astype(y.dtype), (base_state, correction_state)

    def applied(self, u: Array, cost: Array, state: PyTree) -> PyTree:
        base, correction = self.base, self.correction
        return base.applied(u, cost, state[0]), correction.applied(u, cost, state[1])


def local_lqr(environment: Environment, *, regularisation: float = 1e-4) -> LQR:
    """The LQR that an environment defines: for its dynamics and the curvature of its
    cost, both at the operating point of `environment.trim()`.

    A direction in which the cost is flat or concave there is given the weight
    `regularisation` times the largest one, because an LQR needs a definite one.

    **Arguments:**

    - `environment`: the environment. Its state must be observed.
    - `regularisation`: 1e-4 by default.

    **Returns:** a [`delucax.controllers.LQR`][].

    **Raises:** `ValueError` if the state is not observed, the environment has no target
    and no equilibrium, or the cost is not twice differentiable there; an error at run
    time if there is no operating point or no stabilising gain.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("quadrotor")
        dlx.controllers.local_lqr(env).K.shape
        ```
    """
    where = "local_lqr"
    check_instance(environment, Environment, "environment", where)
    check_positive(regularisation, "regularisation", where)
    dynamics = environment.dynamics
    point = environment.trim()
    x, u = point.x, point.u
    H = np.asarray(_curvature(environment.cost, x, u), float)
    if not np.all(np.isfinite(H)):
        raise ValueError(
            f"{where}: the cost must be twice differentiable at x = {x}, u = {u}."
        )
    values, vectors = np.linalg.eigh(H)
    least = regularisation * max(values.max(), 1e-3)
    H = jnp.asarray(vectors * np.clip(values, least, None) @ vectors.T, x.dtype)
    n = x.shape[0]
    weights = H[:n, :n], H[n:, n:], H[:n, n:]
    return LQR(dynamics, *weights, point=point, difference=dynamics.difference)


@eqx.filter_jit
def _curvature(cost: Any, x: Array, u: Array) -> Array:
    """H of the stage cost, `dz' H dz` to second order, `dz` the change of (x, u)."""
    n = x.shape[0]
    stage = lambda z: cost(jnp.zeros(()), x + z[:n], u + z[n:])
    return jax.hessian(stage)(jnp.zeros(n + u.shape[0], x.dtype)) / 2
