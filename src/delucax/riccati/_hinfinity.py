"""The stationary H-infinity games.

A game has the same Riccati equation as a control problem with the joint control
`[u; w]`. Its weight is indefinite: `R` for the control, and `-gamma^2 I` for the
disturbance, which maximises the cost.
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
    r"""Stationary H-infinity control in discrete time.

    $$X = Q + A^\top X M^{-1} A, \qquad
    M = I + (B R^{-1} B^\top - \gamma^{-2} D D^\top) X$$

    For the system $x_{k+1} = A x_k + B u_k + D w_k$ with $x_0 = 0$, the control
    $u = -K x$, $K = R^{-1} B^\top X M^{-1} A$, ensures for every disturbance $w$ that

    $$\sum_{k=0}^\infty \left( x_k^\top Q x_k + u_k^\top R u_k \right) \le
    \gamma^2 \sum_{k=0}^\infty w_k^\top w_k.$$

    The worst disturbance is $w = \gamma^{-2} D^\top X M^{-1} A x$. The control is
    computed without knowledge of $w$. A solution exists only if
    $\gamma^2 I - D^\top X D$ is positive definite.

    The solver uses the doubling algorithm and then Newton steps. The equation also has
    solutions that do not give a controller with the level $\gamma$. Therefore the
    solver checks at the end that $X$ is positive semidefinite, that the game has a
    saddle point, and that the closed loop is stable. At a given `gamma` the solution is
    differentiable to any order, in forward and reverse mode, by the implicit function
    theorem.

    Without `gamma`, a search by secants and bisection finds the smallest level that a
    controller can attain. The smallest level has first derivatives only. The
    derivatives of the other results are then those at a fixed level. These derivatives
    may be large, because there is no saddle point just below the smallest level. If the
    derivatives should include the change of the level, pass
    `gamma=1.05 * hinf_dare(...).gamma`.

    **Arguments:**

    - `A`: shape `(n, n)`.
    - `B`: shape `(n, m)`.
    - `D`: the input matrix of the disturbance, shape `(n, k)`; `None` for the identity.
    - `Q`: state weight, shape `(n, n)`, symmetric, positive semidefinite.
    - `R`: control weight, shape `(m, m)`, symmetric.
    - `gamma`: the level $\gamma$, a positive number. By default `gamma` is the smallest
        level that a controller can attain.
    - `tolerance`: the relative tolerance of the smallest level; by default 16 times
        machine epsilon.
    - `throw`: raise an error if the solver finds no solution (default). If false, check
        `result`.

    **Returns:** a [`delucax.riccati.GameSolution`][]. The matrices of the result are
    NaN if there is no solution, for example because `gamma` is below the smallest
    attainable level.

    **Raises:** `ValueError` if a matrix has the wrong shape or is not finite, if `Q` or
    `R` is not symmetric, if `Q` is not semidefinite, or if `gamma` or `tolerance` is
    not positive. With `throw`, an error at run time if the solver finds no solution.

    Source: Basar and Bernhard, 1995.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[1.0, 1.0], [0.0, 1.0]])
        B = jnp.array([[0.0], [1.0]])
        solution = dlx.riccati.hinf_dare(A, B, jnp.eye(2), jnp.eye(2), jnp.eye(1))
        solution.gamma, solution.K
        ```

        ```text
        (Array(2.956, dtype=float32), Array([[0.713, 1.713]], dtype=float32))
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
    r"""Stationary H-infinity control in continuous time.

    $$A^\top X + X A - X (B R^{-1} B^\top - \gamma^{-2} D D^\top) X + Q = 0$$

    For the system $\dot{x} = A x + B u + D w$ with $x(0) = 0$, the control $u = -K x$,
    $K = R^{-1} B^\top X$, ensures for every disturbance $w$ that

    $$\int_0^\infty \left( x^\top Q x + u^\top R u \right) \mathrm{d}t \le
    \gamma^2 \int_0^\infty w^\top w \,\mathrm{d}t.$$

    The worst disturbance is $w = \gamma^{-2} D^\top X x$.

    The solver solves the Riccati differential equation over an interval that doubles in
    each iteration, and then takes Newton steps. At the end the solver checks that $X$
    is positive semidefinite and that the closed loop is stable. The solution is
    differentiable to any order at a given `gamma`. If you do not pass `gamma`, the
    smallest level has first derivatives only, and the derivatives of the other results
    are those at a fixed level, as in [`delucax.riccati.hinf_dare`][]. As `gamma`
    approaches the smallest level, $X$ may grow without bound. To design a controller,
    choose a `gamma` a few percent above the smallest level.

    **Arguments:** `A`, `B`, `D`, `Q`, `gamma` and `throw`: as in
    [`delucax.riccati.hinf_dare`][].

    - `R`: control weight, shape `(m, m)`, symmetric, positive definite.
    - `tolerance`: the relative tolerance of the smallest level; by default 1e-6, or
        1e-3 in float32. If $X$ grows without bound near the smallest level, the
        function returns the smallest level at which $X$ is still accurate enough. The
        returned level is larger than the exact smallest level, by a relative difference
        of about 1e-5.

    **Returns:** a [`delucax.riccati.GameSolution`][]. The matrices of the result are
    NaN if there is no solution.

    **Raises:** as in [`delucax.riccati.hinf_dare`][].

    Source: Basar and Bernhard, 1995; Doyle, Glover, Khargonekar and Francis, 1989.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[0.0, 1.0], [0.0, 0.0]])
        B = jnp.array([[0.0], [1.0]])
        Q, R = jnp.eye(2), jnp.eye(1)
        least = dlx.riccati.hinf_care(A, B, B, Q, R).gamma
        dlx.riccati.hinf_care(A, B, B, Q, R, gamma=1.1 * least).K
        ```

        ```text
        Array([[2.39, 5.76]], dtype=float32)
        ```
    """
    where = "hinf_care"
    problem = checked_game(where, A, B, D, Q, R)
    return at_level(_solution, where, False, problem, gamma, tolerance, throw)


def checked_game(where: str, A: Any, B: Any, D: Any, Q: Any, R: Any) -> tuple:
    """Check the matrices of a stationary game, and convert them to one precision."""
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
    # An unsolved game is replaced by a trivial one, so that derivatives are not NaN.
    (A, B, D, Q, X), R = where_solved(game.good, (*problem[:4], X), problem[4])
    K = joint_gain(discrete, joint((A, B, D, Q, R), level), X)
    m = B.shape[1]
    loop = A - B @ K[:m]
    bound = spectral_radius if discrete else spectral_abscissa
    masked = lambda M: xp.where(game.good, M, xp.nan)
    # Just below the smallest level the equation nearly has a solution.
    near = game.residual < 100 * _rounding(len(X), X.dtype)
    failure = choose(game.holds & near, RESULTS.not_converged, RESULTS.infeasible)
    # Without a disturbance the game is the control problem. If that has no solution,
    # the level is not the reason.
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
    """The largest relative residual of a solved equation."""
    return 1000 * n * float(xp.finfo(dtype).eps)


def _game_start(discrete: bool, problem: tuple) -> Square:
    """The starting point without a disturbance. It is not 0, because 0 is a fixed point
    if `(A, Q)` is not detectable."""
    A, B, _, Q, R = problem
    if discrete:
        scale = xp.linalg.norm(Q)
        scale = one_if_zero(xp.where(scale > 0, scale, xp.linalg.norm(R)))
    else:
        control = symmetric(B @ solve(R, B.T))
        # If Q = 0, the unstable modes alone set the size of X, |A|^2 / |B R^-1 B'|.
        tiny = xp.finfo(A.dtype).tiny ** 0.5
        unseen = xp.linalg.norm(A) ** 2 / xp.maximum(xp.linalg.norm(control), tiny)
        Q = xp.where(xp.linalg.norm(Q) > 0, Q, shifted(unseen, Q))
        scale = scale_of(control, Q)
    return shifted(scale, A)


def _solve_game(discrete: bool, problem: tuple, gamma: Scalar, X0: Square) -> Game:
    """The stabilising solution of the game equation, and whether it is a saddle
    point."""
    A, B, D, _, R = problem
    (n, m), eps = B.shape, xp.finfo(A.dtype).eps
    data = joint(problem, gamma)
    # Doubling for X - X0. X0 is below the solution, so the iterates increase to it.
    element, unit = _element(discrete, data, problem, gamma, X0)
    J, iterations = double(element, X0 / unit)
    left = newton_refine(
        lambda X, _: riccati_residual(discrete, data, X, False, maximisers=D.shape[1]),
        # No refinement: the next Newton step corrects the error of this one.
        lambda *at: _correction(discrete, *at, 0),
        X0 + unit * J,
        controls=data.B.shape[1],
        units=1,
        to_working_precision=True,
    )
    X = left.X
    # The loop must be stable with the worst disturbance and without a disturbance.
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
    # The equation also has solutions at levels that no controller attains. Then X is
    # not semidefinite, or a loop is not stable (Doyle et al., 1989).
    holds = is_semidefinite(X, 1000) & decided & xp.all(stable)
    solved = left.relative < _rounding(n, A.dtype)
    # At the smallest level, I - D'XD / gamma^2 becomes singular in discrete time, and X
    # may grow without bound in continuous time.
    growing = inverse_margin(D, X, gamma) if discrete else X
    distance = 1 / largest_eigenvalue(growing)
    return Game(X, left.bounds[0], holds, solved, iterations, distance)


def _element(discrete, data, problem, gamma, X0):
    """The element of one step of the equation for `X - X0`, and the unit of `X`."""
    A, B, D, Q, R = problem
    if discrete:
        moved, cross, weight = stationary(True, data, X0)
        linear = moved @ A - X0
        return without_cross_weight(A, data.B, linear, weight, cross, Q), 1.0
    # In continuous time a step is the flow over a short interval.
    G = symmetric(B @ solve(R, B.T) - D @ D.T / gamma**2)
    # The flow of the correction, in the unit that makes its parts equally large.
    moved = X0 @ A
    constant = Q + moved + moved.T - X0 @ G @ X0
    unit = scale_of(G, constant)
    H = hamiltonian(A - G @ X0, unit * G, constant / unit)
    return short_element(H, 0.5 / one_if_zero(xp.linalg.norm(H))), unit


def _correction(discrete, X, loop, error, *refinements):
    """The Newton step for an `error` of the equation.

    In continuous time it is solved in coordinates in which `X` is the identity. Near
    the smallest level `X` is large in some directions, and the loop is far from normal.
    """
    if discrete:
        return lyapunov(True, loop, error)
    eye = shifted(1, X)
    # With X = root root', the loop becomes root' loop root'^-1, and the error becomes
    # root^-1 error root'^-1. A singular X is shifted by its rounding.
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
    """`X` of a solved game with its implicit derivatives; zero for an unsolved game."""
    del discrete, problem, gamma
    return xp.where(game.good, game.X, 0)


@_with_implicit_derivative.defjvp
@full_precision
def _implicit_derivative_jvp(discrete, primals, tangents):
    X = _with_implicit_derivative(discrete, *primals)
    problem, gamma, game = primals
    (A, *others), R = where_solved(game.good, problem[:4], problem[4])
    if not discrete:
        # `where_solved` sets A = 0, which is not stable. A = -I is.
        A = A - shifted(xp.where(game.good, 0, 1), A)
    gamma = xp.where(game.good, gamma, 1)
    # By the implicit function theorem, as for the control equation.
    _, error, loop = jax.jvp(
        lambda *at: left_side(discrete, X, joint(*at)),
        ((A, *others, R), gamma),
        tangents[:2],
        has_aux=True,
    )
    return X, _correction(discrete, X, loop, xp.where(game.good, error, 0))


def _barrier(discrete: bool, problem: tuple, gamma: Scalar) -> Array:
    """A barrier function. Its slope diverges at the smallest level."""
    start = _game_start(discrete, problem)
    solve_game = functools.partial(_solve_game, discrete)
    end, _ = bisect_level(solve_game, problem, start, gamma)
    X = _with_implicit_derivative(discrete, problem, gamma, end.game)
    total = xp.trace(X)
    if discrete:
        total = total + inverse_margins(problem[2][None], X[None], gamma)
    return total
