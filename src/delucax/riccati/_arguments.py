"""Check and convert the arguments of matrix equations."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from .._check import (
    as_finite,
    as_matrix,
    check_count,
    check_definite,
    is_concrete,
    symmetric_matrix,
)
from .._jax import xp
from .._module import as_float_array
from .._typing import Array


class RiccatiData(NamedTuple):
    """The data of an algebraic Riccati equation."""

    A: Array
    B: Array
    Q: Array
    R: Array
    S: Array
    E: Array | None


def square_matrix(value: Any, name: str, where: str) -> Array:
    """Check that `value` is a square matrix of finite entries, and convert it."""
    matrix = as_matrix(value, name, where)
    if matrix.shape[0] != matrix.shape[1] or matrix.shape[0] == 0:
        raise ValueError(f"{where}: {name} must be square, got shape {matrix.shape}.")
    return matrix


def hermitian_matrix(value: Any, name: str, where: str) -> Array:
    """Check that `value` equals its conjugate transpose, and convert it.

    An asymmetry of the size of rounding is averaged away. A larger one is an error, or
    makes a traced matrix NaN.
    """
    matrix = square_matrix(value, name, where)
    transposed = matrix.conj().T
    # Rounding of a product such as C'WC may leave an asymmetry of this size.
    slack = 100 * xp.finfo(matrix.dtype).eps * xp.max(xp.abs(matrix))
    wrong = xp.max(xp.abs(matrix - transposed)) > slack
    if is_concrete(wrong) and wrong:
        kind = "Hermitian" if xp.iscomplexobj(matrix) else "symmetric"
        raise ValueError(f"{where}: {name} must be {kind}, got {matrix}.")
    average = (matrix + transposed) / 2
    # Traced data cannot be checked yet: NaN makes the result `ill_posed`.
    return average if is_concrete(wrong) else xp.where(wrong, xp.nan, average)


def riccati_arguments(
    where: str, A, B, Q, R, S, E, *, definite: bool, names="ABQRSE", dual=False
) -> RiccatiData:
    """Check that the arguments fit each other, and convert them to one precision.

    `R` must be positive definite if `definite`, else semidefinite. `names` are the
    names of the caller's arguments. With `dual`, `A` and `B` are the transposes of the
    caller's arguments, and error messages name the shapes that the caller gave.
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
        if matrix is not None:
            _check_shape(matrix.shape, shape, name, where, f"{n_A} and {n_B}")
    check_definite(R, n_R, where, definite)
    dtype = xp.result_type(*jax.tree.leaves((A, B, Q, R, S, E)))
    S = xp.zeros((n, m), dtype) if S is None else S
    given = RiccatiData(A, B, Q, R, S, E)
    return jax.tree.map(lambda M: M.astype(dtype), given)


def _check_shape(shape: tuple, wanted: tuple, name: str, where: str, to_fit: str):
    if shape != wanted:
        raise ValueError(
            f"{where}: {name} must have shape {wanted} to fit {to_fit}, got {shape}."
        )


def where_solved(ok: Array, zeroed: Any, units: Any) -> tuple[Any, Any]:
    """Replace matrices of failed problems: `zeroed` by zeros, `units` by identities.

    `ok` is one flag, or one for each step. Without this, the derivative of a failed
    problem would be NaN, even if it were multiplied by zero afterwards.
    """
    ok = ok[:, None, None] if ok.ndim else ok
    eye = lambda M: xp.eye(M.shape[-1], dtype=M.dtype)
    return (
        jax.tree.map(lambda M: xp.where(ok, M, 0), zeroed),
        jax.tree.map(lambda M: xp.where(ok, M, eye(M)), units),
    )


def is_complex(*matrices: Array | None) -> bool:
    """Whether any of the matrices is complex."""
    return any(map(xp.iscomplexobj, jax.tree.leaves(matrices)))


def real_form(M: Array) -> Array:
    """The real matrix `[[Re M, -Im M], [Im M, Re M]]`, which adds and multiplies as
    `M` does."""
    return xp.block([[M.real, -M.imag], [M.imag, M.real]])


def complex_form(M: Array) -> Array:
    """The matrix whose real form is `M`."""
    n, m = M.shape[0] // 2, M.shape[1] // 2
    upper, lower = M[:n], M[n:]
    # The two copies of each part differ by rounding, so take their average.
    return ((upper[:, :m] + lower[:, m:]) + 1j * (lower[:, :m] - upper[:, m:])) / 2


_AXES = dict(A="nn", B="nm", D="nk", Q="nn", R="mm", S="nm", d="n", q="n", r="m")
"""The axes of each argument. An axis has the name of its size."""


def stage_arguments(where: str, horizon: Any, **given: Any) -> dict[str, Array]:
    """Give each argument a leading time axis and one precision. `None` becomes zero.

    The first argument with an axis determines its size.
    """
    arrays, sizes, steps = {}, {}, {}
    for name, value in given.items():
        if value is None:
            continue
        axes = _AXES[name]
        ndim = len(axes)
        if name in "QR":
            value = as_float_array(value)
            is_stack = eqx.is_array(value) and value.ndim == 3
            value = symmetric_matrix(value, name, where, ndim=3 if is_stack else 2)
        shape = ", ".join(axes) + ("," if ndim == 1 else "")
        rule = f"have shape ({shape}), or this shape with a leading time axis"
        fits = lambda shape, ndim=ndim: len(shape) in (ndim, ndim + 1)
        arrays[name] = array = as_finite(value, name, where, rule, fits)
        _check_sizes(where, name, array.shape[array.ndim - ndim :], sizes)
        if array.ndim > ndim:
            steps[name] = array.shape[0]
    T, dtype = _length(where, horizon, steps), _real_dtype(where, arrays)
    # Constant arguments are repeated, so one scan serves both kinds.
    zero = xp.zeros((), dtype)
    shape = lambda name: (T, *(sizes[axis] for axis in _AXES[name]))
    return {
        name: xp.broadcast_to(arrays.get(name, zero).astype(dtype), shape(name))
        for name in given
    }


def constant_matrices(where: str, **given: Any) -> dict[str, Array]:
    """Check that the matrices fit each other, and convert them to one precision."""
    arrays, sizes = {}, {}
    for name, value in given.items():
        if value is not None:
            check = symmetric_matrix if name in "QR" else as_matrix
            arrays[name] = check(value, name, where)
            _check_sizes(where, name, arrays[name].shape, sizes)
    dtype = _real_dtype(where, arrays)
    return {name: array.astype(dtype) for name, array in arrays.items()}


def _real_dtype(where: str, given: dict[str, Array]):
    """The common real precision of the given arrays."""
    dtype = xp.result_type(*given.values())
    if not xp.issubdtype(dtype, xp.floating):
        raise ValueError(f"{where}: {', '.join(given)} must be real, got {dtype}.")
    return dtype


def _check_sizes(where, name, shape, sizes):
    for axis, size in zip(_AXES[name], shape, strict=True):
        sizes.setdefault(axis, size)
    wanted = tuple(sizes[axis] for axis in _AXES[name])
    _check_shape(shape, wanted, name, where, "the other arguments")
    if 0 in shape:
        raise ValueError(f"{where}: {name} must not be empty, got shape {shape}.")


def _length(where, horizon, steps):
    """The number of steps. All arguments with a time axis must have the same."""
    if horizon is not None:
        horizon = check_count(horizon, "horizon", where)
    if len(set(steps.values())) > 1 or 0 in steps.values():
        raise ValueError(
            f"{where}: all leading time axes must have the same length of at least 1, "
            f"got {steps}."
        )
    name, T = next(iter(steps.items()), (None, horizon))
    if T is None:
        raise ValueError(
            f"{where}: horizon must be given if no argument has a time axis."
        )
    if horizon not in (None, T):
        raise ValueError(
            f"{where}: horizon must be the length of the time axis of {name} ({T}), "
            f"got {horizon}."
        )
    return T


def final_weight(value: Any, A: Array, where: str) -> Array:
    """Check the final weight; zero by default."""
    shape = A.shape[-2:]
    if value is None:
        return xp.zeros(shape, A.dtype)
    final = symmetric_matrix(value, "final", where)
    _check_shape(final.shape, shape, "final", where, "A")
    return final.astype(A.dtype)


def increasing_times(times: Any, where: str) -> Array:
    """Check that `times` is an increasing vector of at least two numbers."""
    fits = lambda shape: len(shape) == 1 and shape[0] >= 2
    array = as_finite(times, "times", where, "be at least two numbers", fits)
    if is_concrete(array) and not np.all(np.diff(np.asarray(array)) > 0):
        raise ValueError(f"{where}: times must increase, got {array}.")
    return array
