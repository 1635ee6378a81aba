"""The two-link arm of Gym's Acrobot-v1, driven at its elbow alone."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._check import check_choice
from .._module import parameter, positive
from .._typing import Control, Disturbance, State, Time
from ..math import cos, sin
from ._base import AbstractSystem


class Acrobot(AbstractSystem):
    r"""Two links that hang in a chain, with a torque at the joint between them:

    ```
    d1 = m1 c1^2 + m2 (l1^2 + c2^2 + 2 l1 c2 cos(angle_2)) + I1 + I2
    d2 = m2 (c2^2 + l1 c2 cos(angle_2)) + I2
    phi2 = m2 c2 g sin(angle_1 + angle_2)
    phi1 = -m2 l1 c2 (velocity_2^2 + 2 velocity_1 velocity_2) sin(angle_2)
           + (m1 c1 + m2 l1) g sin(angle_1) + phi2
    d(velocity_2)/dt = (torque + d2/d1 phi1 - m2 l1 c2 velocity_1^2 sin(angle_2) - phi2)
                       / (m2 c2^2 + I2 - d2^2/d1)
    d(velocity_1)/dt = -(d2 d(velocity_2)/dt + phi1) / d1
    ```

    The state is (angle_1 [rad], angle_2 [rad], velocity_1 [rad/s], velocity_2 [rad/s]),
    the control is (torque [N m]), to which the disturbance w, (push [N m]), is added.
    `angle_1 = 0` hangs down; `angle_2` is measured from the line of the first link. The
    vector field is smooth. The equilibrium that it names is the upright one,
    `angle_1 = pi`.

    **Arguments:**

    - `mass_1`, `mass_2`: of the links [kg], 1 by default.
    - `length_1`: of the first link [m], 1 by default. That of the second plays no part.
    - `center_1`, `center_2`: c1 and c2, from a link's joint to its center of mass [m],
        0.5 by default.
    - `inertia_1`, `inertia_2`: of a link about its center of mass [kg m^2], 1 by
        default.
    - `gravity`: g [m/s^2], 9.8 by default.
    - `form`: `"book"` (default), the equations of motion; or `"nips"`, those printed in
        the paper, which lack the term in `velocity_1^2` and do not conserve energy.

    **Raises:** `ValueError` if a mass, length or inertia is not positive, a number is
    not finite, or `form` is neither.

    Source: Sutton, 1996 (`"nips"`); Sutton and Barto, 2018 (`"book"`); Gymnasium
    (Towers et al., 2023), `Acrobot-v1`.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        acrobot = dlx.systems.Acrobot(mass_2=1.2)
        acrobot.vector_field(0.0, jnp.array([0.1, 0.0, 0.0, 0.0]), jnp.ones(1), None)
        ```
    """

    mass_1: Array = parameter(1.0, constraint=positive)
    mass_2: Array = parameter(1.0, constraint=positive)
    length_1: Array = parameter(1.0, constraint=positive)
    center_1: Array = parameter(0.5, constraint=positive)
    center_2: Array = parameter(0.5, constraint=positive)
    inertia_1: Array = parameter(1.0, constraint=positive)
    inertia_2: Array = parameter(1.0, constraint=positive)
    gravity: Array = parameter(9.8)
    form: str = eqx.field(static=True, default="book")

    state_names: ClassVar = ("angle_1", "angle_2", "velocity_1", "velocity_2")
    angle_names: ClassVar = ("angle_1", "angle_2")
    control_names: ClassVar = ("torque",)
    disturbance_names: ClassVar = ("push",)
    state_units: ClassVar = ("rad", "rad", "rad/s", "rad/s")
    control_units: ClassVar = ("N m",)

    def __check_init__(self):
        check_choice(self.form, ("book", "nips"), "form", "Acrobot")

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        m1, m2, l1 = self.mass_1, self.mass_2, self.length_1
        c1, c2, g = self.center_1, self.center_2, self.gravity
        angle_1, angle_2, velocity_1, velocity_2 = x[0], x[1], x[2], x[3]
        bend, straight = sin(angle_2), cos(angle_2)
        own = m2 * c2**2 + self.inertia_2
        d1 = m1 * c1**2 + m2 * (l1**2 + c2**2 + 2 * l1 * c2 * straight)
        d1 = d1 + self.inertia_1 + self.inertia_2
        d2 = m2 * (c2**2 + l1 * c2 * straight) + self.inertia_2
        phi2 = m2 * c2 * g * sin(angle_1 + angle_2)
        swing = velocity_2 * velocity_2 + 2 * velocity_1 * velocity_2
        phi1 = (m1 * c1 + m2 * l1) * g * sin(angle_1) + phi2
        phi1 = phi1 - m2 * l1 * c2 * swing * bend
        torque = u[0] if w is None else u[0] + w[0]
        push = torque + d2 / d1 * phi1 - phi2
        if self.form == "book":
            push = push - m2 * l1 * c2 * velocity_1 * velocity_1 * bend
        acceleration_2 = push / (own - d2 * d2 / d1)
        acceleration_1 = -(d2 * acceleration_2 + phi1) / d1
        return jnp.stack([velocity_1, velocity_2, acceleration_1, acceleration_2])

    def equilibrium(self) -> tuple[State, Control]:
        return jnp.array([np.pi, 0.0, 0.0, 0.0]), jnp.zeros(1)
