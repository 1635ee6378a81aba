"""Matrices with rows and columns of similar size."""

from .._jax import stop_gradient, while_loop, xp
from .._typing import Square, Vector
from ._norms import power_of_two


_SWEEPS = 24


def balanced(A: Square) -> tuple[Square, Vector]:
    """`D^-1 A D` and `D`, a diagonal that gives rows and columns similar sizes.

    `D` has powers of two, so that there is no rounding. It is not differentiated.

    Source: Osborne, 1960.
    """
    sizes = xp.abs(stop_gradient(A))

    def more(carry):
        k, _, ratio = carry
        return (k < _SWEEPS) & (xp.max(xp.abs(xp.log2(ratio))) > 1)

    def sweep(carry):
        k, scale, _ = carry
        scaled = sizes * scale[None, :] / scale[:, None]
        off = scaled - xp.diag(xp.diagonal(scaled))
        rows, columns = xp.sum(off, axis=1), xp.sum(off, axis=0)
        usable = (rows > 0) & (columns > 0)
        # The square root of this ratio makes a row and its column equally large.
        ratio = xp.where(usable, rows, 1) / xp.where(usable, columns, 1)
        # All scales change at once, so take half of the step of a single scale.
        scale = scale * ratio**0.25
        return k + 1, scale / xp.exp2(xp.round(xp.mean(xp.log2(scale)))), ratio

    # Balancing need not be exact.
    one = xp.ones(A.shape[0], A.dtype)
    _, scale, _ = while_loop(more, sweep, (0, one, 4 * one))
    usable = xp.isfinite(scale) & (scale > 0)
    scale = power_of_two(xp.where(usable, scale, 1))
    return A * scale[None, :] / scale[:, None], scale
