"""A ventilator: its valves and sensor, the cost of a breath, and the task."""

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
    r"""A proportional valve that lets air in, and one that lets it out to PEEP.

    The flow that the first settles at is a smooth S-curve of its opening `u_in` [%],
    with `z(u) = sigmoid(steepness (u - midpoint))`:

    `flow(u_in) = max_flow (z(u_in) - z(0)) / (z(100) - z(0))`,

    which is 0 when closed and `max_flow` when fully open, whatever the pressure behind
    it (the supply is far above that of the airway). Both valves follow what they are
    asked for through a first-order lag:

    `lag d(inflow)/dt = flow(u_in) - inflow`,
    `expiratory_lag d(opening)/dt = u_out - opening`.

    Out goes `max(opening, 0) (p - peep) / expiratory_resistance`, and through a leak
    `leak p`. Not smooth at an opening of 0, which the lag approaches and does not
    cross.

    **Arguments:**

    - `max_flow`: [L/s], 3 by default.
    - `steepness`: of the curve [1/%], 0.06 by default.
    - `midpoint`: of the curve [%], 45 by default.
    - `lag`: of the inspiratory valve [s], 0.05 by default.
    - `expiratory_lag`: of the expiratory valve [s], 0.02 by default.
    - `expiratory_resistance`: of the valve when fully open [cmH2O s/L], 5 by default.
    - `peep`: the pressure behind the expiratory valve [cmH2O], 5 by default.
    - `leak`: conductance to the room [L/s/cmH2O], 0 by default.

    **Raises:** `ValueError` if a number is not positive, or `peep` or `leak` is
    negative.

    !!! example

        ```python
        from delucax.lung import Valves

        Valves(max_flow=2.0).flow(50.0)
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

        **Arguments:** `u_in`: its opening [%].

        **Returns:** the flow [L/s], of the shape of `u_in`.
        """
        curve = lambda u: jax.nn.sigmoid(self.steepness * (u - self.midpoint))
        # A sigmoid is neither 0 when closed nor 1 when open: shifted and scaled.
        closed = curve(0.0)
        return self.max_flow * (curve(u_in) - closed) / (curve(100.0) - closed)

    def derivatives(
        self, inflow: Array, opening: Array, u: Array
    ) -> tuple[Array, Array]:
        """The time derivatives of the inflow and of the expiratory opening.

        **Arguments:**

        - `inflow`: what flows in now [L/s].
        - `opening`: of the expiratory valve now, from 0 to 1.
        - `u`: the control `(u_in, u_out)`.

        **Returns:** the time derivatives of `inflow` and `opening`.
        """
        filling = (self.flow(u[0]) - inflow) / self.lag
        return filling, (u[1] - opening) / self.expiratory_lag

    def airway_pressure(
        self, inflow: Array, opening: Array, resistance: Array, pressure: Array
    ) -> Array:
        """The pressure between the valves and a lung, by the balance of the flows,

        `inflow = (p - pressure) / resistance + opening (p - peep) /
        expiratory_resistance + leak p`.

        **Arguments:**

        - `inflow`: [L/s].
        - `opening`: of the expiratory valve, from 0 to 1.
        - `resistance`: of the way into the lung [cmH2O s/L].
        - `pressure`: inside the lung [cmH2O].

        **Returns:** `p` [cmH2O].
        """
        # Linear in p, so that no iteration is needed within a step of the solver.
        out = self._conductance(opening)
        flows = inflow + pressure / resistance + out * self.peep
        return flows / (1 / resistance + out + self.leak)

    def outflow(self, opening: Array, pressure: Array) -> Array:
        """The flow out through the expiratory valve and the leak.

        **Arguments:**

        - `opening`: of the expiratory valve, from 0 to 1.
        - `pressure`: of the airway [cmH2O].

        **Returns:** the flow [L/s].
        """
        out = self._conductance(opening) * (pressure - self.peep)
        return jnp.asarray(out + self.leak * pressure)

    def _conductance(self, opening: Array) -> Array:
        """The conductance of the expiratory valve."""
        # A stage of a solver may evaluate an opening below 0, where the balance of the
        # flows would be singular. `where`, unlike `maximum`, has the right-hand
        # derivative at 0 itself.
        return jnp.where(opening < 0, 0, opening) / self.expiratory_resistance


class PressureSensor(AbstractWrapper):
    """Dynamics whose observation, a pressure, is kept at the end of the state.

    A cost reads it there, and need not know the lung. For a sensor delay wrap it in
    [`delucax.dynamics.Delayed`][].

    **Arguments:** `dynamics`: of a lung; it observes one number.

    **Raises:** `ValueError` if `dynamics` is not an `AbstractDynamics`, or observes
    more than one number.

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
        """The state of a lung that has rested.

        **Arguments:** `x`: the state of the dynamics.

        **Returns:** the state, with what is observed of `x`.

        **Raises:** `ValueError` on a wrong shape.
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
    r"""The weighted absolute error of the pressure, `weight |p - r(t)|`.

    The weight is 1 in the inspiratory phase and `expiration_weight` in the other. With
    a limit each cmH2O above it costs ten more, as an alarm is worse than an error. Not
    smooth on the target, and at the limit.

    **Arguments:**

    - `waveform`: the target, a [`delucax.lung.BreathWaveform`][].
    - `index`: the place of the pressure in the state.
    - `expiration_weight`: 0 by default.
    - `limit`: a pressure [cmH2O]; none by default.

    **Raises:** `ValueError` if `waveform` is not a `BreathWaveform`, or the limit is
    not positive.

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
    """A task in which a lung is ventilated.

    The controls are (u_in [%], u_out), the observation is the pressure of the airway
    [cmH2O], and the state holds it too, see [`delucax.lung.PressureSensor`][]. Cost
    `|p - r(t)|` a step of the inspiratory phase, [`delucax.lung.BreathCost`][]. Never
    terminates.

    **Arguments:**

    - `dynamics`: of the lung; it observes the pressure of the airway and takes the
        controls (u_in, u_out).
    - `waveform`: the target, a [`delucax.lung.BreathWaveform`][]; up to 35 cmH2O, 20
        times a minute, by default.
    - `resting_state`: the first state of the dynamics; zero by default.
    - `sensor_delay`: steps until a pressure is observed, 0 by default.
    - `noise`: the standard deviation of what the sensor adds [cmH2O], 0 by default.
    - `expiration_weight`, `limit`: of the cost; 0 and none by default.
    - `horizon`: steps per episode, 100 by default.
    - `**options`: other arguments of [`delucax.Environment`][], which hold instead of
        those of the task.

    **Returns:** an [`delucax.Environment`][].

    **Raises:** `ValueError` on invalid numbers, or if `waveform` is not a
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
    # The value of a traced or batched noise cannot be inspected: it is kept.
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
    """The waveform of a task of a lung, or of several that are stacked."""
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
