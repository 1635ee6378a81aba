"""The continuous-time linear system."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .._check import as_matrix, as_vector
from .._module import indexed_names, parameter
from .._typing import Matrix
from ..math import matvec
from ._base import AbstractSystem


class LinearSystem(AbstractSystem):
    """An affine system about its operating point,

    `dx/dt = dx_ref + A (x - x_ref) + B (u - u_ref) + E w`, `y = C x`.

    **Arguments:**

    - `A`: shape `(n, n)`.
    - `B`: shape `(n, m)`.
    - `C`: shape `(p, n)`; the identity by default.
    - `E`: shape `(n, k)`: how `w` enters the vector field. By default `w` has the size
        of the state and is added to the next state by the discrete dynamics.
    - `x_ref`, `u_ref`: the operating point, shapes `(n,)` and `(m,)`; zero by default.
    - `dx_ref`: the vector field there, shape `(n,)`; zero by default.
    - `state_names`, `control_names`: `("x0", ...)` and `("u0", ...)` by default.

    **Raises:** `ValueError` if shapes do not fit or entries are not finite.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[0.0, 1.0], [0.0, 0.0]])
        B = jnp.array([[0.0], [1.0]])
        dynamics = dlx.c2d(dlx.systems.LinearSystem(A, B), dt=0.1)
        ```
    """

    A: Matrix = parameter()
    B: Matrix = parameter()
    C: Matrix | None = parameter()
    E: Matrix | None = parameter()
    x_ref: Array = parameter()
    u_ref: Array = parameter()
    dx_ref: Array = parameter()
    state_names: tuple[str, ...] = eqx.field(static=True)
    control_names: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        A,
        B,
        C=None,
        E=None,
        *,
        x_ref=None,
        u_ref=None,
        dx_ref=None,
        state_names=None,
        control_names=None,
    ):
        where = "LinearSystem"
        self.A, self.B, self.C, self.E = check_matrices(A, B, C, E, where)
        n, m = self.B.shape
        zeros = jnp.zeros(n, self.A.dtype)
        self.x_ref = zeros if x_ref is None else x_ref
        self.u_ref = jnp.zeros(m, self.A.dtype) if u_ref is None else u_ref
        self.dx_ref = zeros if dx_ref is None else dx_ref
        self.state_names = checked_names(state_names, "x", n, "state_names", where)
        self.control_names = checked_names(
            control_names, "u", m, "control_names", where
        )

    def __check_init__(self):
        where = "LinearSystem"
        n, m = check_matrices(self.A, self.B, self.C, self.E, where)[1].shape
        as_vector(self.x_ref, n, "x_ref", where)
        as_vector(self.u_ref, m, "u_ref", where)
        as_vector(self.dx_ref, n, "dx_ref", where)
        checked_names(self.state_names, "x", n, "state_names", where)
        checked_names(self.control_names, "u", m, "control_names", where)

    @property
    def disturbance_names(self) -> tuple[str, ...]:
        """Names of the disturbances, one a column of `E`."""
        return () if self.E is None else indexed_names("w", self.E.shape[1])

    def vector_field(self, t, x, u, w):
        dx = self.dx_ref + matvec(self.A, x - self.x_ref)
        dx = dx + matvec(self.B, u - self.u_ref)
        if self.E is not None and w is not None:
            dx = dx + matvec(self.E, w)
        return dx

    def observe(self, t, x):
        return x if self.C is None else matvec(self.C, x)

    def equilibrium(self):
        return self.x_ref, self.u_ref


def checked_names(names, letter: str, size: int, argument: str, where: str):
    """`names` as a tuple of `size`, indexed if there are none, or an error."""
    if names is None:
        return indexed_names(letter, size)
    if isinstance(names, str) or len(names) != size:
        raise ValueError(f"{where}: {argument} must have {size} names, got {names!r}.")
    return tuple(names)


def check_matrices(A, B, C, E, where: str):
    """`A`, `B`, `C`, `E` as matrices of fitting shapes, or an error that names one."""
    A = as_matrix(A, "A", where)
    n = A.shape[0]
    if A.shape != (n, n) or n == 0:
        raise ValueError(f"{where}: A must be square, got shape {A.shape}.")
    B = _as_part(B, "B", n, "rows", where)
    C = None if C is None else _as_part(C, "C", n, "columns", where)
    E = None if E is None else _as_part(E, "E", n, "rows", where)
    return A, B, C, E


def _as_part(value, name: str, n: int, side: str, where: str) -> Matrix:
    """`value` as a matrix with as many rows or columns as there are states."""
    matrix = as_matrix(value, name, where)
    if matrix.shape[side == "columns"] != n:
        raise ValueError(
            f"{where}: {name} must have as many {side} as A ({n}), got shape "
            f"{matrix.shape}."
        )
    return matrix
