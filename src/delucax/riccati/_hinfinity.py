"""The stationary H-infinity games.

A game is the Riccati equation of the joint control `[u; w]`, with an indefinite weight:
`R` for the control, `-gamma^2 I` for the disturbance, which maximises.
"""

import functools
from typing import Any

import jax
from jaxtyping import ArrayLike

from .._check import check_definite
from .._jax import (
    compiled_unless_on_host,
    custom_jvp,
    host_unless_traced,
    stop_gradient,
    vmap,
    xp,
)
from .._results import choose, RESULTS
from .._typing import Array, Numbers, Scalar, Square
from ..math._linear_solve import cholesky, full_precision, solve, symmetric
from ..math._lyapunov import lyapunov
from ..math._norms import one_if_zero, size
from ._arguments import constant_matrices, where_solved
from ._doubling import double
from ._level import (
    at_level,
    bisect_level,
    Game,
    game_at_level,
    GameSolution,
    inverse_margin,
    inverse_margins,
    joint,
    joint_gain,
    largest_eigenvalue,
)
from ._recursion import (
    hamiltonian,
    is_clearly_definite,
    is_saddle,
    scale_of,
    short_element,
    without_cross_weight,
)
from ._residual import newton_refine, riccati_residual, stationary
from ._spectrum import is_stable, spectral_abscissa, spectral_radius
from ._stabilising import is_semidefinite, left_side, shifted


@host_unless_traced
def hinf_dare(
    A: Numbers,
    B: Numbers,
    D: Numbers | None,
    Q: Numbers,
    R: Numbers,
    *,
    gamma: ArrayLike | None = None,
    tolerance: ArrayLike | None = None,
    throw: bool = True,
) -> GameSolution:
    r"""The stationary H-infinity game in discrete time,

    `X = Q + A' X (I + (B R^-1 B' - gamma^-2 D D') X)^-1 A`,

    whose control `u = -K x` keeps the sum of `x'Qx + u'Ru` below `gamma^2` times that
    of `w'w`, from rest, for every disturbance `w` along `x_next = A x + B u + D w`:

    `K = R^-1 B' X M^-1 A`, `M = I + (B R^-1 B' - gamma^-2 D D') X`,

    while the worst disturbance is `w = gamma^-2 D' X M^-1 A x`. The control does not
    know `w`, and `gamma^2 I - D'XD` must be positive definite.

    Doubling, then Newton steps on the equation; the conditions of a solution
    (`X` positive semidefinite, that of a saddle point, stability) are checked at the
    end, as the equation alone also has solutions that solve no game. At a given `gamma`
    it is differentiable to any order, in either mode, by the implicit function theorem.

    Without `gamma`, secants and bisection find the least one, which has first
    derivatives. All else is then differentiated at that level, held fixed, and is steep
    where the saddle point vanishes just below it. Use
    `gamma=1.05 * hinf_dare(...).gamma` for a design with derivatives that follow the
    level.

    **Arguments:**

    - `A`: shape `(n, n)`.
    - `B`: shape `(n, m)`.
    - `D`: how the disturbance enters, shape `(n, k)`; `None` for the identity.
    - `Q`: state weight, shape `(n, n)`, symmetric, positive semidefinite.
    - `R`: control weight, shape `(m, m)`, symmetric.
    - `gamma`: the level, a positive number; by default the least that is attainable.
    - `tolerance`: how close to the least level, relatively; by default 16 rounding
        units.
    - `throw`: raise unless the game is solved (default); if false, check `result`.

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


@host_unless_traced
def hinf_care(
    A: Numbers,
    B: Numbers,
    D: Numbers | None,
    Q: Numbers,
    R: Numbers,
    *,
    gamma: ArrayLike | None = None,
    tolerance: ArrayLike | None = None,
    throw: bool = True,
) -> GameSolution:
    """The stationary H-infinity game in continuous time,

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

    **Arguments:** `A`, `B`, `D`, `Q`, `gamma` and `throw`: as of
    [`delucax.riccati.hinf_dare`][];

    - `R`: control weight, shape `(m, m)`, symmetric, positive definite.
    - `tolerance`: how close to the least level, relatively; by default 1e-6, and 1e-3
        in float32. Where `X` grows without bound, the least level is the least at which
        its digits suffice to tell that it is a solution, some 1e-5 above.

    **Returns:** a [`delucax.riccati.GameSolution`][], NaN as there.

    **Raises:** as there.

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


def checked_game(where: str, A: Any, B: Any, D: Any, Q: Any, R: Any) -> tuple:
    """The matrices of a stationary game, in one precision, that fit each other."""
    given = constant_matrices(where, A=A, B=B, D=D, Q=Q, R=R)
    check_definite(given["Q"], "Q", where, False)
    given.setdefault("D", xp.eye(len(given["A"]), dtype=given["A"].dtype))
    return tuple(given[name] for name in "ABDQR")


@compiled_unless_on_host
@full_precision
def _solution(discrete: bool, problem, gamma, tolerance) -> GameSolution:
    end, level, gamma = game_at_level(
        functools.partial(_solve_game, discrete),
        functools.partial(_barrier, discrete),
        problem,
        _game_start(discrete, problem),
        gamma,
        tolerance,
    )
    game = end.game
    X = _with_implicit_derivative(discrete, problem, level, game)
    # An unsolved game is replaced by a trivial one, which keeps NaN out of derivatives.
    (A, B, D, Q, X), R = where_solved(game.good, (*problem[:4], X), problem[4])
    K = joint_gain(discrete, joint((A, B, D, Q, R), level), X)
    m = B.shape[1]
    loop = A - B @ K[:m]
    bound = spectral_radius if discrete else spectral_abscissa
    masked = lambda M: xp.where(game.good, M, xp.nan)
    # A little below the least level the equation nearly has a solution.
    near = game.residual < 100 * _rounding(len(X), X.dtype)
    failure = choose(game.holds & near, RESULTS.not_converged, RESULTS.infeasible)
    # Without a disturbance it is the control problem: no level is to blame.
    failure = choose(end.solvable, failure, RESULTS.not_stabilising)
    bound = masked(bound(stop_gradient(loop)))
    return GameSolution(
        X=masked(X),
        K=masked(K[:m]),
        L=masked(-K[m:]),
        gamma=gamma,
        closed_loop=masked(loop),
        result=choose(game.good, RESULTS.successful, failure),
        residual=game.residual,
        iterations=game.iterations,
        **{"spectral_radius" if discrete else "spectral_abscissa": bound},
    )


def _rounding(n: int, dtype) -> float:
    """The relative residual that counts as solved."""
    return 1000 * n * float(xp.finfo(dtype).eps)


def _game_start(discrete: bool, problem: tuple) -> Square:
    """The starting point without a disturbance: not 0, which is a fixed point if
    `(A, Q)` is not detectable."""
    A, B, _, Q, R = problem
    if discrete:
        scale = xp.linalg.norm(Q)
        scale = one_if_zero(xp.where(scale > 0, scale, xp.linalg.norm(R)))
    else:
        control = symmetric(B @ solve(R, B.T))
        # With Q = 0 the unstable modes alone set the size of X, |A|^2 / |B R^-1 B'|.
        tiny = xp.finfo(A.dtype).tiny ** 0.5
        unseen = xp.linalg.norm(A) ** 2 / xp.maximum(xp.linalg.norm(control), tiny)
        Q = xp.where(xp.linalg.norm(Q) > 0, Q, shifted(unseen, Q))
        scale = scale_of(control, Q)
    return shifted(scale, A)


def _solve_game(discrete: bool, problem: tuple, gamma: Scalar, X0: Square) -> Game:
    """The stabilising solution of the game equation, with the conditions under which it
    is a saddle point."""
    A, B, D, _, R = problem
    (n, m), eps = B.shape, xp.finfo(A.dtype).eps
    data = joint(problem, gamma)
    # Doubling of the equation of X - X0, from below the solution, to which it rises.
    element, unit = _element(discrete, data, problem, gamma, X0)
    J, iterations = double(element, X0 / unit)
    left = newton_refine(
        lambda X, _: riccati_residual(discrete, data, X, False, maximisers=D.shape[1]),
        # The next step corrects what this one leaves: no refinement.
        lambda *at: _correction(discrete, *at, 0),
        X0 + unit * J,
        controls=data.B.shape[1],
        units=1,
        to_working_precision=True,
    )
    X = left.X
    # Both loops must be stable: against the worst disturbance, and without any.
    _, _, weight = stationary(discrete, data, X)
    alone = A - B @ left.K[:m]
    loops = xp.stack([left.closed_loop, alone])
    if discrete:
        margin = xp.asarray(n * eps, A.dtype)
        decided = is_saddle(symmetric(weight), D.shape[1])
    else:
        margin = n * eps * xp.linalg.norm(A)
        decided = is_clearly_definite(R)
    stable = vmap(lambda loop: is_stable(discrete, loop, margin))(loops)
    # The equation alone also has solutions above the level of any controller, at which
    # X is not semidefinite or a loop not stable (Doyle et al., 1989).
    holds = is_semidefinite(X, 1000) & decided & xp.all(stable)
    solved = left.relative < _rounding(n, A.dtype)
    # In discrete time the worth of the disturbance falls to zero, in continuous time
    # the solution grows.
    growing = inverse_margin(D, X, gamma) if discrete else X
    distance = 1 / largest_eigenvalue(growing)
    return Game(X, left.bounds[0], holds, solved, iterations, distance)


def _element(discrete, data, problem, gamma, X0):
    """The element of a step of the equation of `X - X0`, and the unit of `X`."""
    A, B, D, Q, R = problem
    if discrete:
        moved, cross, weight = stationary(True, data, X0)
        linear = moved @ A - X0
        return without_cross_weight(A, data.B, linear, weight, cross, Q), 1.0
    # In continuous time a step is the flow over a short interval.
    G = symmetric(B @ solve(R, B.T) - D @ D.T / gamma**2)
    # The flow of the correction, in the unit that makes its parts alike.
    moved = X0 @ A
    constant = Q + moved + moved.T - X0 @ G @ X0
    unit = scale_of(G, constant)
    H = hamiltonian(A - G @ X0, unit * G, constant / unit)
    return short_element(H, 0.5 / one_if_zero(xp.linalg.norm(H))), unit


def _correction(discrete, X, loop, error, *refinements):
    """The Newton step for an `error` of the equation.

    In continuous time it is solved in coordinates in which `X` is the identity: near
    the least level `X` is large in some directions, and the loop far from normal.
    """
    if discrete:
        return lyapunov(True, loop, error)
    eye = shifted(1, X)
    # With X = root root', loop and error become root' loop root'^-1, root^-1 error
    # root'^-1; a singular X is shifted by its rounding.
    slack = xp.finfo(X.dtype).eps * one_if_zero(size(X))
    root = stop_gradient(cholesky(X + slack * eye))
    root = xp.where(xp.all(xp.isfinite(root)), root, eye)
    loop = solve(root, (root.T @ loop).T).T
    error = solve(root, solve(root, error).T)
    change = lyapunov(False, loop, symmetric(error), *refinements)
    return symmetric(root @ change @ root.T)


@functools.partial(custom_jvp, nondiff_argnums=(0,))
def _with_implicit_derivative(
    discrete: bool, problem: tuple, gamma: Scalar, game: Game
) -> Square:
    """`X` of a solved game with its implicit derivatives; zero of an unsolved one."""
    del discrete, problem, gamma
    return xp.where(game.good, game.X, 0)


@_with_implicit_derivative.defjvp
@full_precision
def _implicit_derivative_jvp(discrete, primals, tangents):
    X = _with_implicit_derivative(discrete, *primals)
    problem, gamma, game = primals
    (A, *others), R = where_solved(game.good, problem[:4], problem[4])
    if not discrete:
        # The trivial game has A = 0, which is not stable: it is given A = -I.
        A = A - shifted(xp.where(game.good, 0, 1), A)
    gamma = xp.where(game.good, gamma, 1)
    # By the implicit function theorem, as for the equation of control.
    _, error, loop = jax.jvp(
        lambda *at: left_side(discrete, X, joint(*at)),
        ((A, *others, R), gamma),
        tangents[:2],
        has_aux=True,
    )
    return X, _correction(discrete, X, loop, xp.where(game.good, error, 0))


def _barrier(discrete: bool, problem: tuple, gamma: Scalar) -> Array:
    """A barrier function, whose slope diverges at the least level."""
    start = _game_start(discrete, problem)
    solve_game = functools.partial(_solve_game, discrete)
    end, _ = bisect_level(solve_game, problem, start, gamma)
    X = _with_implicit_derivative(discrete, problem, gamma, end.game)
    total = xp.trace(X)
    if discrete:
        total = total + inverse_margins(problem[2][None], X[None], gamma)
    return total
