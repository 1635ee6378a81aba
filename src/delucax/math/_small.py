"""Products that are too small for a call of a linear-algebra library."""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike


_UNROLL: ContextVar[int] = ContextVar("delucax_unroll", default=32)
"""Products of up to this number of terms are written out."""


@contextmanager
def products_whole() -> Iterator[None]:
    """A context in which no product is written out. Use it for a program that
    differentiates products twice, for a whole trajectory at once: each product would
    become hundreds of operations."""
    token = _UNROLL.set(0)
    try:
        yield
    finally:
        _UNROLL.reset(token)


def matvec(matrix: ArrayLike, vector: ArrayLike) -> Array:
    """The product `matrix @ vector`, computed entry by entry if the matrix is small.

    For a feedback gain with a few entries, `matvec` is about 1.5 times faster than `@`
    in a simulation loop. Under `jax.vmap`, XLA fuses the product with the operations
    around it.

    **Arguments:**

    - `matrix`: shape `(m, n)`.
    - `vector`: shape `(n,)`.

    **Returns:** the product, shape `(m,)`.

    **Raises:** `ValueError` if the shapes of the matrix and the vector do not fit.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.math.matvec(jnp.eye(2), jnp.array([1.0, 2.0]))
        ```

        ```text
        Array([1., 2.], dtype=float32)
        ```
    """
    matrix, vector = jnp.asarray(matrix), jnp.asarray(vector)
    if matrix.ndim != 2 or vector.shape != matrix.shape[1:]:
        raise ValueError(
            "matvec: matrix and vector must have shapes (m, n) and (n,), got "
            f"{matrix.shape} and {vector.shape}."
        )
    # XLA fuses a product that is written out. For `@` it calls a library for each
    # member of a batch.
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
    r"""The quadratic form $v^\top M v$, computed entry by entry if the matrix is small.

    **Arguments:**

    - `matrix`: $M$, shape `(n, n)`.
    - `vector`: $v$, shape `(n,)`.

    **Returns:** a scalar.

    **Raises:** `ValueError` if the shapes of the matrix and the vector do not fit.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.math.quadratic_form(jnp.eye(2), jnp.array([1.0, 2.0]))
        ```

        ```text
        Array(5., dtype=float32)
        ```
    """
    matrix, vector = jnp.asarray(matrix), jnp.asarray(vector)
    if vector.ndim != 1 or matrix.shape != 2 * vector.shape:
        raise ValueError(
            "quadratic_form: matrix and vector must have shapes (n, n) and (n,), got "
            f"{matrix.shape} and {vector.shape}."
        )
    return dot(vector, matvec(matrix, vector))


def dot(a: Array, b: Array) -> Array:
    """The scalar product of two vectors, written out if they are short."""
    (n,) = a.shape
    if n == 0 or n > _UNROLL.get():
        return a @ b
    total = a[0] * b[0]
    for i in range(1, n):
        total = total + a[i] * b[i]
    return total
