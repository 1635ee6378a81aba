"""The H-infinity games over a finite horizon."""

from typing import Any

import equinox as eqx
from jaxtyping import ArrayLike

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
    """`X` at the steps or times of the game `(A, B, D, Q, R, final, *times)`."""
    A, B, D, Q, R, final, *times = problem
    if discrete:
        both, weight = joint_inputs(B, D, R, gamma)
        S = xp.zeros_like(both)
        return values(A, both, Q, weight, S, final, D.shape[-1], False)
    definite = is_clearly_definite(R)
    safe = xp.where(definite, R, shifted(1, R))
    # The quadratic term of both players, which flows like that of control alone.
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
    r"""The H-infinity game over a finite horizon, back from `X_T = final`:

    `X_t = Q + A' X (I + (B R^-1 B' - gamma^-2 D D') X)^-1 A`, with `X = X_{t+1}`.

    The controls `u = -K_t x` keep the sum of `x'Qx + u'Ru` over steps `t < T`, plus
    `x_T' final x_T`, below `gamma^2` times that of `w'w`, from rest, for every
    disturbance `w` along `x_next = A x + B u + D w`. The control does not know `w`, and
    `gamma^2 I - D'XD` must be positive definite at each step.

    Any argument of the stage may vary in time. Derivatives are those of
    [`delucax.riccati.hinf_dare`][]: to any order at a given `gamma`; of the least
    `gamma`, the first, and of all else at that level, held fixed.

    **Arguments:**

    - `A`: shape `(n, n)`, or `(T, n, n)`.
    - `B`: shape `(n, m)`, or `(T, n, m)`.
    - `D`: how the disturbance enters, shape `(n, k)`, or `(T, n, k)`; `None` for the
        identity.
    - `Q`: state weight, shape `(n, n)`, or `(T, n, n)`, symmetric.
    - `R`: control weight, shape `(m, m)`, or `(T, m, m)`, symmetric.
    - `final`: final weight, shape `(n, n)`, symmetric; zero by default.
    - `horizon`: the number of steps `T`; needed if no argument has a time axis.
    - `gamma`: the level, a positive number; by default the least that is attainable.
    - `tolerance`: how close to the least level, relatively; by default 16 rounding
        units.
    - `throw`: raise unless the game is solved (default); if false, check `result`.

    **Returns:** a [`delucax.riccati.GameSolution`][]. It is NaN at a step that
    has no saddle point, as where `gamma` is too low, and at all before it.

    **Raises:** `ValueError` on an argument of the wrong shape, that is not finite or
    not symmetric, if there is no horizon, or the level is not positive; an error at run
    time as `throw` says.

    Source: Basar and Bernhard, 1995.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[1.0, 1.0], [0.0, 1.0]])
        B = jnp.array([[0.0], [1.0]])
        Q, R = jnp.eye(2), jnp.eye(1)
        dlx.riccati.hinf_dre(A, B, None, Q, R, final=Q, horizon=20).gamma  # 2.9563
        ```
    """
    where = "hinf_dre"
    A = xp.asarray(A) if isinstance(A, list | tuple) else A
    if D is None and eqx.is_array_like(A) and xp.ndim(A) in (2, 3):
        D = xp.eye(xp.shape(A)[-1], dtype=xp.result_type(A, xp.float32))
    stage = stage_arguments(where, horizon, A=A, B=B, D=D, Q=Q, R=R)
    final = final_weight(final, stage["A"], where)
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
    r"""The H-infinity game over a finite horizon of continuous time, back from
    `X(t_1) = final`:

    `-dX/dt = A'X + XA - X (B R^-1 B' - gamma^-2 D D') X + Q`.

    The control `u = -K(t) x`, `K = R^-1 B' X`, keeps the integral of `x'Qx + u'Ru` up
    to `t_1`, the last of `times`, plus `x(t_1)' final x(t_1)`, below `gamma^2` times
    that of `w'w`, from rest, for every disturbance `w` along `dx/dt = A x + B u + D w`.

    It is exact but for rounding, as [`delucax.riccati.cre`][] is. Derivatives are those
    of [`delucax.riccati.hinf_dare`][]: to any order at a given `gamma`; of the least
    `gamma`, the first, and of all else at that level, held fixed. As `gamma` falls to
    the least level, `X` grows without bound at the first time: take a few percent more
    for a controller.

    **Arguments:** `A`, `B`, `D`, `Q`, `R`, `gamma`, `tolerance` and `throw`: as of
    [`delucax.riccati.hinf_care`][];

    - `times`: where `X` is wanted, increasing, at least two, shape `(N,)`.
    - `final`: final weight, shape `(n, n)`, symmetric, positive semidefinite; zero by
        default.

    **Returns:** a [`delucax.riccati.GameSolution`][]. It is NaN at the times from which
    there is no solution, as where `gamma` is too low.

    **Raises:** as there, and on times that do not increase.

    Source: Basar and Bernhard, 1995; Davison and Maki, 1973.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[0.0, 1.0], [0.0, 0.0]])
        B = jnp.array([[0.0], [1.0]])
        Q, R, times = jnp.eye(2), jnp.eye(1), jnp.linspace(0.0, 5.0, 11)
        solution = dlx.riccati.hinf_cre(A, B, B, Q, R, times=times, gamma=3.0)
        ```
    """
    where = "hinf_cre"
    game = checked_game(where, A, B, D, Q, R)
    final = final_weight(final, game[0], where)
    times = increasing_times(times, where).astype(game[0].dtype)
    problem = (*game, final, times)
    return at_level(_solution, where, False, problem, gamma, tolerance, throw)


@compiled_unless_on_host
@full_precision
def _solution(discrete: bool, problem, gamma, tolerance) -> GameSolution:
    A, B, D, Q, R, _, *times = problem
    points = times[0].shape[0] if times else A.shape[0] + 1

    def solve_game(problem, gamma, _) -> Game:
        # There is no equation to be solved: all that can fail is that X is not finite.
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
        # X[t+1] decides the gains of step t, which exist where X[t] does.
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
