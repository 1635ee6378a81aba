"""What the Riccati and Lyapunov solvers accept."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._check import as_matrix, is_concrete


class RiccatiData(NamedTuple):
    """The data of an algebraic Riccati equation."""

    A: Array
    B: Array
    Q: Array
    R: Array
    S: Array
    E: Array | None


def square_matrix(value: Any, name: str, where: str) -> Array:
    """`value` as a square matrix of finite entries, or an error."""
    matrix = as_matrix(value, name, where)
    if matrix.shape[0] != matrix.shape[1] or matrix.shape[0] == 0:
        raise ValueError(f"{where}: {name} must be square, got shape {matrix.shape}.")
    return matrix


def hermitian_matrix(value: Any, name: str, where: str) -> Array:
    """`value` as a matrix that is its own conjugate transpose, or an error.

    An asymmetry of the size of rounding is averaged away. While it is being traced, a
    larger one makes it NaN.
    """
    matrix = square_matrix(value, name, where)
    transposed = matrix.conj().T
    slack = 100 * jnp.finfo(matrix.dtype).eps * jnp.max(jnp.abs(matrix))
    wrong = jnp.max(jnp.abs(matrix - transposed)) > slack
    if is_concrete(wrong) and wrong:
        kind = "Hermitian" if jnp.iscomplexobj(matrix) else "symmetric"
        raise ValueError(f"{where}: {name} must be {kind}, got {matrix}.")
    average = (matrix + transposed) / 2
    # Of data that cannot be looked at yet, the result will say that they are ill-posed.
    return average if is_concrete(wrong) else jnp.where(wrong, jnp.nan, average)


def riccati_arguments(
    where: str,
    A: Any,
    B: Any,
    Q: Any,
    R: Any,
    S: Any,
    E: Any,
    *,
    definite: bool,
    names: tuple[str, ...] = ("A", "B", "Q", "R", "S", "E"),
    dual: bool = False,
) -> RiccatiData:
    """The arguments as matrices of one precision that fit each other.

    `R` must be positive `definite`, or else semidefinite. `names` are those that the
    caller's arguments have. With `dual`, `A`, `B` are the transposes of what the caller
    gave, and errors speak of what was given.
    """
    n_A, n_B, n_Q, n_R, n_S, n_E = names
    A, B = square_matrix(A, n_A, where), as_matrix(B, n_B, where)
    Q, R = hermitian_matrix(Q, n_Q, where), hermitian_matrix(R, n_R, where)
    S = None if S is None else as_matrix(S, n_S, where)
    E = None if E is None else as_matrix(E, n_E, where)
    n, m = A.shape[0], B.shape[1]
    if B.shape != (n, m) or m == 0:
        side, shape = ("columns", B.shape[::-1]) if dual else ("rows", B.shape)
        raise ValueError(
            f"{where}: {n_B} must have as many {side} as {n_A} ({n}), got shape "
            f"{shape}."
        )
    shapes = {n_Q: (Q, (n, n)), n_R: (R, (m, m)), n_S: (S, (n, m)), n_E: (E, (n, n))}
    for name, (matrix, shape) in shapes.items():
        if matrix is not None and matrix.shape != shape:
            raise ValueError(
                f"{where}: {name} must have shape {shape} to fit {n_A} and {n_B}, got "
                f"{matrix.shape}."
            )
    check_definite(R, n_R, where, definite)
    given = [A, B, Q, R, S, E]
    dtype = jnp.result_type(*(M for M in given if M is not None))
    S = jnp.zeros((n, m), dtype) if S is None else S
    given = RiccatiData(A, B, Q, R, S, E)
    return jax.tree.map(lambda M: M.astype(dtype), given)


def check_definite(R: Array, name: str, where: str, definite: bool) -> None:
    """Raise unless `R`, as far as it can be seen, is positive definite or, if not
    `definite`, semidefinite."""
    if not is_concrete(R):
        return
    array = np.asarray(R)
    least, *_ = eigenvalues = np.linalg.eigvalsh(array)
    rounding = np.finfo(array.dtype).eps * np.max(np.abs(eigenvalues))
    slack = -rounding if definite else 100 * len(array) * rounding
    if least < -slack or definite and least <= 0:
        kind = "definite" if definite else "semidefinite"
        raise ValueError(
            f"{where}: {name} must be positive {kind}, got {array}, whose least "
            f"eigenvalue is {least:.3g}."
        )


def is_complex(*matrices: Array | None) -> bool:
    """Whether any of the matrices is."""
    return any(M is not None and jnp.iscomplexobj(M) for M in matrices)


def real_form(M: Array) -> Array:
    """`[[Re M, -Im M], [Im M, Re M]]`, which adds and multiplies as `M` does."""
    return jnp.block([[M.real, -M.imag], [M.imag, M.real]])


def complex_form(M: Array) -> Array:
    """The matrix whose real form is `M`."""
    n, m = M.shape[0] // 2, M.shape[1] // 2
    upper, lower = M[:n], M[n:]
    return ((upper[:, :m] + lower[:, m:]) + 1j * (lower[:, :m] - upper[:, m:])) / 2
