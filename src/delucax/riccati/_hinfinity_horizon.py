"""The H-infinity games over a finite horizon."""

from typing import Any

import equinox as eqx
from jaxtyping import ArrayLike

from .._check import check_definite
from .._jax import compiled_unless_on_host, host_unless_traced, vmap, xp
from .._results import choose, RESULTS
from .._typing import Array, Numbers
from ..math._linear_solve import full_precision, solve, symmetric
from ._arguments import final_weight, increasing_times, stage_arguments, where_solved
from ._hinfinity import checked_game
from ._level import (
    at_level,
    Game,
    game_at_level,
    GameSolution,
    inverse_margin,
    inverse_margins,
    joint,
    joint_gain,
    joint_inputs,
    largest_eigenvalue,
)
from ._recursion import flow_values, gain, is_clearly_definite, values
from ._stabilising import shifted


def _values(discrete: bool, problem: tuple, gamma: Array) -> Array:
    """`X` at each step or time of the game `(A, B, D, Q, R, final, *times)`."""
    A, B, D, Q, R, final, *times = problem
    if discrete:
        both, weight = joint_inputs(B, D, R, gamma)
        S = xp.zeros_like(both)
        return values(A, both, Q, weight, S, final, D.shape[-1], False)
    definite = is_clearly_definite(R)
    safe = xp.where(definite, R, shifted(1, R))
    # The quadratic term of both players. The flow has the same form as for control.
    G = symmetric(B @ solve(safe, B.T) - D @ D.T / gamma**2)
    X = flow_values(A, G, Q, final, *times, True)
    return xp.where(definite, X, xp.nan)


@host_unless_traced
def hinf_dre(
    A: Numbers,
    B: Numbers,
    D: Numbers | None,
    Q: Numbers,
    R: Numbers,
    *,
    final: Numbers | None = None,
    horizon: Any = None,
    gamma: ArrayLike | None = None,
    tolerance: ArrayLike | None = None,
    throw: bool = True,
) -> GameSolution:
    r"""H-infinity control over a finite horizon in discrete time.

    The recursion runs backwards in time, from $X_T = X_f$ (`final`):

    $$X_t = Q + A^\top X_{t+1}
    \left( I + (B R^{-1} B^\top - \gamma^{-2} D D^\top) X_{t+1} \right)^{-1} A$$

    For the system $x_{t+1} = A x_t + B u_t + D w_t$ with $x_0 = 0$, the controls
    $u_t = -K_t x_t$ ensure for every disturbance $w$ that

    $$\sum_{t=0}^{T-1} \left( x_t^\top Q x_t + u_t^\top R u_t \right)
    + x_T^\top X_f x_T \le \gamma^2 \sum_{t=0}^{T-1} w_t^\top w_t.$$

    The control is computed without knowledge of $w$. A solution exists only if
    $\gamma^2 I - D^\top X_{t+1} D$ is positive definite at each step.

    All matrices except `final` may vary in time. The solution is differentiable to any
    order at a given `gamma`. If you do not pass `gamma`, the smallest level has first
    derivatives only, and the derivatives of the other results are those at a fixed
    level, as in [`delucax.riccati.hinf_dare`][].

    **Arguments:**

    - `A`: shape `(n, n)`, or `(T, n, n)`.
    - `B`: shape `(n, m)`, or `(T, n, m)`.
    - `D`: the input matrix of the disturbance, shape `(n, k)`, or `(T, n, k)`; `None`
        for the identity.
    - `Q`: state weight, shape `(n, n)`, or `(T, n, n)`, symmetric.
    - `R`: control weight, shape `(m, m)`, or `(T, m, m)`, symmetric.
    - `final`: final weight $X_f$, shape `(n, n)`, symmetric; zero by default.
    - `horizon`: the number of steps $T$; required if no argument has a time axis.
    - `gamma`: the level $\gamma$, a positive number. By default `gamma` is the smallest
        level that a controller can attain.
    - `tolerance`: the relative tolerance of the smallest level; by default 16 times
        machine epsilon.
    - `throw`: raise an error if the solver finds no solution (default). If false, check
        `result`.

    **Returns:** a [`delucax.riccati.GameSolution`][]. If a step has no saddle point,
    for example because `gamma` is too low, the solution is NaN at this step and at all
    steps before it.

    **Raises:** `ValueError` if an argument has the wrong shape or is not finite, if a
    weight is not symmetric, if the number of steps is unknown because `horizon` is not
    given and no argument has a time axis, or if `gamma` or `tolerance` is not positive.
    With `throw`, an error at run time if the solver finds no solution.

    Source: Basar and Bernhard, 1995.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[1.0, 1.0], [0.0, 1.0]])
        B = jnp.array([[0.0], [1.0]])
        Q, R = jnp.eye(2), jnp.eye(1)
        dlx.riccati.hinf_dre(A, B, None, Q, R, final=Q, horizon=20).gamma
        ```

        ```text
        Array(2.956, dtype=float32)
        ```
    """
    where = "hinf_dre"
    A = xp.asarray(A) if isinstance(A, list | tuple) else A
    if D is None and eqx.is_array_like(A) and xp.ndim(A) in (2, 3):
        D = xp.eye(xp.shape(A)[-1], dtype=xp.result_type(A, xp.float32))
    stage = stage_arguments(where, horizon, A=A, B=B, D=D, Q=Q, R=R)
    final = final_weight(final, stage["A"], where)
    check_definite(stage["Q"], "Q", where, False)
    check_definite(final, "final", where, False)
    problem = (*stage.values(), final)
    return at_level(_solution, where, True, problem, gamma, tolerance, throw)


@host_unless_traced
def hinf_cre(
    A: Numbers,
    B: Numbers,
    D: Numbers | None,
    Q: Numbers,
    R: Numbers,
    *,
    times: Numbers,
    final: Numbers | None = None,
    gamma: ArrayLike | None = None,
    tolerance: ArrayLike | None = None,
    throw: bool = True,
) -> GameSolution:
    r"""H-infinity control over a finite horizon in continuous time.

    The equation runs backwards in time, from $X(t_1) = X_f$ (`final`). $t_0$ and $t_1$
    are the first and the last of `times`:

    $$-\dot{X} = A^\top X + X A - X (B R^{-1} B^\top - \gamma^{-2} D D^\top) X + Q$$

    For the system $\dot{x} = A x + B u + D w$ with $x(t_0) = 0$, the control
    $u = -K(t)\, x$ with $K = R^{-1} B^\top X$ ensures for every disturbance $w$ that

    $$\int_{t_0}^{t_1} \left( x^\top Q x + u^\top R u \right) \mathrm{d}t
    + x(t_1)^\top X_f\, x(t_1) \le \gamma^2 \int_{t_0}^{t_1} w^\top w \,\mathrm{d}t.$$

    The solution is exact except for rounding errors, as in [`delucax.riccati.cre`][].
    The solution is differentiable to any order at a given `gamma`. If you do not pass
    `gamma`, the smallest level has first derivatives only, and the derivatives of the
    other results are those at a fixed level, as in [`delucax.riccati.hinf_dare`][]. As
    `gamma` approaches the smallest level, $X$ grows without bound at the first time. To
    design a controller, choose a `gamma` a few percent above the smallest level.

    **Arguments:** `A`, `B`, `D`, `Q`, `R`, `gamma`, `tolerance` and `throw`: as in
    [`delucax.riccati.hinf_care`][].

    - `times`: the times at which $X$ is computed, at least two and in increasing order,
        shape `(N,)`.
    - `final`: final weight $X_f$, shape `(n, n)`, symmetric, positive semidefinite;
        zero by default.

    **Returns:** a [`delucax.riccati.GameSolution`][]. The solution is NaN at each time
    $t$ for which the problem from $t$ to the end has no saddle point, for example
    because `gamma` is too low.

    **Raises:** as in [`delucax.riccati.hinf_care`][], and `ValueError` if the times do
    not increase or `final` is not symmetric and positive semidefinite.

    Source: Basar and Bernhard, 1995; Davison and Maki, 1973.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[0.0, 1.0], [0.0, 0.0]])
        B = jnp.array([[0.0], [1.0]])
        Q, R, times = jnp.eye(2), jnp.eye(1), jnp.linspace(0.0, 5.0, 11)
        dlx.riccati.hinf_cre(A, B, B, Q, R, times=times, gamma=3.0).K[0]
        ```

        ```text
        Array([[1.059, 1.872]], dtype=float32)
        ```
    """
    where = "hinf_cre"
    game = checked_game(where, A, B, D, Q, R)
    final = final_weight(final, game[0], where)
    check_definite(final, "final", where, False)
    times = increasing_times(times, where).astype(game[0].dtype)
    problem = (*game, final, times)
    return at_level(_solution, where, False, problem, gamma, tolerance, throw)


@compiled_unless_on_host
@full_precision
def _solution(discrete: bool, problem, gamma, tolerance) -> GameSolution:
    A, B, D, Q, R, _, *times = problem
    points = times[0].shape[0] if times else A.shape[0] + 1

    def solve_game(problem, gamma, _) -> Game:
        # The recursion always gives an X. It is not finite if the game has no solution.
        X = _values(discrete, problem, gamma)
        zero, yes = xp.zeros((), X.dtype), xp.ones((), bool)
        if discrete:
            margins = vmap(lambda D, X: inverse_margin(D, X, gamma))(problem[2], X[1:])
            growing = xp.max(vmap(largest_eigenvalue)(margins))
        else:
            growing = largest_eigenvalue(X[0])
        holds = xp.all(xp.isfinite(X))
        return Game(X, zero, holds, yes, xp.asarray(0), 1 / growing)

    def barrier(problem, gamma):
        X = _values(discrete, problem, gamma)
        total = xp.trace(X[0])
        return total + inverse_margins(problem[2], X[1:], gamma) if discrete else total

    start = xp.zeros((points, *A.shape[-2:]), A.dtype)
    end, level, gamma = game_at_level(
        solve_game, barrier, problem, start, gamma, tolerance
    )
    X = _values(discrete, problem, level)
    good = xp.all(xp.isfinite(X), axis=(1, 2))
    masked = lambda M: xp.where(good[:, None, None], M, xp.nan)
    m = B.shape[-1]
    if discrete:
        # The gains of step t follow from X[t+1]. They exist if X[t] exists.
        good = good[:-1]
        both, weight = joint_inputs(B, D, R, level)
        (A, both, after), weight = where_solved(good, (A, both, X[1:]), weight)
        K, _ = vmap(gain)(A, both, weight, xp.zeros_like(both), after)
        B = both[..., :m]
    else:
        known, X = xp.where(good[:, None, None], X, 0), masked(X)
        R = xp.where(xp.any(good), R, shifted(1, R))
        data = joint((A, B, D, Q, R), level)
        K = vmap(lambda X: joint_gain(False, data, X))(known)
    return GameSolution(
        X=X,
        K=masked(K[:, :m]),
        L=masked(-K[:, m:]),
        gamma=gamma,
        closed_loop=masked(A - B @ K[:, :m]),
        result=choose(end.game.good, RESULTS.successful, RESULTS.infeasible),
    )
