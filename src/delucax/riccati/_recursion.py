"""The Riccati recursion over a finite horizon, in sequence or in parallel."""

import functools

import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..math._linear_solve import full_precision, solve, symmetric


Element = tuple[Array, Array, Array]
"""`A, C, J` of an interval: from `X` at its end follows `J + A' X (I + C X)^-1 A` at
its start."""


def is_clearly_definite(M: Float[Array, "n n"]) -> Bool[Array, ""]:
    """Whether a symmetric matrix is positive definite, by more than rounding."""
    L = jnp.linalg.cholesky(lax.stop_gradient(M))
    # Relative to the diagonal, so that units do not matter. NaN compares false.
    least = M.shape[0] * jnp.finfo(M.dtype).eps * jnp.abs(jnp.diagonal(M))
    return jnp.all(jnp.diagonal(L) ** 2 > least)


def is_saddle(M: Float[Array, "k k"], players: int) -> Bool[Array, ""]:
    """Whether `[u; w]' M [u; w]` has a minimum over `u` of its maximum over `w`.

    `w` is the last `players` entries, and may be empty.
    """
    m = M.shape[0] - players
    if players == 0:
        return is_clearly_definite(M)
    U, C, W = M[:m, :m], M[:m, m:], -M[m:, m:]
    concave = is_clearly_definite(W)
    safe = jnp.where(concave, W, jnp.eye(players, dtype=M.dtype))
    return concave & is_clearly_definite(symmetric(U + C @ solve(safe, C.T)))


def failed_step(X: Float[Array, "T n n"]) -> int:
    """The last step without a solution: it is NaN there and at all before it."""
    return int(jnp.sum(jnp.isnan(X[:, 0, 0]))) - 1


def gain(A, B, R, S, X):
    """The stationary `K = (R + B'XB)^-1 (B'XA + S')`, and the loop `A - B K`."""
    K = solve(R + B.T @ X @ B, B.T @ X @ A + S.T)
    return K, A - B @ K


def one_step(A, B, Q, R, S, K, X):
    """The cost-to-go of `u = -K x` for one step, then `X`.

    In this form an error in `K` counts to second order only, and where the costs are
    positive the result is.
    """
    loop, cross = A - B @ K, S @ K
    return symmetric(loop.T @ X @ loop + Q + K.T @ R @ K - cross - cross.T)


def sanitised(ok, A, B, Q, R, S, X):
    """The arguments where all is well; elsewhere a step with no difficulty.

    So no NaN of a step that failed is in a derivative.
    """
    eye = jnp.broadcast_to(jnp.eye(R.shape[-1], dtype=R.dtype), R.shape)
    here = ok[..., None, None]
    A, B, Q, S, X = (jnp.where(here, M, 0) for M in (A, B, Q, S, X))
    return A, B, Q, jnp.where(here, R, eye), S, X


@functools.partial(jax.custom_jvp, nondiff_argnums=(6, 7))
def values(A, B, Q, R, S, final, players: int, parallel: bool):
    """`X` at steps 0 to T of the recursion from `final`, shape `(T+1, n, n)`.

    The last `players` controls maximise. NaN at a step, and at all before it, that has
    no saddle point.
    """
    run = _in_parallel if parallel else _in_sequence
    X = run(A, B, Q, R, S, final)
    pivot = R + jnp.swapaxes(B, 1, 2) @ X[1:] @ B
    good = jax.vmap(lambda M: is_saddle(M, players))(symmetric(pivot))
    good &= jnp.all(jnp.isfinite(X[:-1]), axis=(1, 2))
    good = lax.cummin(good.astype(jnp.int32), reverse=True).astype(bool)
    return X.at[:-1].set(jnp.where(good[:, None, None], X[:-1], jnp.nan))


def _in_sequence(A, B, Q, R, S, final):
    def back(X, here):
        A, B, Q, R, S = here
        K, _ = gain(A, B, R, S, X)
        X = one_step(A, B, Q, R, S, K, X)
        return X, X

    _, X = lax.scan(back, final, (A, B, Q, R, S), reverse=True)
    return jnp.concatenate([X, final[None]])


def _in_parallel(A, B, Q, R, S, final):
    # Adding x_next' P x_next - x' P x to each step changes no decision, and makes the
    # control weight definite even where R is not.
    n = A.shape[-1]
    size = jnp.linalg.norm(Q, axis=(1, 2)).mean() + jnp.linalg.norm(final)
    size = jnp.where(size > 0, size, jnp.linalg.norm(R, axis=(1, 2)).mean())
    P = jnp.where(size > 0, size, 1) * jnp.eye(n, dtype=A.dtype)

    def element(A, B, Q, R, S):
        cross = A.T @ P @ B + S
        return step_element(A, B, R + B.T @ P @ B, cross, A.T @ P @ A - P, Q)

    def combine(later, earlier):
        # The scan runs backwards, so that the later of two comes first.
        return jax.vmap(joined)(earlier, later)

    steps = jax.vmap(element)(A, B, Q, R, S)
    nothing = jnp.zeros((1, n, n), A.dtype)
    last = (nothing, nothing, (final - P)[None])
    elements = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), steps, last)
    _, _, J = lax.associative_scan(combine, elements, reverse=True)
    X = (J + P).at[-1].set(final)
    # One step from each X to the one before takes the scan's rounding away.
    K, _ = jax.vmap(gain)(A, B, R, S, X[1:])
    return X.at[:-1].set(jax.vmap(one_step)(A, B, Q, R, S, K, X[1:]))


def step_element(A, B, weight, cross, linear, Q) -> Element:
    """The element of a step, about some `X0`.

    There `weight` is `R + B'X0 B`, `cross` is `A'X0 B + S`, and `linear` is
    `A'X0 A - X0`.
    """
    n = A.shape[0]
    solved = solve(weight, jnp.concatenate([cross.T, B.T], axis=1))
    K, G = solved[:, :n], symmetric(B @ solved[:, n:])
    return A - B @ K, G, symmetric(linear - cross @ K + Q)


def joined(first: Element, second: Element) -> Element:
    """The element of two intervals, one after the other.

    Source: Sarkka and Garcia-Fernandez, 2023.
    """
    A1, C1, J1 = first
    A2, C2, J2 = second
    n = A1.shape[0]
    eye = jnp.eye(n, dtype=A1.dtype)
    solved = solve(eye + C1 @ J2, jnp.concatenate([A1, C1], axis=1))
    moved, weighted = solved[:, :n], solved[:, n:]
    C = symmetric(C2 + A2 @ weighted @ A2.T)
    return A2 @ moved, C, J1 + symmetric(A1.T @ (J2 @ moved))


def linear_recursion(loop, added, final, parallel: bool, product):
    """`Z_t = product(loop_t, Z_{t+1}) + added_t` back from `final`, with all `Z`.

    `product` is linear in its second argument and turns products of loops into
    composition.
    """
    if not parallel:

        def back(Z, here):
            Z = product(here[0], Z) + here[1]
            return Z, Z

        _, Z = lax.scan(back, final, (loop, added), reverse=True)
        return jnp.concatenate([Z, final[None]])

    def combine(later, earlier):
        (later_loop, later_added), (loop, added) = later, earlier
        moved = jax.vmap(product)(loop, later_added)
        return later_loop @ loop, moved + added

    loop = jnp.concatenate([loop, jnp.zeros_like(loop[:1])])
    added = jnp.concatenate([added, final[None]])
    return lax.associative_scan(combine, (loop, added), reverse=True)[1]


@values.defjvp
@full_precision
def _values_jvp(players, parallel, primals, tangents):
    *matrices, _ = primals
    X = values(*primals, players, parallel)  # pyright: ignore[reportCallIssue]
    good = jnp.all(jnp.isfinite(X[:-1]), axis=(1, 2))
    A, B, Q, R, S, after = sanitised(good, *matrices, X[1:])  # pyright: ignore[reportCallIssue]
    K, loop = jax.vmap(gain)(A, B, R, S, after)

    # At the best gain the cost-to-go is stationary in it: its change is not needed.
    def cost(A, B, Q, R, S):
        return jax.vmap(one_step)(A, B, Q, R, S, K, after)

    _, change = jax.jvp(cost, (A, B, Q, R, S), tangents[:-1])
    change = jnp.where(good[:, None, None], change, 0)
    congruence = lambda loop, Z: loop.T @ Z @ loop
    tangent = linear_recursion(loop, change, tangents[-1], parallel, congruence)
    return X, tangent
