"""Angles: wrapping, and a sine and a cosine that XLA vectorises on CPU.

In float32 on CPU, XLA calls a scalar routine for every sine, which takes longer than
the rest of a simulation step. The functions here are a Cody-Waite range reduction and
an odd polynomial in plain `jax.numpy`, so that a batch runs in vector registers. In
other precisions, and for complex or integer input, they are `jnp.sin` and `jnp.cos`.

Cody and Waite, "Software Manual for the Elementary Functions", 1980.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike


# pi in four parts. Each has so few bits that its product with a whole number up to
# about 12,000 is exact in float32.
_PI = (3.140625, 0.0009670257568359375, 6.2771141529083251953e-07, 1.21542e-10)
# Minimax polynomial of sin(r) on |r| <= pi/2, odd powers from 3. The largest error is
# 6e-9, before rounding.
_SIN = (
    -0.166666597127914428710938,
    0.00833307858556509017944336,
    -0.0001981069071916863322258,
    2.6083159809786593541503e-06,
)


def wrap(angle: ArrayLike) -> Array:
    r"""Wrap an angle to the range from -pi to pi.

    $$\operatorname{wrap}(\alpha) = \alpha - 2 \pi
    \operatorname{round}\left(\frac{\alpha}{2 \pi}\right)$$

    This is much faster than `%`. The gradient of `wrap` is 1 everywhere, even at odd
    multiples of pi, where the wrapped angle jumps.

    **Arguments:**

    - `angle`: $\alpha$ [rad], any shape.

    **Returns:** the wrapped angle, in [-pi, pi], of the same shape.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.math.wrap(jnp.array(7.0))
        ```

        ```text
        Array(0.717, dtype=float32, weak_type=True)
        ```
    """
    angle = jnp.asarray(angle)
    return angle - (2 * np.pi) * jnp.round(angle * (1 / (2 * np.pi)))


def _sine(x: Array, halves: Array, odd: Array) -> Array:
    """`sin(x - halves pi / 2)` to float32 accuracy, negated where `odd`."""
    # Part by part, so that no digit of x is lost before the small parts are subtracted.
    r = x
    for part in _PI:
        r = r - halves * np.float32(part / 2)
    s = r * r
    p = np.float32(_SIN[3])
    for c in (_SIN[2], _SIN[1], _SIN[0]):
        p = p * s + np.float32(c)
    # The leading term comes last, because it is exact and the rest is small.
    p = r + r * (s * p)
    return jnp.where(odd != 0, -p, p)


@jax.custom_jvp
def _sin32(x: Array) -> Array:
    # The nearest multiple of pi: sin(x) = +/- sin(x - quotient pi).
    quotient = jnp.round(x * np.float32(1 / np.pi))
    return _sine(x, 2 * quotient, quotient.astype(jnp.int32) & 1)


@jax.custom_jvp
def _cos32(x: Array) -> Array:
    # The nearest odd multiple of pi / 2: cos(x) = -/+ sin(x - halves pi / 2).
    quotient = jnp.floor(x * np.float32(1 / np.pi))
    return _sine(x, 2 * quotient + 1, 1 - (quotient.astype(jnp.int32) & 1))


# By hand, because the derivative of the rounding in the range reduction is zero.
_sin32.defjvp(lambda p, t: (_sin32(*p), _cos32(*p) * t[0]))
_cos32.defjvp(lambda p, t: (_cos32(*p), -_sin32(*p) * t[0]))


def sin(x: ArrayLike) -> Array:
    """The sine, faster than `jnp.sin` on CPU in float32.

    The function is differentiable to any order. If `x` is not in float32, `sin` calls
    `jnp.sin`.

    **Arguments:**

    - `x`: angles [rad], any shape. In float32, the absolute error of the sine is at
        most 1.5e-7 for `|x|` up to 1e4. For larger `|x|`, the error grows with `|x|`.

    **Returns:** the sine, of the shape and dtype of `x`.

    Source: Cody and Waite, 1980.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.math.sin(jnp.linspace(0.0, 3.0, 4))
        ```

        ```text
        Array([0.   , 0.841, 0.909, 0.141], dtype=float32)
        ```
    """
    x = jnp.asarray(x)
    return _sin32(x) if x.dtype == jnp.float32 else jnp.sin(x)


def cos(x: ArrayLike) -> Array:
    """The cosine, faster than `jnp.cos` on CPU in float32.

    The function is differentiable to any order. If `x` is not in float32, `cos` calls
    `jnp.cos`.

    **Arguments:**

    - `x`: angles [rad], any shape. The accuracy is that of [`delucax.math.sin`][].

    **Returns:** the cosine, of the shape and dtype of `x`.

    Source: Cody and Waite, 1980.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.math.cos(jnp.linspace(0.0, 3.0, 4))
        ```

        ```text
        Array([ 1.   ,  0.54 , -0.416, -0.99 ], dtype=float32)
        ```
    """
    x = jnp.asarray(x)
    return _cos32(x) if x.dtype == jnp.float32 else jnp.cos(x)
