"""What makes a task of a lung: a sensor, a cost, and the bounds of the valves."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .._check import as_vector, check_count, check_range
from .._module import parameter
from ..costs import AbstractCost
from ..disturbances import Gaussian
from ..dynamics import AbstractDynamics
from ..dynamics._base import check_dynamics
from ..dynamics._wrapper import AbstractWrapper
from ._waveform import BreathWaveform, check_waveform


class PressureSensor(AbstractWrapper):
    """Dynamics whose observation, a pressure, is kept and seen some steps late.

    The state is that of the dynamics, then the pressure now, then the last `delay` of
    them: (x, p[k], p[k - 1], ..., p[k - delay]). What is observed is the last.

    **Arguments:**

    - `dynamics`: of a lung; it observes one number.
    - `delay`: in steps, 0 by default.

    **Raises:** `ValueError` if `dynamics` are none or observe more than one number, or
    the delay is not a whole number of at least 0.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp
        from delucax.lung import PressureSensor, SingleCompartment

        lung = SingleCompartment()
        dynamics = PressureSensor(dlx.Discretized(lung, dt=0.03), delay=2)
        x0 = dynamics.filled(lung.resting(5.0))
        states = dlx.open_loop(dynamics, x0, jnp.array([[30.0, 0.0]] * 5))
        dynamics.pressure(states[-1]), dynamics.observe(0.0, states[-1])
        ```
    """

    dynamics: AbstractDynamics
    delay: int = eqx.field(static=True)

    def __init__(self, dynamics: AbstractDynamics, delay: int = 0):
        where = "PressureSensor"
        self.dynamics = dynamics
        self.delay = check_count(delay, "delay", where, least=0)

    def __check_init__(self):
        where = "PressureSensor"
        check_dynamics(self.dynamics, where)
        if self.dynamics.observation_size != 1:
            raise ValueError(
                f"{where}: dynamics must observe one pressure, got "
                f"{self.dynamics.observation_size} numbers."
            )

    @property
    def state_names(self):
        late = [f"pressure[-{k + 1}]" for k in range(self.delay)]
        return (*self.dynamics.state_names, "sensed pressure", *late)

    def filled(self, x: Any) -> Array:
        """The state of a lung that has rested.

        **Arguments:** `x`: the state of the dynamics.

        **Returns:** the state, with what is observed of `x` as each pressure.

        **Raises:** `ValueError` on a wrong shape.
        """
        x = as_vector(x, self.dynamics.state_size, "x", "PressureSensor.filled")
        y = self.dynamics.observe(0.0, x)
        return jnp.concatenate([x, jnp.tile(y, self.delay + 1)]).astype(x.dtype)

    def pressure(self, x: Array) -> Array:
        """The pressure now, without delay or noise.

        **Arguments:** `x`: the state.

        **Returns:** a scalar [cmH2O].
        """
        return x[self.dynamics.state_size]

    def advance(self, t, x, u, w):
        n = self.dynamics.state_size
        after, result = self.dynamics.advance(t, x[:n], u, w)
        now = self.dynamics.observe(t + self.dt, after).astype(x.dtype)
        kept = [x[n:-1]] if self.delay else []
        return jnp.concatenate([after, now, *kept]), result

    def observe(self, t, x):
        return x[-1:]

    def difference(self, x, x_ref):
        n = self.dynamics.state_size
        own = self.dynamics.difference(x[:n], x_ref[:n])
        return jnp.concatenate([own, x[n:] - x_ref[n:]])

    def equilibrium(self):
        x, u = self.dynamics.equilibrium()
        return self.filled(x), u


class BreathCost(AbstractCost):
    r"""How far the pressure is from the target, `weight |p - r(t)|`.

    The weight is 1 in the inspiratory phase and `expiration` in the other. Not smooth
    on the target.

    **Arguments:**

    - `waveform`: the target, a [`delucax.lung.BreathWaveform`][].
    - `index`: the place of the pressure in the state.
    - `expiration`: 0 by default.

    **Raises:** `ValueError` if `waveform` is none.

    !!! example

        ```python
        import jax.numpy as jnp
        from delucax.lung import BreathCost, BreathWaveform

        cost = BreathCost(BreathWaveform(), index=2)
        cost(0.5, jnp.array([0.0, 0.0, 34.0]), jnp.zeros(2))
        ```
    """

    waveform: BreathWaveform
    index: int = eqx.field(static=True)
    expiration: Array = parameter(0.0)

    def __check_init__(self):
        check_waveform(self.waveform, "BreathCost")

    def __call__(self, t, x, u):
        error = jnp.abs(x[self.index] - self.waveform.pressure(t))
        weight = jnp.where(self.waveform.is_inspiration(t), 1, self.expiration)
        return (weight * error).astype(x.dtype)


def ventilation(
    dynamics: AbstractDynamics,
    waveform: BreathWaveform | None = None,
    *,
    rest: Any = None,
    sensor_delay: int = 0,
    noise: Any = 0.0,
    expiration: Any = 0.0,
    horizon: int = 100,
    **environment: Any,
) -> dict[str, Any]:
    """The arguments of an [`delucax.Environment`][] in which a lung is ventilated.

    **Arguments:**

    - `dynamics`: of the lung; it observes the pressure of the airway and takes the
        controls (u_in, u_out).
    - `waveform`: the target, a [`delucax.lung.BreathWaveform`][]; the default one by
        default.
    - `rest`: the first state of the dynamics; zero by default.
    - `sensor_delay`: steps until a pressure is seen, 0 by default.
    - `noise`: the standard deviation of what the sensor adds [cmH2O], 0 by default.
    - `expiration`: the weight of the expiratory phase in the cost, 0 by default.
    - `horizon`: steps an episode, 100 by default.
    - `**environment`: other arguments of [`delucax.Environment`][], which hold instead.

    **Returns:** a dictionary.

    **Raises:** `ValueError` on illegal numbers, or if `waveform` is none.

    !!! example

        ```python
        import delucax as dlx
        from delucax import lung

        plant = lung.SingleCompartment(resistance=5.0)
        dynamics = dlx.Discretized(plant, dt=0.03)
        arguments = lung.ventilation(dynamics, rest=plant.resting(5.0), noise=0.2)
        env = dlx.Environment(**arguments)
        ```
    """
    check_range(noise, "noise", "ventilation")
    check_range(expiration, "expiration", "ventilation")
    waveform = BreathWaveform() if waveform is None else waveform
    sensed = PressureSensor(dynamics, sensor_delay)
    rest = jnp.zeros(dynamics.state_size) if rest is None else rest
    quiet = isinstance(noise, int | float) and noise == 0
    return (
        dict(
            dynamics=sensed,
            cost=BreathCost(waveform, dynamics.state_size, expiration),
            sensor_noise=None if quiet else Gaussian(noise, size=1),
            initial_state=sensed.filled(rest),
            control_bounds=(jnp.zeros(2), jnp.array([100.0, 1.0])),
            horizon=horizon,
        )
        | environment
    )
