"""Linear-quadratic control over a finite horizon in continuous time."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._check import as_matrix, symmetric_matrix
from .._results import choose, Result, RESULTS
from ..math._linear_solve import full_precision, solve, symmetric
from ._flow import flow_values
from ._horizon_arguments import (
    check_shapes,
    checked_times,
    common_dtype,
    final_weight,
)
from ._recursion import failed_step, is_clearly_definite
from ._solution import checked


class ContinuousHorizonSolution(eqx.Module):
    """The optimal control over a finite horizon of continuous time.

    The least cost from state `x` at time `times[i]` is `x'X[i]x`, and the control there
    is `u = -K[i] x`.

    **Attributes:**

    - `times`: the grid, shape `(N,)`.
    - `X`: shape `(N, n, n)`, symmetric.
    - `K`: the gains, shape `(N, m, n)`.
    - `closed_loop`: the matrices `A - B K`, shape `(N, n, n)`.
    - `result`: success, or why not; one of `delucax.RESULTS`.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[0.0, 1.0], [0.0, 0.0]])
        B = jnp.array([[0.0], [1.0]])
        times = jnp.linspace(0.0, 2.0, 21)
        solution = dlx.riccati.cre(A, B, jnp.eye(2), jnp.eye(1), times=times)
        solution.X[0], solution.K[0]
        ```
    """

    times: Array
    X: Array
    K: Array
    closed_loop: Array
    result: Result


def cre(
    A: Any,
    B: Any,
    Q: Any,
    R: Any,
    S: Any = None,
    *,
    times: Any,
    final: Any = None,
    throw: bool = True,
) -> ContinuousHorizonSolution:
    r"""The Riccati differential equation, back from `X(t_1) = final`:

    `-dX/dt = A'X + XA - (XB + S) R^-1 (B'X + S') + Q`.

    The control `u = -K(t) x`, `K = R^-1 (B'X + S')`, minimises the integral of
    `x'Qx + 2 x'Su + u'Ru` along `dx/dt = A x + B u` up to `t_1`, the last of `times`,
    plus `x(t_1)' final x(t_1)`.

    It is exact but for rounding, however stiff the equation and coarse the grid: the
    flow is linear in `[I; X]`, so that it is known over a short time, and intervals are
    joined, doubling their length each time, in a form that does not grow. It is
    differentiable to any order, in either mode.

    **Arguments:**

    - `A`: shape `(n, n)`.
    - `B`: shape `(n, m)`.
    - `Q`: state weight, shape `(n, n)`, symmetric.
    - `R`: control weight, shape `(m, m)`, symmetric, positive definite.
    - `S`: cross weight, shape `(n, m)`; zero by default.
    - `times`: where `X` is wanted, increasing, at least two, shape `(N,)`.
    - `final`: final weight, shape `(n, n)`, symmetric; zero by default.
    - `throw`: raise if there is no minimum (default); if false, look at `result`.

    **Returns:** a [`delucax.riccati.ContinuousHorizonSolution`][]. It is NaN at the
    times from which there is no minimum.

    **Raises:** `ValueError` on an argument of the wrong shape, that is not finite or
    not symmetric, or times that do not increase; an error at run time as `throw` says.

    Source: Davison and Maki, 1973 (the linear flow).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[0.0, 1.0], [0.0, 0.0]])
        B = jnp.array([[0.0], [1.0]])
        times = jnp.array([0.0, 100.0])
        K = dlx.riccati.cre(A, B, jnp.eye(2), jnp.eye(1), times=times).K[0]
        ```
    """
    where = "cre"
    given = {"A": as_matrix(A, "A", where), "B": as_matrix(B, "B", where)}
    given["Q"] = symmetric_matrix(Q, "Q", where)
    given["R"] = symmetric_matrix(R, "R", where)
    if S is not None:
        given["S"] = as_matrix(S, "S", where)
    check_shapes(where, given)
    dtype = common_dtype(where, given)
    n, m = given["B"].shape
    final = final_weight(final, n, where, dtype)
    given.setdefault("S", jnp.zeros((n, m)))
    matrices = (given[name].astype(dtype) for name in "ABQRS")
    solution = _solution(*matrices, final, checked_times(times, where).astype(dtype))
    return checked(solution, where, throw, _first_failure)


def _first_failure(solution: ContinuousHorizonSolution) -> str:
    point = failed_step(solution.X)
    return f"There is no solution over the time from point {point} of the grid."


@eqx.filter_jit
@full_precision
def _solution(A, B, Q, R, S, final, times):
    definite = is_clearly_definite(R)
    safe = jnp.where(definite, R, jnp.eye(R.shape[0], dtype=R.dtype))
    removed = solve(safe, jnp.concatenate([S.T, B.T], axis=1))
    n = A.shape[0]
    plain_A, G = A - B @ removed[:, :n], symmetric(B @ removed[:, n:])
    plain_Q = symmetric(Q - S @ removed[:, :n])
    X = flow_values(plain_A, G, plain_Q, final, times, False)
    good = definite & jnp.all(jnp.isfinite(X), axis=(1, 2))
    known = jnp.where(good[:, None, None], X, 0)
    K = jax.vmap(lambda X: solve(safe, B.T @ X + S.T))(known)
    masked = lambda M: jnp.where(good[:, None, None], M, jnp.nan)
    result = choose(jnp.all(good), RESULTS.successful, RESULTS.infeasible)
    return ContinuousHorizonSolution(
        times, masked(known), masked(K), masked(A - B @ K), result
    )
