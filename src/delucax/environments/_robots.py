"""Robot tasks: keep a car in its lane, fly a quadrotor to a point, reach a goal."""

from collections.abc import Callable, Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from .._check import as_vector, check_finite, FLOAT32_MAX
from .._jax import host_unless_traced
from .._module import as_float_array, parameter
from .._typing import Control, PRNGKey, Real, Scalar, State, Time, Vector
from ..costs import AbstractCost, Quadratic
from ..math import cos, sin, wrap
from ..systems import (
    ConstantWind,
    DissipativeWind,
    DynamicBicycle,
    KinematicBicycle,
    PlanarQuadrotor,
    Quadrotor,
    Reacher,
    VortexWind,
)
from ._task import box, Fields, Limit, Number, task, UniformState


def bicycle_features(x: State) -> Vector:
    """The state of a car, with the heading replaced by its cosine and sine."""
    turned = jnp.stack([x[0], x[1], cos(x[2]), sin(x[2])])
    return jnp.concatenate([turned, x[3:]])


def heading_difference(x: State, x_ref: State) -> State:
    """`x - x_ref`, with the difference of the headings wrapped."""
    d = x - x_ref
    rest = [d[i] for i in range(3, x.shape[0])]
    return jnp.stack([d[0], d[1], wrap(d[2]), *rest])


def _lane_keeping(
    spread: Sequence[float],
    speed: Number,
    max_acceleration: Limit,
    max_steering: Limit,
) -> Fields:
    """What both bicycle tasks share. They start within `spread` of driving along the
    lane.

    The cost is `y^2 + heading^2 + 0.1 acceleration^2 + steering^2`, plus 0.1 times the
    squared deviations of the speed and of the other states. Among the features, only
    the cosine and sine of the heading are bounded.
    """
    rest = len(spread) - 3
    target = [0.0, 0.0, 0.0, speed] + [0.0] * (rest - 1)
    feature_bound = [FLOAT32_MAX] * 2 + [1.0] * 2 + [FLOAT32_MAX] * rest
    # The position along the lane costs nothing.
    weights = [0.0, 1.0, 1.0] + [0.1] * rest
    cost = Quadratic(
        weights, [0.1, 1.0], state_target=target, difference=heading_difference
    )
    return dict(
        cost=cost,
        initial_state=UniformState(*box(spread, target)),
        control_bounds=box([max_acceleration, max_steering]),
        encode=bicycle_features,
        observation_bounds=box(feature_bound),
    )


@task(KinematicBicycle, dt=0.05, horizon=100)
def kinematic_bicycle(
    system: KinematicBicycle,
    *,
    speed: Number = 10.0,
    max_acceleration: Limit = 3.0,
    max_steering: Limit = 0.5,
) -> Fields:
    """Steer a car that rolls without slip to the lane y = 0, and bring it to a given
    speed.

    - *State:* x [m], y [m], heading [rad], speed [m/s]. *Control:* acceleration
        [m/s^2], steering [rad].
    - *Start:* at x = 0, y uniformly random in +-2 m, the heading in +-0.3 rad, the
        speed within 3 m/s of the speed to hold.
    - *Cost:* `y^2 + heading^2 + 0.1 (speed - speed*)^2 + 0.1 acceleration^2 +
        steering^2` per step, where `speed*` is the speed to hold. The heading is
        wrapped.
    - *End:* never terminates.
    - *Features:* `encode` replaces the heading by its cosine and sine.

    **Arguments:**

    - `speed`: the speed to hold [m/s], 10 by default.
    - `max_acceleration`: the largest absolute value of the acceleration [m/s^2], 3 by
        default.
    - `max_steering`: the largest steering angle to either side [rad], 0.5 by default.

    Source: Kong, Pfeiffer, Schildbach and Borrelli, 2015.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("kinematic_bicycle", speed=5.0)
        ```
    """
    spread = [0.0, 2.0, 0.3, 3.0]
    return _lane_keeping(spread, speed, max_acceleration, max_steering)


@task(DynamicBicycle, dt=0.05, horizon=100, substeps=5)
def dynamic_bicycle(
    system: DynamicBicycle,
    *,
    speed: Number = 20.0,
    max_acceleration: Limit = 5.0,
    max_steering: Limit = 0.2,
) -> Fields:
    """Steer a fast car whose tyres slip to the lane y = 0, and bring it to a given
    speed.

    - *State:* x [m], y [m], heading [rad], vx [m/s], vy [m/s], rate [rad/s]. *Control:*
        acceleration [m/s^2], steering [rad].
    - *Start:* at x = 0, y uniformly random in +-2 m, the heading in +-0.1 rad, vx
        within 5 m/s of the speed to hold, vy in +-0.5 m/s, the rate in +-0.2 rad/s.
    - *Cost:* `y^2 + heading^2 + 0.1 ((vx - speed*)^2 + vy^2 + rate^2) +
        0.1 acceleration^2 + steering^2` per step, where `speed*` is the speed to hold.
        The heading is wrapped.
    - *End:* never terminates.
    - *Features:* `encode` replaces the heading by its cosine and sine.

    **Arguments:**

    - `speed`: the speed to hold [m/s], 20 by default.
    - `max_acceleration`: the largest absolute value of the acceleration [m/s^2], 5 by
        default.
    - `max_steering`: the largest steering angle to either side [rad], 0.2 by default.

    Source: Rajamani, 2012.

    !!! example

        ```python
        import delucax as dlx

        icy = dlx.make("dynamic_bicycle", front_stiffness=3e4, rear_stiffness=3e4)
        ```
    """
    spread = [0.0, 2.0, 0.1, 5.0, 0.5, 0.2]
    return _lane_keeping(spread, speed, max_acceleration, max_steering)


_WINDS: dict[str, Callable[..., Any]] = {
    "dissipative": DissipativeWind,
    "constant": ConstantWind,
    "vortices": VortexWind,
}


def _wind(
    *, wind: str | Callable[..., Array] | None = None, wind_strength: Any = None
) -> dict[str, Any]:
    """The wind of a system, from its name or as it is."""
    where = "planar_quadrotor"
    if not isinstance(wind, str):
        if wind_strength is not None:
            raise ValueError(
                f"{where}: wind_strength needs the name of a wind, such as "
                f"'dissipative', got wind={wind!r}."
            )
        return dict(wind=wind)
    if wind not in _WINDS:
        raise ValueError(
            f"{where}: wind must be one of {', '.join(map(repr, _WINDS))}, a "
            f"function (t, x) -> force, or None, got {wind!r}."
        )
    return dict(wind=_WINDS[wind](0.1 if wind_strength is None else wind_strength))


@task(PlanarQuadrotor, dt=0.05, horizon=100, solver=diffrax.Euler(), arguments=_wind)
def planar_quadrotor(system: PlanarQuadrotor) -> Fields:
    """Fly a planar quadrotor to the origin and hover there.

    - *State:* x [m], y [m], angle [rad], vx [m/s], vy [m/s], rate [rad/s]. *Control:*
        the thrusts left [N] and right [N], without bounds. *Disturbance:* force_x [N],
        force_y [N].
    - *Start:* at rest at (1, 1).
    - *Cost:* `|x|^2 + 0.1 |u - u*|^2` per step, where each entry of `u*` is half of the
        weight of the quadrotor, with or without wind.
    - *End:* never terminates.

    The default solver is explicit Euler, as in the paper.

    **Arguments:**

    - `wind`: the name of a wind or a function `(t, x) -> force`. The names
        `"dissipative"`, `"constant"` and `"vortices"` stand for
        [`delucax.systems.DissipativeWind`][], [`delucax.systems.ConstantWind`][] and
        [`delucax.systems.VortexWind`][]. None by default.
    - `wind_strength`: the strength of the wind if `wind` is a name, 0.1 by default.

    Source: Gradu et al., 2021 (Deluca).

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("planar_quadrotor", wind="dissipative", wind_strength=0.4)
        ```
    """
    windless = PlanarQuadrotor(system.mass, system.length, system.gravity)
    # The wind is left out, because the paper's cost is that of a model without wind.
    _, hover = windless.equilibrium()
    return dict(
        cost=Quadratic([1.0] * 6, [0.1] * 2, control_target=hover),
        initial_state=[1.0, 1.0, 0.0, 0.0, 0.0, 0.0],
    )


# The bound of the entries of a rotation matrix, with room for rounding.
_ROTATION = 1.00001


class _Start(eqx.Module):
    """A state drawn from a box, with its quaternion normalised."""

    box: UniformState

    def __call__(self, key: PRNGKey) -> Array:
        return Quadrotor.project(self.box(key))


def quadrotor_features(x: State) -> Vector:
    """The state, with the quaternion replaced by the rotation matrix, which is the same
    for q and -q."""
    return jnp.concatenate([x[:3], Quadrotor.rotation(x), x[7:]])


@task(Quadrotor, dt=0.02, horizon=250)
def quadrotor(system: Quadrotor, *, max_thrust: Limit = 6.0) -> Fields:
    r"""Fly a quadrotor to the origin and hover there.

    - *State:* 13 entries: position [m], quaternion, velocity [m/s], body rates [rad/s].
        *Control:* the thrusts front, left, back and right [N]; or with
        `inputs="wrench"` thrust [N] and torques [N m]. *Disturbance:* a force [N].
    - *Start:* the position uniformly random in +-1 m, the velocity in +-0.5 m/s, the
        rates in +-0.5 rad/s, the attitude tilted by up to about 40 degrees.
    - *Cost:* $|p|^2 + |q - q^*|^2 + 0.1 (|v|^2 + |\omega|^2) + 0.1 |u - u^*|^2$ per
        step, with the attitude $q^*$ and the control $u^*$ of hovering.
    - *End:* never terminates.
    - *Features:* `encode` gives position, rotation matrix from body to world (row by
        row), velocity and body rates, shape `(18,)`. The rotation matrix is the same
        for $q$ and $-q$.

    **Arguments:**

    - `max_thrust`: the largest thrust of a rotor [N], 6 by default; the smallest is 0.
        With `inputs="wrench"`, the thrust and each torque are bounded by the largest
        value that the rotors can give.

    Source: Mahony, Kumar and Corke, 2012; Furrer, Burri, Achtelik and Siegwart, 2016.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("quadrotor", mass=0.8)
        ```
    """
    x, hover = system.equilibrium()
    low, high = 0.0, as_float_array(max_thrust)
    if system.inputs == "wrench":
        turn, yaw = system.arm * high, 2 * system.moment * high
        high = jnp.stack([4 * high, turn, turn, yaw])
        low = -high.at[0].set(0.0)
    feature_bound = [FLOAT32_MAX] * 3 + [_ROTATION] * 9 + [FLOAT32_MAX] * 6
    spread = [1.0] * 3 + [0.0] + [0.2] * 3 + [0.5] * 6
    weights = [1.0] * 7 + [0.1] * 6, [0.1] * 4
    target = dict(state_target=x, control_target=hover)
    return dict(
        cost=Quadratic(*weights, difference=Quadrotor.difference, **target),
        initial_state=_Start(UniformState(*box(spread, x))),
        control_bounds=(low, high),
        encode=quadrotor_features,
        observation_bounds=box(feature_bound),
    )


class ReacherCost(AbstractCost):
    """The cost `|tip - goal|^2 + torque_weight |torques|^2`."""

    system: Reacher
    goal: Real = parameter()
    torque_weight: Real = parameter(0.1)

    def __check_init__(self):
        as_vector(self.goal, 2, "goal", "ReacherCost")
        check_finite(self.goal, "goal", "ReacherCost")

    def offset(self, x: State) -> Vector:
        """The position of the tip relative to the goal."""
        return self.system.tip(x) - self.goal.astype(x.dtype)

    def __call__(self, t: Time, x: State, u: Control) -> Scalar:
        offset = self.offset(x)
        effort = self.torque_weight * (u[0] * u[0] + u[1] * u[1])
        return offset[0] * offset[0] + offset[1] * offset[1] + effort


class _ReacherFeatures(eqx.Module):
    """Cosines and sines of the angles, the rates, and `tip - goal`."""

    cost: ReacherCost

    def __call__(self, x: State) -> Vector:
        offset = self.cost.offset(x)
        angles = [cos(x[0]), sin(x[0]), cos(x[1]), sin(x[1])]
        return jnp.stack([*angles, x[2], x[3], offset[0], offset[1]])


@host_unless_traced
def _feature_bounds(system: Reacher, goal: Vector) -> tuple[Vector, Vector]:
    reach = system.length_1 + system.length_2
    spread = [1.0] * 4 + [FLOAT32_MAX] * 2 + [reach] * 2
    return box(spread, [0.0] * 6 + [-goal[0], -goal[1]])


@task(Reacher, dt=0.01, horizon=200, solver=diffrax.Euler())
def reacher(
    system: Reacher, *, goal: ArrayLike | tuple[float, float] = (0.0, 1.8)
) -> Fields:
    """Bring the tip of an arm with two links to a goal position.

    - *State:* shoulder [rad], elbow [rad], shoulder_rate [rad/s], elbow_rate [rad/s].
        *Control:* shoulder_torque [N m], elbow_torque [N m], without bounds.
    - *Start:* at rest at the angles (pi/4, pi/2).
    - *Cost:* `|tip - goal|^2 + 0.1 |torques|^2` per step.
    - *End:* never terminates.
    - *Features:* `encode` gives cosines and sines of the angles, the rates and
        `tip - goal`.

    The default solver is explicit Euler, as in the paper.

    The dynamics, the cost and `encode` each hold the parameters of the arm. To change
    these parameters, call this function again (under `jax.vmap` for a batch), because
    [`delucax.replace`][] would change the parameters in only one of these three places.

    **Arguments:**

    - `goal`: position of the goal [m], shape `(2,)`; (0, 1.8) by default.

    Source: Gradu et al., 2021 (Deluca).

    !!! example

        ```python
        import delucax as dlx

        model = dlx.make("reacher")
        plant = dlx.make("reacher", gravity=-10.0)
        ```
    """
    cost = ReacherCost(system, goal)
    return dict(
        cost=cost,
        initial_state=[np.pi / 4, np.pi / 2, 0.0, 0.0],
        encode=_ReacherFeatures(cost),
        observation_bounds=_feature_bounds(system, cost.goal),
    )
