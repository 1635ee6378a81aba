"""The flow of the continuous Riccati equation, and what goes with continuous time."""

import functools

import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..math._linear_solve import full_precision, solve, symmetric
from ._recursion import joined


_MAX_HALVINGS = 40
_PADE = (1.0, 1 / 2, 5 / 44, 1 / 66, 1 / 792, 1 / 15840, 1 / 665280)
"""Numerator of the [6/6] approximant of exp; its error is 2e-17 at norm 1/2."""


def scale_of(G: Array, Q: Array) -> Array:
    """The size of `X` at which `X G X` is as large as `Q`; 1 if that is no size."""
    quadratic, constant = jnp.linalg.norm(G), jnp.linalg.norm(Q)
    usual = (quadratic > 0) & (constant > 0)
    ratio = jnp.where(usual, constant, 1) / jnp.where(usual, quadratic, 1)
    return lax.stop_gradient(jnp.sqrt(ratio))


def hamiltonian(A, G, Q) -> Array:
    """The matrix of the linear flow of `[I; X]`, for `dX/dt = -A'X - XA + XGX - Q`."""
    return jnp.block([[A, -G], [-Q, -A.T]])


def short_element(H: Float[Array, "_ _"], time: Array) -> tuple[Array, Array, Array]:
    """What `joined` joins, over a time that is short against `H`."""
    n = H.shape[0] // 2
    Z = -H * time
    even = jnp.eye(2 * n, dtype=H.dtype) * _PADE[0]
    odd, power = jnp.zeros_like(Z), jnp.eye(2 * n, dtype=H.dtype)
    for k in range(1, 7):
        power = power @ Z
        even, odd = (
            (even, odd + _PADE[k] * power) if k % 2 else (even + _PADE[k] * power, odd)
        )
    flow = solve(even - odd, even + odd)
    # Backwards over the time: [U; V] = flow [I; X] and V U^-1 is X before it.
    first, second = flow[:n, :n], flow[:n, n:]
    eye = jnp.eye(n, dtype=H.dtype)
    solved = solve(first, jnp.concatenate([eye, second], axis=1))
    J = solve(first.T, flow[n:, :n].T).T
    return solved[:, :n], symmetric(solved[:, n:]), symmetric(J)


def elements(H: Float[Array, "_ _"], times: Float[Array, " N"], is_game: bool):
    """The elements of intervals of these lengths, by doubling from short ones; and
    whether the equation has a solution from 0 over each."""
    count, short = _short_elements(H, times)
    reach = lambda C, J: is_within_reach(C, J, is_game)

    def twice(_, carry):
        element, good = carry
        good &= jax.vmap(reach)(element[1], element[2])
        return jax.vmap(joined)(element, element), good

    start = (short, jnp.ones(times.shape, bool))
    return lax.fori_loop(0, count, twice, start)


def elements_to_differentiate(H: Float[Array, "_ _"], times: Float[Array, " N"]):
    """The same elements, by a loop of fixed length, which reverse mode needs."""
    count, short = _short_elements(H, times)

    def twice(element, k):
        # Beyond the last doubling nothing is joined to nothing, which is harmless.
        going = k < count
        tried = jax.tree.map(lambda M: jnp.where(going, M, 0), element)
        after = jax.vmap(joined)(tried, tried)
        kept = jax.tree.map(lambda a, b: jnp.where(going, a, b), after, element)
        return kept, None

    return lax.scan(twice, short, jnp.arange(_MAX_HALVINGS))[0]


def _short_elements(H, times):
    # Halved so often, the longest flow is near the identity.
    sizes = jnp.maximum(2 * jnp.linalg.norm(H) * times, 1)
    count = jnp.max(lax.stop_gradient(jnp.ceil(jnp.log2(sizes))).astype(jnp.int32))
    count = jnp.minimum(count, _MAX_HALVINGS)
    return count, jax.vmap(lambda time: short_element(H, time))(times * 0.5**count)


def is_within_reach(C: Array, X: Array, is_game: bool) -> Array:
    """Whether the equation has a solution over an interval, back from `X`.

    It has while `I + C X` is not singular, `C` being that of the time passed so far. As
    `C` grows with time where nothing but a control is in it, and the interval that can
    be passed shrinks with `X` where `X` is not negative, it is enough to see at the end
    that no eigenvalue of `I + C X` has become negative.
    """
    C, X = lax.stop_gradient((C, X))
    inner, outer = (X, C) if is_game else (C, X)
    n = X.shape[0]
    eye = jnp.eye(n, dtype=X.dtype)
    size = jnp.linalg.norm(inner)
    slack = 100 * n * jnp.finfo(X.dtype).eps * jnp.where(size > 0, size, 1)
    root = jnp.linalg.cholesky(inner + slack * eye)
    moved = jnp.linalg.cholesky(eye + symmetric(root.T @ outer @ root))
    return jnp.all(jnp.isfinite(root)) & jnp.all(jnp.isfinite(moved))


@functools.partial(jax.custom_jvp, nondiff_argnums=(5,))
def flow_values(A, G, Q, final, times, is_game: bool):
    """`X` at `times`, back from `final`, along `dX/dt = -A'X - XA + XGX - Q`.

    NaN at a time, and at all before it, from which there is no solution to the end.
    """
    unit, H = _scaled(A, G, Q)
    parts, possible = elements(H, jnp.diff(times), is_game)

    def back(carry, here):
        X, good = carry
        element, possible = here
        good &= possible & is_within_reach(element[1], X, is_game)
        X = passed(element, X)
        good &= jnp.all(jnp.isfinite(X))
        return (X, good), jnp.where(good, X, jnp.nan)

    start = (final / unit, jnp.ones((), bool))
    _, X = lax.scan(back, start, (parts, possible), reverse=True)
    return jnp.concatenate([unit * X, final[None]])


def _scaled(A, G, Q):
    """The unit of `X` that makes the parts of the flow alike, and the flow in it."""
    unit = scale_of(G, Q)
    return unit, hamiltonian(A, unit * G, Q / unit)


def _to_differentiate(A, G, Q, final, times):
    """The same `X`, where there is one, by loops that can be differentiated."""
    unit, H = _scaled(A, G, Q)
    parts = elements_to_differentiate(H, jnp.diff(times))

    def back(X, element):
        X = passed(element, X)
        return X, X

    _, X = lax.scan(back, final / unit, parts, reverse=True)
    return jnp.concatenate([unit * X, final[None]])


@flow_values.defjvp
@full_precision
def _flow_values_jvp(is_game, primals, tangents):
    X = flow_values(*primals, is_game)  # pyright: ignore[reportCallIssue]
    good = jnp.all(jnp.isfinite(X))
    *matrices, times = primals
    # What fails is replaced, so that no NaN of it is in a derivative.
    safe = (*(jnp.where(good, M, 0) for M in matrices), times)
    _, tangent = jax.jvp(_to_differentiate, safe, tangents)
    return X, jnp.where(good, tangent, 0)


def passed(element, X):
    """`X` at the start of an interval from `X` at its end."""
    A, C, J = element
    n = A.shape[0]
    moved = solve(jnp.eye(n, dtype=A.dtype) + C @ X, A)
    return symmetric(J + A.T @ X @ moved)
