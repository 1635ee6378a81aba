"""Dynamics that are made of another plant."""

import abc
from typing import Any, ClassVar, TYPE_CHECKING

import equinox as eqx

from .._check import check_instance
from ..systems import AbstractPlant, AbstractSystem
from ._base import AbstractDynamics


def _forwarded(name: str) -> Any:
    """A property of the plant inside."""
    return property(
        lambda self: getattr(self._inside, name), doc="That of the plant inside."
    )


def _forwarded_units(what: str) -> Any:
    """The units of the plant inside, where its names are the wrapper's too."""

    def units(self):
        same = getattr(self, f"{what}_names") == getattr(self._inside, f"{what}_names")
        return getattr(self._inside, f"{what}_units") if same else ()

    return property(units, doc="Those of the plant inside, where the names are.")


class _Forwarding(AbstractDynamics):
    """Dynamics whose names, sizes and hooks are those of a plant inside by default."""

    @property
    @abc.abstractmethod
    def _inside(self) -> AbstractPlant: ...

    state_names = _forwarded("state_names")
    control_names = _forwarded("control_names")
    disturbance_names = _forwarded("disturbance_names")
    disturbance_size = _forwarded("disturbance_size")
    noise = _forwarded("noise")
    state_units = _forwarded_units("state")
    control_units = _forwarded_units("control")
    time_unit = _forwarded("time_unit")

    @property
    def observes_state(self):
        """Whether `observe` returns the state itself."""
        own = type(self).observe is not _Forwarding.observe
        if own or self.state_size != self._inside.state_size:
            return super().observes_state
        return self._inside.observes_state

    def observe(self, t, x):
        return self._inside.observe(t, x)

    def difference(self, x, x_ref):
        return self._inside.difference(x, x_ref)

    def equilibrium(self):
        return self._inside.equilibrium()


class AbstractDiscretization(_Forwarding):
    """Dynamics that step a continuous-time system, in a field `system`, whose names,
    units, sensor and equilibrium they have.

    A subclass gives `dt` and writes `advance`. [`delucax.Discretized`][] is the one
    that takes any system and any solver.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp
        from jaxtyping import Array

        class Euler(dlx.dynamics.AbstractDiscretization):
            system: dlx.AbstractSystem
            dt: Array = dlx.parameter(0.05)

            def advance(self, t, x, u, w):
                x_next = x + self.dt * self.system.vector_field(t, x, u, None)
                x_next = x_next if w is None else x_next + w
                return x_next, dlx.RESULTS.successful

        Euler(dlx.systems.Pendulum())(0.0, jnp.array([0.1, 0.0]), jnp.ones(1))
        ```
    """

    if TYPE_CHECKING:  # as in AbstractPlant
        system: ClassVar[Any]
    else:
        system: eqx.AbstractVar[AbstractSystem]

    @property
    def _inside(self):
        return self.system


class AbstractWrapper(_Forwarding):
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

    if TYPE_CHECKING:  # as in AbstractPlant
        dynamics: ClassVar[Any]
    else:
        dynamics: eqx.AbstractVar[AbstractDynamics]

    def __check_init__(self):
        check_instance(self.dynamics, AbstractDynamics, "dynamics", type(self).__name__)

    @property
    def _inside(self):
        return self.dynamics

    dt = _forwarded("dt")
    increments = _forwarded("increments")
