"""Systems whose derivative depends on past states."""

import abc
from typing import Any, ClassVar, TYPE_CHECKING

import equinox as eqx
from jaxtyping import Array, Float

from .._module import check_parameters
from .._typing import Control, Disturbance, State, Time
from ._base import AbstractPlant, check_names


class AbstractDelaySystem(AbstractPlant):
    r"""A system whose derivative depends on past states.

    $$\dot x(t) = f(t, x(t), u, w, x(t - \tau_1), \dots, x(t - \tau_d))$$

    Subclass `AbstractDelaySystem` like [`delucax.AbstractSystem`][]; its `vector_field`
    takes one more argument, `late`, which holds the delayed states.
    [`delucax.dynamics.MethodOfSteps`][] turns it into discrete-time dynamics. If only
    controls or sensor readings are late, use [`delucax.dynamics.TransportDelay`][]
    instead.

    **Attributes:**

    - `delays`: the delays $\tau_i$, positive, shape `(d,)`: a [`delucax.parameter`][],
        or a property computed from parameters.

    **Raises:** `ValueError` at construction if a [`delucax.parameter`][] is not finite
    or violates its constraint, or if the names are missing.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp
        from jaxtyping import Array

        class Blowflies(dlx.systems.AbstractDelaySystem):
            state_names, control_names = ("population",), ("harvest",)
            delays: Array = dlx.parameter([12.0])
            death: Array = dlx.parameter(0.2)

            def vector_field(self, t, x, u, w, late):
                born = 8.5 * late[0] * jnp.exp(-late[0])
                return born - self.death * x - u

        dynamics = dlx.dynamics.MethodOfSteps(Blowflies(), dt=0.5)
        x0 = dynamics.filled([1.0])
        dlx.open_loop(dynamics, x0, jnp.zeros((100, 1)))[-1, 0]
        ```

        ```text
        Array(5.93, dtype=float32)
        ```
    """

    if TYPE_CHECKING:  # a static checker would ask for an abstract field as argument
        delays: ClassVar[Any]
    else:
        delays: eqx.AbstractVar[Float[Array, " d"]]

    def __check_init__(self):
        check_names(self)
        check_parameters(self)

    @abc.abstractmethod
    def vector_field(
        self,
        t: Time,
        x: State,
        u: Control,
        w: Disturbance,
        late: Float[Array, "d n"],
    ) -> State:
        r"""The time derivative of the state.

        **Arguments:**

        - `t`: time, a scalar.
        - `x`: state, shape `(state_size,)`.
        - `u`: control, shape `(control_size,)`.
        - `w`: disturbance, as for [`delucax.AbstractSystem`][].
        - `late`: the delayed states, shape `(d, state_size)`; row `i` is the state at
            `t - delays[i]`.

        **Returns:** $\dot x$, shape `(state_size,)`.
        """
