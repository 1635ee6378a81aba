"""What systems and discrete-time dynamics have in common."""

from typing import Any, ClassVar, Literal, TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._check import as_vector, output_of
from .._typing import Control, Observation, RealScalar, State


Noise = Literal["additive", "brownian"] | None


class AbstractPlant(eqx.Module):
    """The names and sizes of a plant, what its sensor reads, and where it rests.

    [`delucax.AbstractSystem`][] adds a vector field to it, and
    [`delucax.AbstractDynamics`][] a step.
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
        shape = getattr(y, "shape", None)
        if shape is None or len(shape) != 1:
            got = type(y).__name__ if shape is None else f"an array of shape {shape}"
            raise ValueError(
                f"{type(self).__name__}: observe must return a vector, got {got}."
            )
        return shape[0]

    @property
    def observes_state(self) -> bool:
        """Whether what `observe` returns is the state itself, as its program shows."""
        shapes = (), (self.state_size,)
        t, x = (jax.ShapeDtypeStruct(s, jnp.result_type(float)) for s in shapes)
        traced = jax.make_jaxpr(self.observe)(t, x).jaxpr
        return list(traced.outvars) == [traced.invars[1]]

    def observe(self, t: RealScalar, x: State) -> Observation:
        """What the plant's sensor reads; the state by default.

        **Arguments:** `t`: time. `x`: state.

        **Returns:** the observation, rank 1.
        """
        del t
        return x

    def difference(self, x: State, x_ref: State) -> State:
        """The deviation of `x` from `x_ref`; `x - x_ref` by default. Angles wrap here.

        **Arguments:** `x`: state. `x_ref`: the state to measure from.

        **Returns:** the deviation, a vector.
        """
        return x - x_ref

    def equilibrium(self) -> tuple[State, Control]:
        """A state and a control at which the plant rests.

        **Returns:** `(x, u)`.

        **Raises:** `ValueError` if none is named.
        """
        raise ValueError(
            f"{type(self).__name__} names no equilibrium: override `equilibrium`, or "
            "give the state and control yourself."
        )


def validate_io(
    plant: AbstractPlant, x: Any, u: Any, w: Any
) -> tuple[Array, Array, Any]:
    """State, control and disturbance with the sizes that `plant` names, or an error."""
    where = type(plant).__name__
    x = as_vector(x, plant.state_size, "x (the state)", where)
    u = as_vector(u, plant.control_size, "u (the control)", where)
    if w is not None:
        w = as_vector(w, plant.disturbance_size, "w (the disturbance)", where)
    return x, u, w


def zeros_if_none(w: Array | None, size: int, like: Array) -> Array:
    """A zero disturbance where none is given."""
    return jnp.zeros(size, like.dtype) if w is None else w
