"""Regulation tasks with a quadratic cost."""

from collections.abc import Sequence
from typing import Any

from jaxtyping import Array

from .._typing import PRNGKey
from ..costs import Quadratic
from ..systems import (
    AbstractSystem,
    CSTR,
    DoubleIntegrator,
    Lorenz,
    MassSpringDamper,
    NeuralSystem,
    PermanentMagnetMotor,
    TwoTank,
    VanDerPol,
)
from ._task import box, Fields, Limit, Number, Positive, task, UniformState


def _regulation(
    cost: Quadratic,
    spread: Array | Sequence[float],
    bounds: tuple[Limit, Limit],
    centre: Array | Sequence[float] | float = 0.0,
) -> Fields:
    """The cost, a start within `spread` of `centre`, and bounds of the controls."""
    return dict(
        cost=cost,
        initial_state=UniformState(*box(spread, centre)),
        control_bounds=bounds,
    )


@task(DoubleIntegrator, dt=0.1, horizon=100)
def double_integrator(system: DoubleIntegrator, *, max_force: Limit = 1.0) -> Fields:
    """Bring a mass on a line to rest at the origin.

    - *State:* position [m], velocity [m/s]. *Control:* force [N].
    - *Start:* the position uniformly random in +-2 m, the velocity in +-1 m/s.
    - *Cost:* `|x|^2 + 0.1 force^2` per step.
    - *End:* never terminates.

    **Arguments:**

    - `max_force`: the largest absolute value of the force [N], 1 by default.

    Source: Åström and Murray, 2008.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("double_integrator", mass=2.0)
        ```
    """
    cost = Quadratic([1.0, 1.0], [0.1])
    return _regulation(cost, [2.0, 1.0], (-max_force, max_force))


@task(MassSpringDamper, dt=0.1, horizon=200)
def mass_spring_damper(system: MassSpringDamper, *, max_force: Limit = 1.0) -> Fields:
    """Bring a chain of masses and springs, by default of one mass, to rest with a force
    on the last mass.

    - *State:* positions [m], velocities [m/s]. *Control:* force [N].
    - *Start:* each state is uniformly random in +-1.
    - *Cost:* `|x|^2 + 0.1 force^2` per step.
    - *End:* never terminates.

    **Arguments:**

    - `max_force`: the largest absolute value of the force [N], 1 by default.

    Source: Åström and Murray, 2008.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("mass_spring_damper", masses=3)
        ```
    """
    ones = [1.0] * system.state_size
    return _regulation(Quadratic(ones, [0.1]), ones, (-max_force, max_force))


@task(VanDerPol, dt=0.05, horizon=200)
def van_der_pol(system: VanDerPol, *, max_control: Limit = 3.0) -> Fields:
    """Bring van der Pol's oscillator from its limit cycle to rest.

    - *State:* x, v. *Control:* u.
    - *Start:* each state is uniformly random in +-2.
    - *Cost:* `x^2 + v^2 + 0.1 u^2` per step.
    - *End:* never terminates.

    **Arguments:**

    - `max_control`: the largest absolute value of the control, 3 by default.

    Source: van der Pol, 1926.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("van_der_pol", mu=2.0)
        ```
    """
    cost = Quadratic([1.0, 1.0], [0.1])
    return _regulation(cost, [2.0, 2.0], (-max_control, max_control))


@task(Lorenz, dt=0.01, horizon=500)
def lorenz(system: Lorenz, *, max_control: Limit = 50.0) -> Fields:
    """Hold Lorenz's chaotic system at the centre of its right wing.

    - *State:* x, y, z. *Control:* u.
    - *Start:* x and y uniformly random in +-20, z in [10, 40].
    - *Cost:* `(x - x*)^2 + (y - y*)^2 + (z - z*)^2 + 0.001 u^2` per step, where `x*`,
        `y*` and `z*` are the coordinates of the equilibrium at this centre.
    - *End:* never terminates.

    **Arguments:**

    - `max_control`: the largest absolute value of the control, 50 by default.

    Source: Lorenz, 1963; Kaiser, Kutz and Brunton, 2018.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("lorenz", rho=24.0)
        ```
    """
    wing, _ = system.equilibrium()
    cost = Quadratic([1.0, 1.0, 1.0], [0.001], state_target=wing)
    middle = [0.0, 0.0, 25.0]
    return _regulation(cost, [20.0, 20.0, 15.0], (-max_control, max_control), middle)


@task(TwoTank, dt=2.0, horizon=200)
def two_tank(system: TwoTank, *, level: Limit = 10.0, max_flow: Limit = 30.0) -> Fields:
    """Hold the lower of two tanks at a given level.

    - *State:* the levels upper [cm] and lower [cm]. *Control:* flow [cm^3/s], not
        negative.
    - *Start:* the levels uniformly random in [0, 20] cm.
    - *Cost:* `(lower - level)^2 + 0.01 (flow - flow*)^2` per step, where `flow*` is the
        flow that holds the level.
    - *End:* never terminates.

    **Arguments:**

    - `level`: the level to hold [cm], 10 by default.
    - `max_flow`: the largest flow of the pump [cm^3/s], 30 by default.

    Source: Johansson, 2000.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("two_tank", level=12.0)
        ```
    """
    x, u = system.equilibrium(level)
    cost = Quadratic([0.0, 1.0], [0.01], state_target=x, control_target=u)
    return _regulation(cost, [10.0, 10.0], (0.0, max_flow), 10.0)


@task(CSTR, dt=0.05, horizon=100, substeps=4)
def cstr(
    system: CSTR,
    *,
    concentration: Positive = 0.5,
    min_coolant: Limit = 280.0,
    max_coolant: Limit = 320.0,
) -> Fields:
    """Hold a stirred-tank reactor at its unstable equilibrium.

    - *State:* concentration [mol/l], temperature [K]. *Control:* coolant [K]. Time is
        in minutes.
    - *Start:* the concentration within 0.05 mol/l, and the temperature within 3 K, of
        the equilibrium.
    - *Cost:* `10 (c - c*)^2 + 0.01 (T - T*)^2 + 0.01 (T_coolant - T_coolant*)^2` per
        step. Here `c*`, `T*` and `T_coolant*` are the values at the equilibrium whose
        concentration is the argument `concentration`.
    - *End:* never terminates.

    **Arguments:**

    - `concentration`: the concentration to hold [mol/l], below the concentration of the
        feed; 0.5 by default.
    - `min_coolant`, `max_coolant`: the lowest and the highest temperature of the
        coolant [K], 280 and 320 by default.

    Source: Henson and Seborg, 1997.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("cstr")
        mpc = dlx.controllers.MPC(env.dynamics, env.cost, 20, bounds=(280.0, 320.0))
        ```
    """
    x, u = system.equilibrium(concentration)
    cost = Quadratic([10.0, 0.01], [0.01], state_target=x, control_target=u)
    return _regulation(cost, [0.05, 3.0], (min_coolant, max_coolant), x)


@task(PermanentMagnetMotor, dt=0.0005, horizon=200)
def permanent_magnet_motor(
    system: PermanentMagnetMotor, *, speed: Number = 100.0, max_voltage: Limit = 150.0
) -> Fields:
    """Bring a synchronous motor to a given speed and hold it.

    - *State:* i_d [A], i_q [A], speed [rad/s]. *Control:* v_d [V], v_q [V].
        *Disturbance:* load [N m].
    - *Start:* the currents uniformly random in +-1 A, the speed in +-50 rad/s.
    - *Cost:* `0.01 |i - i*|^2 + 0.001 (speed - speed*)^2 + 1e-5 |v - v*|^2` per step,
        where `i*`, `speed*` and `v*` are the values at the equilibrium with the given
        speed and without load.
    - *End:* never terminates.

    **Arguments:**

    - `speed`: the speed to hold [rad/s], 100 by default.
    - `max_voltage`: the largest absolute value of each voltage [V], 150 by default.

    Source: Krause, Wasynczuk and Sudhoff, 2002.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        load = dlx.disturbances.Constant(jnp.array([0.5]))
        env = dlx.make("permanent_magnet_motor", speed=80.0, disturbance=load)
        ```
    """
    x, u = system.equilibrium(speed)
    Q, R = [0.01, 0.01, 0.001], [1e-5, 1e-5]
    cost = Quadratic(Q, R, state_target=x, control_target=u)
    return _regulation(cost, [1.0, 1.0, 50.0], (-max_voltage, max_voltage))


def _drawn(
    *, key: PRNGKey | None = None, states: Any = 2, controls: Any = 1, width: int = 32
) -> dict[str, Any]:
    """The arguments of a `NeuralSystem` with random weights."""
    if key is None:
        raise ValueError(
            "neural: pass a system, or a key to draw the weights of one, such as "
            "key=jax.random.key(0), got neither."
        )
    return dict(key=key, states=states, controls=controls, width=width)


@task(NeuralSystem, dt=0.05, horizon=100, arguments=_drawn, accepts=AbstractSystem)
def neural(system: AbstractSystem, *, max_control: Limit = 1.0) -> Fields:
    """Bring the state of a learned vector field to the origin.

    - *Start:* each state is uniformly random in +-1.
    - *Cost:* `|x|^2 + 0.1 |u|^2` per step.
    - *End:* never terminates.

    Pass a `system`, such as a network that was fitted to data, or a `key` for a network
    with random weights.

    **Arguments:**

    - `key`: a random key, with which the random weights of the network are drawn.
    - `states`, `controls`, `width`: the number of states, the number of controls and
        the width of the network with random weights, 2, 1 and 32 by default; see
        [`delucax.systems.NeuralSystem`][].
    - `max_control`: the largest absolute value of each control, 1 by default.

    Source: Chen, Rubanova, Bettencourt and Duvenaud, 2018.

    !!! example

        ```python
        import delucax as dlx
        import jax

        env = dlx.make("neural", key=jax.random.key(0), states=3)
        again = dlx.make("neural", system=env.dynamics.system)
        ```
    """
    ones = [1.0] * system.state_size
    cost = Quadratic(ones, [0.1] * system.control_size)
    return _regulation(cost, ones, (-max_control, max_control))
