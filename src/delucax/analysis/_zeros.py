"""The transmission zeros of linear models."""

from typing import Any

import numpy as np
from jaxtyping import Complex

from .._check import is_concrete
from .._jax import host_unless_traced, xp
from .._typing import Array
from ..math._linear_solve import eigenvalues
from ._state_space import LinearModel, state_space


_SWEEPS = 24
"""The largest number of balancing sweeps."""


@host_unless_traced
def zeros(model: LinearModel, *, inputs: str = "controls") -> Complex[Array, " zeros"]:
    r"""The invariant zeros of a linear model.

    A number $z$ is a zero if this matrix has a lower rank than for other numbers:

    $$\begin{bmatrix} A - z I & B \\ C & 0 \end{bmatrix}$$

    The algorithm first balances the matrices, so the units of the plant hardly matter.
    Then the algorithm removes the states that the outputs observe directly, first from
    the system and then from the transposed system. The poles of the remaining system
    are the zeros. The number of zeros depends on the values of the matrices, so the
    matrices cannot be traced.

    **Arguments:**

    - `model`: a [`delucax.systems.LinearSystem`][], or time-invariant
        [`delucax.LinearDynamics`][].
    - `inputs`: the inputs of the model, `"controls"` (default) with the matrix $B$, or
        `"disturbances"` with the matrix $E$.

    **Returns:** the zeros, complex, shape `(number of zeros,)`. A zero stays in the
    result even if it is also a pole.

    **Raises:** `ValueError` if `model` is not linear or is time-varying, if `inputs` is
    unknown, or if the model is traced by `jax.jit`, `jax.vmap` or `jax.grad`.

    Source: Emami-Naeini and Van Dooren, 1982.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[0.0, 1.0], [-2.0, -3.0]])
        B = jnp.array([[0.0], [1.0]])
        system = dlx.systems.LinearSystem(A, B, C=jnp.array([[5.0, 1.0]]))
        dlx.analysis.zeros(system)
        ```

        ```text
        Array([-5.+0.j], dtype=complex64)
        ```
    """
    system = state_space(model, inputs, "zeros")
    if not all(is_concrete(M) for M in (system.A, system.B, system.C)):
        raise ValueError(
            "zeros: model must be concrete, got one that is being traced (by jax.jit, "
            "jax.vmap or jax.grad). The number of zeros depends on its values."
        )
    # By NumPy, because the sizes of the reduced systems depend on ranks.
    A, B, C, D = _balanced(*(np.asarray(M) for M in system[:4]))
    total = np.linalg.norm(np.block([[A, B], [C, D]]))
    tolerance = 10 * sum(A.shape) * np.finfo(A.dtype).eps * total
    A, B, C, D = _hidden_part(A, B, C, D, tolerance)
    # D has full row rank now. The reduction of the transposed system makes it square.
    A, C, B, D = (M.T for M in _hidden_part(A.T, C.T, B.T, D.T, tolerance))
    if not len(A):
        return xp.zeros(0, complex)
    # The zeros are the modes under the input that keeps the outputs at zero.
    left: Any = A - B @ np.linalg.solve(D, C) if D.size else A
    return eigenvalues(left)


def _balanced(A, B, C, D):
    """The system in other units of its states, inputs and outputs. The largest entries
    of the row and of the column of each state have about the same size. `D` is zero.

    Source: Osborne, 1960.
    """
    n = len(A)
    table = np.block([[A, B], [C, D]])
    A, B, C, D = table[:n, :n], table[:n, n:], table[n:, :n], table[n:, n:]
    for _ in range(_SWEEPS):
        # Inputs and outputs are smaller than A, so that they decide the unit of a state
        # only if no other state does.
        half = np.max(np.abs(A)) / 2
        for M, axis in (B, 0), (C, 1):
            M *= _unit(half, np.max(np.abs(M), axis=axis, keepdims=True))
        before = table.copy()
        for i in range(n):
            lines = np.delete(table[i], i), np.delete(table[:, i], i)
            unit = _unit(*(np.max(np.abs(line)) for line in lines), root=2)
            table[i] /= unit
            table[:, i] *= unit
        if np.array_equal(table, before):
            break
    return A, B, C, D


def _unit(a, b, root=1):
    """A power of two near `(a / b)^(1 / root)`, or 1 if `a` or `b` is zero."""
    usable = (a > 0) & (b > 0)
    exponent = np.log2(np.where(usable, a, 1)) - np.log2(np.where(usable, b, 1))
    return np.ldexp(a.dtype.type(1), np.rint(exponent / root).astype(int))


def _hidden_part(A, B, C, D, tolerance):
    """The part of the states that some input can hide from the outputs.

    Source: Emami-Naeini and Van Dooren, 1982 (the reduction).
    """
    while True:
        # Compress the rows of D. The outputs of `free` do not depend on the inputs.
        left, values, _ = np.linalg.svd(D) if D.size else (np.eye(len(C)), [], None)
        rank = int(np.sum(np.asarray(values) > tolerance))
        C, D = left.T @ C, left.T @ D
        free = C[rank:]
        # These outputs observe some states directly, which are removed.
        _, values, right = (
            np.linalg.svd(free) if free.size else ([], [], np.eye(len(A)))
        )
        count = int(np.sum(np.asarray(values) > tolerance))
        if count == 0:
            return A, B, C[:rank], D[:rank]
        shown, hidden = right[:count].T, right[count:].T
        C = np.concatenate([C[:rank] @ hidden, shown.T @ A @ hidden])
        D = np.concatenate([D[:rank], shown.T @ B])
        A, B = hidden.T @ A @ hidden, hidden.T @ B
