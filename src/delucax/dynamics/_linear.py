"""Linear dynamics in discrete time."""

from dataclasses import KW_ONLY
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._check import as_matrix, check_real, is_concrete
from .._check_models import check_matrices, checked_names
from .._module import as_float_array, parameter
from .._results import Result, RESULTS
from .._typing import Control, Observation, Real, RealScalar, State, Time
from ..math import matvec
from ..math._steps import row_at, step_at
from ._base import AbstractDynamics


class LinearDynamics(AbstractDynamics):
    r"""Linear dynamics in discrete time, or dynamics that are linear in the deviation
    from an operating point.

    $$x_{k+1} = x_\mathrm{next} + A (x_k - x_\mathrm{ref}) + B (u_k - u_\mathrm{ref})
    + E w_k, \qquad y_k = C x_k$$

    The dynamics are time-varying if `A` has a leading time axis of length `T`. `B`, `E`
    and the operating point may then have a leading time axis too. At time `t`, the
    dynamics use the entries with the index `round(t / dt)`. At times before the first
    entry or after the last entry, the next state is NaN, and a rollout reports this.

    **Arguments:**

    - `A`: shape `(n, n)`, or `(T, n, n)`.
    - `B`: shape `(n, m)`, or `(T, n, m)`.
    - `C`: shape `(p, n)`, always time-invariant; the identity by default.
    - `E`: shape `(n, k)`, or `(T, n, k)`; the identity by default.
    - `dt`: the time step, in units of time; 1 by default.
    - `x_ref`, `u_ref`: the operating point, shapes `(n,)` and `(m,)`, or `(T, n)` and
        `(T, m)`; zero by default.
    - `x_next`: the state one step after the operating point, shape `(n,)` or `(T, n)`;
        by default `x_ref`, so that the operating point is an equilibrium.
    - `state_names`, `control_names`: tuples of `n` and `m` strings; `("x0", ...)` and
        `("u0", ...)` by default.

    **Raises:** `ValueError` if shapes do not fit, entries are not finite, or `dt` is
    not positive.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[1.0, 1.0], [0.0, 1.0]])
        B = jnp.array([[0.0], [1.0]])
        dynamics = dlx.LinearDynamics(A, B)
        dynamics(0.0, jnp.ones(2), jnp.zeros(1))
        ```

        ```text
        Array([2., 1.], dtype=float32)
        ```
    """

    A: Float[Array, "*T n n"] = parameter()
    B: Float[Array, "*T n m"] = parameter()
    C: Float[Array, "p n"] | None = parameter(None)
    E: Float[Array, "*T n k"] | None = parameter(None)
    dt: Real = parameter(1.0)
    x_ref: Float[Array, "*T n"] = parameter(None)
    u_ref: Float[Array, "*T m"] = parameter(None)
    x_next: Float[Array, "*T n"] = parameter(None)
    _: KW_ONLY
    state_names: tuple[str, ...] = eqx.field(static=True, default=None)
    control_names: tuple[str, ...] = eqx.field(static=True, default=None)

    def __post_init__(self):
        where = "LinearDynamics"
        A, B, *_ = parts = _checked_matrices(self.A, self.B, self.C, self.E)
        self.A, self.B, self.C, self.E = parts
        n, m = B.shape[-2:]
        # Constant arguments are repeated along the time axis of A, so that one index
        # serves all.
        x_ref = np.zeros(n, A.dtype) if self.x_ref is None else self.x_ref
        u_ref = np.zeros(m, A.dtype) if self.u_ref is None else self.u_ref
        x_next = x_ref if self.x_next is None else self.x_next
        points = (as_float_array(point) for point in (x_ref, u_ref, x_next))
        self.x_ref, self.u_ref, self.x_next = (_over_time(p, 1, A) for p in points)
        self.state_names = checked_names(self.state_names, "x", n, "state_names", where)
        self.control_names = checked_names(
            self.control_names, "u", m, "control_names", where
        )

    def __check_init__(self):
        where = "LinearDynamics"
        _checked_matrices(self.A, self.B, self.C, self.E)
        n, m = self.B.shape[-2:]
        k = None if self.E is None else self.E.shape[-1]
        shapes = dict(B=(n, m), E=(n, k), x_ref=(n,), u_ref=(m,), x_next=(n,))
        for name, shape in shapes.items():
            array, shape = getattr(self, name), (*self.A.shape[:-2], *shape)
            if array is None:
                continue
            if jnp.shape(array) != shape:
                raise ValueError(
                    f"{where}: {name} must have shape {shape}, got {jnp.shape(array)}."
                )
            check_real(array, name, where)

    @property
    def is_time_varying(self) -> bool:
        """Whether the matrices have a leading time axis."""
        return self.A.ndim == 3

    @property
    def disturbance_size(self) -> int:
        """The number of columns of `E`; the size of the state by default."""
        return self.state_size if self.E is None else self.E.shape[-1]

    @property
    def noise(self) -> Literal["additive"] | None:
        """`None` if `E` is given, by which `w` enters the equations; otherwise
        `"additive"`."""
        return "additive" if self.E is None else None

    @property
    def observes_state(self) -> bool:
        """Whether `C` is known to be the identity. A traced `C` is not."""
        if self.C is None:
            return True
        same = is_concrete(self.C) and self.C.shape == (self.state_size,) * 2
        return same and np.array_equal(self.C, np.eye(self.state_size))

    def at(self, t: Any) -> "LinearDynamics":
        """The time-invariant dynamics at time `t`.

        **Arguments:** `t`: time, a scalar.

        **Returns:** `LinearDynamics` without a time axis.
        """
        if not self.is_time_varying:
            return self
        # Outside of the horizon every entry is NaN, and so is the next state.
        k = step_at(t, self.dt, len(self.A), "LinearDynamics")
        pick = lambda s: [s.A, s.B, s.E, s.x_ref, s.u_ref, s.x_next]  # noqa: E731
        here = row_at(pick(self), k)
        return eqx.tree_at(pick, self, here, is_leaf=lambda leaf: leaf is None)

    def advance(
        self, t: RealScalar, x: Array, u: Array, w: Array | None
    ) -> tuple[Array, Result]:
        # Deviations are taken before the products: far from zero, `A x - A x_ref`
        # would lose digits.
        here = self.at(t)
        x_next = here.x_next + matvec(here.A, x - here.x_ref)
        x_next = x_next + matvec(here.B, u - here.u_ref)
        if w is not None:
            x_next = x_next + (w if here.E is None else matvec(here.E, w))
        return x_next.astype(x.dtype), RESULTS.successful

    def observe(self, t: Time, x: State) -> Observation:
        return x if self.C is None else matvec(self.C, x)

    def equilibrium(self) -> tuple[State, Control]:
        here = self.at(0.0)
        return here.x_ref, here.u_ref


def _checked_matrices(A: Any, B: Any, C: Any, E: Any) -> tuple[Array, Array, Any, Any]:
    """`A`, `B`, `C`, `E` with checked shapes, and with a time axis if `A` has one."""
    where = "LinearDynamics"
    A, B, E = as_float_array(A), as_float_array(B), as_float_array(E)
    if not eqx.is_array(A) or A.ndim != 3:
        return check_matrices(A, B, C, E, where)
    A = as_matrix(A, "A", where, ndim=3)
    if len(A) == 0:
        raise ValueError(f"{where}: A must have at least one time step.")
    inputs: list[Any] = []
    for name, value in (("B", B), ("E", E)):
        if value is not None:
            value = as_matrix(value, name, where, ndim=jnp.ndim(value))
            value = _over_time(value, 2, A)
            if value.ndim != 3 or len(value) != len(A):
                raise ValueError(
                    f"{where}: {name} must have 2 axes, or a leading time axis of "
                    f"length {len(A)} like A, got shape {value.shape}."
                )
        inputs.append(value)
    B, E = inputs
    first = check_matrices(A[0], B[0], C, None if E is None else E[0], where)
    return A, B, first[2], E


def _over_time(array: Any, ndim: int, A: Array) -> Any:
    """`array`, which has `ndim` axes, repeated along the time axis of `A`, if any."""
    if A.ndim == 2 or not eqx.is_array(array) or array.ndim != ndim:
        return array
    return jnp.broadcast_to(array, (len(A), *array.shape))
