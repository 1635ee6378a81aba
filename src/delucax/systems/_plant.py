"""What systems and discrete-time dynamics have in common."""

from typing import Any, ClassVar, Literal, TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp

from .._check import output_of
from .._typing import Control, Observation, State, Time
from ..math import wrap


Noise = Literal["additive", "brownian"] | None


class AbstractPlant(eqx.Module):
    """The names and sizes of a plant, what its sensor reads, and where it rests.

    [`delucax.AbstractSystem`][] adds a vector field to it, and
    [`delucax.AbstractDynamics`][] a step.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        plant = dlx.systems.Pendulum()
        assert isinstance(plant, dlx.systems.AbstractPlant)
        x, u = plant.equilibrium()
        plant.difference(jnp.array([6.3, 0.0]), x)
        ```
    """

    if TYPE_CHECKING:  # a static checker would ask for abstract fields as arguments
        state_names: ClassVar[Any]
        control_names: ClassVar[Any]
    else:
        state_names: eqx.AbstractVar[tuple[str, ...]]
        control_names: eqx.AbstractVar[tuple[str, ...]]
    angle_names: ClassVar[Any] = ()
    disturbance_names: ClassVar[Any] = ()
    state_units: ClassVar[Any] = ()
    control_units: ClassVar[Any] = ()
    time_unit: ClassVar[Any] = "s"

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

    @property
    def noise(self) -> Noise:
        """How `w` acts: `None` if it enters the equations under `disturbance_names`,
        `"additive"` if it is added to the next state, which is the default without
        names, and `"brownian"` if it holds the increments of Brownian motions.
        """
        return None if self.disturbance_names else "additive"

    @property
    def observation_size(self) -> int:
        """The size of what `observe` returns."""
        y = output_of(self.observe, (), (self.state_size,))
        is_array = isinstance(y, jax.ShapeDtypeStruct)
        if not is_array or len(y.shape) != 1:
            got = f"an array of shape {y.shape}" if is_array else type(y).__name__
            raise ValueError(
                f"{type(self).__name__}: observe must return a vector, got {got}."
            )
        return y.shape[0]

    @property
    def observes_state(self) -> bool:
        """Whether what `observe` returns is the state itself, as its program shows."""
        shapes = (), (self.state_size,)
        t, x = (jax.ShapeDtypeStruct(s, jnp.result_type(float)) for s in shapes)
        traced = jax.make_jaxpr(self.observe)(t, x).jaxpr
        return list(traced.outvars) == [traced.invars[1]]

    def observe(self, t: Time, x: State) -> Observation:
        """What the plant's sensor reads; the state by default.

        **Arguments:** `t`: time. `x`: state.

        **Returns:** the observation, rank 1.
        """
        del t
        return x

    def difference(self, x: State, x_ref: State) -> State:
        """The deviation of `x` from `x_ref`; by default `x - x_ref`, in which the
        states that `angle_names` lists are wrapped to +-pi.

        **Arguments:** `x`: state. `x_ref`: the state to measure from.

        **Returns:** the deviation, a vector.
        """
        d = x - x_ref
        if not self.angle_names:
            return d
        angles = [name in self.angle_names for name in self.state_names]
        return jnp.stack([wrap(d[i]) if a else d[i] for i, a in enumerate(angles)])

    def equilibrium(self) -> tuple[State, Control]:
        """A state and a control at which the plant rests.

        **Returns:** `(x, u)`.

        **Raises:** `ValueError` if none is named.
        """
        raise ValueError(
            f"{type(self).__name__} names no equilibrium: override `equilibrium`, or "
            "give the state and control yourself."
        )
