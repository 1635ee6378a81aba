"""Process control and drives: a stirred-tank reactor, two tanks, a motor."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from .._check import check_range, is_concrete
from .._jax import host_unless_traced, xp
from .._message import shortened
from .._module import parameter, positive
from .._typing import Control, Disturbance, Real, Scalar, State, Time
from ._base import AbstractSystem


class CSTR(AbstractSystem):
    r"""The continuous stirred-tank reactor. A reactant flows into a stirred tank and
    reacts. The reaction gives off heat, which a cooling jacket takes away.

    $$\dot c = f (c_\mathrm{feed} - c) - r, \qquad
    \dot T = f (T_\mathrm{feed} - T) + h r + k (T_\mathrm{coolant} - T), \qquad
    r = r_0 e^{-E / T} c$$

    The state is (concentration [mol/l], temperature [K]), the control is (coolant [K]),
    the temperature of the jacket. Time is in minutes.

    With the default constants, the reactor has an unstable equilibrium at half the
    concentration of the feed. If the tank gets a little warmer there, the reaction
    becomes faster and heats the tank even more. The poles at this equilibrium are 2.83
    and -0.45 per minute.

    **Arguments:**

    - `flow`: $f$, the flow of the feed divided by the volume of the tank [1/min], 1 by
        default.
    - `feed_concentration`: $c_\mathrm{feed}$, concentration of the reactant in the feed
        [mol/l], 1 by default.
    - `feed_temperature`: $T_\mathrm{feed}$ [K], 350 by default.
    - `rate`: $r_0$, the rate of the reaction at infinite temperature [1/min], 7.2e10 by
        default.
    - `activation`: $E$, the activation energy divided by the gas constant [K], 8750 by
        default.
    - `heat`: $h$, the rise of the temperature for each mol/l that reacts,
        $-\Delta H / (\rho c_p)$ [K l/mol], 209.2 by default.
    - `cooling`: $k$, the heat that flows to the jacket per kelvin of temperature
        difference, divided by the heat capacity of the tank [1/min], 2.092 by default.

    **Raises:** `ValueError` if a number is not positive.

    Source: Hicks and Ray, 1971; Henson and Seborg, 1997 (these numbers).

    !!! example

        ```python
        import delucax as dlx

        reactor = dlx.systems.CSTR()
        reactor.equilibrium(concentration=0.5)
        ```

        ```text
        (Array([  0.5  , 350.001], dtype=float32), Array([300.001], dtype=float32))
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
        # A solver may try a stage with T <= 0, where the exponential would overflow.
        reaction = self.rate * jnp.exp(-self.activation / jnp.maximum(T, 1.0)) * c
        dc = self.flow * (self.feed_concentration - c) - reaction
        warming = self.flow * (self.feed_temperature - T) + self.heat * reaction
        return jnp.stack([dc, warming + self.cooling * (u[0] - T)])

    @host_unless_traced
    def equilibrium(self, concentration: Any = 0.5) -> tuple[State, Control]:
        """The equilibrium at a given concentration.

        **Arguments:** `concentration`: the concentration of the reactant in the tank
            [mol/l], above 0 and below `feed_concentration`; 0.5 by default.

        **Returns:** `(x, u)`, shapes `(2,)` and `(1,)`.

        **Raises:** `ValueError` if `concentration` is not between 0 and
        `feed_concentration`.
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
        # At rest, what flows in reacts. This gives the rate of the reaction, and the
        # rate gives the temperature.
        reaction = self.flow * (feed - c)
        T = self.activation / xp.log(self.rate * c / reaction)
        warming = self.flow * (self.feed_temperature - T) + self.heat * reaction
        return xp.stack([c, T]), xp.stack([T - warming / self.cooling])


class TwoTank(AbstractSystem):
    r"""Two tanks in a cascade. A pump fills the upper tank. The upper tank drains into
    the lower tank, which has an outlet too.

    $$A_1 \dot h_1 = q - a_1 \sqrt{2 g}\, r(h_1), \qquad
    A_2 \dot h_2 = a_1 \sqrt{2 g}\, r(h_1) - a_2 \sqrt{2 g}\, r(h_2), \qquad
    r(h) = \frac{h}{(h^2 + s^2)^{1/4}}$$

    The state is the two levels (upper [cm], lower [cm]), the control is (flow
    [cm^3/s]).

    Torricelli's law is $r(h) = \sqrt h$, whose slope is infinite at $h = 0$ and which
    is not defined for $h < 0$. The function $r$ of this model is odd and smooth for all
    $h$. Its relative difference from $\sqrt h$ is about $(s / h)^2 / 4$, which is
    2.5e-5 at a level of 1 cm with the default $s$. A smaller $s$ makes the equations
    stiffer when a tank is nearly empty.

    **Arguments:**

    - `upper_area`, `lower_area`: $A_1$ and $A_2$, cross sections of the tanks [cm^2],
        28 by default.
    - `upper_outlet`, `lower_outlet`: $a_1$ and $a_2$, areas of the outlets [cm^2],
        0.071 by default.
    - `gravity`: $g$ [cm/s^2], 981 by default.
    - `smoothing`: $s$, the level below which $r$ departs from $\sqrt h$ [cm], 0.01 by
        default.

    **Raises:** `ValueError` if a number is not positive.

    Source: Johansson, 2000 (one branch of the quadruple tank).

    !!! example

        ```python
        import delucax as dlx

        tanks = dlx.systems.TwoTank(upper_outlet=0.1)
        tanks.equilibrium(level=12.0)
        ```

        ```text
        (Array([ 6.049, 12.   ], dtype=float32), Array([10.894], dtype=float32))
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
        # Odd in the level, because a solver may try a stage with a level below zero.
        root = level * (level * level + self.smoothing**2) ** -0.25
        return outlet * (2 * self.gravity) ** 0.5 * root

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        upper = self._outflow(self.upper_outlet, x[0])
        lower = self._outflow(self.lower_outlet, x[1])
        filling = (u[0] - upper) / self.upper_area
        return jnp.stack([filling, (upper - lower) / self.lower_area])

    @host_unless_traced
    def equilibrium(self, level: Any = 10.0) -> tuple[State, Control]:
        """The equilibrium at a given level of the lower tank.

        **Arguments:** `level`: level of the lower tank [cm], not negative; 10 by
            default.

        **Returns:** `(x, u)`, shapes `(2,)` and `(1,)`.
        """
        check_range(level, "level", "TwoTank")
        level = xp.asarray(level, jnp.result_type(float))
        flow = self._outflow(self.lower_outlet, level)
        # The level of the upper tank at that outflow: r(h)^2 = r is quadratic in h^2.
        r = (flow / self.upper_outlet) ** 2 / (2 * self.gravity)
        square = r * (r + (r * r + 4 * self.smoothing**2) ** 0.5) / 2
        return xp.stack([square**0.5, level]), xp.stack([flow])


class PermanentMagnetMotor(AbstractSystem):
    r"""A synchronous motor with permanent magnets, in coordinates that turn with the
    rotor: the d axis points along the magnets, and the q axis across them.

    $$\begin{aligned}
    L_d \dot i_d &= v_d - R i_d + p \omega L_q i_q \\
    L_q \dot i_q &= v_q - R i_q - p \omega (L_d i_d + \psi) \\
    J \dot\omega &= \tfrac32 p (\psi i_q + (L_d - L_q) i_d i_q) - b \omega - \tau
    \end{aligned}$$

    The state is (i_d [A], i_q [A], speed [rad/s]), where $\omega$ is the speed of the
    shaft. The control is (v_d [V], v_q [V]). The disturbance is (load [N m]), the
    torque $\tau$ that brakes the shaft. The vector field is smooth.

    **Arguments:**

    - `resistance`: $R$ [ohm], 2.875 by default.
    - `d_inductance`, `q_inductance`: $L_d$ and $L_q$ [H], 0.0085 by default.
    - `flux`: $\psi$, flux of the magnets [Wb], 0.175 by default.
    - `inertia`: $J$ [kg m^2], 0.0008 by default.
    - `friction`: $b$ [N m s], 0.001 by default.
    - `pole_pairs`: $p$, 4 by default.

    **Raises:** `ValueError` if an inductance, the flux, the inertia or the number of
    pole pairs is not positive, or a number is not finite.

    Source: Krause, Wasynczuk and Sudhoff, 2002. The constants are those of a small
    servo motor.

    !!! example

        ```python
        import delucax as dlx

        motor = dlx.systems.PermanentMagnetMotor()
        motor.equilibrium(speed=100.0)
        ```

        ```text
        (Array([0.000e+00, 9.524e-02, 1.000e+02], dtype=float32),
         Array([-0.324, 70.274], dtype=float32))
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
        """The torque that the currents exert on the shaft.

        **Arguments:** `x`: state, shape `(3,)`.

        **Returns:** the torque [N m], a scalar.
        """
        saliency = self.d_inductance - self.q_inductance
        # The factor 3/2 belongs to Clarke's transformation, which keeps amplitudes: the
        # power is 3/2 (v_d i_d + v_q i_q).
        return 1.5 * self.pole_pairs * (self.flux * x[1] + saliency * x[0] * x[1])

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        electrical = self.pole_pairs * x[2]  # the speed at which d and q turn
        d_flux = self.d_inductance * x[0] + self.flux
        q_flux = self.q_inductance * x[1]
        # Because the axes turn, the flux along each axis induces a voltage in the
        # other, with opposite signs.
        d_voltage = u[0] - self.resistance * x[0] + electrical * q_flux
        q_voltage = u[1] - self.resistance * x[1] - electrical * d_flux
        torque = self.torque(x) - self.friction * x[2]
        if w is not None:
            torque = torque - w[0]
        # Reciprocals, because a loop computes them once.
        d_slope = d_voltage * (1 / self.d_inductance)
        q_slope = q_voltage * (1 / self.q_inductance)
        return jnp.stack([d_slope, q_slope, torque * (1 / self.inertia)])

    @host_unless_traced
    def equilibrium(self, speed: Any = 0.0) -> tuple[State, Control]:
        """The equilibrium at a given speed without load, with no current along the
        magnets.

        **Arguments:** `speed`: speed of the shaft [rad/s], 0 by default.

        **Returns:** `(x, u)`, shapes `(3,)` and `(2,)`.
        """
        speed = xp.asarray(speed, jnp.result_type(float))
        current = self.friction * speed / (1.5 * self.pole_pairs * self.flux)
        electrical = self.pole_pairs * speed
        d_voltage = -electrical * self.q_inductance * current
        q_voltage = self.resistance * current + electrical * self.flux
        x = xp.stack([xp.zeros_like(current), current, speed])
        return x, xp.stack([d_voltage, q_voltage])
