"""Norms, projections onto balls and boxes, and the residual of an equilibrium."""

from typing import Any

from jaxtyping import ArrayLike

from .._jax import lax, on_host, xp
from .._typing import Array


_SMALL = 16
ULPS = 4
"""The rounding error of a residual `F(x) - x`, in units in the last place of `x`."""


def safe_norm(x: ArrayLike, axis: int | None = -1, keepdims: bool = False) -> Array:
    """The Euclidean norm, with the gradient 0 (not NaN) at 0.

    **Arguments:**

    - `x`: an array of any shape.
    - `axis`: the axis along which the norm is computed, the last axis by default;
        `None` for the norm over all axes.
    - `keepdims`: whether to keep the axis of the norm in the result, with size 1; false
        by default.

    **Returns:** the norm along `axis`.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        jax.grad(dlx.math.safe_norm)(jnp.zeros(3))
        ```

        ```text
        Array([0., 0., 0.], dtype=float32)
        ```
    """
    x = xp.asarray(x)
    squared = xp.sum(x * x, axis=axis, keepdims=keepdims)
    # The square root is taken of 1 where the norm is 0, so that its gradient is finite.
    at_zero = squared == 0
    return xp.where(at_zero, 0.0, xp.sqrt(xp.where(at_zero, 1.0, squared)))


def within_ball(x: Array, radius: ArrayLike) -> Array:
    """The point of the ball of `radius` that is nearest to `x`, in the Euclidean
    (Frobenius) norm. The gradient is finite everywhere."""
    norm = safe_norm(x, axis=None)
    # Inside of the ball, the factor is exactly 1.
    over = norm > radius
    return xp.where(over, radius / xp.where(over, norm, 1), 1).astype(x.dtype) * x


def clip(x: ArrayLike, low: Any, high: Any) -> Array:
    """Clip `x` to the range from `low` to `high`, either of which may be infinite.

    On CPU, `clip` is faster than `jnp.clip` for a batch, because it uses comparisons.
    `jnp.clip` must also propagate NaN limits. In a simulation step of the pendulum,
    this takes as long as all other operations together. `clip` ignores NaN limits. A
    NaN in `x` stays NaN. If `x` is within the limits or equal to one of them, the
    gradient with respect to `x` is 1. Otherwise this gradient is 0, and the gradient
    with respect to the limit that clips `x` is 1.

    **Arguments:**

    - `x`: an array of any shape.
    - `low`, `high`: the limits, numbers or arrays that broadcast against `x`.

    **Returns:** the clipped array. Its dtype follows from the three arguments by the
    type promotion of JAX.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.math.clip(jnp.array([-3.0, 0.5, 3.0]), -2.0, 2.0)
        ```

        ```text
        Array([-2. ,  0.5,  2. ], dtype=float32)
        ```
    """
    x = xp.where(x > high, high, x)
    return xp.where(x < low, low, x)


def size(matrix: Array) -> Array:
    """The Frobenius norm."""
    unit = _unit(matrix)
    return _norm(matrix * unit) / unit


def largest(matrix: Array) -> Array:
    """The absolute value of the largest entry."""
    if _is_large(matrix):
        return abs(matrix).max()
    # `abs` is also taken first, because XLA leaves out the reduction of a single entry.
    join = lambda a, b: lax.max(xp.abs(a), xp.abs(b))
    return _reduced(join, xp.abs(matrix), matrix.ndim)


def largest_of_each(*matrices: Array) -> tuple[Array, ...]:
    """The absolute values of the largest entries of matrices of one shape."""
    if on_host() or not _is_large(matrices[0]):
        return tuple(map(largest, matrices))
    # One loop over all matrices, which stores nothing.
    join = lambda a, b: tuple(map(lax.max, a, b))
    zero = xp.zeros((), matrices[0].dtype)
    return lax.reduce(
        tuple(map(xp.abs, matrices)), (zero,) * len(matrices), join, (0, 1)
    )


def relative_size(error: Array, *terms: Array) -> Array:
    """The norm of the residual of an equation, divided by that of its terms."""
    return relative_and_total_size(error, xp.stack(terms))[0]


def relative_and_total_size(error: Array, terms: Array) -> tuple[Array, Array]:
    """The norm of an equation's residual (or of a stack of residuals), divided by the
    sum of the norms of its stacked terms; and this sum."""
    unit = _unit(terms)
    total = xp.sum(_norm(terms * unit))
    # `lax.max` propagates NaN, as a comparison would not.
    divisor = lax.max(total, xp.finfo(total.dtype).tiny)
    return _norm(error * unit) / divisor, total / unit


def one_if_zero(x: Array) -> Array:
    """`x`, with 1 in place of each zero."""
    return x + (x == 0)


def _unit(matrix):
    """A factor for matrices whose squared entries may overflow or underflow. It makes
    the largest entry 4 and not 1, because the factor itself may underflow."""
    return 4 / lax.max(largest(matrix), 2 * xp.finfo(matrix.dtype).tiny)


def _norm(matrix):
    squares = matrix * matrix
    if _is_large(matrix):
        return xp.sqrt(xp.sum(squares, axis=(-2, -1)))
    return xp.sqrt(_reduced(lambda a, b: xp.abs(a) + xp.abs(b), squares, 2))


def _is_large(matrix):
    return on_host() or matrix.shape[-1] > _SMALL


def _reduced(join, array, axes):
    """A reduction of few entries over the last `axes` axes.

    XLA on CPU hands a plain sum or maximum to a library with a pool of threads. That
    takes twice as long to compile, and also to run for a batch of small matrices. XLA
    does not recognise these operations, which are valid for numbers that are not
    negative.
    """
    last = range(array.ndim)[-axes:]
    return lax.reduce(array, xp.zeros((), array.dtype), join, tuple(last))


def power_of_two(x: Array) -> Array:
    """A power of two near each number. It is exact, unlike `jnp.exp2`."""
    # Rounded to a mantissa without digits.
    return lax.reduce_precision(x, xp.finfo(x.dtype).nexp, 0)


def relative_drift(
    drift: Array, jacobian: Array, x: Array, u: Array, *, is_map: bool
) -> Array:
    """The scaled residual of an equilibrium: the largest entry of
    `|drift_i| / (|drift_i| + sum_j |jacobian_ij| unit_j)`.

    The drift of a map is `F(x) - x`; the rounding of `x_i` is subtracted from its size.
    Leading axes are times, and the unit is that of the largest value over time.
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
    """The absolute value of each entry. An entry that is zero up to rounding gets that
    of the largest entry, at most 1; or 1 if all are zero."""
    size = xp.abs(z)
    largest = xp.max(size, initial=0)
    # A state that rests at zero needs a unit for its drift, too.
    floor = xp.where(largest > 0, xp.minimum(largest, 1), 1)
    return xp.where(size > 100 * xp.finfo(z.dtype).eps * floor, size, floor)
