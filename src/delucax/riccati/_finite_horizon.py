"""Linear-quadratic control over a finite horizon."""

from typing import Any

import equinox as eqx

from .._check import finite_vector
from .._jax import compiled_unless_on_host, host_unless_traced, on_host, vmap, xp
from .._module import shown
from .._results import choose, raise_on_failure, Result, RESULTS
from .._typing import Array, Numbers
from ..math._linear_solve import full_precision, solve
from ._arguments import (
    constant_matrices,
    final_weight,
    increasing_times,
    stage_arguments,
    where_solved,
)
from ._recursion import (
    failed_step,
    flow_values,
    gain,
    is_clearly_definite,
    linear_recursion,
    values,
    without_cross_weight,
)


class FiniteHorizonSolution(eqx.Module):
    r"""The optimal control of a linear-quadratic problem over a finite horizon.

    In discrete time the minimal cost from state $x$ at step $t$ is
    $x^\top X_t x + 2 p_t^\top x + s_t$. The control $u = -K_t x - k_t$ attains this
    cost. In continuous time the minimal cost from $x$ at `times[i]` is $x^\top X_i x$,
    and the control $u = -K_i x$ attains this cost.

    **Attributes:**

    - `X`: the quadratic part of the cost-to-go, symmetric. In discrete time, `X` has
        one matrix for each step and one for the end, shape `(T+1, n, n)`. In continuous
        time, `X` has one matrix for each point of the time grid, shape `(N, n, n)`.
    - `K`: the gains, shape `(T, m, n)`, or `(N, m, n)` in continuous time.
    - `closed_loop`: the matrices $A - B K$, shape `(T, n, n)`, or `(N, n, n)` in
        continuous time.
    - `result`: success, or the reason for a failure; one of `delucax.RESULTS`.
    - `p`: the linear part of the cost-to-go, shape `(T+1, n)`. `p`, `s` and `k` are
        zero if the problem has no linear terms, and `None` in continuous time.
    - `s`: the constant part of the cost-to-go, shape `(T+1,)`.
    - `k`: the feed-forward controls, shape `(T, m)`.
    - `times`: the time grid in continuous time, shape `(N,)`; `None` in discrete time.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[1.0, 1.0], [0.0, 1.0]])
        B = jnp.array([[0.0], [1.0]])
        solution = dlx.riccati.dre(A, B, jnp.eye(2), jnp.eye(1), horizon=10)
        solution.K[0]
        ```

        ```text
        Array([[0.422, 1.244]], dtype=float32)
        ```
    """

    X: Array
    K: Array
    closed_loop: Array
    result: Result
    p: Array | None = None
    s: Array | None = None
    k: Array | None = None
    times: Array | None = None

    __repr__ = shown


@host_unless_traced
def dre(
    A: Numbers,
    B: Numbers,
    Q: Numbers,
    R: Numbers,
    S: Numbers | None = None,
    *,
    final: Numbers | None = None,
    horizon: Any = None,
    d: Numbers | None = None,
    q: Numbers | None = None,
    r: Numbers | None = None,
    final_q: Numbers | None = None,
    parallel: bool = False,
    throw: bool = True,
) -> FiniteHorizonSolution:
    r"""The discrete-time Riccati recursion, for control over a finite horizon.

    It runs backwards in time, from $X_T = X_f$ (`final`):

    $$K_t = (R + B^\top X_{t+1} B)^{-1} (B^\top X_{t+1} A + S^\top), \qquad
    X_t = Q + A^\top X_{t+1} A - (A^\top X_{t+1} B + S) K_t$$

    For the system $x_{t+1} = A x_t + B u_t + d$, the controls $u_t = -K_t x_t - k_t$
    minimise

    $$\sum_{t=0}^{T-1} \left( x_t^\top Q x_t + 2 x_t^\top S u_t + u_t^\top R u_t
    + 2 q^\top x_t + 2 r^\top u_t \right) + x_T^\top X_f x_T + 2 q_f^\top x_T.$$

    To track references $x^*$ and $u^*$, pass $q = -Q x^*$, $r = -R u^*$ and
    $q_f = -X_f x_T^*$ as the linear costs.

    All arguments except `final` and `final_q` may vary in time. The solution is
    differentiable to any order, in forward and reverse mode. The computation of a
    gradient needs as much memory as $X$ itself.

    **Arguments:**

    - `A`: shape `(n, n)`, or `(T, n, n)`.
    - `B`: shape `(n, m)`, or `(T, n, m)`.
    - `Q`: state weight, shape `(n, n)`, or `(T, n, n)`, symmetric.
    - `R`: control weight, shape `(m, m)`, or `(T, m, m)`, symmetric. It may be
        singular.
    - `S`: cross weight, shape `(n, m)`, or `(T, n, m)`; zero by default.
    - `final`: final weight $X_f$, shape `(n, n)`, symmetric; zero by default.
    - `horizon`: the number of steps $T$; required if no argument has a time axis.
    - `d`: an offset of the next state, shape `(n,)`, or `(T, n)`; zero by default.
    - `q`: linear cost of the state, shape `(n,)`, or `(T, n)`; zero by default.
    - `r`: linear cost of the control, shape `(m,)`, or `(T, m)`; zero by default.
    - `final_q`: linear cost $q_f$ of the final state, shape `(n,)`; zero by default.
    - `parallel`: if true, compute all steps in parallel, by associative scans of
        logarithmic depth. This is faster on accelerators. False by default.
    - `throw`: raise an error if the cost has no minimum at some step (default). If
        false, check `result`.

    **Returns:** a [`delucax.riccati.FiniteHorizonSolution`][]. If
    $R + B^\top X_{t+1} B$ is not positive definite at a step $t$, the cost has no
    minimum at this step. The solution is then NaN at this step and at all steps before
    it.

    **Raises:** `ValueError` if an argument has the wrong shape or is not finite, if a
    weight is not symmetric, or if the number of steps is unknown because `horizon` is
    not given and no argument has a time axis. With `throw`, an error at run time if the
    cost has no minimum at some step.

    Source: Bertsekas, 2017; Sarkka and Garcia-Fernandez, 2023 (in parallel).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[1.0, 0.1], [0.0, 1.0]])
        B = jnp.array([[0.0], [0.1]])
        Q, R = jnp.eye(2), jnp.eye(1)
        ramp = jnp.stack([0.1 * jnp.arange(50), jnp.ones(50)], axis=1)
        plan = dlx.riccati.dre(A, B, Q, R, q=-ramp @ Q, parallel=True)
        -plan.K[0] @ jnp.zeros(2) - plan.k[0]
        ```

        ```text
        Array([1.681], dtype=float32)
        ```
    """
    where = "dre"
    # The parallel form takes more work, and NumPy runs it in sequence.
    parallel = bool(parallel) and not on_host()
    stage = stage_arguments(where, horizon, A=A, B=B, Q=Q, R=R, S=S, d=d, q=q, r=r)
    A = stage["A"]
    final, n = final_weight(final, A, where), A.shape[-1]
    is_affine = any(v is not None for v in (d, q, r, final_q))
    # Without linear terms, p, s and k are zero and are not computed.
    final_q = xp.zeros(n) if final_q is None else final_q
    final_q = finite_vector(final_q, n, "final_q", where).astype(A.dtype)
    solution = _discrete_solution(*stage.values(), final, final_q, is_affine, parallel)
    step = lambda: (
        f"R + B'XB is not positive definite at step {failed_step(solution.X)}."
    )
    return raise_on_failure(solution, where, throw, facts=step)


@compiled_unless_on_host
@full_precision
def _discrete_solution(A, B, Q, R, S, d, q, r, final, final_q, is_affine, parallel):
    X = values(A, B, Q, R, S, final, 0, parallel)
    good = xp.all(xp.isfinite(X[:-1]), axis=(1, 2))
    (A, B, Q, S, after), R = where_solved(good, (A, B, Q, S, X[1:]), R)
    K, loop = vmap(gain)(A, B, R, S, after)
    (T, _, m), n = B.shape, A.shape[-1]
    if is_affine:
        p, s, k = _affine(loop, K, B, R, after, d, q, r, final_q, parallel)
    else:
        p, s, k = (xp.zeros(shape, A.dtype) for shape in ((T + 1, n), T + 1, (T, m)))
    masked = lambda M: xp.where(good.reshape(-1, *(1,) * (M.ndim - 1)), M, xp.nan)
    p, s = (xp.concatenate([masked(M[:-1]), M[-1:]]) for M in (p, s))
    result = choose(xp.all(good), RESULTS.successful, RESULTS.infeasible)
    return FiniteHorizonSolution(X, masked(K), masked(loop), result, p, s, masked(k))


def _affine(loop, K, B, R, after, d, q, r, final_q, parallel):
    """The linear and constant parts of the cost-to-go, and the feed-forward."""
    # V(x) = x'Xx + 2 p'x + s at the next step. The cost-to-go as a function of u has
    # the derivative zero at u = -K x - k.
    pushed = xp.einsum("tij,tj->ti", after, d)
    added = xp.einsum("tji,tj->ti", loop, pushed) + q
    added = added - xp.einsum("tji,tj->ti", K, r)
    p = linear_recursion(loop, added, final_q, parallel, lambda loop, p: loop.T @ p)
    ahead = p[1:] + pushed
    push = r + xp.einsum("tji,tj->ti", B, ahead)
    pivot = R + xp.swapaxes(B, 1, 2) @ after @ B
    k = vmap(solve)(pivot, push[..., None])[..., 0]
    # d adds to the cost-to-go, and the feed-forward reduces it.
    gained = xp.sum(d * (p[1:] + ahead), axis=1) - xp.sum(k * push, axis=1)
    s = xp.cumsum(gained[::-1])[::-1]
    return p, xp.concatenate([s, xp.zeros(1, s.dtype)]), k


@host_unless_traced
def cre(
    A: Numbers,
    B: Numbers,
    Q: Numbers,
    R: Numbers,
    S: Numbers | None = None,
    *,
    times: Numbers,
    final: Numbers | None = None,
    throw: bool = True,
) -> FiniteHorizonSolution:
    r"""The Riccati differential equation, for control over a finite horizon.

    It runs backwards in time, from $X(t_1) = X_f$ (`final`). $t_0$ and $t_1$ are the
    first and the last of `times`:

    $$-\dot{X} = A^\top X + X A - (X B + S) R^{-1} (B^\top X + S^\top) + Q$$

    For the system $\dot{x} = A x + B u$, the control $u = -K(t)\, x$ with
    $K = R^{-1} (B^\top X + S^\top)$ minimises

    $$\int_{t_0}^{t_1} \left( x^\top Q x + 2 x^\top S u + u^\top R u \right)
    \mathrm{d}t + x(t_1)^\top X_f\, x(t_1).$$

    The solution is exact except for rounding errors, even if the equation is stiff or
    `times` has only a few points. The solver computes $X$ from a linear differential
    equation, which a matrix exponential solves over a short interval. Then the solver
    joins neighbouring intervals, which doubles the length of the intervals each time.
    The formula that joins two intervals contains no terms that grow with time. The
    solution is differentiable to any order, in forward and reverse mode.

    **Arguments:**

    - `A`: shape `(n, n)`.
    - `B`: shape `(n, m)`.
    - `Q`: state weight, shape `(n, n)`, symmetric.
    - `R`: control weight, shape `(m, m)`, symmetric, positive definite.
    - `S`: cross weight, shape `(n, m)`; zero by default.
    - `times`: the times at which $X$ is computed, at least two and in increasing order,
        shape `(N,)`.
    - `final`: final weight $X_f$, shape `(n, n)`, symmetric; zero by default.
    - `throw`: raise an error if the cost has no minimum (default). If false, check
        `result`.

    **Returns:** a [`delucax.riccati.FiniteHorizonSolution`][]. The solution is NaN at
    each time $t$ for which the cost from $t$ to the end has no minimum.

    **Raises:** `ValueError` if an argument has the wrong shape or is not finite, if a
    weight is not symmetric, or if the times do not increase. With `throw`, an error at
    run time if the cost has no minimum.

    Source: Davison and Maki, 1973 (the linear flow).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[0.0, 1.0], [0.0, 0.0]])
        B = jnp.array([[0.0], [1.0]])
        times = jnp.array([0.0, 100.0])
        dlx.riccati.cre(A, B, jnp.eye(2), jnp.eye(1), times=times).K[0]
        ```

        ```text
        Array([[1.   , 1.732]], dtype=float32)
        ```
    """
    where = "cre"
    given = constant_matrices(where, A=A, B=B, Q=Q, R=R, S=S)
    A, B = given["A"], given["B"]
    given.setdefault("S", xp.zeros_like(B))
    final = final_weight(final, A, where)
    times = increasing_times(times, where).astype(A.dtype)
    solution = _continuous_solution(*(given[M] for M in "ABQRS"), final, times)
    point = lambda: (
        "There is no solution over the time from point "
        f"{failed_step(solution.X)} of the grid (times) to its end."
    )
    return raise_on_failure(solution, where, throw, facts=point)


@compiled_unless_on_host
@full_precision
def _continuous_solution(A, B, Q, R, S, final, times):
    # If R is not definite, the Hamiltonian has no minimum for any X.
    definite = is_clearly_definite(R)
    safe = xp.where(definite, R, xp.eye(R.shape[0], dtype=R.dtype))
    X = flow_values(*without_cross_weight(A, B, Q, safe, S), final, times, False)
    good = definite & xp.all(xp.isfinite(X), axis=(1, 2))
    known = xp.where(good[:, None, None], X, 0)
    K = vmap(lambda X: solve(safe, B.T @ X + S.T))(known)
    masked = lambda M: xp.where(good[:, None, None], M, xp.nan)
    result = choose(xp.all(good), RESULTS.successful, RESULTS.infeasible)
    return FiniteHorizonSolution(
        masked(known), masked(K), masked(A - B @ K), result, times=times
    )
