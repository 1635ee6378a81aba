"""Arms of two links: the acrobot of Gym, and the reacher of the paper."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .._check import check_choice
from .._module import parameter, positive
from .._typing import Control, Disturbance, Real, State, Time, Vector
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

    mass_1: Real = parameter(1.0, constraint=positive)
    mass_2: Real = parameter(1.0, constraint=positive)
    length_1: Real = parameter(1.0, constraint=positive)
    center_1: Real = parameter(0.5, constraint=positive)
    center_2: Real = parameter(0.5, constraint=positive)
    inertia_1: Real = parameter(1.0, constraint=positive)
    inertia_2: Real = parameter(1.0, constraint=positive)
    gravity: Real = parameter(9.8)
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
        # The inertia about the first joint, and how it couples to the second.
        d1 = m1 * c1**2 + m2 * (l1**2 + c2**2 + 2 * l1 * c2 * straight)
        d1 = d1 + self.inertia_1 + self.inertia_2
        d2 = m2 * (c2**2 + l1 * c2 * straight) + self.inertia_2
        # Gravity about the second joint; gravity and Coriolis forces about the first.
        phi2 = m2 * c2 * g * sin(angle_1 + angle_2)
        swing = velocity_2 * velocity_2 + 2 * velocity_1 * velocity_2
        phi1 = (m1 * c1 + m2 * l1) * g * sin(angle_1) + phi2
        phi1 = phi1 - m2 * l1 * c2 * swing * bend
        torque = u[0] if w is None else u[0] + w[0]
        push = torque + d2 / d1 * phi1 - phi2  # acceleration_1 is eliminated
        if self.form == "book":
            push = push - m2 * l1 * c2 * velocity_1 * velocity_1 * bend
        acceleration_2 = push / (own - d2 * d2 / d1)
        acceleration_1 = -(d2 * acceleration_2 + phi1) / d1
        return jnp.stack([velocity_1, velocity_2, acceleration_1, acceleration_2])

    def equilibrium(self) -> tuple[State, Control]:
        return jnp.array([np.pi, 0.0, 0.0, 0.0]), jnp.zeros(1)


class Reacher(AbstractSystem):
    r"""Two massless links with a point mass at the end of each, and a torque at each
    joint:

    `M(q) d2q/dt2 = u + h(q, dq/dt) - G(q)`, `q = (shoulder, elbow)`,

    `M11 = (m1 + m2) l1^2 + m2 l2^2 + 2 m2 l1 l2 cos(elbow)`,
    `M12 = m2 l2^2 + m2 l1 l2 cos(elbow)`, `M22 = m2 l2^2`.

    The state is (shoulder [rad], elbow [rad], their rates), the control two torques
    [N m]. The shoulder's angle is measured from the x axis, the elbow's from the first
    link, so the arm is stretched along x at zero. The vector field is smooth.

    A positive `gravity` pulls **along the x axis**, towards the arm stretched at zero,
    and a negative one away from it: this is what the paper's experiments change to make
    a plant that differs from its model. For weight in the common sense, take x to point
    down.

    **Arguments:**

    - `mass_1`, `mass_2`: [kg], 1 by default.
    - `length_1`, `length_2`: [m], 1 by default.
    - `gravity`: [m/s^2], 0 by default.

    **Raises:** `ValueError` if a mass or length is not positive, or a number is not
    finite.

    Source: Gradu, Hallman, Suo, Yu, Agarwal, Ghai, Singh, Zhang, Majumdar and Hazan,
    2021 (Deluca); Spong, Hutchinson and Vidyasagar, 2006.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        arm = dlx.systems.Reacher(gravity=-10.0)
        arm.vector_field(0.0, jnp.array([0.8, 1.6, 0.0, 0.0]), jnp.zeros(2), None)
        arm.tip(jnp.zeros(4))
        ```
    """

    mass_1: Real = parameter(1.0, constraint=positive)
    mass_2: Real = parameter(1.0, constraint=positive)
    length_1: Real = parameter(1.0, constraint=positive)
    length_2: Real = parameter(1.0, constraint=positive)
    gravity: Real = parameter(0.0)

    state_names: ClassVar = ("shoulder", "elbow", "shoulder_rate", "elbow_rate")
    angle_names: ClassVar = ("shoulder", "elbow")
    control_names: ClassVar = ("shoulder_torque", "elbow_torque")
    state_units: ClassVar = ("rad", "rad", "rad/s", "rad/s")
    control_units: ClassVar = ("N m", "N m")

    def tip(self, x: State) -> Vector:
        """Where the hand is.

        **Arguments:** `x`: state.

        **Returns:** its position, shape `(2,)` [m].
        """
        l1, l2, both = self.length_1, self.length_2, x[0] + x[1]
        return jnp.stack([l1 * along(x[0]) + l2 * along(both) for along in (cos, sin)])

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        m2, l1, l2 = self.mass_2, self.length_1, self.length_2
        total = self.mass_1 + m2
        d1, d2 = x[2], x[3]
        c, s = cos(x[1]), sin(x[1])
        coupling = m2 * l1 * l2
        # Gravity pulls along x: its torque is as the sine of the angle from there.
        far = m2 * l2 * self.gravity * sin(x[0] + x[1])
        near = total * l1 * self.gravity * sin(x[0])
        # M a = b, with the Coriolis and centrifugal forces on the right.
        b1 = u[0] + coupling * (2 * d1 + d2) * d2 * s - far - near
        b2 = u[1] - coupling * (d1 * d1) * s - far
        m22 = m2 * l2**2
        m12 = m22 + coupling * c
        m11 = total * l1**2 + m22 + 2 * coupling * c
        # The determinant without the cancellation of m11 m22 - m12^2.
        determinant = m22 * l1**2 * (self.mass_1 + m2 * (s * s))
        a1 = (m22 * b1 - m12 * b2) / determinant
        a2 = (m11 * b2 - m12 * b1) / determinant
        return jnp.stack([d1, d2, a1, a2])

    def equilibrium(self) -> tuple[State, Control]:
        """The arm stretched along the x axis, at rest.

        **Returns:** the zero state and control.
        """
        return jnp.zeros(4), jnp.zeros(2)
