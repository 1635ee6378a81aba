"""Newton steps on a Riccati equation."""

from collections.abc import Callable

import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..math._linear_solve import symmetric
from ._residual import no_residual, Residual
from ._search import tolerance


_NEWTON_STEPS = 8
_FINE = 64
"""Units of rounding in the relative residual that need no correction."""


def polish(
    residual: Callable[[Array, Array], Residual],
    correction: Callable[[Array, Array, Array], Array],
    X: Float[Array, "n n"],
    *,
    units: int,
    to_working_precision: bool = False,
) -> tuple[Array, Residual]:
    """Newton steps on the equation itself, if it asks for them, while they help.

    `residual(X, accurately)` is what is left of it, in so many `units`, and
    `correction(X, closed_loop, error)` solves it to first order. Where rounding may
    hide more than there is to be left, the steps go on with accurate residuals, unless
    they are to end in working precision. Returns the best `X`, and what is left there.
    """
    eps = float(jnp.finfo(X.dtype).eps)
    fine = _FINE * eps
    wide = tolerance(X.dtype)

    def more(carry):
        return carry[4]

    def body(carry):
        X, last, best, accurately, going, patient, k = carry
        first = k == 0
        X = symmetric(X + step((X, *last), going & ~first))
        new = residual(X, going & accurately)
        better = first | (new.relative < best[1].relative)
        # Where steps stop to help much, rounding is all that is left. But far from the
        # solution the first may not help and yet be one towards it.
        helped = first | (new.relative < best[1].relative / 4)
        best = jax.tree.map(lambda a, b: jnp.where(better, a, b), (X, new), best)
        rest = best[1].relative
        again = helped | patient & (rest > wide)
        again &= (rest > fine) & (k < _NEWTON_STEPS)
        hidden = ~again & ~accurately & (jnp.max(best[1].bounds) > wide)
        X = jnp.where(hidden, best[0], X)
        k = jnp.where(hidden, 0, k + 1)
        last = new.closed_loop, new.error
        return X, last, best, accurately | hidden, again | hidden, helped, k

    def step(at, needed):
        """The correction. A loop of one round is not run for a batch in which no member
        needs it, as in the first round, which only measures."""

        def once(carry):
            # What is carried changes, so that no work on it is moved ahead of the loop.
            nothing = jax.tree.map(jnp.zeros_like, at)
            return jnp.zeros_like(needed), correction(*carry[2]), nothing

        start = needed, jnp.zeros_like(X), at
        return lax.while_loop(lambda carry: carry[0], once, start)[1]

    no, yes = jnp.asarray(False), jnp.asarray(True)
    unknown = no_residual(X, units)
    last = unknown.closed_loop, unknown.error
    accurately = yes if to_working_precision else no
    start = X, last, (X, unknown), accurately, yes, yes, jnp.asarray(0)
    return lax.while_loop(more, body, start)[2]
