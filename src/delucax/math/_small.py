"""Products too small to be worth a call into a linear-algebra library."""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike


_UNROLL: ContextVar[int] = ContextVar("delucax_unroll", default=32)
"""Products of up to as many terms are written out."""


@contextmanager
def products_whole() -> Iterator[None]:
    """Within, no product is written out: in a program that differentiates it twice, it
    would be hundreds of operations, and is computed for a whole trajectory at once."""
    token = _UNROLL.set(0)
    try:
        yield
    finally:
        _UNROLL.reset(token)


def matvec(matrix: ArrayLike, vector: ArrayLike) -> Array:
    """`matrix @ vector`, written out entry by entry where the matrix is small.

    For a feedback gain of a few entries this is about 1.5 times faster in a simulation
    loop, and under `jax.vmap` it fuses with what surrounds it.

    **Arguments:**

    - `matrix`: shape `(m, n)`.
    - `vector`: shape `(n,)`.

    **Returns:** the product, shape `(m,)`.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.math.matvec(jnp.eye(2), jnp.array([1.0, 2.0]))
        ```
    """
    matrix, vector = jnp.asarray(matrix), jnp.asarray(vector)
    if matrix.ndim != 2 or vector.shape != matrix.shape[1:]:
        raise ValueError(
            "matvec: matrix and vector must have shapes (m, n) and (n,), got "
            f"{matrix.shape} and {vector.shape}."
        )
    # Entry by entry XLA fuses the product; as `dot` it calls a library for each member.
    m, n = matrix.shape
    if m * n == 0 or m * n > _UNROLL.get():
        return matrix @ vector
    rows = []
    for i in range(m):
        row = matrix[i, 0] * vector[0]
        for j in range(1, n):
            row = row + matrix[i, j] * vector[j]
        rows.append(row)
    return jnp.stack(rows)


def quadratic_form(matrix: ArrayLike, vector: ArrayLike) -> Array:
    """The scalar `vector' matrix vector`, small matrices written out.

    **Arguments:**

    - `matrix`: shape `(n, n)`.
    - `vector`: shape `(n,)`.

    **Returns:** a scalar.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.math.quadratic_form(jnp.eye(2), jnp.array([1.0, 2.0]))
        ```
    """
    vector = jnp.asarray(vector)
    return dot(vector, matvec(matrix, vector))


def dot(a: Array, b: Array) -> Array:
    """The sum of the products of two vectors, a few written out."""
    (n,) = a.shape
    if n == 0 or n > _UNROLL.get():
        return a @ b
    total = a[0] * b[0]
    for i in range(1, n):
        total = total + a[i] * b[i]
    return total
