"""Dynamics that change something about others."""

from typing import Any, ClassVar, TYPE_CHECKING

import equinox as eqx

from ._base import AbstractDynamics, check_dynamics


class AbstractWrapper(AbstractDynamics):
    """Has a field `dynamics`, and is like them but for what a subclass says.

    Units of the state are not passed on, for there may be more states.
    """

    if TYPE_CHECKING:  # as in AbstractDynamics
        dynamics: ClassVar[Any]
        control_units: ClassVar[Any]
    else:
        dynamics: eqx.AbstractVar[AbstractDynamics]

        @property
        def control_units(self):
            return self.dynamics.control_units

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
    def is_stochastic(self):
        return self.dynamics.is_stochastic

    def observe(self, t, x):
        return self.dynamics.observe(t, x)

    def difference(self, x, x_ref):
        return self.dynamics.difference(x, x_ref)

    def equilibrium(self):
        return self.dynamics.equilibrium()
