"""Tasks that no linear controller solves: swing up, flip, carry, drift and ignite."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .._check import FLOAT32_MAX
from .._module import parameter
from .._typing import BoolScalar, Numbers, Real, State, Time, Vector
from ..costs import Quadratic
from ..math import cos, sin
from ..systems import (
    AbstractSystem,
    CartPole,
    CSTR,
    DoublePendulumCart,
    DriftingCar,
    FurutaPendulum,
    PlanarQuadrotor,
    SlungLoad,
)
from ._task import box, Fields, Limit, Number, once, Positive, task, UniformState


class _Chord(eqx.Module):
    """`x - x_ref`, where the difference `d` of each angle becomes `2 sin(d / 2)`.

    Its square, `2 (1 - cos(d))`, is smooth all around the circle, and near `d^2` for
    small differences.
    """

    angles: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, x: State, x_ref: State) -> Vector:
        d = x - x_ref
        parts = [2 * sin(p / 2) if i in self.angles else p for i, p in enumerate(d)]
        return jnp.stack(parts)


class _Features(eqx.Module):
    """The state, with each angle replaced by its cosine and sine."""

    angles: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, x: State) -> Vector:
        parts = []
        for i, p in enumerate(x):
            parts += [cos(p), sin(p)] if i in self.angles else [p]
        return jnp.stack(parts)


def _turning(system: AbstractSystem, weights: Numbers, effort: Numbers) -> Fields:
    """The cost about the equilibrium, the features and their bounds, for a system with
    angles that turn all the way around."""
    names = system.state_names
    angles = tuple(i for i, name in enumerate(names) if name in system.angle_names)
    x, u = system.equilibrium()
    chord = _Chord(angles)
    bound = [[1.0, 1.0] if i in angles else [FLOAT32_MAX] for i in range(len(names))]
    return dict(
        cost=Quadratic(
            weights, effort, state_target=x, control_target=u, difference=chord
        ),
        encode=_Features(angles),
        observation_bounds=box(sum(bound, [])),
    )


class _OffTrack(eqx.Module):
    """Whether the cart has left the track."""

    max_position: Real = parameter()

    def __call__(self, t: Time, x: State) -> BoolScalar:
        return abs(x[0]) > self.max_position


def _on_track(
    fields: Fields,
    start: UniformState,
    max_force: Limit,
    max_position: Positive,
    exit_cost: Number,
) -> Fields:
    """`fields` for a cart on a track. Leaving the track ends the episode."""
    off = _OffTrack(max_position)
    return fields | dict(
        cost=fields["cost"] + once(off, exit_cost),
        initial_state=start,
        control_bounds=(-max_force, max_force),
        terminated=off,
    )


@task(CartPole, dt=0.04, horizon=125)
def cartpole_swing_up(
    system: CartPole,
    *,
    max_force: Limit = 10.0,
    max_position: Positive = 2.4,
    exit_cost: Number = 1000.0,
) -> Fields:
    """Swing a pole up from hanging and keep it upright, on a short track.

    - *State:* position [m], velocity [m/s], angle [rad], 0 upright; spin [rad/s].
        *Control:* force [N].
    - *Start:* the position uniformly random in +-0.5 m, the angle within 0.2 rad of
        hanging, the velocity and the spin in +-0.1.
    - *Cost:* `0.1 position^2 + 2 (1 - cos(angle)) + 0.01 (velocity^2 + spin^2) +
        0.001 force^2` per step.
    - *End:* when the cart leaves the track. Leaving the track costs `exit_cost`, which
        is more than the cost of a whole episode in which the pendulum only hangs.
    - *Features:* `encode` replaces the angle by its cosine and sine.

    The largest force is smaller than the weight of the cart and the pole, so a swing-up
    takes two or three pushes.

    **Arguments:**

    - `max_force`: the largest absolute value of the force [N], 10 by default.
    - `max_position`: the distance from the centre to an end of the track [m], 2.4 by
        default.
    - `exit_cost`: the cost of leaving the track, 1000 by default.

    Source: Barto, Sutton and Anderson, 1983 (the plant); Tassa et al., 2018 (the task).

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("cartpole_swing_up", max_position=1.0)
        ```
    """
    start = UniformState(*box([0.5, 0.1, 0.2, 0.1], [0.0, 0.0, np.pi, 0.0]))
    fields = _turning(system, [0.1, 0.01, 1.0, 0.01], [0.001])
    return _on_track(fields, start, max_force, max_position, exit_cost)


@task(DoublePendulumCart, dt=0.04, horizon=100, substeps=2)
def double_pendulum_cart(
    system: DoublePendulumCart,
    *,
    max_force: Limit = 40.0,
    max_position: Positive = 3.0,
    exit_cost: Number = 1500.0,
) -> Fields:
    """Swing up both rods of a double pendulum on a cart, and keep them upright.

    - *State:* position [m], angle_1 [rad], angle_2 [rad], both 0 upright; velocity
        [m/s], spin_1 [rad/s], spin_2 [rad/s]. *Control:* force [N].
    - *Start:* at rest, the position uniformly random in +-0.1 m, the angles within 0.1
        rad of hanging.
    - *Cost:* `0.1 position^2 + 2 (1 - cos(angle_1)) + 2 (1 - cos(angle_2)) +
        0.01 (velocity^2 + spin_1^2 + spin_2^2) + 0.0003 force^2` per step.
    - *End:* when the cart leaves the track. Leaving the track costs `exit_cost`, which
        is more than the cost of a whole episode in which the pendulum only hangs.
    - *Features:* `encode` replaces each angle by its cosine and sine.

    A planner with a horizon of one second swings the rods up within 1.5 seconds. A
    linear controller can balance the rods only if they start within a few degrees of
    upright.

    **Arguments:**

    - `max_force`: the largest absolute value of the force [N], 40 by default.
    - `max_position`: the distance from the centre to an end of the track [m], 3 by
        default.
    - `exit_cost`: the cost of leaving the track, 1500 by default.

    Source: Bogdanov, 2004 (the plant); Graichen, Treuer and Zeitz, 2007 (the task).

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("double_pendulum_cart", max_force=60.0)
        ```
    """
    hanging = [0.0, np.pi, np.pi, 0.0, 0.0, 0.0]
    start = UniformState(*box([0.1, 0.1, 0.1, 0.0, 0.0, 0.0], hanging))
    fields = _turning(system, [0.1, 1.0, 1.0, 0.01, 0.01, 0.01], [0.0003])
    return _on_track(fields, start, max_force, max_position, exit_cost)


@task(FurutaPendulum, dt=0.02, horizon=150)
def furuta(system: FurutaPendulum, *, max_voltage: Limit = 5.0) -> Fields:
    """Swing up a pendulum at the end of a turning arm, and keep it upright.

    - *State:* arm [rad], angle [rad], 0 upright; arm_rate [rad/s], spin [rad/s].
        *Control:* voltage [V].
    - *Start:* the arm uniformly random in +-0.5 rad, the angle within 0.2 rad of
        hanging, the rates in +-0.5 rad/s.
    - *Cost:* `0.1 arm^2 + 2 (1 - cos(angle)) + 0.001 (arm_rate^2 + spin^2) + 0.001
        voltage^2` per step. The cost does not wrap the angle of the arm, because every
        turn of the arm winds up its cable.
    - *End:* never terminates.
    - *Features:* `encode` replaces the angle by its cosine and sine.

    A swing-up takes three or four pushes of the motor.

    **Arguments:**

    - `max_voltage`: the largest absolute value of the voltage [V], 5 by default. The
        motor itself would allow 10 V.

    Source: Furuta, Yamakita and Kobayashi, 1992; Cazzolato and Prime, 2011.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("furuta", max_voltage=8.0)
        ```
    """
    start = UniformState(*box([0.5, 0.2, 0.5, 0.5], [0.0, np.pi, 0.0, 0.0]))
    fields = _turning(system, [0.1, 1.0, 0.001, 0.001], [0.001])
    bounds = (-max_voltage, max_voltage)
    return fields | dict(initial_state=start, control_bounds=bounds)


@task(PlanarQuadrotor, dt=0.04, horizon=100)
def quadrotor_flip(system: PlanarQuadrotor, *, max_thrust: Limit = 1.0) -> Fields:
    """Flip a planar quadrotor that is upside down, and bring it back to the origin.

    - *State:* x [m], y [m], angle [rad], vx [m/s], vy [m/s], rate [rad/s]. *Control:*
        thrusts left and right [N], not negative. *Disturbance:* force_x, force_y [N].
    - *Start:* x and y uniformly random in +-0.5 m, the angle within 0.5 rad of upside
        down, the velocities in +-0.5 m/s, the rate in +-1 rad/s.
    - *Cost:* `x^2 + y^2 + 2 (1 - cos(angle)) + 0.1 (vx^2 + vy^2) + 0.01 rate^2 + 0.1 |u
        - u*|^2` per step, where each entry of `u*` is half of the weight of the
        quadrotor.
    - *End:* never terminates.
    - *Features:* `encode` replaces the angle by its cosine and sine.

    The quadrotor falls by 2 or 3 m while it turns, because its rotors push it down
    while it is upside down.

    **Arguments:**

    - `max_thrust`: the largest thrust of a rotor [N], 1 by default, which is about the
        weight of the quadrotor.

    Source: Gradu et al., 2021 (the plant); Lupashin, Schöllig, Sherback and D'Andrea,
    2010 (flips).

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("quadrotor_flip", max_thrust=0.8)
        ```
    """
    spread = [0.5, 0.5, 0.5, 0.5, 0.5, 1.0]
    start = UniformState(*box(spread, [0.0, 0.0, np.pi, 0.0, 0.0, 0.0]))
    fields = _turning(system, [1.0, 1.0, 1.0, 0.1, 0.1, 0.01], [0.1, 0.1])
    bounds = (0.0, max_thrust)
    return fields | dict(initial_state=start, control_bounds=bounds)


@task(SlungLoad, dt=0.05, horizon=120)
def slung_load(system: SlungLoad, *, max_thrust: Limit = 5.0) -> Fields:
    """Carry a load on a cable to the origin, and stop it there without swing.

    - *State:* x [m] and y [m] of the load, angle [rad], swing [rad], vx [m/s], vy
        [m/s], rate [rad/s], swing_rate [rad/s]. *Control:* the thrusts left [N] and
        right [N], not negative.
    - *Start:* x and y uniformly random in +-4 m, the angle in +-0.1 rad, the swing in
        +-0.8 rad, the velocities and rates in +-0.5.
    - *Cost:* `x^2 + y^2 + 2 (1 - cos(angle)) + 2 (1 - cos(swing)) + 0.1 (vx^2 + vy^2 +
        swing_rate^2) + 0.01 rate^2 + 0.01 |u - u*|^2` per step, where each entry of
        `u*` is half of the weight of the quadrotor with its load.
    - *End:* never terminates.
    - *Features:* `encode` replaces each angle by its cosine and sine.

    From a start up to 4 m from the origin, a linear controller demands too much thrust,
    and the quadrotor tips over.

    **Arguments:**

    - `max_thrust`: the largest thrust of a rotor [N], 5 by default; the quadrotor and
        its load weigh 5.9 N.

    Source: Sreenath, Lee and Kumar, 2013.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("slung_load", load=0.2, max_thrust=6.0)
        ```
    """
    start = UniformState(*box([4.0, 4.0, 0.1, 0.8, 0.5, 0.5, 0.5, 0.5]))
    weights = [1.0, 1.0, 1.0, 1.0, 0.1, 0.1, 0.01, 0.1]
    fields = _turning(system, weights, [0.01, 0.01])
    bounds = (0.0, max_thrust)
    return fields | dict(initial_state=start, control_bounds=bounds)


@task(DriftingCar, dt=0.04, horizon=125)
def drift(
    system: DriftingCar,
    *,
    speed: Positive = 8.0,
    steering: Number = -12 * 2 * np.pi / 360,
    max_force: Limit = 4500.0,
    max_steering: Limit = 0.6,
) -> Fields:
    """Bring a car from driving straight ahead into a drift, and hold the drift.

    - *State:* vx [m/s], vy [m/s], rate [rad/s]. *Control:* force [N], steering [rad].
    - *Start:* vx within 2 m/s of the speed of the drift, vy in +-0.2 m/s, the rate in
        +-0.1 rad/s.
    - *Cost:* `(vx - vx*)^2 + (vy - vy*)^2 + 10 (rate - rate*)^2 + 1e-7 (force -
        force*)^2 + (steering - steering*)^2` per step. Here `vx*`, `vy*`, `rate*`,
        `force*` and `steering*` are the states and controls of the drift to be held,
        which is to the left and is an unstable equilibrium.
    - *End:* never terminates.

    **Arguments:**

    - `speed`: the forward velocity vx of the drift [m/s], 8 by default.
    - `steering`: steering angle of the drift [rad], 12 degrees to the right by default.
    - `max_force`: the largest absolute value of the force [N], 4500 by default, which
        is nine tenths of the largest friction force of the rear tyre.
    - `max_steering`: the largest steering angle to either side [rad], 0.6 by default.

    Source: Voser, Hindiyeh and Gerdes, 2010; Hindiyeh and Gerdes, 2014.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("drift", speed=10.0, steering=-0.3)
        ```
    """
    x, u = system.equilibrium(speed, steering)
    weights = [1.0, 1.0, 10.0], [1e-7, 1.0]
    ahead = jnp.zeros(3, x.dtype).at[0].set(x[0])
    return dict(
        cost=Quadratic(*weights, state_target=x, control_target=u),
        initial_state=UniformState(*box([2.0, 0.2, 0.1], ahead)),
        control_bounds=box([max_force, max_steering]),
    )


class _RunsAway(eqx.Module):
    """Whether the reactor is too hot."""

    max_temperature: Real = parameter()

    def __call__(self, t: Time, x: State) -> BoolScalar:
        return x[1] > self.max_temperature


@task(CSTR, dt=0.05, horizon=120, substeps=8)
def reactor_start_up(
    system: CSTR,
    *,
    concentration: Positive = 0.3,
    min_coolant: Limit = 290.0,
    max_coolant: Limit = 310.0,
    max_temperature: Positive = 380.0,
    shutdown_cost: Number = 5000.0,
) -> Fields:
    """Start a stirred-tank reactor from cold, and hold it where most of the feed
    reacts.

    - *State:* concentration [mol/l], temperature [K]. *Control:* coolant [K]. Time is
        in minutes.
    - *Start:* the concentration uniformly random in [0.9, 1] mol/l, so that hardly any
        of the feed has reacted, and the temperature in [295, 305] K.
    - *Cost:* `10 (c - c*)^2 + 0.01 (T - T*)^2 + 0.01 (T_coolant - T_coolant*)^2` per
        step. Here `c*`, `T*` and `T_coolant*` are the values at the equilibrium whose
        concentration is the argument `concentration`.
    - *End:* above `max_temperature`. A shutdown costs `shutdown_cost`, which is more
        than the cost of a whole episode in which the controller does nothing.

    The plant is the same as in [`delucax.environments.cstr`][]. But here the cooling
    jacket must first heat the reactor, and the linear model at the goal has two
    unstable poles. With too little heat the reaction never starts; with too much heat
    the reaction runs away.

    **Arguments:**

    - `concentration`: the concentration to hold [mol/l], below the concentration of the
        feed; 0.3 by default.
    - `min_coolant`, `max_coolant`: the lowest and the highest temperature of the
        coolant [K], 290 and 310 by default.
    - `max_temperature`: the temperature above which the reactor is shut down [K], 380
        by default.
    - `shutdown_cost`: the cost of a shutdown, 5000 by default.

    Source: Henson and Seborg, 1997.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("reactor_start_up", max_coolant=320.0)
        ```
    """
    x, u = system.equilibrium(concentration)
    cost = Quadratic([10.0, 0.01], [0.01], state_target=x, control_target=u)
    hot = _RunsAway(max_temperature)
    return dict(
        cost=cost + once(hot, shutdown_cost),
        initial_state=UniformState([0.9, 295.0], [1.0, 305.0]),
        control_bounds=(min_coolant, max_coolant),
        terminated=hot,
    )
