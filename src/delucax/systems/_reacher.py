"""An arm of two links in a plane."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array

from .._module import parameter, positive
from .._typing import Control, Disturbance, State, Time, Vector
from ..math import cos, sin
from ._base import AbstractSystem


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

    mass_1: Array = parameter(1.0, constraint=positive)
    mass_2: Array = parameter(1.0, constraint=positive)
    length_1: Array = parameter(1.0, constraint=positive)
    length_2: Array = parameter(1.0, constraint=positive)
    gravity: Array = parameter(0.0)

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
        both = x[0] + x[1]
        return jnp.stack(
            [
                self.length_1 * cos(x[0]) + self.length_2 * cos(both),
                self.length_1 * sin(x[0]) + self.length_2 * sin(both),
            ]
        )

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        m2, l1, l2 = self.mass_2, self.length_1, self.length_2
        total = self.mass_1 + m2
        d1, d2 = x[2], x[3]
        c, s = cos(x[1]), sin(x[1])
        coupling = m2 * l1 * l2
        far = m2 * l2 * self.gravity * sin(x[0] + x[1])
        near = total * l1 * self.gravity * sin(x[0])
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
