"""The valves and the sensor of a ventilator, the cost of a breath, and the task."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from .._check import as_vector, check_count, check_keywords, check_positive, check_range
from .._module import check_parameters, parameter, positive, shown
from .._results import Result
from .._typing import Control, Observation, RealScalar, Scalar, State, Time
from ..costs import AbstractCost
from ..disturbances import Gaussian
from ..dynamics import AbstractDynamics, AbstractWrapper, Delayed
from ..environments import Environment
from ._waveform import BreathWaveform, check_waveform


class Valves(eqx.Module):
    r"""The two valves of a ventilator: a proportional valve that lets air in, and a
    valve that lets air out, with PEEP behind it.

    The steady flow of the inspiratory valve is a smooth S-curve of its opening
    $u_\mathrm{in}$ [%]:

    $$q(u) = q_\mathrm{max} \frac{z(u) - z(0)}{z(100) - z(0)}, \qquad
    z(u) = \sigma(a (u - m))$$

    The flow $q$ does not depend on the pressure of the airway, because the pressure of
    the supply is much higher. Both valves follow their controls through a first-order
    lag:

    $$T_\mathrm{in} \dot q_\mathrm{in} = q(u_\mathrm{in}) - q_\mathrm{in}, \qquad
    T_\mathrm{out} \dot o = u_\mathrm{out} - o$$

    The flow out of the airway is $\max(o, 0) (p - \mathrm{peep}) / R_\mathrm{out}$
    through the expiratory valve, and $G p$ through a leak. The flow through the
    expiratory valve is not smooth at an opening $o$ of 0. Because of the lag, the
    opening approaches 0 but does not cross it.

    **Arguments:**

    - `max_flow`: $q_\mathrm{max}$ [L/s], 3 by default.
    - `steepness`: $a$ [1/%], 0.06 by default.
    - `midpoint`: $m$ [%], 45 by default.
    - `lag`: $T_\mathrm{in}$ [s], 0.05 by default.
    - `expiratory_lag`: $T_\mathrm{out}$ [s], 0.02 by default.
    - `expiratory_resistance`: $R_\mathrm{out}$, the resistance of the expiratory valve
        when fully open [cmH2O s/L], 5 by default.
    - `peep`: the pressure behind the expiratory valve [cmH2O], 5 by default.
    - `leak`: $G$, the conductance of the leak to the room [L/s/cmH2O], 0 by default.

    **Raises:** `ValueError` if `peep` or `leak` is negative, or if a number other than
    `peep`, `leak` and `midpoint` is not positive.

    !!! example

        ```python
        from delucax.lung import Valves

        Valves(max_flow=2.0).flow(50.0)
        ```

        ```text
        Array(1.135, dtype=float32, weak_type=True)
        ```
    """

    max_flow: Array = parameter(3.0, constraint=positive)
    steepness: Array = parameter(0.06, constraint=positive)
    midpoint: Array = parameter(45.0)
    lag: Array = parameter(0.05, constraint=positive)
    expiratory_lag: Array = parameter(0.02, constraint=positive)
    expiratory_resistance: Array = parameter(5.0, constraint=positive)
    peep: Array = parameter(5.0)
    leak: Array = parameter(0.0)

    __repr__ = shown

    def __check_init__(self):
        check_parameters(self)
        check_range(self.peep, "peep", "Valves")
        check_range(self.leak, "leak", "Valves")

    def flow(self, u_in: Any) -> Array:
        """The steady flow of the inspiratory valve.

        **Arguments:** `u_in`: the opening [%].

        **Returns:** the flow [L/s], of the shape of `u_in`.
        """
        curve = lambda u: jax.nn.sigmoid(self.steepness * (u - self.midpoint))
        # Shift and scale the sigmoid to be 0 when closed and 1 when open.
        closed = curve(0.0)
        return self.max_flow * (curve(u_in) - closed) / (curve(100.0) - closed)

    def derivatives(
        self, inflow: Array, opening: Array, u: Array
    ) -> tuple[Array, Array]:
        """The time derivatives of the inflow and of the expiratory opening.

        **Arguments:**

        - `inflow`: the flow in [L/s].
        - `opening`: the opening of the expiratory valve, from 0 to 1.
        - `u`: the control `(u_in, u_out)`.

        **Returns:** the time derivatives of `inflow` and `opening`.
        """
        filling = (self.flow(u[0]) - inflow) / self.lag
        return filling, (u[1] - opening) / self.expiratory_lag

    def airway_pressure(
        self, inflow: Array, opening: Array, resistance: Array, pressure: Array
    ) -> Array:
        r"""The pressure $p$ between the valves and a lung, from the balance of flows.

        $$q_\mathrm{in} = \frac{p - p_\mathrm{lung}}{R}
        + \frac{o \, (p - \mathrm{peep})}{R_\mathrm{out}} + G p$$

        **Arguments:**

        - `inflow`: $q_\mathrm{in}$ [L/s].
        - `opening`: $o$, the opening of the expiratory valve, from 0 to 1.
        - `resistance`: $R$, the resistance of the lung [cmH2O s/L].
        - `pressure`: $p_\mathrm{lung}$, the pressure inside the lung [cmH2O].

        **Returns:** $p$ [cmH2O].
        """
        # Linear in p, so no iteration is needed.
        out = self._conductance(opening)
        flows = inflow + pressure / resistance + out * self.peep
        return flows / (1 / resistance + out + self.leak)

    def outflow(self, opening: Array, pressure: Array) -> Array:
        """The flow out through the expiratory valve and the leak.

        **Arguments:**

        - `opening`: the opening of the expiratory valve, from 0 to 1.
        - `pressure`: the pressure of the airway [cmH2O].

        **Returns:** the flow [L/s].
        """
        out = self._conductance(opening) * (pressure - self.peep)
        return jnp.asarray(out + self.leak * pressure)

    def _conductance(self, opening: Array) -> Array:
        """The conductance of the expiratory valve."""
        # A stage of a solver may evaluate an opening below 0, which could make the
        # balance of flows singular. At 0, `where` has the right-hand derivative, and
        # `maximum` does not.
        return jnp.where(opening < 0, 0, opening) / self.expiratory_resistance


class PressureSensor(AbstractWrapper):
    """A wrapper of dynamics that appends their observation, a pressure, to the state.

    A cost can then read the pressure from the state, for any kind of lung. For a sensor
    delay, wrap the `PressureSensor` in [`delucax.dynamics.Delayed`][].

    **Arguments:** `dynamics`: the dynamics of a lung, whose observation is one number.

    **Raises:** `ValueError` if `dynamics` is not an `AbstractDynamics`, or does not
    observe exactly one number.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp
        from delucax.lung import PressureSensor, SingleCompartment

        lung = SingleCompartment()
        dynamics = PressureSensor(dlx.Discretized(lung, dt=0.03))
        x0 = dynamics.filled(lung.resting(5.0))
        states = dlx.open_loop(dynamics, x0, jnp.array([[30.0, 0.0]] * 5))
        dynamics.observe(0.0, states[-1])
        ```

        ```text
        Array([23.15], dtype=float32)
        ```
    """

    dynamics: AbstractDynamics

    def __check_init__(self):
        AbstractWrapper.__check_init__(self)
        if self.dynamics.observation_size != 1:
            raise ValueError(
                "PressureSensor: dynamics must observe one pressure, got "
                f"{self.dynamics.observation_size} numbers."
            )

    @property
    def state_names(self) -> tuple[str, ...]:
        return (*self.dynamics.state_names, "sensed pressure")

    def filled(self, x: ArrayLike) -> State:
        """Add the observation to a state of the dynamics.

        **Arguments:** `x`: the state of the dynamics, shape `(n,)`.

        **Returns:** `x` with its observation at the end, shape `(n + 1,)`.

        **Raises:** `ValueError` if `x` has a wrong shape.
        """
        x = as_vector(x, self.dynamics.state_size, "x", "PressureSensor.filled")
        return _with_reading(self.dynamics, x)

    def advance(
        self, t: RealScalar, x: Array, u: Array, w: Array | None
    ) -> tuple[Array, Result]:
        after, result = self.dynamics.advance(t, x[:-1], u, w)
        now = self.dynamics.observe(t + self.dt, after).astype(x.dtype)
        return jnp.concatenate([after, now]), result

    def observe(self, t: Time, x: State) -> Observation:
        return x[-1:]

    def difference(self, x: State, x_ref: State) -> State:
        own = self.dynamics.difference(x[:-1], x_ref[:-1])
        return jnp.concatenate([own, x[-1:] - x_ref[-1:]])

    def equilibrium(self) -> tuple[State, Control]:
        x, u = self.dynamics.equilibrium()
        return self.filled(x), u


@eqx.filter_jit
def _with_reading(dynamics: AbstractDynamics, x: Array) -> Array:
    return jnp.append(x, dynamics.observe(0.0, x)).astype(x.dtype)


class BreathCost(AbstractCost):
    r"""The weighted absolute error of the pressure, $w \, |p - r(t)|$.

    The weight $w$ is 1 in the inspiratory phase and `expiration_weight` in the
    expiratory phase. If a `limit` is given, each cmH2O above the limit adds 10 to the
    cost, because a pressure that is too high is worse than an error. The cost is not
    smooth at the target and at the limit.

    **Arguments:**

    - `waveform`: the target, a [`delucax.lung.BreathWaveform`][].
    - `index`: the index of the pressure in the state.
    - `expiration_weight`: the weight in the expiratory phase, 0 by default.
    - `limit`: the limit of the pressure [cmH2O]; none by default.

    **Raises:** `ValueError` if `waveform` is not a `BreathWaveform`, or the limit is
    not positive.

    !!! example

        ```python
        import jax.numpy as jnp
        from delucax.lung import BreathCost, BreathWaveform

        cost = BreathCost(BreathWaveform(), index=2)
        cost(0.5, jnp.array([0.0, 0.0, 34.0]), jnp.zeros(2))
        ```

        ```text
        Array(1., dtype=float32)
        ```
    """

    waveform: BreathWaveform
    index: int = eqx.field(static=True)
    expiration_weight: Array = parameter(0.0)
    limit: Array | None = parameter(None)

    def __check_init__(self):
        check_waveform(self.waveform, "BreathCost")
        if self.limit is not None:
            check_positive(self.limit, "limit", "BreathCost")

    def __call__(self, t: RealScalar, x: State, u: Control) -> Scalar:
        pressure = x[self.index]
        error = jnp.abs(pressure - self.waveform.pressure(t))
        weight = jnp.where(self.waveform.is_inspiration(t), 1, self.expiration_weight)
        cost = weight * error
        if self.limit is not None:
            cost = cost + 10 * jnp.maximum(pressure - self.limit, 0)
        return cost.astype(x.dtype)


def ventilation(
    dynamics: AbstractDynamics,
    /,
    waveform: BreathWaveform | None = None,
    *,
    resting_state: ArrayLike | None = None,
    sensor_delay: int = 0,
    noise: Any = 0.0,
    expiration_weight: Any = 0.0,
    limit: Any = None,
    horizon: int = 100,
    **options: Any,
) -> Environment:
    """The task to ventilate a lung, so that the pressure tracks a waveform.

    The controls are (u_in [%], u_out). The observation is the pressure of the airway
    [cmH2O]. The state contains the pressure of the airway too; see
    [`delucax.lung.PressureSensor`][]. The cost of a step is the absolute error of the
    pressure in the inspiratory phase; see [`delucax.lung.BreathCost`][]. The task never
    terminates.

    **Arguments:**

    - `dynamics`: the dynamics of the lung, whose observation is the pressure of the
        airway and whose controls are (u_in, u_out).
    - `waveform`: the target, a [`delucax.lung.BreathWaveform`][]. The default waveform
        has 20 breaths per minute with a peak pressure of 35 cmH2O.
    - `resting_state`: the state of the dynamics at the start of an episode; zero by
        default.
    - `sensor_delay`: the number of steps until a pressure is observed, 0 by default.
    - `noise`: the standard deviation of the noise of the sensor [cmH2O], 0 by default.
    - `expiration_weight`, `limit`: arguments of [`delucax.lung.BreathCost`][]; 0 and
        none by default.
    - `horizon`: the number of steps per episode, 100 by default.
    - `**options`: other arguments of [`delucax.Environment`][], which are used in place
        of those that the task sets.

    **Returns:** a [`delucax.Environment`][].

    **Raises:** `ValueError` if a number is invalid, or if `waveform` is not a
    `BreathWaveform`.

    !!! example

        ```python
        import delucax as dlx
        from delucax import lung

        plant = lung.SingleCompartment(resistance=5.0)
        dynamics = dlx.Discretized(plant, dt=0.03)
        env = lung.ventilation(dynamics, resting_state=plant.resting(5.0), noise=0.2)
        ```
    """
    where = "ventilation"
    check_keywords(options, where, ventilation, Environment)
    check_range(noise, "noise", where)
    check_range(expiration_weight, "expiration_weight", where)
    delay = check_count(sensor_delay, "sensor_delay", where, least=0)
    waveform = BreathWaveform() if waveform is None else waveform
    rest: Any = resting_state
    if rest is None:
        rest = [0.0] * dynamics.state_size
    sensor = sensed = PressureSensor(dynamics)
    initial_state = sensor.filled(rest)
    if delay:
        sensed = Delayed(sensor, sensor=delay)
        initial_state = sensed.filled(initial_state)
    # A traced or batched noise cannot be compared with 0, so it is kept.
    silent = isinstance(noise, int | float) and noise == 0
    fields: dict[str, Any] = dict(
        dynamics=sensed,
        cost=BreathCost(waveform, dynamics.state_size, expiration_weight, limit),
        sensor_noise=None if silent else Gaussian(noise, size=1),
        initial_state=initial_state,
        control_bounds=([0.0, 0.0], [100.0, 1.0]),
        horizon=horizon,
    )
    return Environment(**(fields | options))


def waveform_of(env: Any, where: str, *, stacked: bool = False) -> BreathWaveform:
    """The waveform of a task of a lung, or of several stacked tasks."""
    if not isinstance(env, Environment) or not isinstance(env.cost, BreathCost):
        raise ValueError(
            f"{where}: env must be a task with a breath waveform, such as "
            f"delucax.make('lung/double_compartment'), got {type(env).__name__}."
        )
    if not stacked and jnp.ndim(env.dt):
        raise ValueError(
            f"{where}: env must be one task, got {jnp.shape(env.dt)[0]} that are "
            "stacked: map over them with equinox.filter_vmap."
        )
    return env.cost.waveform
