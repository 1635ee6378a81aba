"""The continuous-time system: a vector field and its names."""

import abc
from typing import Any, ClassVar, TYPE_CHECKING

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .._check import as_vector
from .._module import check_parameters
from .._typing import RealScalar


class AbstractSystem(eqx.Module):
    r"""A system in continuous time, `dx/dt = f(t, x, u, w)`.

    Subclass it, name the states and controls, and write `vector_field`. States,
    controls and disturbances are rank-1 arrays whose sizes follow from the names.

    **Class attributes** (or properties, where they depend on a field):

    - `state_names`, `control_names`: tuples of strings.
    - `disturbance_names`: tuple of strings, empty by default. If it is empty then `w`
        has the size of the state and is added to the next state by the discrete
        dynamics; otherwise `w` enters the vector field, and is held over a step.
    - `state_units`, `control_units`: tuples of strings, empty by default.
    - `time_unit`: a string, `"s"` by default.

    **Hooks**, which alone may be overridden: `observe`, `project`, `difference`,
    `equilibrium`, `diffusion`.

    **Raises:** `ValueError` at construction if a [`delucax.parameter`][] is not finite
    or not legal, or if the names are missing.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp
        from jaxtyping import Array

        class VanDerPol(dlx.AbstractSystem):
            state_names = ("x", "v")
            control_names = ("u",)
            mu: Array = dlx.parameter(1.0)

            def vector_field(self, t, x, u, w):
                acceleration = self.mu * (1 - x[0] ** 2) * x[1] - x[0] + u[0]
                return jnp.stack([x[1], acceleration])

        VanDerPol().vector_field(0.0, jnp.ones(2), jnp.zeros(1), None)
        ```
    """

    if TYPE_CHECKING:  # a static checker would ask for abstract fields as arguments
        state_names: ClassVar[Any]
        control_names: ClassVar[Any]
    else:
        state_names: eqx.AbstractVar[tuple[str, ...]]
        control_names: eqx.AbstractVar[tuple[str, ...]]
    disturbance_names: ClassVar[Any] = ()
    state_units: ClassVar[Any] = ()
    control_units: ClassVar[Any] = ()
    time_unit: ClassVar[str] = "s"

    def __check_init__(self):
        for name in ("state_names", "control_names", "disturbance_names"):
            names = getattr(self, name)
            if isinstance(names, str) or not isinstance(names, tuple | list):
                raise ValueError(
                    f"{type(self).__name__}: {name} must be a tuple of strings, such "
                    f"as ('angle', 'velocity'), got {names!r}."
                )
        if not self.state_names:
            raise ValueError(f"{type(self).__name__}: state_names must not be empty.")
        check_parameters(self)

    @property
    def state_size(self) -> int:
        """The number of states."""
        return len(self.state_names)

    @property
    def control_size(self) -> int:
        """The number of controls."""
        return len(self.control_names)

    @property
    def disturbance_size(self) -> int:
        """The size of `w`: that of its names, or of the state if there are none."""
        return len(self.disturbance_names) or self.state_size

    @abc.abstractmethod
    def vector_field(self, t: RealScalar, x: Array, u: Array, w: Array | None) -> Array:
        """The time derivative of the state.

        **Arguments:**

        - `t`: time, a scalar.
        - `x`: state, shape `(state_size,)`.
        - `u`: control, shape `(control_size,)`.
        - `w`: disturbance, shape `(disturbance_size,)` if `disturbance_names` is given
            (zeros where there is no disturbance), else `None`.

        **Returns:** dx/dt, shape `(state_size,)`.
        """

    def observe(self, t: RealScalar, x: Array) -> Array:
        """What the plant's sensor reads; the state by default.

        **Arguments:** `t`: time. `x`: state.

        **Returns:** the observation, rank 1.
        """
        del t
        return x

    def project(self, x: Array) -> Array:
        """Brings the state back to its manifold after each control interval; the
        identity by default. Normalise a quaternion or wrap an angle here.

        **Arguments:** `x`: state.

        **Returns:** the projected state.
        """
        return x

    def difference(self, x: Array, x_ref: Array) -> Array:
        """The deviation of `x` from `x_ref`; `x - x_ref` by default. Angles wrap here.

        **Arguments:** `x`: state. `x_ref`: the state to measure from.

        **Returns:** the deviation, a vector.
        """
        return x - x_ref

    def equilibrium(self) -> tuple[Array, Array]:
        """A state and a control at which the system rests.

        **Returns:** `(x, u)`.

        **Raises:** `ValueError` if the system names none.
        """
        raise ValueError(
            f"{type(self).__name__} names no equilibrium: override `equilibrium`, or "
            "give the state and control yourself."
        )

    def diffusion(self, t: RealScalar, x: Array, u: Array) -> Array | None:
        """The matrix g of `dx = f dt + g dB`; none by default.

        If it is given then `w` holds the increments of its k Brownian motions over the
        step, which `disturbance_names` names if it is given too.

        **Arguments:** `t`: time. `x`: state. `u`: control.

        **Returns:** shape `(state_size, k)`, or `(state_size,)` for a diagonal (k is
        then the number of states); or `None` for a system without noise inside.
        """
        del t, x, u
        return None


def validate_io(owner: Any, x: Any, u: Any, w: Any) -> tuple[Array, Array, Any]:
    """State, control and disturbance with the sizes that `owner` names, or an error."""
    where = type(owner).__name__
    x = as_vector(x, owner.state_size, "x (the state)", where)
    u = as_vector(u, owner.control_size, "u (the control)", where)
    if w is not None:
        w = as_vector(w, owner.disturbance_size, "w (the disturbance)", where)
    return x, u, w


def zeros_if_none(w: Array | None, size: int, like: Array) -> Array:
    """A zero disturbance where none is given."""
    return jnp.zeros(size, like.dtype) if w is None else w
