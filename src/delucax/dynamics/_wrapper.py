"""Dynamics that change something about others."""

from typing import Any, ClassVar, TYPE_CHECKING

import equinox as eqx

from ._base import AbstractDynamics, check_dynamics


class AbstractWrapper(AbstractDynamics):
    """Dynamics with a field `dynamics`, like which they are in all that a subclass does
    not say otherwise.

    A subclass writes `advance`. One whose state has more entries also gives
    `state_names`, `observe`, `difference` and `equilibrium`. Anything else that
    environments, planners and learners ask of dynamics is asked of the field.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        class Slippery(dlx.dynamics.AbstractWrapper):
            dynamics: dlx.AbstractDynamics
            grip: jnp.ndarray = dlx.parameter(0.8)

            def advance(self, t, x, u, w):
                return self.dynamics.advance(t, x, self.grip * u, w)

        pendulum = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05)
        Slippery(pendulum)(0.0, jnp.array([0.1, 0.0]), jnp.ones(1))
        ```
    """

    if TYPE_CHECKING:  # as in AbstractDynamics
        dynamics: ClassVar[Any]
        state_units: ClassVar[Any]
        control_units: ClassVar[Any]
        time_unit: ClassVar[Any]
    else:
        dynamics: eqx.AbstractVar[AbstractDynamics]

        @property
        def state_units(self):
            same = self.state_names == self.dynamics.state_names
            return self.dynamics.state_units if same else ()

        @property
        def time_unit(self):
            return self.dynamics.time_unit

        @property
        def control_units(self):
            same = self.control_names == self.dynamics.control_names
            return self.dynamics.control_units if same else ()

    def __check_init__(self):
        check_dynamics(self.dynamics, type(self).__name__)

    @property
    def dt(self):
        return self.dynamics.dt

    @property
    def state_names(self):
        return self.dynamics.state_names

    @property
    def control_names(self):
        return self.dynamics.control_names

    @property
    def disturbance_size(self):
        return self.dynamics.disturbance_size

    @property
    def increments(self):
        return self.dynamics.increments

    @property
    def observes_state(self):
        own = type(self).observe is not AbstractWrapper.observe
        if own or self.state_size != self.dynamics.state_size:
            return super().observes_state
        return self.dynamics.observes_state

    def observe(self, t, x):
        return self.dynamics.observe(t, x)

    def difference(self, x, x_ref):
        return self.dynamics.difference(x, x_ref)

    def equilibrium(self):
        return self.dynamics.equilibrium()
