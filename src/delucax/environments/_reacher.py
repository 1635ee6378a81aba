"""Reach for a point with an arm of two links: the paper's task."""

from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._check import check_finite, LARGEST
from .._module import parameter
from ..costs import AbstractCost
from ..math import cos, sin
from ..systems import Reacher
from ._task import task


class ReacherCost(AbstractCost):
    """`|tip - goal|^2 + torque_weight |torques|^2`.

    **Arguments:**

    - `system`: the arm, for where its tip is.
    - `goal`: shape `(2,)` [m]; (0, 1.8) by default.
    - `torque_weight`: 0.1 by default.

    **Raises:** `ValueError` if the goal is not a finite vector of two.

    Source: Gradu, Hallman, Suo, Yu, Agarwal, Ghai, Singh, Zhang, Majumdar and Hazan,
    2021 (Deluca).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        cost = dlx.environments.ReacherCost(dlx.systems.Reacher())
        cost(0.0, jnp.zeros(4), jnp.zeros(2))
        ```
    """

    system: Reacher
    goal: Array = parameter((0.0, 1.8))
    torque_weight: Array = parameter(0.1)

    def __check_init__(self):
        if jnp.shape(self.goal) != (2,):
            raise ValueError(
                f"ReacherCost: goal must have shape (2,), got {jnp.shape(self.goal)}."
            )
        check_finite(self.goal, "goal", "ReacherCost")

    def offset(self, x: Array) -> Array:
        """Where the tip is, seen from the goal.

        **Arguments:** `x`: state.

        **Returns:** `tip - goal`, shape `(2,)` [m].
        """
        return self.system.tip(x) - self.goal.astype(x.dtype)

    def __call__(self, t, x, u):
        offset = self.offset(x)
        effort = self.torque_weight * (u[0] * u[0] + u[1] * u[1])
        return offset[0] * offset[0] + offset[1] * offset[1] + effort


class _Features(eqx.Module):
    """Cosines and sines of the angles, the rates, and the offset of the tip."""

    cost: ReacherCost

    def __call__(self, x: Array) -> Array:
        offset = self.cost.offset(x)
        angles = [cos(x[0]), sin(x[0]), cos(x[1]), sin(x[1])]
        return jnp.stack([*angles, x[2], x[3], offset[0], offset[1]])


@task(Reacher, dt=0.01, horizon=200, solver=diffrax.Euler())
def reacher(system: Reacher, *, goal: Any = (0.0, 1.8)) -> dict[str, Any]:
    """Bring the tip of an arm of two links to a goal.

    State (shoulder, elbow, shoulder_rate, elbow_rate); control (shoulder_torque,
    elbow_torque), without bounds. Starts at rest at the angles (pi/4, pi/2). Cost
    `|tip - goal|^2 + 0.1 |torques|^2` a step. `encode` gives cosines and sines of the
    angles, the rates and `tip - goal`. Explicit Euler, as in the paper. Never
    terminates.

    The cost and `encode` hold the arm too: for arms of other lengths call this again,
    under `jax.vmap` for many, where `delucax.replace` would change one of the three.

    **Arguments:**

    - `system`: a [`delucax.systems.Reacher`][]; made of `others` by default.
    - `goal`: shape `(2,)` [m]; (0, 1.8) by default.
    - `dt`: the control interval, 0.01 by default.
    - `horizon`: steps an episode, 200 by default.
    - `solver`: a Diffrax solver, `diffrax.Euler()` by default.
    - `substeps`: solver steps an interval, 1 by default.
    - `**others`: arguments of [`delucax.systems.Reacher`][] or
        [`delucax.Environment`][], such as `control_bounds`.

    **Returns:** an [`delucax.Environment`][].

    **Raises:** `ValueError` on illegal numbers, or a goal that is not a vector of two.

    Source: Gradu, Hallman, Suo, Yu, Agarwal, Ghai, Singh, Zhang, Majumdar and Hazan,
    2021 (Deluca).

    !!! example

        ```python
        import delucax as dlx

        model = dlx.make("reacher")
        plant = dlx.make("reacher", gravity=-10.0)
        ```
    """
    cost = ReacherCost(system, goal)
    reach = system.length_1 + system.length_2
    low, high = (
        jnp.array([sign] * 4 + [sign * LARGEST] * 2 + [*(sign * reach - cost.goal)])
        for sign in (-1.0, 1.0)
    )
    return dict(
        cost=cost,
        initial_state=jnp.array([np.pi / 4, np.pi / 2, 0.0, 0.0]),
        encode=_Features(cost),
        observation_bounds=(low, high),
    )
