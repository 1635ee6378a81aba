"""The stationary H-infinity game, in discrete time, at a given level."""

from collections.abc import Callable

import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array

from ..math._linear_solve import full_precision, solve
from ._arguments import RiccatiData
from ._level import Game
from ._recursion import gain, is_saddle, one_step, symmetric
from ._residual import riccati_residual
from ._spectrum import spectral_radius
from ._start import double
from ._stein import stein


NEWTON_STEPS = 4


def players(B, D, R, gamma):
    """`[B D]`, and the weight of the joint control `[u; w]`."""
    m, k = B.shape[-1], D.shape[-1]
    weight = jnp.zeros((*R.shape[:-2], m + k, m + k), R.dtype)
    worth = -(gamma**2) * jnp.eye(k, dtype=R.dtype)
    weight = weight.at[..., :m, :m].set(R).at[..., m:, m:].set(worth)
    return jnp.concatenate([B, D], axis=-1), weight


def is_semidefinite(X: Array) -> Array:
    """Whether a symmetric matrix has no negative eigenvalue, up to rounding."""
    n, dtype = X.shape[0], X.dtype
    size = jnp.linalg.norm(X)
    slack = 1000 * n * jnp.finfo(dtype).eps * jnp.where(size > 0, size, 1)
    return jnp.all(jnp.isfinite(jnp.linalg.cholesky(X + slack * jnp.eye(n))))


def rounding(n: int, dtype) -> float:
    """The relative residual that counts as solved."""
    return 1000 * n * float(jnp.finfo(dtype).eps)


def discrete_start(problem: tuple) -> Array:
    """Where to start without a disturbance: not at 0, where an iteration rests that has
    an unstable mode unseen by the cost."""
    A, _, _, Q, R = problem
    size = jnp.linalg.norm(Q)
    size = jnp.where(size > 0, size, jnp.linalg.norm(R))
    return jnp.where(size > 0, size, 1) * jnp.eye(A.shape[0], dtype=A.dtype)


def discrete_game(problem: tuple, gamma: Array, X0: Array) -> Game:
    """The stabilising solution of the game equation, and whether it is of the game."""
    A, B, D, Q, R = problem
    n, m = B.shape
    both, weight = players(B, D, R, gamma)
    S = jnp.zeros_like(both)
    # The equation of the correction to X0.
    crossed = both.T @ X0
    right = jnp.concatenate([crossed @ A, both.T], axis=1)
    solved = solve(weight + crossed @ both, right)
    K, G = solved[:, :n], symmetric(both @ solved[:, n:])
    J = symmetric(A.T @ X0 @ A - X0 - A.T @ crossed.T @ K + Q)
    J, iterations = double((A - both @ K, G, J), X0)

    data = RiccatiData(A, both, Q, weight, S, None)

    def equation(X):
        left = riccati_residual(True, data, X, False, players=D.shape[1])
        return left.error, left.closed_loop, left.K, left

    X, _, loop, K, left = polish(X0 + J, equation, lambda _, *linear: stein(*linear))
    pivot = symmetric(weight + both.T @ X @ both)
    bound = 1 - n * jnp.finfo(A.dtype).eps
    loops = jnp.stack([loop, A - B @ K[:m]])
    holds = is_semidefinite(X) & is_saddle(pivot, D.shape[1])
    holds &= jnp.all(jax.vmap(spectral_radius)(loops) < bound)
    solved = left.relative < rounding(n, A.dtype)
    return Game(X, left.bounds[0], holds, solved, iterations)


def polish(X: Array, equation: Callable, correction: Callable, unit: Array | float = 1):
    """Newton steps for as long as they bring `X` closer; and the equation there.

    `equation(X)` is its error, the closed loop, the gains and all about what is left,
    and `correction(X, loop, error)` the solution of its linearisation. `unit` is the
    size of error over `X`.
    """
    small = unit * X.shape[0] * jnp.finfo(X.dtype).eps

    def more(carry):
        *_, relative, k = carry
        return (k <= NEWTON_STEPS) & (relative > small)

    def body(carry):
        old, relative, k = carry
        X, error, loop, *_ = old
        candidate = symmetric(X + jnp.where(k == 0, 0, correction(X, loop, error)))
        new = (candidate, *equation(candidate))
        found = jnp.linalg.norm(new[1]) / jnp.linalg.norm(candidate)
        # The first round only measures. A NaN compares false, and ends it.
        better = (found < relative) | (k == 0)
        new = jax.tree.map(lambda a, b: jnp.where(better, a, b), new, old)
        return new, jnp.where(better, found, 0), k + 1

    unknown = jax.eval_shape(equation, X)
    nothing = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), unknown)
    start = ((X, *nothing), jnp.asarray(jnp.inf, X.dtype), jnp.asarray(0))
    return lax.while_loop(more, body, start)[0]


def sanitised_game(good, problem, X):
    """A game that is solved; one at rest for another, so that no NaN of it is in a
    derivative."""
    A, B, D, Q, R = problem
    A, B, D, Q, X = (jnp.where(good, M, 0) for M in (A, B, D, Q, X))
    return (A, B, D, Q, jnp.where(good, R, jnp.eye(R.shape[0], dtype=R.dtype))), X


@jax.custom_jvp
def discrete_attached(problem: tuple, gamma: Array, game: Game) -> Array:
    """`X` of a game that was solved, with its derivatives; zero if it was not."""
    del problem, gamma
    return jnp.where(game.good, game.X, 0)


@discrete_attached.defjvp
@full_precision
def _discrete_attached_jvp(primals, tangents):
    X = discrete_attached(*primals)
    problem, gamma, game = primals
    (A, B, D, Q, R), _ = sanitised_game(game.good, problem, X)
    gamma = jnp.where(game.good, gamma, 1)
    both, weight = players(B, D, R, gamma)
    S = jnp.zeros_like(both)
    K, loop = gain(A, both, weight, S, X)

    # At the saddle point the cost-to-go is stationary in both gains.
    def cost(problem, gamma):
        A, B, D, Q, R = problem
        both, weight = players(B, D, R, gamma)
        return one_step(A, both, Q, weight, S, K, X)

    _, change = jax.jvp(cost, ((A, B, D, Q, R), gamma), tangents[:2])
    return X, stein(loop, jnp.where(game.good, change, 0))
