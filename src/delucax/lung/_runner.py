"""The real-time loop of a controller and a ventilator, simulated or real."""

import abc
import time
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._check import check_bool, check_count, check_key, check_positive
from .._controller import AbstractController, check_controller
from .._typing import PRNGKey
from ..environments import Environment


ABORT = 60.0
"""The pressure above which a run is aborted [cmH2O]."""


_step = eqx.filter_jit(Environment.step)
_act = eqx.filter_jit(lambda controller, t, y, state: controller(t, y, state))
_applied = eqx.filter_jit(
    lambda controller, u, state: controller.applied(u, jnp.zeros(()), state)
)


@runtime_checkable
class Runner(Protocol):
    """The interface between a ventilator and [`delucax.lung.run_breaths`][].

    To use your machine, write a class with these methods. The methods do not have to
    use JAX. They may wait, and they may raise an error.

    **Attributes:** `dt`, the length of a step [s].

    !!! example

        ```python
        import delucax as dlx
        import jax
        from delucax import lung

        env = dlx.make("lung/single_compartment")
        runner = lung.SimulatedRunner(env, key=jax.random.key(0))
        isinstance(runner, lung.Runner)
        ```

        ```text
        True
        ```
    """

    dt: float

    @abc.abstractmethod
    def observe(self) -> float:
        """The pressure that the sensor reads now [cmH2O]."""

    @abc.abstractmethod
    def actuate(self, u_in: float, u_out: float) -> None:
        """Set both valves.

        **Arguments:** `u_in`: from 0 to 100 %. `u_out`: from 0 to 1.
        """

    @abc.abstractmethod
    def wait(self) -> None:
        """Wait until the next step is due."""

    @abc.abstractmethod
    def should_abort(self, pressure: float) -> bool:
        """Whether to abort the run.

        **Arguments:** `pressure`: the last reading [cmH2O].
        """

    @abc.abstractmethod
    def cleanup(self) -> None:
        """Leave the machine safe. `run_breaths` calls this method once at the end, even
        after an error."""


class SimulatedRunner:
    """A [`delucax.lung.Runner`][] that simulates a task of a lung in place of a real
    ventilator.

    **Arguments:**

    - `environment`: a task of a lung.
    - `key`: a random key, for the noise of the sensor.
    - `abort`: the pressure above which `should_abort` is true and the run stops
        [cmH2O], 60 by default.
    - `real_time`: whether `wait` waits for the duration of a step, as on a real
        machine; `False` by default.

    **Raises:** `ValueError` if `environment` is not a task of a lung, or `abort` is not
    positive.

    !!! example

        ```python
        import delucax as dlx
        import jax
        from delucax import lung

        env = dlx.make("lung/single_compartment")
        runner = lung.SimulatedRunner(env, key=jax.random.key(0))
        runner.actuate(50.0, 0.0)
        runner.wait()
        round(runner.observe(), 1)
        ```

        ```text
        21.0
        ```
    """

    def __init__(
        self,
        environment: Environment,
        *,
        key: PRNGKey,
        abort: Any = ABORT,
        real_time: bool = False,
    ):
        where = "SimulatedRunner"
        fits = isinstance(environment, Environment) and environment.control_size == 2
        if not fits or environment.observation_size != 1:
            raise ValueError(
                f"{where}: environment must be a task of a lung, with two controls and "
                f"one observation, got {type(environment).__name__}."
            )
        check_key(key, where)
        check_positive(abort, "abort", where)
        self.environment, self.abort = environment, float(abort)
        self.real_time = check_bool(real_time, "real_time", where)
        self.dt = float(environment.dt)
        start, self._key = jax.random.split(key)
        self.state = environment.reset(start)
        self.steps, self.controls, self.is_clean = 0, (0.0, 0.0), False
        self._noise = jnp.zeros((0, 1))
        if self.real_time:
            # Compile now, not within the first interval.
            self._advanced()
        self._due = time.perf_counter()

    def observe(self) -> float:
        """The pressure that the sensor reads now [cmH2O]."""
        y = self.environment.dynamics.observe(self.steps * self.dt, self.state)
        noise = self.environment.sensor_noise
        if noise is not None:
            if self.steps >= len(self._noise):
                # The noise of a longer episode begins with that of a shorter one.
                count = max(self.environment.horizon, 2 * self.steps)
                self._noise = noise.draw(self._key, self.dt, count, self.state.dtype)
            y = y + self._noise[self.steps]
        return float(y[0])

    def actuate(self, u_in: float, u_out: float) -> None:
        """Set both valves.

        **Arguments:** `u_in`: from 0 to 100 %. `u_out`: from 0 to 1.
        """
        self.controls = (float(u_in), float(u_out))

    def wait(self) -> None:
        """Advance the simulation by one step."""
        if self.real_time:
            # No step is shorter than `dt`, even after a missed deadline.
            self._due = max(self._due + self.dt, time.perf_counter())
            time.sleep(max(0.0, self._due - time.perf_counter()))
        self.state = self._advanced()
        self.steps += 1

    def _advanced(self) -> Array:
        """The state after one step."""
        u = jnp.asarray(self.controls, self.state.dtype)
        # An array, because each new Python number would compile the program again.
        t = jnp.asarray(self.steps * self.dt)
        return _step(self.environment, t, self.state, u).state

    def should_abort(self, pressure: float) -> bool:
        """Whether the pressure is above the limit, or is not a number.

        **Arguments:** `pressure`: the last reading [cmH2O].
        """
        return not pressure <= self.abort

    def cleanup(self) -> None:
        """Let the air out for 3 s, and then close both valves."""
        self.actuate(0.0, 1.0)
        for _ in range(round(3.0 / self.dt)):
            self.wait()
        self.actuate(0.0, 0.0)
        self.is_clean = True


class Recording(NamedTuple):
    """The record of a run at a ventilator, in NumPy arrays.

    **Attributes:**

    - `times` [s], `pressure` [cmH2O], `u_in` [%], `u_out`: an entry for each step.
    - `aborted`: whether the run was aborted. After an abort, the last entry is the
        reading that was too high, with the inspiratory valve closed and the expiratory
        valve open.
    """

    times: np.ndarray
    pressure: np.ndarray
    u_in: np.ndarray
    u_out: np.ndarray
    aborted: bool


def run_breaths(
    runner: Runner,
    controller: AbstractController,
    steps: int = 100,
    *,
    key: PRNGKey | None = None,
) -> Recording:
    """Run a controller at a ventilator.

    Each step reads the pressure, stops if `runner.should_abort` is true, calls the
    controller, sets the valves, and waits. At the end `runner.cleanup()` is called.
    `cleanup` is also called after an error or an interruption, and the error is then
    raised again.

    **Arguments:**

    - `runner`: a [`delucax.lung.Runner`][].
    - `controller`: a controller of both valves, such as a [`delucax.lung.Breathing`][].
    - `steps`: the number of steps, 100 by default.
    - `key`: a random key for the controller; none by default.

    **Returns:** a named tuple. `times` [s], `pressure` [cmH2O], `u_in` [%] and `u_out`
        are NumPy arrays with an entry for each step. `aborted` tells whether the run
        was aborted. After an abort, the last entry is the reading that was too high,
        with the inspiratory valve closed and the expiratory valve open.

    **Raises:** `ValueError` if `runner` is not a runner, `controller` is not a
        controller of both valves, or a control is not finite.

    !!! example

        ```python
        import delucax as dlx
        import jax
        from delucax import lung

        env = dlx.make("lung/single_compartment")
        waveform = env.cost.waveform
        pid = dlx.controllers.LeakyPID(1.0, 1.0, dt=env.dt, reference=waveform)
        runner = lung.SimulatedRunner(env, key=jax.random.key(0))
        lung.run_breaths(runner, lung.Breathing(pid, waveform), 5).pressure.round(2)
        ```

        ```text
        array([ 5.  , 12.73, 15.11, 16.34, 17.24])
        ```
    """
    where = "run_breaths"
    if not isinstance(runner, Runner):
        raise ValueError(
            f"{where}: runner must have dt, observe, actuate, wait, "
            f"should_abort and cleanup, got {type(runner).__name__}."
        )
    check_controller(controller, "controller", where)
    steps = check_count(steps, "steps", where)
    rows, aborted = [], False
    try:
        state = controller.init(key=key)
        # Compile now, not while a valve stands open.
        u, _ = _act(controller, jnp.asarray(0.0), jnp.array([0.0]), state)
        if u.shape != (2,):
            raise ValueError(
                f"{where}: controller must return the controls of both valves, shape "
                f"(2,), got shape {u.shape}. lung.Breathing makes such a controller "
                "from a controller of the inspiratory valve."
            )
        _applied(controller, jnp.array([0.0, 0.0]), state)
        for k in range(steps):
            pressure = float(runner.observe())
            if runner.should_abort(pressure):
                aborted = True
                rows.append((k * runner.dt, pressure, 0.0, 1.0))
                break
            now = jnp.asarray(k * runner.dt)
            u, state = _act(controller, now, jnp.array([pressure]), state)
            if not np.all(np.isfinite(u)):
                raise ValueError(
                    f"{where}: the controls must be finite, got ({u[0]}, {u[1]}) at "
                    f"step {k}."
                )
            u_in, u_out = np.clip(np.asarray(u), [0, 0], [100, 1]).tolist()
            runner.actuate(u_in, u_out)
            state = _applied(controller, jnp.array([u_in, u_out]), state)
            rows.append((k * runner.dt, pressure, u_in, u_out))
            runner.wait()
    finally:
        runner.cleanup()
    columns = np.array(rows, float).reshape(-1, 4).T
    return Recording(*columns, aborted=aborted)
