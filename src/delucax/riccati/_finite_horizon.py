"""Linear-quadratic control over a finite horizon."""

from typing import Any

import equinox as eqx

from .._check import as_vector
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
    """The optimal control over a finite horizon.

    The least cost from state `x` at step `t` is `x'X[t]x + 2 p[t]'x + s[t]`, and the
    control that attains it is `u = -K[t] x - k[t]`. In continuous time the least cost
    from `x` at `times[i]` is `x'X[i]x`, attained by `u = -K[i] x`.

    **Attributes:**

    - `X`: at each step and at the end, shape `(T+1, n, n)`, symmetric; in continuous
        time at each point of the grid, shape `(N, n, n)`.
    - `K`: the gains, shape `(T, m, n)`, or `(N, m, n)`.
    - `closed_loop`: the matrices `A - B K`, shape `(T, n, n)`, or `(N, n, n)`.
    - `result`: success, or why not; one of `delucax.RESULTS`.
    - `p`: the linear part of the cost-to-go, shape `(T+1, n)`; zero if the problem has
        no linear terms, as are `s` and `k`. `None` in continuous time, as are they.
    - `s`: its constant part, shape `(T+1,)`.
    - `k`: the feed-forward controls, shape `(T, m)`.
    - `times`: in continuous time the grid, shape `(N,)`; `None` in discrete time.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[1.0, 1.0], [0.0, 1.0]])
        B = jnp.array([[0.0], [1.0]])
        solution = dlx.riccati.dre(A, B, jnp.eye(2), jnp.eye(1), horizon=10)
        solution.K[0], solution.X[0]
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
    r"""The discrete-time Riccati recursion, back from `X_T = final`:

    `X_t = Q + A'X A - (A'X B + S) K_t`, `K_t = (R + B'X B)^-1 (B'X A + S')`

    with `X = X_{t+1}`. The controls `u = -K_t x - k_t` minimise, along
    `x_next = A x + B u + d`, the sum of `x'Qx + 2 x'Su + u'Ru + 2 q'x + 2 r'u` over
    steps `t < T`, plus `x_T' final x_T + 2 final_q'x_T`. To track references `x_ref`
    and `u_ref`, give `q = -Q x_ref`, `r = -R u_ref` and `final_q = -final x_ref_T`.

    Any argument of the stage may vary in time. It is differentiable to any order, in
    either mode, and the memory of a gradient is that of `X`.

    **Arguments:**

    - `A`: shape `(n, n)`, or `(T, n, n)`.
    - `B`: shape `(n, m)`, or `(T, n, m)`.
    - `Q`: state weight, shape `(n, n)`, or `(T, n, n)`, symmetric.
    - `R`: control weight, shape `(m, m)`, or `(T, m, m)`, symmetric. May be singular.
    - `S`: cross weight, shape `(n, m)`, or `(T, n, m)`; zero by default.
    - `final`: final weight, shape `(n, n)`, symmetric; zero by default.
    - `horizon`: the number of steps `T`; needed if no argument has a time axis.
    - `d`: what is added to the next state, shape `(n,)`, or `(T, n)`; zero by default.
    - `q`: linear cost of the state, shape `(n,)`, or `(T, n)`; zero by default.
    - `r`: linear cost of the control, shape `(m,)`, or `(T, m)`; zero by default.
    - `final_q`: linear cost of the final state, shape `(n,)`; zero by default.
    - `parallel`: if true, in parallel over time, by associative scans of logarithmic
        depth, which pays on accelerators; in sequence by default.
    - `throw`: raise if a step has no minimum (default); if false, check `result`.

    **Returns:** a [`delucax.riccati.FiniteHorizonSolution`][]. It is NaN at a step
    where `R + B'XB` is not positive definite, and at all before it, as there is no
    minimum then.

    **Raises:** `ValueError` on an argument of the wrong shape, that is not finite or
    not symmetric, or if there is no horizon; an error at run time as `throw` says.

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
        u0 = -plan.K[0] @ jnp.zeros(2) - plan.k[0]
        ```
    """
    where = "dre"
    # NumPy gains nothing from the longer way that is parallel.
    parallel = bool(parallel) and not on_host()
    stage = stage_arguments(where, horizon, A=A, B=B, Q=Q, R=R, S=S, d=d, q=q, r=r)
    A = stage["A"]
    final, n = final_weight(final, A, where), A.shape[-1]
    is_affine = any(v is not None for v in (d, q, r, final_q))
    # Without linear terms p, s and k are zero, and are not computed.
    final_q = xp.zeros(n) if final_q is None else final_q
    final_q = as_vector(final_q, n, "final_q", where).astype(A.dtype)
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
    # With V(x) = x'Xx + 2 p'x + s at the next step, the control of x meets
    # X (A x + B u + d) + p: the derivative in u is zero at u = -K x - k.
    pushed = xp.einsum("tij,tj->ti", after, d)
    added = xp.einsum("tji,tj->ti", loop, pushed) + q
    added = added - xp.einsum("tji,tj->ti", K, r)
    p = linear_recursion(loop, added, final_q, parallel, lambda loop, p: loop.T @ p)
    ahead = p[1:] + pushed
    push = r + xp.einsum("tji,tj->ti", B, ahead)
    pivot = R + xp.swapaxes(B, 1, 2) @ after @ B
    k = vmap(solve)(pivot, push[..., None])[..., 0]
    # What d adds to the cost-to-go, less what the feed-forward saves of it.
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
    r"""The Riccati differential equation, back from `X(t_1) = final`:

    `-dX/dt = A'X + XA - (XB + S) R^-1 (B'X + S') + Q`.

    The control `u = -K(t) x`, `K = R^-1 (B'X + S')`, minimises the integral of
    `x'Qx + 2 x'Su + u'Ru` along `dx/dt = A x + B u` up to `t_1`, the last of `times`,
    plus `x(t_1)' final x(t_1)`.

    It is exact but for rounding, however stiff the equation and coarse the grid: the
    flow is linear in `[I; X]`, so that it is known over a short time, and intervals are
    composed, doubling their length each time, in a form that does not grow. It is
    differentiable to any order, in either mode.

    **Arguments:**

    - `A`: shape `(n, n)`.
    - `B`: shape `(n, m)`.
    - `Q`: state weight, shape `(n, n)`, symmetric.
    - `R`: control weight, shape `(m, m)`, symmetric, positive definite.
    - `S`: cross weight, shape `(n, m)`; zero by default.
    - `times`: where `X` is wanted, increasing, at least two, shape `(N,)`.
    - `final`: final weight, shape `(n, n)`, symmetric; zero by default.
    - `throw`: raise if there is no minimum (default); if false, check `result`.

    **Returns:** a [`delucax.riccati.FiniteHorizonSolution`][]. It is NaN at the
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
    given = constant_matrices(where, A=A, B=B, Q=Q, R=R, S=S)
    A, B = given["A"], given["B"]
    given.setdefault("S", xp.zeros_like(B))
    final = final_weight(final, A, where)
    times = increasing_times(times, where).astype(A.dtype)
    solution = _continuous_solution(*(given[M] for M in "ABQRS"), final, times)
    point = lambda: (
        "There is no solution over the time from point "
        f"{failed_step(solution.X)} of the grid."
    )
    return raise_on_failure(solution, where, throw, facts=point)


@compiled_unless_on_host
@full_precision
def _continuous_solution(A, B, Q, R, S, final, times):
    # Without a definite R the Hamiltonian has no minimum, whatever X is.
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
