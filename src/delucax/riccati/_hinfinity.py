"""The stationary H-infinity games."""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array

from .._check import check_definite, check_step
from .._results import choose, raise_on_failure, Result, RESULTS
from ..math._linear_solve import full_precision
from ._arguments import constant_matrices
from ._game import (
    attached,
    barrier,
    game_start,
    joint,
    joint_gain,
    rounding,
    sanitised_game,
    solve_game,
)
from ._level import Bisection, game_at_level
from ._spectrum import spectral_abscissa, spectral_radius


class GameSolution(eqx.Module):
    """The saddle point of a stationary game.

    **Attributes:**

    - `X`: the solution of the game equation, shape `(n, n)`, symmetric.
    - `K`: the gain of the control `u = -K x`, shape `(m, n)`.
    - `L`: the gain of the worst disturbance `w = L x`, shape `(k, n)`.
    - `gamma`: the level that is attained.
    - `residual`: the norm of the equation's residual over the sum of the norms of its
        terms: an upper bound, with rounding of its own evaluation counted.
    - `closed_loop`: the matrix `A - B K`, shape `(n, n)`.
    - `spectral_radius`: in discrete time, an upper bound on that of `closed_loop`,
        close to it. `None` in continuous time.
    - `iterations`: doublings taken at `gamma`.
    - `result`: success, or why not; one of `delucax.RESULTS`.
    - `spectral_abscissa`: in continuous time, the largest real part of an eigenvalue of
        `closed_loop`, up to rounding. `None` in discrete time.

    `residual`, `spectral_radius` and `spectral_abscissa` are measurements and have no
    gradient.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[1.0, 1.0], [0.0, 1.0]])
        B = jnp.array([[0.0], [1.0]])
        Q, R = jnp.eye(2), jnp.eye(1)
        solution = dlx.riccati.hinf_dare(A, B, None, Q, R, gamma=5.0)
        solution.K, solution.L, solution.spectral_radius
        ```
    """

    X: Array
    K: Array
    L: Array
    gamma: Array
    residual: Array
    closed_loop: Array
    spectral_radius: Array | None
    iterations: Array
    result: Result
    spectral_abscissa: Array | None = None


def hinf_dare(
    A: Any,
    B: Any,
    D: Any,
    Q: Any,
    R: Any,
    *,
    gamma: Any = None,
    tolerance: Any = None,
    throw: bool = True,
) -> GameSolution:
    r"""The stationary H-infinity game in discrete time,

    `X = Q + A' X (I + (B R^-1 B' - gamma^-2 D D') X)^-1 A`,

    whose control `u = -K x` keeps the sum of `x'Qx + u'Ru` below `gamma^2` times that
    of `w'w`, from rest, for every disturbance `w` along `x_next = A x + B u + D w`:

    `K = R^-1 B' X L^-1 A`, `L = I + (B R^-1 B' - gamma^-2 D D') X`,

    while the worst disturbance is `w = gamma^-2 D' X L^-1 A x`. The control does not
    know `w`, and `gamma^2 I - D'XD` must be positive definite.

    Doubling, then Newton steps on the equation; the conditions of a solution
    (`X` positive semidefinite, that of a saddle point, stability) are checked at the
    end, as the equation alone also has solutions that solve no game. At a given `gamma`
    it is differentiable to any order, in either mode, by the implicit function theorem.

    Without `gamma`, the least one is found by bisection, and has first derivatives. All
    else is then differentiated at that level, held fixed, and is steep where the
    saddle point vanishes just below it. Use `gamma=1.05 * hinf_dare(...).gamma` for a
    design with derivatives that follow the level.

    **Arguments:**

    - `A`: shape `(n, n)`.
    - `B`: shape `(n, m)`.
    - `D`: how the disturbance enters, shape `(n, k)`; `None` for the identity.
    - `Q`: state weight, shape `(n, n)`, symmetric, positive semidefinite.
    - `R`: control weight, shape `(m, m)`, symmetric.
    - `gamma`: the level, a positive number; by default the least that is attainable.
    - `tolerance`: how close to the least level, relatively; by default 16 rounding
        units.
    - `throw`: raise unless the game is solved (default); if false, look at `result`.

    **Returns:** a [`delucax.riccati.GameSolution`][]. Its matrices are NaN if there is
    no solution, as when `gamma` is below the least attainable level.

    **Raises:** `ValueError` on a matrix of the wrong shape, that is not finite or not
    symmetric, or a level that is not positive; an error at run time as `throw` says.

    Source: Basar and Bernhard, 1995.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[1.0, 1.0], [0.0, 1.0]])
        B = jnp.array([[0.0], [1.0]])
        solution = dlx.riccati.hinf_dare(A, B, jnp.eye(2), jnp.eye(2), jnp.eye(1))
        solution.gamma, solution.K  # 2.9563, [[0.7129, 1.7128]]
        ```
    """
    where = "hinf_dare"
    problem = checked_game(where, A, B, D, Q, R)
    return at_level(_solution, where, True, problem, gamma, tolerance, throw)


def hinf_care(
    A: Any,
    B: Any,
    D: Any,
    Q: Any,
    R: Any,
    *,
    gamma: Any = None,
    tolerance: Any = None,
    throw: bool = True,
) -> GameSolution:
    r"""The stationary H-infinity game in continuous time,

    `A'X + XA - X (B R^-1 B' - gamma^-2 D D') X + Q = 0`,

    whose control `u = -K x`, `K = R^-1 B' X`, keeps the integral of `x'Qx + u'Ru` below
    `gamma^2` times that of `w'w`, from rest, for every disturbance `w` along
    `dx/dt = A x + B u + D w`. The worst is `w = gamma^-2 D' X x`.

    Doubling of the flow of the Riccati differential equation, then Newton steps on the
    equation; the conditions of a solution (`X` positive semidefinite, stability) are
    checked at the end. Derivatives are those of [`delucax.riccati.hinf_dare`][]: to any
    order at a given `gamma`; of the least `gamma`, the first, and of all else at that
    level, held fixed. As `gamma` falls to the least level `X` may grow without bound:
    take a few percent more for a controller.

    **Arguments:**

    - `A`: shape `(n, n)`.
    - `B`: shape `(n, m)`.
    - `D`: how the disturbance enters, shape `(n, k)`; `None` for the identity.
    - `Q`: state weight, shape `(n, n)`, symmetric, positive semidefinite.
    - `R`: control weight, shape `(m, m)`, symmetric, positive definite.
    - `gamma`: the level, a positive number; by default the least that is attainable.
    - `tolerance`: how close to the least level, relatively; by default 1e-6, and 1e-3
        in float32. Where `X` grows without bound, the least level is the least at which
        its digits suffice to tell that it is a solution, some 1e-5 above.
    - `throw`: raise unless the game is solved (default); if false, look at `result`.

    **Returns:** a [`delucax.riccati.GameSolution`][]. Its matrices are NaN if
    there is no solution, as when `gamma` is below the least attainable level.

    **Raises:** `ValueError` on a matrix of the wrong shape, that is not finite or not
    symmetric, or a level that is not positive; an error at run time as `throw` says.

    Source: Basar and Bernhard, 1995; Doyle, Glover, Khargonekar and Francis, 1989.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[0.0, 1.0], [0.0, 0.0]])
        B = jnp.array([[0.0], [1.0]])
        Q, R = jnp.eye(2), jnp.eye(1)
        least = dlx.riccati.hinf_care(A, B, B, Q, R).gamma
        solution = dlx.riccati.hinf_care(A, B, B, Q, R, gamma=1.1 * least)
        ```
    """
    where = "hinf_care"
    problem = checked_game(where, A, B, D, Q, R)
    return at_level(_solution, where, False, problem, gamma, tolerance, throw)


_LOOSE = {4: 1e-3, 8: 1e-6}
"""Default tolerance of a level by the bytes of a number, where `X` has a pole at it."""


def checked_game(where: str, A: Any, B: Any, D: Any, Q: Any, R: Any) -> tuple:
    """The matrices of a stationary game, in one precision, that fit each other."""
    given = constant_matrices(where, A=A, B=B, D=D, Q=Q, R=R)
    check_definite(given["Q"], "Q", where, False)
    given.setdefault("D", jnp.eye(len(given["A"]), dtype=given["A"].dtype))
    return tuple(given[name] for name in "ABDQR")


def at_level(
    solution_of: Callable[..., Any],
    where: str,
    discrete: bool,
    problem: tuple,
    gamma: Any,
    tolerance: Any,
    throw: bool,
) -> Any:
    """A game at the level that is given, or at the least one to within a tolerance."""
    dtype = problem[0].dtype
    if tolerance is None:
        tolerance = 16 * jnp.finfo(dtype).eps if discrete else _LOOSE[dtype.itemsize]
    check_step(tolerance, where, "tolerance")
    if gamma is not None:
        check_step(gamma, where, "gamma")
        gamma = jnp.asarray(gamma, dtype)
    solution = solution_of(discrete, problem, gamma, jnp.asarray(tolerance, dtype))
    facts = lambda: f"Level gamma {float(solution.gamma):.6g}."
    return raise_on_failure(solution, where, throw, facts=facts)


@eqx.filter_jit
@full_precision
def _solution(discrete: bool, problem, gamma, tolerance) -> GameSolution:
    solve = functools.partial(solve_game, discrete)
    steep = functools.partial(barrier, discrete)
    start = game_start(discrete, problem)
    end, level, gamma = game_at_level(solve, steep, problem, start, gamma, tolerance)
    game = end.game
    X = attached(discrete, problem, level, game)
    safe, X = sanitised_game(game.good, problem, X)
    A, B, *_ = safe
    K = joint_gain(discrete, joint(safe, level), X)
    m = B.shape[1]
    loop = A - B @ K[:m]
    bound = (spectral_radius if discrete else spectral_abscissa)(
        lax.stop_gradient(loop)
    )
    masked = lambda M: jnp.where(game.good, M, jnp.nan)
    bound = masked(bound)
    return GameSolution(
        X=masked(X),
        K=masked(K[:m]),
        L=masked(-K[m:]),
        gamma=gamma,
        residual=game.residual,
        closed_loop=masked(loop),
        spectral_radius=bound if discrete else None,
        iterations=game.iterations,
        result=_outcome(end),
        spectral_abscissa=None if discrete else bound,
    )


def _outcome(end: Bisection) -> Result:
    game = end.game
    # A little below the least level the equation nearly has a solution.
    near = game.residual < 100 * rounding(game.X.shape[0], game.X.dtype)
    failure = choose(game.holds & near, RESULTS.not_converged, RESULTS.infeasible)
    failure = choose(end.solvable, failure, RESULTS.not_stabilising)
    return choose(game.good, RESULTS.successful, failure)
