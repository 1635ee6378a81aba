"""The Gramian of a linear flow over a finite time."""

import jax.lax as lax
import jax.numpy as jnp
import jax.scipy.linalg as jsl

from .._typing import Scalar, Square
from ._linear_solve import full_precision, symmetric


_DOUBLINGS = 60
"""Enough for a time of 2**60 times what the fastest mode takes."""


@full_precision
def gramian_over(A: Square, Q: Square, time: Scalar) -> Square:
    """The integral of `exp(A s) Q exp(A' s)` over `s` from 0 to `time`.

    Over the whole time the exponential of `-A` would overflow where `A` is stiff. It is
    taken over a short part, with `|A| t < 1`, which is then doubled.

    Source: Van Loan, 1978.
    """
    n = A.shape[0]
    fastest = lax.stop_gradient(time * jnp.linalg.norm(A))
    doublings = jnp.clip(jnp.ceil(jnp.log2(jnp.maximum(fastest, 1))), 0, _DOUBLINGS)
    short = time * 0.5**doublings
    block = jnp.block([[-A, Q], [jnp.zeros_like(A), A.T]]) * short
    exponential = jsl.expm(block)
    power = exponential[n:, n:].T
    W = power @ exponential[:n, n:]

    def double(carry, k):
        W, power = carry
        more = k < doublings
        # Zero where it is not used: what overflows there must not reach a derivative.
        safe_power = jnp.where(more, power, 0)
        W_next = W + safe_power @ W @ safe_power.T
        return (W_next, jnp.where(more, safe_power @ safe_power, power)), None

    (W, _), _ = lax.scan(double, (W, power), jnp.arange(_DOUBLINGS))
    return symmetric(W)
