"""The stationary H-infinity game, in continuous time, at a given level."""

import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array

from ..math._linear_solve import full_precision, solve
from ._arguments import RiccatiData
from ._flow import hamiltonian, lyapunov, scale_of, short_element
from ._game import (
    is_semidefinite,
    players,
    polish,
    rounding,
    sanitised_game,
)
from ._level import Game, search
from ._recursion import is_clearly_definite, symmetric
from ._residual import riccati_residual
from ._spectrum import spectral_abscissa
from ._start import double


def joint_gain(A, both, weight, X):
    """The gains of the joint control `[u; w] = -K x`, and the loop `A - [B D] K`."""
    K = solve(weight, both.T @ X)
    return K, A - both @ K


def rate(A, both, Q, weight, K, X):
    """How fast the cost-to-go of `-K x` grows back in time, where it is `X`."""
    moved = X @ (A - both @ K)
    return symmetric(moved + moved.T + Q + K.T @ weight @ K)


def even_lyapunov(X, loop, right):
    """The solution `Z` of `loop'Z + Z loop + right = 0`, where it goes with `X`.

    In the coordinates in which `X` is the identity: near the least level `X` is large
    in some directions, and the loop far from normal.
    """
    n = X.shape[0]
    eye = jnp.eye(n, dtype=X.dtype)
    size = jnp.linalg.norm(X)
    slack = jnp.finfo(X.dtype).eps * jnp.where(size > 0, size, 1)
    root = lax.stop_gradient(jnp.linalg.cholesky(X + slack * eye))
    root = jnp.where(jnp.all(jnp.isfinite(root)), root, eye)
    loop = solve(root, (root.T @ loop).T).T
    right = solve(root, solve(root, right).T)
    return symmetric(root @ lyapunov(loop, symmetric(right)) @ root.T)


def continuous_start(problem: tuple) -> Array:
    """Where to start without a disturbance; not at 0."""
    A, B, _, Q, R = problem
    control = symmetric(B @ solve(R, B.T))
    # Without a cost of the state it is the unstable modes that set the size.
    tiny = jnp.finfo(A.dtype).tiny ** 0.5
    eye = jnp.eye(A.shape[0], dtype=A.dtype)
    unseen = jnp.linalg.norm(A) ** 2 / jnp.maximum(jnp.linalg.norm(control), tiny)
    return scale_of(control, jnp.where(jnp.linalg.norm(Q) > 0, Q, unseen * eye)) * eye


def continuous_game(problem: tuple, gamma: Array, X0: Array) -> Game:
    """The stabilising solution of the game equation, and whether it is of the game."""
    A, B, D, Q, R = problem
    n, m = B.shape
    both, weight = players(B, D, R, gamma)
    G = symmetric(B @ solve(R, B.T) - D @ D.T / gamma**2)
    # The flow of the correction to X0, in the units that make its parts alike.
    moved = X0 @ A
    constant = Q + moved + moved.T - X0 @ G @ X0
    unit = scale_of(G, constant)
    H = hamiltonian(A - G @ X0, unit * G, constant / unit)
    size = jnp.linalg.norm(H)
    time = 0.5 / jnp.where(size > 0, size, 1)
    J, iterations = double(short_element(H, time), X0 / unit)

    data = RiccatiData(A, both, Q, weight, jnp.zeros_like(both), None)

    def equation(X):
        left = riccati_residual(False, data, X, False, players=D.shape[1])
        return left.error, left.closed_loop, left.K, left

    X, _, loop, K, left = polish(X0 + unit * J, equation, even_lyapunov, size)
    slack = n * jnp.finfo(A.dtype).eps * jnp.linalg.norm(A)
    loops = jnp.stack([loop, A - B @ K[:m]])
    holds = is_semidefinite(X) & is_clearly_definite(R)
    holds &= jnp.all(jax.vmap(spectral_abscissa)(loops) < -slack)
    solved = left.relative < rounding(n, A.dtype)
    return Game(X, left.bounds[0], holds, solved, iterations)


@jax.custom_jvp
def continuous_attached(problem: tuple, gamma: Array, game: Game) -> Array:
    """`X` of a game that was solved, with its derivatives; zero if it was not."""
    del problem, gamma
    return jnp.where(game.good, game.X, 0)


@continuous_attached.defjvp
@full_precision
def _continuous_attached_jvp(primals, tangents):
    X = continuous_attached(*primals)
    problem, gamma, game = primals
    (A, B, D, Q, R), _ = sanitised_game(game.good, problem, X)
    # At rest a loop is not stable: it is given one that is.
    A = A - jnp.where(game.good, 0, jnp.eye(A.shape[0], dtype=A.dtype))
    gamma = jnp.where(game.good, gamma, 1)
    both, weight = players(B, D, R, gamma)
    K, loop = joint_gain(A, both, weight, X)

    # At the saddle point the rate is stationary in both gains.
    def cost(problem, gamma):
        A, B, D, Q, R = problem
        both, weight = players(B, D, R, gamma)
        return rate(A, both, Q, weight, K, X)

    _, change = jax.jvp(cost, ((A, B, D, Q, R), gamma), tangents[:2])
    return X, even_lyapunov(X, loop, jnp.where(game.good, change, 0))


def continuous_barrier(problem, gamma):
    """What becomes steep at the least level."""
    found, _ = search(continuous_game, problem, continuous_start(problem), gamma)
    return jnp.trace(continuous_attached(problem, gamma, found.game))
