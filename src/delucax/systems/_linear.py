"""The continuous-time linear system."""

from dataclasses import KW_ONLY

import equinox as eqx
import jax.numpy as jnp

from .._check import as_vector, check_matrices, checked_names
from .._module import indexed_names, parameter
from .._typing import Control, Disturbance, Matrix, Observation, State, Time, Vector
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
    C: Matrix | None = parameter(None)
    E: Matrix | None = parameter(None)
    _: KW_ONLY
    x_ref: Vector = parameter(None)
    u_ref: Vector = parameter(None)
    dx_ref: Vector = parameter(None)
    # Converters let None through to `__post_init__`.
    state_names: tuple[str, ...] = eqx.field(
        static=True, default=None, converter=lambda names: names
    )
    control_names: tuple[str, ...] = eqx.field(
        static=True, default=None, converter=lambda names: names
    )

    def __post_init__(self):
        where = "LinearSystem"
        self.A, self.B, self.C, self.E = check_matrices(
            self.A, self.B, self.C, self.E, where
        )
        n, m = self.B.shape
        for name, size in (("x_ref", n), ("u_ref", m), ("dx_ref", n)):
            if getattr(self, name) is None:
                setattr(self, name, jnp.zeros(size, self.A.dtype))
        self.state_names = checked_names(self.state_names, "x", n, "state_names", where)
        self.control_names = checked_names(
            self.control_names, "u", m, "control_names", where
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

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        dx = self.dx_ref + matvec(self.A, x - self.x_ref)
        dx = dx + matvec(self.B, u - self.u_ref)
        if self.E is not None and w is not None:
            dx = dx + matvec(self.E, w)
        return dx

    def observe(self, t: Time, x: State) -> Observation:
        return x if self.C is None else matvec(self.C, x)

    def equilibrium(self) -> tuple[State, Control]:
        return self.x_ref, self.u_ref
