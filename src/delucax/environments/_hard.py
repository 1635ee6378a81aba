"""Tasks that no linear law solves: swing up, flip, carry, drift and ignite."""

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
    """`x - x_ref` with `2 sin(d / 2)` for the difference d of each angle.

    Its square, `2 (1 - cos(d))`, is smooth all around the circle, and `d^2` for small
    differences.
    """

    angles: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, x: State, x_ref: State) -> Vector:
        d = x - x_ref
        parts = [2 * sin(p / 2) if i in self.angles else p for i, p in enumerate(d)]
        return jnp.stack(parts)


class _Features(eqx.Module):
    """The state with the cosine and the sine of each angle in its place."""

    angles: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, x: State) -> Vector:
        parts = []
        for i, p in enumerate(x):
            parts += [cos(p), sin(p)] if i in self.angles else [p]
        return jnp.stack(parts)


def _turning(system: AbstractSystem, weights: Numbers, effort: Numbers) -> Fields:
    """The cost about the equilibrium, the features and their bounds where some of the
    states are angles that go all the way around."""
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
    """`fields` on a track of which the end ends the episode."""
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
    """Swing a pole up from hanging and keep it upright, on a track that ends.

    State (position, velocity, angle, spin), upright at 0; control (force). Starts with
    the position uniform in +-0.5, the angle within 0.2 of hanging, and the velocities
    in +-0.1. Cost
    `0.1 position^2 + 2 (1 - cos(angle)) + 0.01 (velocity^2 + spin^2) + 0.001 force^2`
    per step. The episode ends, at `exit_cost`, when the cart leaves the track: that is
    more than an episode of hanging costs. `encode` gives the cosine and the sine of the
    angle in its place. The force is less than the weight of cart and pole, and the
    swing-up takes two or three pushes.

    **Arguments:**

    - `max_force`: 10 by default.
    - `max_position`: where the track ends, 2.4 by default.
    - `exit_cost`: 1000 by default.

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

    State (position, angle_1, angle_2, velocity, spin_1, spin_2), both angles measured
    from the upright; control (force). Starts near rest, with the position uniform in
    +-0.1 and the angles within 0.1 of hanging. Cost
    `0.1 position^2 + 2 (1 - cos(angle_1)) + 2 (1 - cos(angle_2)) +
    0.01 (velocity^2 + spin_1^2 + spin_2^2) + 0.0003 force^2` per step. The episode
    ends, at `exit_cost`, when the cart leaves the track: that is more than an episode
    of hanging costs. `encode` gives the cosine and the sine of each angle in its place.

    Plans that look ahead by a second swing it up within a second and a half. The
    upright is caught by a linear law only from within a few degrees.

    **Arguments:**

    - `max_force`: 40 by default.
    - `max_position`: where the track ends, 3 by default.
    - `exit_cost`: 1500 by default.

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

    State (arm, angle, arm_rate, spin), upright at 0; control (voltage). Starts with the
    arm uniform in +-0.5, the angle within 0.2 of hanging and the rates in +-0.5. Cost
    `0.1 arm^2 + 2 (1 - cos(angle)) + 0.001 (arm_rate^2 + spin^2) + 0.001 voltage^2` per
    step; a turn of the arm counts, as it winds up its cable. Never terminates. `encode`
    gives the cosine and the sine of the angle in its place. The swing-up takes three or
    four pushes of the motor.

    **Arguments:**

    - `max_voltage`: 5 by default, of 10 that the motor takes.

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

    State (x, y, angle, vx, vy, rate); control (left, right), the thrusts, neither
    negative; disturbance (force_x, force_y). Starts with x and y uniform in +-0.5, the
    angle within 0.5 of upside down, the velocities in +-0.5 and the rate in +-1. Cost
    `x^2 + y^2 + 2 (1 - cos(angle)) + 0.1 (vx^2 + vy^2) + 0.01 rate^2 + 0.1 |u - u*|^2`
    per step, u* being half of the weight. Never terminates. `encode` gives the cosine
    and the sine of the angle in its place. It falls by 2 or 3 m as it turns: what a
    rotor pushes then drives it down.

    **Arguments:**

    - `max_thrust`: of a rotor, 1 by default, about the weight.

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
    """Carry a load on a cable to the origin, and leave it there without swing.

    State (x, y, angle, swing, vx, vy, rate, swing_rate), x and y being those of the
    load; control (left, right), the thrusts, neither negative. Starts with x and y
    uniform in +-4, the angle in +-0.1, the swing in +-0.8 and what moves in +-0.5. Cost
    `x^2 + y^2 + 2 (1 - cos(angle)) + 2 (1 - cos(swing)) + 0.1 (vx^2 + vy^2 +
    swing_rate^2) + 0.01 rate^2 + 0.01 |u - u*|^2` per step, u* being half of the whole
    weight. Never terminates. `encode` gives the cosine and the sine of each angle in
    its place. From this far, a linear law asks for more than the rotors have, and tips
    over.

    **Arguments:**

    - `max_thrust`: of a rotor, 5 by default; 5.9 is the whole weight.

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
    """Make a car that drives straight ahead drift, and hold the drift.

    State (vx, vy, rate); control (force, steering). Starts with vx within 2 m/s of the
    speed of the drift, vy in +-0.2 m/s and the rate in +-0.1 rad/s. Cost
    `(vx - vx*)^2 + (vy - vy*)^2 + 10 (rate - rate*)^2 + 1e-7 (force - force*)^2 +
    (steering - steering*)^2` per step, measured from the drift to the left, which is an
    unstable equilibrium. Never terminates.

    **Arguments:**

    - `speed`: vx of the drift [m/s], 8 by default.
    - `steering`: of the drift [rad], 12 degrees to the right by default.
    - `max_force`: of the rear tyre, in either direction [N], 4500 by default, which is
        nine tenths of its grip.
    - `max_steering`: to either side [rad], 0.6 by default.

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

    State (concentration [mol/l], temperature [K]); control (coolant [K]). Starts with
    the concentration uniform in [0.9, 1] mol/l, hardly any having reacted, and the
    temperature in [295, 305] K. Cost
    `10 (c - c*)^2 + 0.01 (T - T*)^2 + 0.01 (T_coolant - T_coolant*)^2` per step, with
    the equilibrium at the concentration. The episode ends, at `shutdown_cost`, above
    the highest temperature. The time is in minutes.

    As in [`delucax.environments.cstr`][], but from where the jacket must heat first,
    and to a point with two unstable poles. Without enough heat the reaction never
    starts; with too much it runs away.

    **Arguments:**

    - `concentration`: to hold [mol/l], below that of the feed; 0.3 by default.
    - `min_coolant`, `max_coolant`: what the jacket can do [K], 290 and 310 by default.
    - `max_temperature`: above which the reactor is shut down [K], 380 by default.
    - `shutdown_cost`: 5000 by default, more than an episode of doing nothing costs.

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
