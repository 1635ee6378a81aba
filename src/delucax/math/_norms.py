"""Norms, projections onto balls and boxes, and the residual of an equilibrium."""

from typing import Any

from jaxtyping import ArrayLike

from .._jax import lax, on_host, xp
from .._typing import Array


_SMALL = 16
ULPS = 4
"""The rounding error of a residual `F(x) - x`, in units of the last place of `x`."""


def safe_norm(x: ArrayLike, axis: int | None = -1, keepdims: bool = False) -> Array:
    """The Euclidean norm with gradient 0 (not NaN) at 0.

    **Arguments:**

    - `x`: any array.
    - `axis`: the axis to reduce; `None` for all.
    - `keepdims`: keep the reduced axis with size 1.

    **Returns:** the norm along `axis`.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        jax.grad(dlx.math.safe_norm)(jnp.zeros(3))
        ```
    """
    x = xp.asarray(x)
    squared = xp.sum(x * x, axis=axis, keepdims=keepdims)
    # The square root of a masked one: its gradient is finite where it is not taken.
    at_zero = squared == 0
    return xp.where(at_zero, 0.0, xp.sqrt(xp.where(at_zero, 1.0, squared)))


def within_ball(x: Array, radius: ArrayLike) -> Array:
    """The nearest point of a ball in the Euclidean (Frobenius) norm, with a finite
    gradient everywhere."""
    norm = safe_norm(x, axis=None)
    # Inside, the factor is exactly 1, and so is its derivative of `x`.
    over = norm > radius
    return xp.where(over, radius / xp.where(over, norm, 1), 1).astype(x.dtype) * x


def clip(x: ArrayLike, low: Any, high: Any) -> Array:
    """`x` kept between `low` and `high`, either of which may be infinite.

    `jnp.clip` by comparisons: its own minimum and maximum must pass on a NaN of the
    limits, which costs a batch on CPU as much as all the rest of a pendulum's step. A
    NaN in `x` is kept; NaN limits are ignored. The gradient goes to `x` within the
    limits and on them, and to the limit outside.

    **Arguments:**

    - `x`: any array.
    - `low`, `high`: the limits, numbers or arrays that broadcast against `x`.

    **Returns:** the clipped array, of the dtype that the three promote to.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.math.clip(jnp.array([-3.0, 0.5, 3.0]), -2.0, 2.0)
        ```
    """
    x = xp.where(x > high, high, x)
    return xp.where(x < low, low, x)


def size(matrix: Array) -> Array:
    """The Frobenius norm."""
    unit = _unit(matrix)
    return _norm(matrix * unit) / unit


def largest(matrix: Array) -> Array:
    """The size of the largest entry."""
    if _is_large(matrix):
        return abs(matrix).max()
    # Sizes are taken beforehand too, as XLA leaves out the reduction of a single entry.
    join = lambda a, b: lax.max(xp.abs(a), xp.abs(b))
    return _reduced(join, xp.abs(matrix), matrix.ndim)


def largest_of_each(*matrices: Array) -> tuple[Array, ...]:
    """The sizes of the largest entries of matrices of one shape."""
    if on_host() or not _is_large(matrices[0]):
        return tuple(map(largest, matrices))
    # One loop over all, in which nothing is stored.
    join = lambda a, b: tuple(map(lax.max, a, b))
    zero = xp.zeros((), matrices[0].dtype)
    return lax.reduce(
        tuple(map(xp.abs, matrices)), (zero,) * len(matrices), join, (0, 1)
    )


def relative_size(error: Array, *terms: Array) -> Array:
    """The norm of an equation's residual over the sum of the norms of its terms."""
    return relative_and_total_size(error, xp.stack(terms))[0]


def relative_and_total_size(error: Array, terms: Array) -> tuple[Array, Array]:
    """The norm of an equation's residual, or of a stack of residuals, over the sum of
    the norms of its stacked terms; and this sum."""
    unit = _unit(terms)
    total = xp.sum(_norm(terms * unit))
    # `lax.max` propagates NaN, as a comparison would not.
    divisor = lax.max(total, xp.finfo(total.dtype).tiny)
    return _norm(error * unit) / divisor, total / unit


def one_if_zero(x: Array) -> Array:
    """Numbers, with 1 for each that is zero."""
    return x + (x == 0)


def _unit(matrix):
    """A factor for entries whose squares may overflow or underflow. It makes the
    largest one 4, as the reciprocal of a number of any size may itself underflow."""
    return 4 / lax.max(largest(matrix), 2 * xp.finfo(matrix.dtype).tiny)


def _norm(matrix):
    squares = matrix * matrix
    if _is_large(matrix):
        return xp.sqrt(xp.sum(squares, axis=(-2, -1)))
    return xp.sqrt(_reduced(lambda a, b: xp.abs(a) + xp.abs(b), squares, 2))


def _is_large(matrix):
    return on_host() or matrix.shape[-1] > _SMALL


def _reduced(join, array, axes):
    """A reduction of so many last axes, of few entries.

    XLA on CPU hands a plain sum or maximum to a library with a pool of threads, which
    takes twice as long to compile, and for a batch of small matrices to run. It does
    not know these operations, which are those of numbers that are not negative.
    """
    last = range(array.ndim)[-axes:]
    return lax.reduce(array, xp.zeros((), array.dtype), join, tuple(last))


def power_of_two(x: Array) -> Array:
    """A power of two near each number, to the last bit, which `jnp.exp2` is not."""
    # Rounded to no digit of the mantissa.
    return lax.reduce_precision(x, xp.finfo(x.dtype).nexp, 0)


def relative_drift(
    drift: Array, jacobian: Array, x: Array, u: Array, *, is_map: bool
) -> Array:
    """The scaled residual of an equilibrium, the largest entry of

    `|drift_i| / (|drift_i| + sum_j |jacobian_ij| unit_j)`. The drift of a map is
    `F(x) - x`, less the rounding of `x_i`. Leading axes are times, along which the unit
    is that of the largest value.
    """
    largest = lambda z: xp.max(xp.abs(z).reshape(-1, z.shape[-1]), axis=0)
    terms = xp.abs(jacobian) @ xp.concatenate(
        [units_of(largest(x)), units_of(largest(u))]
    )
    left = xp.abs(drift)
    if is_map:
        rounding = ULPS * xp.finfo(x.dtype).eps * largest(x)
        left = xp.maximum(left - rounding, 0)
    return xp.max(xp.where(left == 0, 0, left / (left + terms)))


def units_of(z: Array) -> Array:
    """The size of each entry; for one that is zero up to rounding that of the largest
    entry, at most 1, and 1 if all are zero."""
    size = xp.abs(z)
    largest = xp.max(size, initial=0)
    # A state at rest at zero still needs a unit in which its drift is judged.
    floor = xp.where(largest > 0, xp.minimum(largest, 1), 1)
    return xp.where(size > 100 * xp.finfo(z.dtype).eps * floor, size, floor)
