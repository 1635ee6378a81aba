"""The controllers that an environment defines: by its model and its cost, at its
operating point."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._check import check_instance, check_positive, is_concrete
from .._typing import RealScalar, State
from ..costs import AbstractCost, Function
from ..dynamics import LinearDynamics, linearize
from ..environments import Environment
from ..planning import AbstractPlanner, ILQR
from ._lqr import LQR
from ._mpc import MPC


class LocalModel(NamedTuple):
    """A linear-quadratic model of an environment about an operating point.

    **Attributes:** `dynamics`, linear and about that point; `Q`, `R` and `S`, the
    weights of `dx'Q dx + 2 dx'S du + du'R du`, shapes `(n, n)`, `(m, m)` and `(n, m)`.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("quadrotor")
        model = dlx.controllers.local_model(env)
        dlx.controllers.HInfinity(model.dynamics, model.Q, model.R).gamma
        ```
    """

    dynamics: LinearDynamics
    Q: Float[Array, "n n"]
    R: Float[Array, "m m"]
    S: Float[Array, "n m"]


def local_model(
    environment: Environment, *, regularisation: float = 1e-4
) -> LocalModel:
    """The dynamics of an environment and the curvature of its cost, both at the
    operating point of `environment.trim()`: what a linear design needs.

    A direction in which the cost is flat or concave there is given the weight
    `regularisation` times the largest one, because designs need a definite one.

    **Arguments:**

    - `environment`: the environment.
    - `regularisation`: 1e-4 by default.

    **Returns:** a [`delucax.controllers.LocalModel`][].

    **Raises:** `ValueError` if the environment has no target and no equilibrium, if the
    cost is not twice differentiable there, or if the environment is traced (under
    `jax.jit`, `jax.vmap` or `jax.grad`); an error at run time if there is no operating
    point.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("pendulum")
        dynamics, Q, R, S = dlx.controllers.local_model(env)
        dlx.controllers.FiniteHorizonLQR(dynamics, Q, R, S, horizon=env.horizon).K[0]
        ```
    """
    return _local_model(environment, regularisation, "local_model")


def _local_model(environment: Any, regularisation: Any, where: str) -> LocalModel:
    check_instance(environment, Environment, "environment", where)
    check_positive(regularisation, "regularisation", where)
    if not all(is_concrete(leaf) for leaf in jax.tree.leaves(environment)):
        raise ValueError(
            f"{where}: environment must hold values. Under jax.jit, jax.vmap or "
            "jax.grad use delucax.linearize and delucax.controllers.LQR."
        )
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
    linear = linearize(environment.dynamics, x=point)
    return LocalModel(linear, H[:n, :n], H[n:, n:], H[:n, n:])


@eqx.filter_jit
def _curvature(cost: Any, x: Array, u: Array) -> Array:
    """H of the stage cost, `dz' H dz` to second order, `dz` the change of (x, u)."""
    n = x.shape[0]
    # A cost that only counts may be of integers.
    stage = lambda z: jnp.asarray(cost(jnp.zeros(()), x + z[:n], u + z[n:]), x.dtype)
    return jax.hessian(stage)(jnp.zeros(n + u.shape[0], x.dtype)) / 2


def local_lqr(environment: Environment, *, regularisation: float = 1e-4) -> LQR:
    """The LQR that an environment defines: that of
    [`delucax.controllers.local_model`][].

    **Arguments:**

    - `environment`: the environment. Its state must be observed.
    - `regularisation`: of the weights, 1e-4 by default.

    **Returns:** a [`delucax.controllers.LQR`][].

    **Raises:** `ValueError` if the state is not observed, and where
    [`delucax.controllers.local_model`][] raises; an error at run time if there is no
    stabilising gain.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("quadrotor")
        dlx.controllers.local_lqr(env).K.shape
        ```
    """
    model = _local_model(environment, regularisation, "local_lqr")
    return LQR(*model, difference=environment.dynamics.difference)


def local_mpc(
    environment: Environment,
    lqr: LQR | None = None,
    *,
    horizon: int = 30,
    planner: AbstractPlanner | None = None,
    real_time: bool = False,
    throw: bool = True,
) -> MPC:
    """The MPC that an environment defines: by its model, its cost and its bounds, and
    with the cost to go of an LQR, `dx' P dx`, at the end of each plan.

    **Arguments:**

    - `environment`: the environment. Its state must be observed.
    - `lqr`: such as that of [`delucax.controllers.local_lqr`][]; by default plans end
        with the final cost of the environment.
    - `horizon`: the steps of a plan, 30 by default.
    - `planner`: [`delucax.planning.ILQR`][] with at most 8 iterations by default, and
        [`delucax.planning.SQP`][] with `real_time`.
    - `real_time`, `throw`: as in [`delucax.controllers.MPC`][].

    **Returns:** a [`delucax.controllers.MPC`][].

    **Raises:** `ValueError` if the observation has not the size of the state, and as
    [`delucax.controllers.MPC`][] does.

    !!! example

        ```python
        import delucax as dlx
        import jax

        env = dlx.make("pendulum")
        mpc = dlx.controllers.local_mpc(env, dlx.controllers.local_lqr(env))
        dlx.rollout(env, mpc, key=jax.random.key(0), horizon=10).total_cost
        ```
    """
    where = "local_mpc"
    check_instance(environment, Environment, "environment", where)
    dynamics = environment.dynamics
    # By the sizes, which are known of a traced sensor too.
    p, n = dynamics.observation_size, dynamics.state_size
    if p != n:
        raise ValueError(
            f"{where}: environment must observe its state, of size {n}, got an "
            f"observation of size {p}."
        )
    cost: AbstractCost = environment.cost
    if lqr is not None:
        check_instance(lqr, LQR, "lqr", where)
        P, x_ref, difference = lqr.P, lqr.x_ref, dynamics.difference

        def to_go(t: RealScalar, x: State) -> Array:
            away = difference(x, x_ref)
            return away @ P @ away

        cost = Function(cost, to_go)
    if planner is None and not real_time:
        planner = ILQR(max_iterations=8)
    options: dict[str, Any] = dict(planner=planner, real_time=real_time, throw=throw)
    bounds = environment.control_bounds
    return MPC(dynamics, cost, horizon, bounds=bounds, **options)
