"""A synchronous motor with permanent magnets, seen from its rotor."""

from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Array

from .._module import parameter, positive
from .._typing import Control, Disturbance, Scalar, State, Time
from ._base import AbstractSystem


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

    resistance: Array = parameter(2.875)
    d_inductance: Array = parameter(0.0085, constraint=positive)
    q_inductance: Array = parameter(0.0085, constraint=positive)
    flux: Array = parameter(0.175, constraint=positive)
    inertia: Array = parameter(0.0008, constraint=positive)
    friction: Array = parameter(0.001)
    pole_pairs: Array = parameter(4.0, constraint=positive)

    state_names: ClassVar = ("i_d", "i_q", "speed")
    control_names: ClassVar = ("v_d", "v_q")
    disturbance_names: ClassVar = ("load",)
    state_units: ClassVar = ("A", "A", "rad/s")
    control_units: ClassVar = ("V", "V")

    def torque(self, x: State) -> Scalar:
        """What the currents do to the shaft.

        **Arguments:** `x`: state.

        **Returns:** the torque [N m], a scalar.
        """
        saliency = self.d_inductance - self.q_inductance
        return 1.5 * self.pole_pairs * (self.flux * x[1] + saliency * x[0] * x[1])

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        electrical = self.pole_pairs * x[2]
        d_flux = self.d_inductance * x[0] + self.flux
        q_flux = self.q_inductance * x[1]
        d_voltage = u[0] - self.resistance * x[0] + electrical * q_flux
        q_voltage = u[1] - self.resistance * x[1] - electrical * d_flux
        torque = self.torque(x) - self.friction * x[2]
        if w is not None:
            torque = torque - w[0]
        # Loops compute the reciprocals once.
        return jnp.stack(
            [
                d_voltage * (1 / self.d_inductance),
                q_voltage * (1 / self.q_inductance),
                torque * (1 / self.inertia),
            ]
        )

    def equilibrium(self, speed: Any = 0.0) -> tuple[State, Control]:
        """Turning at a speed without load, with no current along the magnets.

        **Arguments:** `speed`: [rad/s], 0 by default.

        **Returns:** `(x, u)`.
        """
        speed = jnp.asarray(speed, float)
        current = self.friction * speed / (1.5 * self.pole_pairs * self.flux)
        electrical = self.pole_pairs * speed
        d_voltage = -electrical * self.q_inductance * current
        q_voltage = self.resistance * current + electrical * self.flux
        x = jnp.stack([jnp.zeros_like(current), current, speed])
        return x, jnp.stack([d_voltage, q_voltage])
