"""Plants that switch: a thermostat, dry friction, and a valve between its stops."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from .._check import is_concrete
from .._jax import host_unless_traced, xp
from .._module import parameter, positive
from .._typing import BoolScalar, Control, Disturbance, Real, Scalar, State, Time
from ._hybrid_base import AbstractHybridSystem


class Thermostat(AbstractHybridSystem):
    r"""A room whose heater a thermostat switches on below a band and off above it:

    `capacity d(temperature)/dt = on power + heat - loss (temperature - outside)`.

    The state is (temperature [degC], mode), the control is (heat [kW]) of a second
    source, the modes are off and on. Time is in hours.

    Between `low` and `high` the temperature goes to and fro, if the heater is strong
    enough and the outside cold enough.

    **Arguments:**

    - `capacity`: of the room [kWh/K], 2 by default.
    - `loss`: to the outside [kW/K], 0.2 by default.
    - `power`: of the heater [kW], 6 by default.
    - `outside`: its temperature [degC], 5 by default.
    - `low`, `high`: the ends of the band [degC], 19 and 21 by default.

    **Raises:** `ValueError` if the capacity or the loss is not positive, `low` is not
    below `high`, or a number is not finite.

    Source: Ihara and Schweppe, 1981.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dynamics = dlx.Discretized(dlx.systems.Thermostat(), dt=0.1)
        dlx.open_loop(dynamics, jnp.array([20.0, 0.0]), jnp.zeros((100, 1)))
        ```
    """

    capacity: Real = parameter(2.0, constraint=positive)
    loss: Real = parameter(0.2, constraint=positive)
    power: Real = parameter(6.0)
    outside: Real = parameter(5.0)
    low: Real = parameter(19.0)
    high: Real = parameter(21.0)

    state_names, state_units = ("temperature", "mode"), ("degC", "")
    control_names, control_units = ("heat",), ("kW",)
    time_unit = "h"
    mode_names = ("off", "on")
    event_names, event_directions = ("too cold", "too warm"), (-1, 1)
    # It may be switched off in a cold room.
    urgent_events = event_names

    def __check_init__(self):
        _check_order("Thermostat", "low", self.low, "high", self.high)

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        heat = u[0] + jnp.where(self.mode(x) == 1, self.power, 0)
        lost = self.loss * (x[0] - self.outside)
        return jnp.stack([(heat - lost) / self.capacity, 0 * x[1]])

    def guards(self, t: Time, x: State, u: Control) -> Sequence[Scalar]:
        return x[0] - self.low, x[0] - self.high

    def enabled(self, t: Time, x: State, u: Control) -> Sequence[BoolScalar]:
        mode = self.mode(x)
        return mode == 0, mode == 1

    def resets(self, t: Time, x: State, u: Control) -> Sequence[State]:
        return tuple(jnp.stack([x[0], mode + 0 * x[1]]) for mode in (1, 0))

    @host_unless_traced
    def equilibrium(self) -> tuple[State, Control]:
        """In the middle of the band, where the heater is off and the control heats."""
        middle = (self.low + self.high) / 2
        heat = self.loss * (middle - self.outside)
        return xp.stack([middle, xp.zeros_like(middle)]), xp.stack([heat])


class StickSlip(AbstractHybridSystem):
    r"""A mass on a belt that moves, held by a spring and a damper, with dry friction:

    `mass d2(position)/dt2 = force + friction - stiffness position - damping velocity`.

    Where it slips on the belt the friction is `kinetic`, against the motion relative to
    the belt. Where it sticks it moves with the belt, until what holds it there would
    have to exceed `static`. The state is (position [m], velocity [m/s], mode), the
    control is (force [N]); the modes are to stick, to slip slower than the belt
    (`"slip behind"`) and to slip faster (`"slip ahead"`).

    Without damping and control it settles into a cycle of sticking and slipping, which
    begins where `position = static / stiffness`.

    **Arguments:**

    - `mass`: [kg], 1 by default.
    - `stiffness`: of the spring [N/m], 10 by default.
    - `damping`: [N s/m], 0 by default.
    - `belt`: its velocity [m/s], 0.2 by default.
    - `static`: the most friction of a mass that sticks [N], 1.5 by default.
    - `kinetic`: the friction of one that slips [N], 1 by default.

    **Raises:** `ValueError` if the mass, stiffness or kinetic friction is not positive,
    `kinetic` is not below `static`, or a number is not finite.

    Source: Den Hartog, 1930; Popp and Stelter, 1990.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dynamics = dlx.Discretized(dlx.systems.StickSlip(), dt=0.05)
        dlx.open_loop(dynamics, jnp.array([0.0, 0.2, 0.0]), jnp.zeros((100, 1)))
        ```
    """

    mass: Real = parameter(1.0, constraint=positive)
    stiffness: Real = parameter(10.0, constraint=positive)
    damping: Real = parameter(0.0)
    belt: Real = parameter(0.2)
    static: Real = parameter(1.5)
    kinetic: Real = parameter(1.0, constraint=positive)

    state_names, state_units = ("position", "velocity", "mode"), ("m", "m/s", "")
    control_names, control_units = ("force",), ("N",)
    mode_names = ("stick", "slip behind", "slip ahead")
    event_names = ("break behind", "break ahead", "meet behind", "meet ahead")
    # What holds the mass depends on the control.
    urgent_events = ("break behind", "break ahead")

    def __check_init__(self):
        names = "kinetic", self.kinetic, "static", self.static
        _check_order("StickSlip", *names)

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        mode = self.mode(x)
        friction = jnp.where(mode == 1, self.kinetic, -self.kinetic)
        pull = self.stiffness * x[0] + self.damping * x[1]
        slips = (u[0] + friction - pull) / self.mass
        velocity = jnp.where(mode == 0, self.belt, x[1])
        return jnp.stack([velocity, jnp.where(mode == 0, 0, slips), 0 * x[2]])

    def _holding(self, x: State, u: Control) -> Scalar:
        """The friction that lets the mass move with the belt."""
        return self.stiffness * x[0] + self.damping * self.belt - u[0]

    def guards(self, t: Time, x: State, u: Control) -> Sequence[Scalar]:
        holding, ahead = self._holding(x, u), x[1] - self.belt
        return self.static - holding, self.static + holding, -ahead, ahead

    def enabled(self, t: Time, x: State, u: Control) -> Sequence[BoolScalar]:
        mode = self.mode(x)
        return mode == 0, mode == 0, mode == 1, mode == 2

    def resets(self, t: Time, x: State, u: Control) -> Sequence[State]:
        # Where it cannot stick it passes to the other side of the belt's velocity.
        sticks = jnp.abs(self._holding(x, u)) <= self.static
        modes = 1, 2, jnp.where(sticks, 0, 2), jnp.where(sticks, 0, 1)
        belt = self.belt + 0 * x[1]
        return tuple(jnp.stack([x[0], belt, mode + 0 * x[2]]) for mode in modes)

    @host_unless_traced
    def equilibrium(self) -> tuple[State, Control]:
        """At rest, with the belt slipping under it."""
        way = xp.sign(self.belt)
        mode = xp.where(way < 0, 2.0, way)
        position = way * self.kinetic / self.stiffness
        return xp.stack([position, xp.zeros_like(way), mode]), xp.zeros(1)


class ValveWithStops(AbstractHybridSystem):
    r"""A valve on a spring between two stops, off which it bounces:

    `mass d2(position)/dt2 = force - stiffness (position - neutral) - damping velocity`

    between 0, closed, and 1, open. At a stop `velocity+ = -restitution velocity-`, or
    the valve stays there, in a mode of its own, if it would leave more slowly than
    `rest_speed`. It leaves a stop where the push off it exceeds `adhesion`. The state
    is (position, velocity [1/s], mode), the control is (force [N]); lengths are in
    units of the valve's travel.

    **Arguments:**

    - `mass`: 1 by default.
    - `stiffness`: of the spring, 40 by default.
    - `damping`: 1 by default.
    - `neutral`: where the spring is relaxed, 0.5 by default, as with two springs that
        act against each other; below 0 for a valve that the spring closes.
    - `restitution`: the share of its speed that the valve keeps, 0.3 by default.
    - `adhesion`: what a stop holds back, 0.5 by default.
    - `rest_speed`: 0.02 by default.

    **Raises:** `ValueError` if the mass, the restitution, the adhesion or the speed is
    not positive, or a number is not finite.

    Source: Hoffmann, Peterson and Stefanopoulou, 2003 (the valve of an engine);
    Brogliato, 2016 (impacts).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        valve = dlx.systems.ValveWithStops(neutral=-0.1)
        dynamics = dlx.Discretized(valve, dt=0.02)
        dlx.open_loop(dynamics, jnp.array([0.8, 0.0, 0.0]), jnp.zeros((100, 1)))
        ```
    """

    mass: Real = parameter(1.0, constraint=positive)
    stiffness: Real = parameter(40.0)
    damping: Real = parameter(1.0)
    neutral: Real = parameter(0.5)
    restitution: Real = parameter(0.3, constraint=positive)
    adhesion: Real = parameter(0.5, constraint=positive)
    rest_speed: Real = parameter(0.02, constraint=positive)

    state_names, state_units = ("position", "velocity", "mode"), ("", "1/s", "")
    control_names, control_units = ("force",), ("N",)
    mode_names = ("free", "closed", "open")
    event_names = ("close", "open", "leave closed", "leave open")
    # A valve that rests on a stop is moved by the control alone.
    urgent_events = ("leave closed", "leave open")

    def _push(self, position: Scalar | int, u: Control) -> Scalar:
        """The force on a valve that does not move."""
        return u[0] - self.stiffness * (position - self.neutral)

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        is_free = self.mode(x) == 0
        slope = (self._push(x[0], u) - self.damping * x[1]) / self.mass
        return jnp.where(is_free, jnp.stack([x[1], slope, 0 * x[2]]), 0)

    def guards(self, t: Time, x: State, u: Control) -> Sequence[Scalar]:
        leaving = self.adhesion - self._push(0, u), self.adhesion + self._push(1, u)
        return x[0], 1 - x[0], *leaving

    def enabled(self, t: Time, x: State, u: Control) -> Sequence[BoolScalar]:
        mode = self.mode(x)
        return mode == 0, mode == 0, mode == 1, mode == 2

    def resets(self, t: Time, x: State, u: Control) -> Sequence[State]:
        rebound = -self.restitution * x[1]
        is_slow = jnp.abs(rebound) < self.rest_speed

        def at(stop, push, mode):
            stays = is_slow & (push < self.adhesion)
            hit = jnp.where(stays, 0, rebound), jnp.where(stays, mode, 0)
            return jnp.stack([stop + 0 * x[0], *hit]).astype(x.dtype)

        left = x.at[1:].set(0)
        closes, opens = at(0, self._push(0, u), 1), at(1, -self._push(1, u), 2)
        return closes, opens, left, left

    @host_unless_traced
    def equilibrium(self) -> tuple[State, Control]:
        """Where the spring is relaxed, or on the stop that it pushes to."""
        place = xp.clip(self.neutral, 0, 1)
        mode = xp.where(self.neutral <= 0, 1.0, xp.where(self.neutral >= 1, 2.0, 0.0))
        return xp.stack([place, xp.zeros_like(place), mode]), xp.zeros(1)


def _check_order(
    where: str, lower: str, low: Scalar, higher: str, high: Scalar
) -> None:
    """Raise unless one number is below another, as far as they are known."""
    known = is_concrete(low) and is_concrete(high)
    if known and not np.all(np.asarray(low) < np.asarray(high)):
        raise ValueError(
            f"{where}: {lower} must be below {higher}, got {low} and {high}."
        )
