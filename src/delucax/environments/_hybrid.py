"""Tasks with events: bounce, roll, walk, switch, slip and land."""

import equinox as eqx
import jax.numpy as jnp

from .._module import parameter
from .._typing import BoolScalar, Control, Real, Scalar, State, Time
from ..costs import AbstractCost, Quadratic
from ..math import cos
from ..systems import (
    BouncingBall,
    CompassGait,
    RimlessWheel,
    StickSlip,
    Thermostat,
    ValveWithStops,
)
from ._task import box, Fields, Limit, Number, once, Positive, task, UniformState


def peak(system: BouncingBall, x: State) -> Scalar:
    """How high the ball would fly without drag and force."""
    return x[0] + x[1] * x[1] / (2 * system.gravity)


class PeakCost(AbstractCost):
    """`(peak - height)^2 + force_weight force^2`."""

    system: BouncingBall
    height: Real = parameter()
    force_weight: Real = parameter(0.01)

    def __call__(self, t: Time, x: State, u: Control) -> Scalar:
        lack = peak(self.system, x) - self.height
        return lack * lack + self.force_weight * (u[0] * u[0])


class _Rests(eqx.Module):
    """Whether the ball no longer bounces high."""

    system: BouncingBall
    low: Real = parameter(0.05)

    def __call__(self, t: Time, x: State) -> BoolScalar:
        return peak(self.system, x) < self.low


@task(
    BouncingBall,
    dt=0.05,
    horizon=200,
    arguments=lambda *, drag=0.02: dict(drag=drag),
)
def bouncing_ball(
    system: BouncingBall,
    *,
    height: Positive = 2.0,
    max_force: Limit = 3.0,
    rest_cost: Number = 1000.0,
) -> Fields:
    """Keep a ball bouncing up to a given height, with a force smaller than its weight.

    - *State:* height [m], velocity [m/s]. *Control:* force [N].
    - *Start:* at rest, at a height uniformly random in [0.5, 1.5] m.
    - *Cost:* `(peak - height)^2 + 0.01 force^2` per step. Here `height` is the argument
        of this function, and `peak` is the height that the ball would reach without
        drag and force: the current height of the ball plus `velocity^2 / (2 gravity)`.
    - *End:* when the peak is below 0.05 m. This end of the episode costs `rest_cost`.
        The episode ends before the bounces become infinitely frequent, unless the
        restitution is below 0.2.

    The dynamics, the cost and the condition of termination each hold the parameters of
    the ball. To change these parameters, call this function again (under `jax.vmap` for
    a batch), because [`delucax.replace`][] would change the parameters in only one of
    these three places.

    **Arguments:**

    - `drag`: drag of the ball [kg/m], 0.02 by default.
    - `height`: the height to which the ball should bounce [m], 2 by default.
    - `max_force`: the largest absolute value of the force [N], 3 by default.
    - `rest_cost`: the cost if the ball comes to rest, 1000 by default.

    Source: Goebel, Sanfelice and Teel, 2012.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("bouncing_ball", restitution=0.9)
        ```
    """
    rests = _Rests(system)
    return dict(
        cost=PeakCost(system, height) + once(rests, rest_cost),
        initial_state=UniformState([0.5, 0.0], [1.5, 0.0]),
        control_bounds=(-max_force, max_force),
        terminated=rests,
    )


class _RollsBack(eqx.Module):
    """Whether the wheel rolls back, because it did not come over a spoke."""

    def __call__(self, t: Time, x: State) -> BoolScalar:
        return x[1] < 0


@task(RimlessWheel, dt=0.05, horizon=200)
def rimless_wheel(
    system: RimlessWheel,
    *,
    speed: Number = 2.0,
    max_torque: Limit = 2.0,
    stall_cost: Number = 500.0,
) -> Fields:
    """Roll a wheel that has spokes but no rim down a gentle slope, faster than the
    wheel rolls by itself.

    - *State:* angle [rad], velocity [rad/s]. *Control:* torque [N m].
    - *Start:* the angle uniformly random in +-0.2 rad about the vertical, the velocity
        in [0.8, 1.6] rad/s.
    - *Cost:* `(velocity - speed)^2 + 0.1 torque^2` per step.
    - *End:* when the wheel rolls backwards, which costs `stall_cost`.

    **Arguments:**

    - `speed`: the velocity to hold [rad/s], 2 by default.
    - `max_torque`: the largest absolute value of the torque [N m], 2 by default, which
        is about half of the torque by which gravity keeps a standing wheel from
        rolling.
    - `stall_cost`: the cost if the wheel rolls backwards, 500 by default.

    Source: McGeer, 1990; Coleman, Chatterjee and Ruina, 1997.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("rimless_wheel", slope=0.0)
        ```
    """
    back = _RollsBack()
    cost = Quadratic([0.0, 1.0], [0.1], state_target=[0.0, speed])
    return dict(
        cost=cost + once(back, stall_cost),
        initial_state=UniformState([-0.2, 0.8], [0.2, 1.6]),
        control_bounds=(-max_torque, max_torque),
        terminated=back,
    )


class WalkingCost(AbstractCost):
    """`(v - speed)^2 + torque_weight torque^2`, where `v` is the speed of the hip along
    the slope."""

    system: CompassGait
    speed: Real = parameter()
    torque_weight: Real = parameter(0.001)

    def __call__(self, t: Time, x: State, u: Control) -> Scalar:
        leg = self.system.lower + self.system.upper
        # Walking turns the stance leg forwards, to smaller angles.
        lack = -leg * cos(x[1] + self.system.slope) * x[3] - self.speed
        return lack * lack + self.torque_weight * (u[0] * u[0])


class _Falls(eqx.Module):
    """Whether the stance leg leans too far from the normal of the slope, or the swing
    foot is still below the ground after the legs have passed each other."""

    system: CompassGait
    max_lean: Real = parameter(0.8)

    def __call__(self, t: Time, x: State) -> BoolScalar:
        u = jnp.zeros(1, x.dtype)
        (height,), (ahead,) = self.system.guards(t, x, u), self.system.enabled(t, x, u)
        leans = abs(x[1] + self.system.slope) > self.max_lean
        # The tolerance is for a foot that strikes at the end of an interval: the next
        # one begins with this step.
        return leans | ahead & (height < -(jnp.finfo(x.dtype).eps ** 0.6))


@task(CompassGait, dt=0.05, horizon=200)
def compass_gait(
    system: CompassGait,
    *,
    speed: Number = 0.73,
    max_torque: Limit = 10.0,
    fall_cost: Number = 200.0,
) -> Fields:
    """Walk on two straight legs with a motor at the hip.

    - *State:* swing [rad], stance [rad], swing rate [rad/s], stance rate [rad/s].
        *Control:* torque [N m].
    - *Start:* near the state in which a step of the passive gait on a slope of 3
        degrees begins, with the angles within 0.01 rad and the rates within 0.03 rad/s
        of this state.
    - *Cost:* `(v - speed)^2 + 0.001 torque^2` per step, where `v` is the speed of the
        hip along the slope.
    - *End:* when the walker trips or falls over. It trips if the swing foot is still
        below the ground after the legs have passed each other. It falls over if the
        stance leg leans by more than 0.8 rad from the normal of the slope. Both cost
        `fall_cost`.

    On the default slope of 3 degrees the walker walks on without control. On level
    ground (`slope=0.0`) the walker slows down and falls.

    The dynamics, the cost and the condition of termination each hold the parameters of
    the walker. To change these parameters, call this function again (under `jax.vmap`
    for a batch), because [`delucax.replace`][] would change the parameters in only one
    of these three places.

    **Arguments:**

    - `speed`: the speed at which the hip should move [m/s], 0.73 by default, which is
        the speed of the passive gait on a slope of 3 degrees.
    - `max_torque`: the largest absolute value of the torque [N m], 10 by default; 0 for
        a passive walker.
    - `fall_cost`: the cost of tripping or falling over, 200 by default.

    Source: Goswami, Thuilot and Espiau, 1998.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("compass_gait", slope=0.0, max_torque=20.0)
        passive = dlx.make("compass_gait", max_torque=0.0)
        ```
    """
    falls = _Falls(system)
    # These angles put both feet on the ground.
    angles = [-0.27105 - system.slope, 0.27105 - system.slope]
    centre = jnp.stack([*angles, *map(jnp.asarray, (-0.3772, -1.0918))])
    return dict(
        cost=WalkingCost(system, speed) + once(falls, fall_cost),
        initial_state=UniformState(*box([0.01, 0.01, 0.03, 0.03], centre)),
        control_bounds=(-max_torque, max_torque),
        terminated=falls,
    )


@task(Thermostat, dt=0.1, horizon=240)
def thermostat(
    system: Thermostat, *, target: Number = 20.0, max_heat: Limit = 2.0
) -> Fields:
    """Reduce the temperature swings in a room whose heater is switched by a thermostat.
    The control is a heat pump that is too weak to heat the room alone.

    - *State:* temperature [degC], mode. *Control:* heat [kW]. Time is in hours.
    - *Start:* the heater is off, the temperature uniformly random in [19.2, 20.8] degC.
    - *Cost:* `(temperature - target)^2 + 0.01 heat^2` per step.
    - *End:* never terminates.

    **Arguments:**

    - `target`: the temperature to hold [degC], 20 by default.
    - `max_heat`: the largest heating or cooling power of the heat pump [kW], 2 by
        default. To hold the default target, the room needs 3 kW of heat.

    Source: Ihara and Schweppe, 1981.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("thermostat", outside=-5.0, power=10.0)
        ```
    """
    return dict(
        cost=Quadratic([1.0, 0.0], [0.01], state_target=[target, 0.0]),
        initial_state=UniformState([19.2, 0.0], [20.8, 0.0]),
        control_bounds=(-max_heat, max_heat),
    )


@task(
    StickSlip,
    dt=0.05,
    horizon=200,
    arguments=lambda *, damping=0.1: dict(damping=damping),
)
def stick_slip(system: StickSlip, *, max_force: Limit = 0.5) -> Fields:
    """Bring a mass on a moving belt to rest, so that the belt slides under the mass.

    - *State:* position [m], velocity [m/s], mode. *Control:* force [N].
    - *Start:* the mass sticks to the belt, the position uniformly random in +-0.1 m.
    - *Cost:* `100 (position - position*)^2 + 10 velocity^2 + force^2` per step, where
        `position*` is the position in which the mass can stay at rest.
    - *End:* never terminates.

    Without control the mass goes on sticking to the belt and slipping, again and again.

    **Arguments:**

    - `damping`: damping of the mass [N s/m], 0.1 by default.
    - `max_force`: the largest absolute value of the force [N], 0.5 by default, which is
        less than the static and the kinetic friction.

    Source: Popp and Stelter, 1990.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("stick_slip", static=2.0)
        ```
    """
    rest, _ = system.equilibrium()
    sticking = jnp.stack([0 * system.belt, system.belt, 0 * system.belt])
    return dict(
        cost=Quadratic([100.0, 10.0, 0.0], [1.0], state_target=rest),
        initial_state=UniformState(*box([0.1, 0.0, 0.0], sticking)),
        control_bounds=(-max_force, max_force),
    )


@task(ValveWithStops, dt=0.02, horizon=200)
def valve_with_stops(system: ValveWithStops, *, max_force: Limit = 25.0) -> Fields:
    """Bring the valve of an engine softly to its open stop, and hold the valve there.

    - *State:* position, velocity [1/s], mode. *Control:* force [N].
    - *Start:* the valve is between its stops, the position uniformly random in [0.2,
        0.8], the velocity in +-1 per second.
    - *Cost:* `10 (position - 1)^2 + 0.1 velocity^2 + 0.0002 force^2` per step.
    - *End:* never terminates.

    Without control the valve comes to rest between its stops. A force of 19.5 N holds
    the valve open.

    **Arguments:**

    - `max_force`: the largest absolute value of the force [N], 25 by default.

    Source: Hoffmann, Peterson and Stefanopoulou, 2003.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("valve_with_stops", restitution=0.5)
        ```
    """
    target = [1.0, 0.0, 0.0]
    return dict(
        cost=Quadratic([10.0, 0.1, 0.0], [2e-4], state_target=target),
        initial_state=UniformState([0.2, -1.0, 0.0], [0.8, 1.0, 0.0]),
        control_bounds=(-max_force, max_force),
    )
