"""The stationary H-infinity games."""

from typing import Any

import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array

from .._check import as_matrix, check_positive, is_concrete, symmetric_matrix
from .._message import shortened
from .._module import as_float_array
from .._results import choose, Result, RESULTS
from ..math._linear_solve import full_precision, solve
from ._arguments import check_definite
from ._continuous_game import (
    continuous_attached,
    continuous_barrier,
    continuous_game,
    continuous_start,
    joint_gain,
)
from ._game import (
    discrete_attached,
    discrete_game,
    discrete_start,
    players,
    rounding,
    sanitised_game,
)
from ._horizon_arguments import common_dtype
from ._level import followed, Search, search
from ._recursion import gain
from ._spectrum import spectral_abscissa, spectral_radius


class GameSolution(eqx.Module):
    """The saddle point of a stationary game in discrete time.

    **Attributes:**

    - `X`: the solution of the game equation, shape `(n, n)`, symmetric.
    - `K`: the gain of the control `u = -K x`, shape `(m, n)`.
    - `L`: the gain of the worst disturbance `w = L x`, shape `(k, n)`.
    - `gamma`: the level that is attained.
    - `residual`: the norm of the equation's residual over the sum of the norms of its
        terms: an upper bound, with rounding of its own evaluation counted.
    - `closed_loop`: the matrix `A - B K`, shape `(n, n)`.
    - `spectral_radius`: an upper bound on that of `closed_loop`, close to it.
    - `iterations`: doublings taken at `gamma`.
    - `result`: success, or why not; one of `delucax.RESULTS`.

    `residual` and `spectral_radius` are measurements and have no gradient.

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
    spectral_radius: Array
    iterations: Array
    result: Result


class ContinuousGameSolution(eqx.Module):
    """The saddle point of a stationary game in continuous time.

    **Attributes:**

    - `X`: the solution of the game equation, shape `(n, n)`, symmetric.
    - `K`: the gain of the control `u = -K x`, shape `(m, n)`.
    - `L`: the gain of the worst disturbance `w = L x`, shape `(k, n)`.
    - `gamma`: the level that is attained.
    - `residual`: the norm of the equation's residual over the sum of the norms of its
        terms: an upper bound, with rounding of its own evaluation counted.
    - `closed_loop`: the matrix `A - B K`, shape `(n, n)`.
    - `spectral_abscissa`: the largest real part of its eigenvalues, up to rounding.
    - `iterations`: doublings taken at `gamma`.
    - `result`: success, or why not; one of `delucax.RESULTS`.

    `residual` and `spectral_abscissa` are measurements and have no gradient.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[0.0, 1.0], [0.0, 0.0]])
        B = jnp.array([[0.0], [1.0]])
        Q, R = jnp.eye(2), jnp.eye(1)
        solution = dlx.riccati.hinf_care(A, B, None, Q, R, gamma=5.0)
        solution.K, solution.L, solution.spectral_abscissa
        ```
    """

    X: Array
    K: Array
    L: Array
    gamma: Array
    residual: Array
    closed_loop: Array
    spectral_abscissa: Array
    iterations: Array
    result: Result


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
    arguments = checked_game(where, A, B, D, Q, R)
    gamma, tolerance = checked_level(where, gamma, tolerance, arguments[0].dtype)
    solution = _discrete(arguments, gamma, tolerance)
    return thrown(where, solution) if throw else solution


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
) -> ContinuousGameSolution:
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

    **Returns:** a [`delucax.riccati.ContinuousGameSolution`][]. Its matrices are NaN if
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
    arguments = checked_game(where, A, B, D, Q, R)
    dtype = arguments[0].dtype
    gamma, tolerance = checked_level(
        where, gamma, tolerance, dtype, LOOSE[dtype.itemsize]
    )
    solution = _continuous(arguments, gamma, tolerance)
    return thrown(where, solution) if throw else solution


LOOSE = {4: 1e-3, 8: 1e-6}
"""Default tolerance of a level by the bytes of a number, where `X` has a pole at it."""


def checked_game(where, A, B, D, Q, R):
    """The matrices of a stationary game, in one precision, that fit each other."""
    given = {name: as_matrix(M, name, where) for name, M in (("A", A), ("B", B))}
    n = given["A"].shape[0]
    given["D"] = as_matrix(jnp.eye(n) if D is None else D, "D", where)
    given["Q"] = symmetric_matrix(Q, "Q", where)
    given["R"] = symmetric_matrix(R, "R", where)
    check_definite(given["Q"], "Q", where, False)
    m, k = given["B"].shape[1], given["D"].shape[1]
    shapes = {"A": (n, n), "B": (n, m), "D": (n, k), "Q": (n, n), "R": (m, m)}
    for name, shape in shapes.items():
        if given[name].shape != shape or 0 in shape:
            raise ValueError(
                f"{where}: {name} must have shape {shape} to fit the other matrices, "
                f"got {given[name].shape}."
            )
    if D is None:
        del given["D"]
    dtype = common_dtype(where, given)
    given.setdefault("D", jnp.eye(n))
    return tuple(given[name].astype(dtype) for name in "ABDQR")


def checked_level(where, gamma, tolerance, dtype, default=None):
    """The level, or `None`; and the tolerance of the search for it."""
    values = []
    for value, name in ((gamma, "gamma"), (tolerance, "tolerance")):
        if value is None:
            values.append(None)
            continue
        value = as_float_array(value)
        if not eqx.is_inexact_array(value) or value.ndim != 0:
            raise ValueError(
                f"{where}: {name} must be a number, got {shortened(value)}."
            )
        check_positive(value, name, where)
        values.append(value.astype(dtype))
    gamma, tolerance = values
    if tolerance is None:
        default = 16 * jnp.finfo(dtype).eps if default is None else default
        tolerance = jnp.asarray(default, dtype)
    return gamma, tolerance


def thrown(where: str, solution: Any) -> Any:
    """Raise if a game is not solved: now if it can be seen, else at run time."""
    failed = solution.result != RESULTS.successful
    if not is_concrete(failed):
        return solution.result.error_if(solution, failed)
    if failed:
        raise RuntimeError(
            f"{where}: {RESULTS[solution.result]} Level gamma "
            f"{float(solution.gamma):.6g}. Pass throw=False to look at the solution."
        )
    return solution


@eqx.filter_jit
@full_precision
def _discrete(problem, gamma, tolerance):
    start = discrete_start(problem)
    found, level = search(discrete_game, problem, start, gamma, tolerance)
    if gamma is None:
        gamma = followed(_barrier, problem, level)
    else:
        level = gamma
    game, level = found.game, jnp.where(level > 0, level, 1)
    X = discrete_attached(problem, level, game)
    (A, B, D, _, R), X = sanitised_game(game.good, problem, X)
    both, weight = players(B, D, R, level)
    K, _ = gain(A, both, weight, jnp.zeros_like(both), X)
    m = B.shape[1]
    loop = A - B @ K[:m]
    radius = spectral_radius(lax.stop_gradient(loop))
    masked = lambda M: jnp.where(game.good, M, jnp.nan)
    matrices = masked(X), masked(K[:m]), masked(-K[m:]), gamma, game.residual
    measured = masked(radius), game.iterations, outcome(found)
    return GameSolution(*matrices, masked(loop), *measured)


@eqx.filter_jit
@full_precision
def _continuous(problem, gamma, tolerance):
    start = continuous_start(problem)
    found, level = search(continuous_game, problem, start, gamma, tolerance)
    if gamma is None:
        gamma = followed(continuous_barrier, problem, level)
    else:
        level = gamma
    game, level = found.game, jnp.where(level > 0, level, 1)
    X = continuous_attached(problem, level, game)
    (A, B, D, _, R), X = sanitised_game(game.good, problem, X)
    both, weight = players(B, D, R, level)
    K, _ = joint_gain(A, both, weight, X)
    m = B.shape[1]
    loop = A - B @ K[:m]
    abscissa = spectral_abscissa(lax.stop_gradient(loop))
    masked = lambda M: jnp.where(game.good, M, jnp.nan)
    matrices = masked(X), masked(K[:m]), masked(-K[m:]), gamma, game.residual
    measured = masked(abscissa), game.iterations, outcome(found)
    return ContinuousGameSolution(*matrices, masked(loop), *measured)


def _barrier(problem, gamma):
    _, _, D, _, _ = problem
    found, _ = search(discrete_game, problem, discrete_start(problem), gamma)
    X = discrete_attached(problem, gamma, found.game)
    eye = jnp.eye(D.shape[1], dtype=D.dtype)
    margin = solve(gamma**2 * eye - D.T @ X @ D, eye)
    scale = lax.stop_gradient(gamma**2 * jnp.linalg.norm(X))
    return scale * jnp.trace(margin) + jnp.trace(X)


def outcome(found: Search) -> Result:
    """What became of a search."""
    game = found.game
    # A little below the least level the equation nearly has a solution.
    near = game.residual < 100 * rounding(game.X.shape[0], game.X.dtype)
    failure = choose(game.holds & near, RESULTS.not_converged, RESULTS.infeasible)
    failure = choose(found.calm, failure, RESULTS.not_stabilising)
    return choose(game.good, RESULTS.successful, failure)
