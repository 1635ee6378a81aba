"""Systems around another system."""

from typing import Any, ClassVar, TYPE_CHECKING

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._check import as_entries, check_instance
from .._check_models import state_network
from .._module import parameter, positive, weight
from .._typing import Control, Disturbance, Observation, PRNGKey, State, Time
from ._base import AbstractSystem
from ._hybrid_base import AbstractHybridSystem


def _forwarded(name: str) -> Any:
    """A property of the wrapped system."""
    return property(
        lambda self: getattr(self.system, name), doc="As in the wrapped system."
    )


class AbstractSystemWrapper(AbstractSystem):
    """A system around another system. The field `system` holds the wrapped system.
    Methods and names that a subclass does not override are those of the wrapped system.

    A subclass declares the field `system` and writes `vector_field`. Systems with
    events cannot be wrapped.

    **Raises:** `ValueError` at construction if `system` is not a system or has events.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp
        from jaxtyping import Array

        class Heavier(dlx.systems.AbstractSystemWrapper):
            system: dlx.AbstractSystem
            factor: Array = dlx.parameter(2.0)

            def vector_field(self, t, x, u, w):
                return self.system.vector_field(t, x, u / self.factor, w)

        heavier = Heavier(dlx.systems.Pendulum())
        heavier.vector_field(0.0, jnp.ones(2), jnp.ones(1), None)
        ```

        ```text
        Array([ 1.   , 14.122], dtype=float32)
        ```
    """

    if TYPE_CHECKING:  # as in AbstractPlant
        system: ClassVar[Any]
    else:
        system: eqx.AbstractVar[AbstractSystem]

    def __check_init__(self):
        where = type(self).__name__
        check_instance(self.system, AbstractSystem, "system", where)
        if isinstance(self.system, AbstractHybridSystem):
            raise ValueError(
                f"{where}: system must have no events, got "
                f"{type(self.system).__name__}."
            )

    state_names = _forwarded("state_names")
    control_names = _forwarded("control_names")
    disturbance_names = _forwarded("disturbance_names")
    angle_names = _forwarded("angle_names")
    state_units = _forwarded("state_units")
    control_units = _forwarded("control_units")
    time_unit = _forwarded("time_unit")

    @property
    def projects_state(self) -> bool:
        """Whether the class, or the wrapped system, overrides `project`."""
        own = type(self).project is not AbstractSystemWrapper.project
        return own or self.system.projects_state

    def observe(self, t: Time, x: State) -> Observation:
        return self.system.observe(t, x)

    def project(self, x: State) -> State:
        return self.system.project(x)

    def difference(self, x: State, x_ref: State) -> State:
        return self.system.difference(x, x_ref)

    def equilibrium(self) -> tuple[State, Control]:
        return self.system.equilibrium()

    def diffusion(self, t: Time, x: State, u: Control) -> Array | None:
        return self.system.diffusion(t, x, u)


class Calibrated(AbstractSystemWrapper):
    r"""A system with a scale and an offset for each control and each output.

    $$\dot x = f(t, x, a_u u + b_u, w), \qquad y = a_y h(t, x) + b_y$$

    An example is a tank whose pump is driven by a voltage and whose level is read in
    volts. [`delucax.training.sysid.physical`][] can estimate all four constants.

    **Arguments:**

    - `system`: the system inside, a [`delucax.AbstractSystem`][].
    - `control_scale`, `control_offset`: $a_u$ and $b_u$, each a number or shape `(m,)`;
        1 and 0 by default.
    - `output_scale`, `output_offset`: $a_y$ and $b_y$, each a number or shape `(p,)`; 1
        and 0 by default.

    **Raises:** `ValueError` if an argument has another shape, or if `system` has
    events.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        tank = dlx.systems.Calibrated(
            dlx.systems.MassSpringDamper(), control_scale=2.0, output_offset=0.1
        )
        tank.observe(0.0, jnp.zeros(2))
        ```

        ```text
        Array([0.1, 0.1], dtype=float32)
        ```
    """

    system: AbstractSystem
    control_scale: Float[Array, "..."] = parameter(1.0)
    control_offset: Float[Array, "..."] = parameter(0.0)
    output_scale: Float[Array, "..."] = parameter(1.0)
    output_offset: Float[Array, "..."] = parameter(0.0)

    def __check_init__(self):
        # First, so that a `system` of the wrong kind gets a clear error.
        super().__check_init__()
        system = self.system
        sizes = dict(control=system.control_size, output=system.observation_size)
        for what, size in sizes.items():
            for name in (f"{what}_scale", f"{what}_offset"):
                as_entries(getattr(self, name), size, name, "Calibrated")

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        u = self.control_scale * u + self.control_offset
        return self.system.vector_field(t, x, u, w)

    def diffusion(self, t: Time, x: State, u: Control) -> Array | None:
        u = self.control_scale * u + self.control_offset
        return self.system.diffusion(t, x, u)

    def equilibrium(self) -> tuple[State, Control]:
        x, u = self.system.equilibrium()
        return x, (u - self.control_offset) / self.control_scale

    def observe(self, t: Time, x: State) -> Observation:
        return self.output_scale * self.system.observe(t, x) + self.output_offset


class Corrected(AbstractSystemWrapper):
    r"""A grey-box model: a known system and a neural network, which learns what the
    equations of the system leave out.

    $$\dot x = f(t, x, u, w) + s \cdot \mathrm{network}\left(
    \frac{x - \bar x}{\sigma_x}, \frac{u - \bar u}{\sigma_u}\right)$$

    The last layer of the network is initialised to zero, so the model starts as the
    known system. [`delucax.training.sysid.grey_box`][] fits both together.

    `equilibrium()` returns the equilibrium of the known system, without the network.
    Starting there, [`delucax.trim`][] finds the equilibrium of the corrected system.

    **Arguments:**

    - `system`: the known part, a [`delucax.AbstractSystem`][].
    - `width`, `depth`: the number of units in each hidden layer of the network, and the
        number of its hidden layers; 16 and 1 by default.
    - `size`: $s$, the size of the correction to the derivative of each state, shape
        `(n,)` or a number; 1 by default. Pass 0 for a derivative that is known exactly,
        such as that of a position.
    - `x_mean`, `x_scale`: $\bar x$ and $\sigma_x$, the mean and the scale of the
        states, shape `(n,)` or a number; 0 and 1 by default.
    - `u_mean`, `u_scale`: $\bar u$ and $\sigma_u$, the mean and the scale of the
        controls, shape `(m,)` or a number; 0 and 1 by default.
    - `key`: a random key for the initial weights.

    **Attributes:** `network`, an `eqx.nn.MLP`, trainable.

    **Raises:** `ValueError` if an argument has another shape, a scale is not positive,
    or `system` has events.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        spring = dlx.systems.MassSpringDamper()
        key = jax.random.key(0)
        grey = dlx.systems.Corrected(spring, width=8, size=[0.0, 1.0], key=key)
        grey.vector_field(0.0, jnp.ones(2), jnp.zeros(1), None)
        ```

        ```text
        Array([ 1. , -1.1], dtype=float32)
        ```
    """

    system: AbstractSystem
    network: eqx.nn.MLP = weight()
    size: Float[Array, "..."] = parameter(1.0)
    x_mean: Float[Array, "..."] = parameter(0.0)
    x_scale: Float[Array, "..."] = parameter(1.0, constraint=positive)
    u_mean: Float[Array, "..."] = parameter(0.0)
    u_scale: Float[Array, "..."] = parameter(1.0, constraint=positive)

    def __init__(
        self,
        system: AbstractSystem,
        width: int = 16,
        depth: int = 1,
        *,
        size: Any = 1.0,
        x_mean: Any = 0.0,
        x_scale: Any = 1.0,
        u_mean: Any = 0.0,
        u_scale: Any = 1.0,
        key: PRNGKey,
    ):
        check_instance(system, AbstractSystem, "system", "Corrected")
        names = system.state_names, system.control_names
        *_, network = state_network(*names, width, depth, jnp.tanh, key, "Corrected")
        last = lambda network: (network.layers[-1].weight, network.layers[-1].bias)
        zeros = tuple(jnp.zeros_like(leaf) for leaf in last(network))
        self.system, self.network = system, eqx.tree_at(last, network, zeros)
        self.size, self.x_mean, self.x_scale = size, x_mean, x_scale
        self.u_mean, self.u_scale = u_mean, u_scale

    def __check_init__(self):
        super().__check_init__()
        n, m = self.state_size, self.control_size
        sizes = dict(size=n, x_mean=n, x_scale=n, u_mean=m, u_scale=m)
        for name, entries in sizes.items():
            as_entries(getattr(self, name), entries, name, "Corrected")

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        z = (x - self.x_mean) / self.x_scale, (u - self.u_mean) / self.u_scale
        slope = self.system.vector_field(t, x, u, w)
        return slope + self.size * self.network(jnp.concatenate(z))
