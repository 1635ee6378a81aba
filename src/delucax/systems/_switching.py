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
    r"""A room with a heater that a thermostat switches on below a band of temperatures
    and off above it.

    $$C \dot T = s P + u - k (T - T_\mathrm{outside})$$

    Here $s$ is 1 while the heater is on and 0 while it is off. The state is
    (temperature $T$ [degC], mode). The control is (heat $u$ [kW]), the power of a
    second source of heat. The modes are `"off"` and `"on"`. Time is in hours.

    If the heater is strong enough and the outside cold enough, the temperature swings
    between `low` and `high`.

    **Arguments:**

    - `capacity`: $C$, heat capacity of the room [kWh/K], 2 by default.
    - `loss`: $k$, heat loss to the outside [kW/K], 0.2 by default.
    - `power`: $P$, power of the heater [kW], 6 by default.
    - `outside`: $T_\mathrm{outside}$ [degC], 5 by default.
    - `low`, `high`: the lower and the upper end of the band of temperatures [degC], 19
        and 21 by default.

    **Raises:** `ValueError` if the capacity or the loss is not positive, `low` is not
    below `high`, or a number is not finite.

    Source: Ihara and Schweppe, 1981.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dynamics = dlx.Discretized(dlx.systems.Thermostat(), dt=0.1)
        dlx.open_loop(dynamics, jnp.array([20.0, 0.0]), jnp.zeros((100, 1)))[::25]
        ```

        ```text
        Array([[20.   ,  0.   ],
               [20.258,  0.   ],
               [20.521,  0.   ],
               [20.788,  0.   ],
               [20.948,  1.   ]], dtype=float32)
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
    # Urgent, because a simulation may start with the heater off in a cold room.
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
        """The middle of the band, with the heater off and the control heating.

        **Returns:** the state, shape `(2,)`, and the heat, shape `(1,)`.
        """
        middle = (self.low + self.high) / 2
        heat = self.loss * (middle - self.outside)
        return xp.stack([middle, xp.zeros_like(middle)]), xp.stack([heat])


class StickSlip(AbstractHybridSystem):
    r"""A mass on a moving belt. A spring and a damper hold the mass, and dry friction
    acts between the mass and the belt.

    $$m \ddot p = u + F - k p - c \dot p$$

    Here $u$ is the control and $F$ the friction. While the mass slips on the belt,
    $|F|$ is `kinetic`, and $F$ opposes the motion of the mass relative to the belt.
    While the mass sticks, it moves with the belt. It begins to slip when a friction
    larger than `static` would be needed to hold it.

    The state is (position $p$ [m], velocity [m/s], mode), the control is (force [N]).
    The modes are `"stick"`, `"slip behind"` (slower than the belt) and `"slip ahead"`
    (faster than the belt).

    Without damping and control, the mass settles into a cycle of sticking and slipping.
    In each cycle, the mass begins to slip at `position = static / stiffness`.

    **Arguments:**

    - `mass`: $m$ [kg], 1 by default.
    - `stiffness`: $k$, the stiffness of the spring [N/m], 10 by default.
    - `damping`: $c$ [N s/m], 0 by default.
    - `belt`: velocity of the belt [m/s], 0.2 by default.
    - `static`: the largest friction while the mass sticks [N], 1.5 by default.
    - `kinetic`: the friction while the mass slips [N], 1 by default.

    **Raises:** `ValueError` if the mass, stiffness or kinetic friction is not positive,
    `kinetic` is not below `static`, or a number is not finite.

    Source: Den Hartog, 1930; Popp and Stelter, 1990.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dynamics = dlx.Discretized(dlx.systems.StickSlip(), dt=0.05)
        dlx.open_loop(dynamics, jnp.array([0.0, 0.2, 0.0]), jnp.zeros((100, 1)))[::25]
        ```

        ```text
        Array([[ 0.   ,  0.2  ,  0.   ],
               [ 0.163, -0.16 ,  1.   ],
               [ 0.087,  0.2  ,  0.   ],
               [ 0.062, -0.225,  1.   ],
               [ 0.17 ,  0.126,  1.   ]], dtype=float32)
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
    # Urgent, because the friction that holds the mass depends on the control.
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
        """The friction that keeps the mass on the moving belt."""
        return self.stiffness * x[0] + self.damping * self.belt - u[0]

    def guards(self, t: Time, x: State, u: Control) -> Sequence[Scalar]:
        holding, ahead = self._holding(x, u), x[1] - self.belt
        return self.static - holding, self.static + holding, -ahead, ahead

    def enabled(self, t: Time, x: State, u: Control) -> Sequence[BoolScalar]:
        mode = self.mode(x)
        return mode == 0, mode == 0, mode == 1, mode == 2

    def resets(self, t: Time, x: State, u: Control) -> Sequence[State]:
        # If the mass cannot stick, its velocity passes that of the belt.
        sticks = jnp.abs(self._holding(x, u)) <= self.static
        modes = 1, 2, jnp.where(sticks, 0, 2), jnp.where(sticks, 0, 1)
        belt = self.belt + 0 * x[1]
        return tuple(jnp.stack([x[0], belt, mode + 0 * x[2]]) for mode in modes)

    @host_unless_traced
    def equilibrium(self) -> tuple[State, Control]:
        """The mass at rest, with the belt slipping under it.

        **Returns:** the state, shape `(3,)`, and a zero control, shape `(1,)`.
        """
        way = xp.sign(self.belt)
        mode = xp.where(way < 0, 2.0, way)
        position = way * self.kinetic / self.stiffness
        return xp.stack([position, xp.zeros_like(way), mode]), xp.zeros(1)


class ValveWithStops(AbstractHybridSystem):
    r"""A valve on a spring. The valve bounces between two stops: at one it is closed,
    at the other open.

    $$m \ddot p = F - k (p - p_0) - c \dot p, \qquad 0 \le p \le 1$$

    The position $p$ is 0 where the valve is closed and 1 where it is open. At a stop
    the valve bounces, $\dot p^+ = -e\, \dot p^-$. If the speed after a bounce would be
    below `rest_speed` and the force away from the stop is below `adhesion`, the valve
    stays at the stop, in the mode `"closed"` or `"open"`. The valve leaves the stop
    again when the force away from the stop exceeds `adhesion`.

    The state is (position, velocity [1/s], mode), the control is (force [N]). The modes
    are `"free"`, `"closed"` and `"open"`. The unit of length is the distance between
    the two stops.

    **Arguments:**

    - `mass`: $m$ [N s^2], 1 by default.
    - `stiffness`: $k$, the stiffness of the spring [N], 40 by default.
    - `damping`: $c$ [N s], 1 by default.
    - `neutral`: $p_0$, the position where the spring is relaxed. The default is 0.5, as
        if two equal springs held the valve halfway. For a spring that closes the valve,
        choose a value below 0.
    - `restitution`: $e$, the fraction of its speed that the valve keeps in a bounce,
        0.3 by default.
    - `adhesion`: the largest force with which a stop holds the valve [N], 0.5 by
        default.
    - `rest_speed`: [1/s], 0.02 by default.

    **Raises:** `ValueError` if the mass, the restitution, the adhesion or `rest_speed`
    is not positive, or a number is not finite.

    Source: Hoffmann, Peterson and Stefanopoulou, 2003 (the valve of an engine);
    Brogliato, 2016 (impacts).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        valve = dlx.systems.ValveWithStops(neutral=-0.1)
        dynamics = dlx.Discretized(valve, dt=0.02)
        dlx.open_loop(dynamics, jnp.array([0.8, 0.0, 0.0]), jnp.zeros((100, 1)))[::25]
        ```

        ```text
        Array([[ 0.8  ,  0.   ,  0.   ],
               [ 0.113, -0.738,  0.   ],
               [ 0.   ,  0.   ,  1.   ],
               [ 0.   ,  0.   ,  1.   ],
               [ 0.   ,  0.   ,  1.   ]], dtype=float32)
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
    # Urgent, because only a jump of the control moves a valve that rests on a stop.
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
        """The position where the spring is relaxed, or the stop towards which the
        spring pushes.

        **Returns:** the state, shape `(3,)`, and a zero control, shape `(1,)`.
        """
        place = xp.clip(self.neutral, 0, 1)
        mode = xp.where(self.neutral <= 0, 1.0, xp.where(self.neutral >= 1, 2.0, 0.0))
        return xp.stack([place, xp.zeros_like(place), mode]), xp.zeros(1)


def _check_order(
    where: str, lower: str, low: Scalar, higher: str, high: Scalar
) -> None:
    """Raise unless `low` is below `high`. Traced numbers are skipped."""
    known = is_concrete(low) and is_concrete(high)
    if known and not np.all(np.asarray(low) < np.asarray(high)):
        raise ValueError(
            f"{where}: {lower} must be below {higher}, got {low} and {high}."
        )
