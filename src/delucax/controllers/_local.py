"""Controllers from the model, the cost and the operating point of an environment."""

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
    r"""A linear-quadratic model of an environment about an operating point.

    The cost per step is, up to a constant and linear terms,

    $$\delta x^\top Q\, \delta x + 2\, \delta x^\top S\, \delta u +
    \delta u^\top R\, \delta u$$

    where $\delta x$ and $\delta u$ are the deviations from the operating point.

    **Attributes:**

    - `dynamics`: linear dynamics about the operating point.
    - `Q`, `R`, `S`: the weights of the cost, shapes `(n, n)`, `(m, m)` and `(n, m)`.

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
    """The linearised dynamics and the second-order cost of an environment.

    The function linearises the dynamics and approximates the cost to second order, both
    at the operating point from `environment.trim()`. A linear design such as
    [`delucax.controllers.LQR`][] needs this model.

    Linear designs need a positive definite cost. If the cost is flat or concave in some
    direction, the function sets the weight of this direction to `regularisation` times
    the largest weight.

    **Arguments:**

    - `environment`: the environment.
    - `regularisation`: the ratio of the smallest allowed weight to the largest weight,
        1e-4 by default.

    **Returns:** a [`delucax.controllers.LocalModel`][].

    **Raises:** `ValueError` if the environment has no target and no equilibrium, if the
    cost is not twice differentiable at the operating point, or if the environment is
    traced (under `jax.jit`, `jax.vmap` or `jax.grad`); an error at run time if there is
    no operating point.

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
            f"{where}: environment must hold values, got traced arrays. Under jax.jit, "
            "jax.vmap or jax.grad use delucax.linearize and delucax.controllers.LQR."
        )
    point = environment.trim()
    x, u = point.x, point.u
    H = np.asarray(_curvature(environment.cost, x, u), float)
    if not np.all(np.isfinite(H)):
        raise ValueError(
            f"{where}: the cost of environment must be twice differentiable at the "
            f"operating point x = {x}, u = {u}."
        )
    values, vectors = np.linalg.eigh(H)
    least = regularisation * max(values.max(), 1e-3)
    H = jnp.asarray(vectors * np.clip(values, least, None) @ vectors.T, x.dtype)
    n = x.shape[0]
    linear = linearize(environment.dynamics, x=point)
    return LocalModel(linear, H[:n, :n], H[n:, n:], H[:n, n:])


@eqx.filter_jit
def _curvature(cost: Any, x: Array, u: Array) -> Array:
    """The matrix `H` of the stage cost `dz' H dz` to second order in `z = (x, u)`."""
    n = x.shape[0]
    # A cost may return integers, which have no derivative.
    stage = lambda z: jnp.asarray(cost(jnp.zeros(()), x + z[:n], u + z[n:]), x.dtype)
    return jax.hessian(stage)(jnp.zeros(n + u.shape[0], x.dtype)) / 2


def local_lqr(environment: Environment, *, regularisation: float = 1e-4) -> LQR:
    """The LQR of an environment, for its linear-quadratic model.

    [`delucax.controllers.local_model`][] computes that model.

    **Arguments:**

    - `environment`: the environment. Its observation must be its state.
    - `regularisation`: the ratio of the smallest allowed weight to the largest weight,
        1e-4 by default.

    **Returns:** a [`delucax.controllers.LQR`][].

    **Raises:** `ValueError` if the observation is not the state, or for the same
    reasons as [`delucax.controllers.local_model`][]; an error at run time if there is
    no stabilising gain.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("quadrotor")
        dlx.controllers.local_lqr(env).K.shape
        ```

        ```text
        (4, 13)
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
    r"""The MPC of an environment, with the model, cost and bounds of the environment.

    Differences of states come from `environment.dynamics.difference`, which wraps
    angles.

    If you pass `lqr`, the final cost of each plan is the cost to go of this regulator,
    $\delta x^\top P\, \delta x$.

    **Arguments:**

    - `environment`: the environment. Its observation must be its state.
    - `lqr`: a linear-quadratic regulator, whose cost to go becomes the final cost, for
        example from [`delucax.controllers.local_lqr`][]. By default each plan uses the
        final cost of the environment.
    - `horizon`: the number of steps of a plan, 30 by default.
    - `planner`: the planner of the MPC. By default it is [`delucax.planning.ILQR`][]
        with at most 8 iterations, or [`delucax.planning.SQP`][] if `real_time` is true.
    - `real_time`, `throw`: as in [`delucax.controllers.MPC`][].

    **Returns:** a [`delucax.controllers.MPC`][].

    **Raises:** `ValueError` if the observation and the state have different sizes, or
    for the same reasons as [`delucax.controllers.MPC`][].

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
    # Only the sizes are compared, because they are known under a trace too.
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
    options |= dict(bounds=environment.control_bounds, difference=dynamics.difference)
    return MPC(dynamics, cost, horizon, **options)
