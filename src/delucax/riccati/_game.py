"""The stationary H-infinity game at a given level: the Riccati equation of the joint
control `[u; w]`, whose weight is indefinite."""

import functools

import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..math._linear_solve import full_precision, solve, symmetric
from ..math._size import one_if_zero, size
from ._arguments import RiccatiData
from ._flow import hamiltonian, scale_of, short_element
from ._level import bisect_level, Game
from ._lyapunov import lyapunov, stein
from ._newton import polish
from ._recursion import is_clearly_definite, is_saddle, step_element
from ._residual import riccati_residual, stationary
from ._spectrum import spectral_abscissa, spectral_radius
from ._stabilising import is_semidefinite, left_side, shifted
from ._start import double


def players(B, D, R, gamma) -> tuple[Array, Array]:
    """`[B D]`, and the weight of the joint control `[u; w]`."""
    m, k = B.shape[-1], D.shape[-1]
    weight = jnp.zeros((*R.shape[:-2], m + k, m + k), R.dtype)
    worth = -(gamma**2) * jnp.eye(k, dtype=R.dtype)
    weight = weight.at[..., :m, :m].set(R).at[..., m:, m:].set(worth)
    return jnp.concatenate([B, D], axis=-1), weight


def joint(problem: tuple, gamma: Float[Array, ""]) -> RiccatiData:
    """The equation of the game `(A, B, D, Q, R)`."""
    A, B, D, Q, R = problem
    both, weight = players(B, D, R, gamma)
    return RiccatiData(A, both, Q, weight, jnp.zeros_like(both), None)


def joint_gain(discrete: bool, data: RiccatiData, X: Float[Array, "n n"]) -> Array:
    """The gains `K` of the joint control `[u; w] = -K x`."""
    _, cross, weight = stationary(discrete, data, X)
    return solve(weight, cross.T)


def rounding(n: int, dtype) -> float:
    """The relative residual that counts as solved."""
    return 1000 * n * float(jnp.finfo(dtype).eps)


def game_start(discrete: bool, problem: tuple) -> Float[Array, "n n"]:
    """Where to start without a disturbance: not at 0, where an iteration rests that has
    an unstable mode unseen by the cost."""
    A, B, _, Q, R = problem
    if discrete:
        scale = jnp.linalg.norm(Q)
        scale = one_if_zero(jnp.where(scale > 0, scale, jnp.linalg.norm(R)))
    else:
        control = symmetric(B @ solve(R, B.T))
        # Without a cost of the state it is the unstable modes that set the size.
        tiny = jnp.finfo(A.dtype).tiny ** 0.5
        unseen = jnp.linalg.norm(A) ** 2 / jnp.maximum(jnp.linalg.norm(control), tiny)
        Q = jnp.where(jnp.linalg.norm(Q) > 0, Q, shifted(unseen, Q))
        scale = scale_of(control, Q)
    return shifted(scale, A)


def solve_game(
    discrete: bool, problem: tuple, gamma: Float[Array, ""], X0: Float[Array, "n n"]
) -> Game:
    """The stabilising solution of the game equation, and whether it is of the game."""
    A, B, D, _, R = problem
    (n, m), eps = B.shape, jnp.finfo(A.dtype).eps
    data = joint(problem, gamma)
    element, unit = _element(discrete, data, problem, gamma, X0)
    J, iterations = double(element, X0 / unit)
    X, left = polish(
        lambda X, _: riccati_residual(discrete, data, X, False, players=D.shape[1]),
        functools.partial(_correction, discrete),
        X0 + unit * J,
        units=1,
        to_working_precision=True,
    )
    _, _, weight = stationary(discrete, data, X)
    alone = A - B @ joint_gain(discrete, data, X)[:m]
    loops = jnp.stack([left.closed_loop, alone])
    if discrete:
        stable = jax.vmap(spectral_radius)(loops) < 1 - n * eps
        decided = is_saddle(symmetric(weight), D.shape[1])
    else:
        slack = n * eps * jnp.linalg.norm(A)
        stable = jax.vmap(spectral_abscissa)(loops) < -slack
        decided = is_clearly_definite(R)
    holds = is_semidefinite(X, 1000) & decided & jnp.all(stable)
    solved = left.relative < rounding(n, A.dtype)
    return Game(X, left.bounds[0], holds, solved, iterations)


def _element(discrete, data, problem, gamma, X0):
    """The equation of the correction to X0 over a step, and the unit of its parts."""
    A, B, D, Q, R = problem
    if discrete:
        moved, cross, weight = stationary(True, data, X0)
        return step_element(A, data.B, weight, cross, moved @ A - X0, Q), 1.0
    G = symmetric(B @ solve(R, B.T) - D @ D.T / gamma**2)
    # The flow of the correction, in the unit that makes its parts alike.
    moved = X0 @ A
    constant = Q + moved + moved.T - X0 @ G @ X0
    unit = scale_of(G, constant)
    H = hamiltonian(A - G @ X0, unit * G, constant / unit)
    return short_element(H, 0.5 / one_if_zero(jnp.linalg.norm(H))), unit


def _correction(discrete, X, loop, error):
    """The change of `X` that takes an error of the equation away, to first order.

    In continuous time in the coordinates in which `X` is the identity: near the least
    level `X` is large in some directions, and the loop far from normal.
    """
    if discrete:
        return stein(loop, error)
    eye = shifted(1, X)
    slack = jnp.finfo(X.dtype).eps * one_if_zero(size(X))
    root = lax.stop_gradient(jnp.linalg.cholesky(X + slack * eye))
    root = jnp.where(jnp.all(jnp.isfinite(root)), root, eye)
    loop = solve(root, (root.T @ loop).T).T
    error = solve(root, solve(root, error).T)
    return symmetric(root @ lyapunov(loop, symmetric(error)) @ root.T)


def sanitised_game(good: Bool[Array, ""], problem: tuple, X: Array) -> tuple:
    """A game that is solved; one at rest for another, so that no NaN of it is in a
    derivative."""
    A, B, D, Q, R = problem
    A, B, D, Q, X = (jnp.where(good, M, 0) for M in (A, B, D, Q, X))
    return (A, B, D, Q, jnp.where(good, R, shifted(1, R))), X


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def attached(
    discrete: bool, problem: tuple, gamma: Float[Array, ""], game: Game
) -> Float[Array, "n n"]:
    """`X` of a game that was solved, with its derivatives; zero if it was not."""
    del discrete, problem, gamma
    return jnp.where(game.good, game.X, 0)


@attached.defjvp
@full_precision
def _attached_jvp(discrete, primals, tangents):
    X = attached(discrete, *primals)
    problem, gamma, game = primals
    (A, *others), _ = sanitised_game(game.good, problem, X)
    if not discrete:
        # At rest a loop is not stable: it is given one that is.
        A = A - shifted(jnp.where(game.good, 0, 1), A)
    gamma = jnp.where(game.good, gamma, 1)
    _, error, loop = jax.jvp(
        lambda *at: left_side(discrete, X, joint(*at)),
        ((A, *others), gamma),
        tangents[:2],
        has_aux=True,
    )
    return X, _correction(discrete, X, loop, jnp.where(game.good, error, 0))


def barrier(discrete: bool, problem: tuple, gamma: Float[Array, ""]) -> Array:
    """What becomes steep at the least level."""
    start = game_start(discrete, problem)
    end, _ = bisect_level(
        functools.partial(solve_game, discrete), problem, start, gamma
    )
    X = attached(discrete, problem, gamma, end.game)
    total = jnp.trace(X)
    if discrete:
        total += inverse_margins(problem[2][None], X[None], gamma)
    return total


def inverse_margins(
    D: Float[Array, "T n k"], X: Float[Array, "T n n"], gamma: Float[Array, ""]
) -> Float[Array, ""]:
    """The traces of `(gamma^2 I - D'XD)^-1`, summed, in a unit that fits."""
    eye = jnp.eye(D.shape[-1], dtype=D.dtype)
    margins = gamma**2 * eye - jnp.swapaxes(D, 1, 2) @ X @ D
    inverses = jax.vmap(lambda M: jnp.trace(solve(M, eye)))(margins)
    return lax.stop_gradient(gamma**2 * jnp.linalg.norm(X)) * jnp.sum(inverses)
