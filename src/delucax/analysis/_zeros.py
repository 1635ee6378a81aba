"""The zeros of a linear model."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex

from .._check import is_concrete
from ._state_space import LinearModel, state_space


def zeros(model: LinearModel, *, inputs: str = "controls") -> Complex[Array, " zeros"]:
    """The invariant zeros: where `[[A - z I, B], [C, 0]]` loses rank.

    Each step takes away what the outputs show at once, and then, of the transposed
    system, what the inputs reach at once, until the zeros are what is left. How many
    there are depends on the values, which therefore cannot be traced.

    **Arguments:**

    - `model`: a [`delucax.systems.LinearSystem`][], or time-invariant
        [`delucax.LinearDynamics`][].
    - `inputs`: `"controls"` (default), or `"disturbances"`: `E` in the place of `B`.

    **Returns:** complex, as many as there are; those that are also poles included.

    **Raises:** `ValueError` if `model` is not linear or is time-varying, if `inputs` is
    unknown, or under `jax.jit`, `jax.vmap` and `jax.grad`.

    Source: Emami-Naeini and Van Dooren, 1982.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[0.0, 1.0], [-2.0, -3.0]])
        B = jnp.array([[0.0], [1.0]])
        system = dlx.systems.LinearSystem(A, B, C=jnp.array([[5.0, 1.0]]))
        dlx.analysis.zeros(system)  # -5
        ```
    """
    system = state_space(model, inputs, "zeros")
    if not all(is_concrete(M) for M in (system.A, system.B, system.C)):
        raise ValueError(
            "zeros: model must be concrete, got one that is being traced (by jax.jit, "
            "jax.vmap or jax.grad); how many zeros there are depends on its values."
        )
    A, B, C, D = (np.asarray(M) for M in (system.A, system.B, system.C, system.D))
    total = np.linalg.norm(np.block([[A, B], [C, D]]))
    tolerance = 10 * sum(A.shape) * np.finfo(A.dtype).eps * total
    A, B, C, D = _hidden_part(A, B, C, D, tolerance)
    # Of the transposed system: D is then of full row rank, so in the end it is square.
    A, C, B, D = (M.T for M in _hidden_part(A.T, C.T, B.T, D.T, tolerance))
    if not len(A):
        return jnp.zeros(0, complex)
    # With no input or output left the modes that are left are zeros.
    left = A - B @ np.linalg.solve(D, C) if D.size else A
    return jnp.linalg.eigvals(jnp.asarray(left))


def _hidden_part(A, B, C, D, tolerance):
    """What the outputs do not show at once, with the inputs that keep it so."""
    while True:
        # Outputs that the inputs do not touch: the rest of the rows of D is zero.
        left, values, _ = np.linalg.svd(D) if D.size else (np.eye(len(C)), [], None)
        rank = int(np.sum(np.asarray(values) > tolerance))
        C, D = left.T @ C, left.T @ D
        free = C[rank:]
        # States that those show at once.
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
