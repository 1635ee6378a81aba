"""Process control and drives: a stirred-tank reactor, two tanks, a motor."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from .._check import is_concrete
from .._jax import host_unless_traced, xp
from .._message import shortened
from .._module import parameter, positive
from .._typing import Control, Disturbance, Real, Scalar, State, Time
from ._base import AbstractSystem


class CSTR(AbstractSystem):
    r"""The continuous stirred-tank reactor: a reactant flows in, reacts in a tank that
    is stirred, and gives off heat, which a jacket takes away,

    `dc/dt = flow (c_feed - c) - r`,
    `dT/dt = flow (T_feed - T) + heat r + cooling (T_coolant - T)`,

    with `r = rate exp(-activation / T) c`. Time is in minutes.

    The state is (concentration [mol/l], temperature [K]), the control is (coolant [K]),
    the temperature of the jacket.

    With the numbers below it can rest at half the feed's concentration, but not by
    itself: a little warmer, it reacts faster and gets warmer still. There the poles are
    2.83 and -0.45 a minute.

    **Arguments:**

    - `flow`: of the feed over the volume, q/V [1/min], 1 by default.
    - `feed_concentration`: of the reactant in the feed [mol/l], 1 by default.
    - `feed_temperature`: [K], 350 by default.
    - `rate`: k0, of the reaction at infinite temperature [1/min], 7.2e10 by default.
    - `activation`: the activation energy over the gas constant, E/R [K], 8750 by
        default.
    - `heat`: the temperature rise per concentration that reacts, -dH / (rho c_p)
        [K l/mol], 209.2 by default.
    - `cooling`: heat conducted to the jacket, over the capacity of the tank [1/min],
        2.092 by default.

    **Raises:** `ValueError` if a number is not positive.

    Source: Hicks and Ray, 1971; Henson and Seborg, 1997 (these numbers).

    !!! example

        ```python
        import delucax as dlx

        reactor = dlx.systems.CSTR()
        x, u = reactor.equilibrium(concentration=0.5)
        reactor.vector_field(0.0, x, u, None)
        ```
    """

    flow: Real = parameter(1.0, constraint=positive)
    feed_concentration: Real = parameter(1.0, constraint=positive)
    feed_temperature: Real = parameter(350.0, constraint=positive)
    rate: Real = parameter(7.2e10, constraint=positive)
    activation: Real = parameter(8750.0, constraint=positive)
    heat: Real = parameter(209.2, constraint=positive)
    cooling: Real = parameter(2.092, constraint=positive)

    state_names, state_units = ("concentration", "temperature"), ("mol/l", "K")
    control_names, control_units = ("coolant",), ("K",)
    time_unit = "min"

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        c, T = x[0], x[1]
        # A stage of a solver may have T <= 0, where the exponential would overflow.
        reaction = self.rate * jnp.exp(-self.activation / jnp.maximum(T, 1.0)) * c
        dc = self.flow * (self.feed_concentration - c) - reaction
        warming = self.flow * (self.feed_temperature - T) + self.heat * reaction
        return jnp.stack([dc, warming + self.cooling * (u[0] - T)])

    @host_unless_traced
    def equilibrium(self, concentration: Any = 0.5) -> tuple[State, Control]:
        """The equilibrium at a concentration.

        **Arguments:** `concentration`: of the reactant, between 0 and that of the feed
        [mol/l]; 0.5 by default.

        **Returns:** `(x, u)`.

        **Raises:** `ValueError` if `concentration` is not between these.
        """
        c, feed = (
            xp.asarray(concentration, jnp.result_type(float)),
            self.feed_concentration,
        )
        if is_concrete(c) and is_concrete(feed):
            if not np.all((0 < np.asarray(c)) & (np.asarray(c) < np.asarray(feed))):
                raise ValueError(
                    "CSTR: concentration must be above 0 and below feed_concentration, "
                    f"{shortened(feed)}, got {shortened(c)}."
                )
        # All that flows in reacts: this gives the rate, and the rate the temperature.
        reaction = self.flow * (feed - c)
        T = self.activation / xp.log(self.rate * c / reaction)
        warming = self.flow * (self.feed_temperature - T) + self.heat * reaction
        return xp.stack([c, T]), xp.stack([T - warming / self.cooling])


class TwoTank(AbstractSystem):
    r"""A pump fills the upper of two tanks, which drains into the lower one, which
    drains away:

    `A1 d(upper)/dt = flow - a1 sqrt(2 g) root(upper)`,
    `A2 d(lower)/dt = a1 sqrt(2 g) root(upper) - a2 sqrt(2 g) root(lower)`.

    The state is the levels (upper [cm], lower [cm]), the control is (flow [cm^3/s]).

    Torricelli's law has `root(h) = sqrt(h)`, whose slope is infinite at an empty tank,
    and which has no value below. Here it is `root(h) = h / (h^2 + smoothing^2)^(1/4)`,
    odd and smooth everywhere, and off by `(smoothing / h)^2 / 4` relatively: 2.5e-5 at
    a level of 1 cm, by default. With a smaller `smoothing` an empty tank is stiffer.

    **Arguments:**

    - `upper_area`, `lower_area`: A1 and A2, of the tanks [cm^2], 28 by default.
    - `upper_outlet`, `lower_outlet`: a1 and a2, of the holes [cm^2], 0.071 by default.
    - `gravity`: g [cm/s^2], 981 by default.
    - `smoothing`: a level [cm], 0.01 by default.

    **Raises:** `ValueError` if a number is not positive.

    Source: Johansson, 2000 (one branch of the quadruple tank).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        tanks = dlx.systems.TwoTank()
        x, u = tanks.equilibrium(level=12.0)  # of the lower tank, in cm
        tanks.vector_field(0.0, x, u, None)
        ```
    """

    upper_area: Real = parameter(28.0, constraint=positive)
    lower_area: Real = parameter(28.0, constraint=positive)
    upper_outlet: Real = parameter(0.071, constraint=positive)
    lower_outlet: Real = parameter(0.071, constraint=positive)
    gravity: Real = parameter(981.0, constraint=positive)
    smoothing: Real = parameter(0.01, constraint=positive)

    state_names, state_units = ("upper", "lower"), ("cm", "cm")
    control_names, control_units = ("flow",), ("cm^3/s",)

    def _outflow(self, outlet: Scalar, level: Scalar) -> Scalar:
        # Torricelli's sqrt(level) far above `smoothing`, and linear near zero; a level
        # below zero, as a stage of a solver may have, flows back.
        root = level * (level * level + self.smoothing**2) ** -0.25
        return outlet * (2 * self.gravity) ** 0.5 * root

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        upper = self._outflow(self.upper_outlet, x[0])
        lower = self._outflow(self.lower_outlet, x[1])
        filling = (u[0] - upper) / self.upper_area
        return jnp.stack([filling, (upper - lower) / self.lower_area])

    @host_unless_traced
    def equilibrium(self, level: Any = 10.0) -> tuple[State, Control]:
        """The equilibrium at a level of the lower tank.

        **Arguments:** `level`: of the lower tank, not negative [cm]; 10 by default.

        **Returns:** `(x, u)`.
        """
        level = xp.asarray(level, jnp.result_type(float))
        flow = self._outflow(self.lower_outlet, level)
        # The level with that outflow: root(h)^2 = r solves for h^2 by a quadratic.
        r = (flow / self.upper_outlet) ** 2 / (2 * self.gravity)
        square = r * (r + (r * r + 4 * self.smoothing**2) ** 0.5) / 2
        return xp.stack([square**0.5, level]), xp.stack([flow])


class PermanentMagnetMotor(AbstractSystem):
    r"""A synchronous motor with permanent magnets, in the coordinates d (along the
    magnets) and q (across them) that turn with the rotor:

    `L_d d(i_d)/dt = v_d - R i_d + p speed L_q i_q`,
    `L_q d(i_q)/dt = v_q - R i_q - p speed (L_d i_d + flux)`,
    `J d(speed)/dt = 3/2 p (flux i_q + (L_d - L_q) i_d i_q) - b speed - load`.

    The state is (i_d [A], i_q [A], speed [rad/s]), the speed being that of the shaft;
    the control is (v_d [V], v_q [V]); the disturbance is (load [N m]). Smooth.

    **Arguments:**

    - `resistance`: R [ohm], 2.875 by default.
    - `d_inductance`, `q_inductance`: L_d and L_q [H], 0.0085 by default.
    - `flux`: of the magnets [Wb], 0.175 by default.
    - `inertia`: J [kg m^2], 0.0008 by default.
    - `friction`: b [N m s], 0.001 by default.
    - `pole_pairs`: p, 4 by default.

    **Raises:** `ValueError` if an inductance, the flux, the inertia or the number of
    poles is not positive, or a number is not finite.

    Source: Krause, Wasynczuk and Sudhoff, 2002. The constants are those of a small
    servo motor.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        motor = dlx.systems.PermanentMagnetMotor()
        x, u = motor.equilibrium(speed=100.0)
        motor.vector_field(0.0, x, u, None)
        ```
    """

    resistance: Real = parameter(2.875)
    d_inductance: Real = parameter(0.0085, constraint=positive)
    q_inductance: Real = parameter(0.0085, constraint=positive)
    flux: Real = parameter(0.175, constraint=positive)
    inertia: Real = parameter(0.0008, constraint=positive)
    friction: Real = parameter(0.001)
    pole_pairs: Real = parameter(4.0, constraint=positive)

    state_names, state_units = ("i_d", "i_q", "speed"), ("A", "A", "rad/s")
    control_names, control_units = ("v_d", "v_q"), ("V", "V")
    disturbance_names = ("load",)

    def torque(self, x: State) -> Scalar:
        """The torque of the currents on the shaft.

        **Arguments:** `x`: state.

        **Returns:** the torque [N m], a scalar.
        """
        saliency = self.d_inductance - self.q_inductance
        # 3/2, as d and q are of the transformation that keeps amplitudes (Clarke's):
        # the power is 3/2 (v_d i_d + v_q i_q).
        return 1.5 * self.pole_pairs * (self.flux * x[1] + saliency * x[0] * x[1])

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        electrical = self.pole_pairs * x[2]  # the speed at which d and q turn
        d_flux = self.d_inductance * x[0] + self.flux
        q_flux = self.q_inductance * x[1]
        # The axes turn with the rotor, so that each sees the flux along the other as a
        # voltage, with opposite signs.
        d_voltage = u[0] - self.resistance * x[0] + electrical * q_flux
        q_voltage = u[1] - self.resistance * x[1] - electrical * d_flux
        torque = self.torque(x) - self.friction * x[2]
        if w is not None:
            torque = torque - w[0]
        # Loops compute the reciprocals once.
        d_slope = d_voltage * (1 / self.d_inductance)
        q_slope = q_voltage * (1 / self.q_inductance)
        return jnp.stack([d_slope, q_slope, torque * (1 / self.inertia)])

    @host_unless_traced
    def equilibrium(self, speed: Any = 0.0) -> tuple[State, Control]:
        """Turning at a speed without load, with no current along the magnets.

        **Arguments:** `speed`: [rad/s], 0 by default.

        **Returns:** `(x, u)`.
        """
        speed = xp.asarray(speed, jnp.result_type(float))
        current = self.friction * speed / (1.5 * self.pole_pairs * self.flux)
        electrical = self.pole_pairs * speed
        d_voltage = -electrical * self.q_inductance * current
        q_voltage = self.resistance * current + electrical * self.flux
        x = xp.stack([xp.zeros_like(current), current, speed])
        return x, xp.stack([d_voltage, q_voltage])
