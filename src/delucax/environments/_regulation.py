"""Set-point regulation tasks with a quadratic cost."""

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
    """A start within `spread` of `centre`, and bounds of the controls."""
    return dict(
        cost=cost,
        initial_state=UniformState(*box(spread, centre)),
        control_bounds=bounds,
    )


@task(DoubleIntegrator, dt=0.1, horizon=100)
def double_integrator(system: DoubleIntegrator, *, max_force: Limit = 1.0) -> Fields:
    """Bring a mass on a line to rest at the origin.

    State (position, velocity); control (force). Starts with the position uniform in
    +-2 and the velocity in +-1. Cost `|x|^2 + 0.1 force^2` per step. Never terminates.

    **Arguments:**

    - `max_force`: 1 by default.

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
    """Bring a mass on a spring, or a chain of them, to rest by a force on the last.

    State (positions, velocities); control (force). Starts with each state uniform in
    +-1. Cost `|x|^2 + 0.1 force^2` per step. Never terminates.

    **Arguments:**

    - `max_force`: 1 by default.

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

    State (x, v); control (u). Starts with each state uniform in +-2. Cost
    `|x|^2 + 0.1 u^2` per step. Never terminates.

    **Arguments:**

    - `max_control`: 3 by default.

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

    State (x, y, z); control (u). Starts with x and y uniform in +-20 and z in [10, 40].
    Cost `|x - x*|^2 + 0.001 u^2` per step, x* being the equilibrium. Never terminates.

    **Arguments:**

    - `max_control`: 50 by default.

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
    """Hold the lower of two tanks at a level.

    State (upper, lower) [cm]; control (flow) [cm^3/s], not negative. Starts with the
    levels uniform in [0, 20]. Cost `(lower - level)^2 + 0.01 (flow - flow*)^2` per
    step, where flow* holds the level. Never terminates.

    **Arguments:**

    - `level`: to hold [cm], 10 by default.
    - `max_flow`: of the pump, 30 by default.

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

    State (concentration [mol/l], temperature [K]); control (coolant [K]). Starts within
    0.05 mol/l and 3 K of the equilibrium. Cost
    `10 (c - c*)^2 + 0.01 (T - T*)^2 + 0.01 (T_coolant - T_coolant*)^2` per step, with
    the equilibrium at the concentration. Never terminates. The time is in minutes.

    **Arguments:**

    - `concentration`: to hold [mol/l], below that of the feed; 0.5 by default.
    - `min_coolant`, `max_coolant`: what the jacket can do [K], 280 and 320 by default.

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
    """Bring a synchronous motor to a speed and hold it.

    State (i_d, i_q, speed); control (v_d, v_q), each within +-max_voltage; disturbance
    (load). Starts with the currents uniform in +-1 A and the speed in +-50 rad/s. Cost
    `0.01 (di_d^2 + di_q^2) + 0.001 dspeed^2 + 1e-5 |dv|^2` per step, each measured from
    what holds the speed without load. Never terminates.

    **Arguments:**

    - `speed`: to hold [rad/s], 100 by default.
    - `max_voltage`: 150 by default.

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
    """The arguments of a network with random weights."""
    if key is None:
        raise ValueError(
            "neural: give a system, or a key to draw the weights of one, such as "
            "key=jax.random.key(0), got neither."
        )
    return dict(key=key, states=states, controls=controls, width=width)


@task(NeuralSystem, dt=0.05, horizon=100, arguments=_drawn, accepts=AbstractSystem)
def neural(system: AbstractSystem, *, max_control: Limit = 1.0) -> Fields:
    """Bring the state of a learned vector field to the origin.

    Starts with each state uniform in +-1. Cost `|x|^2 + 0.1 |u|^2` per step. Never
    terminates.

    **Arguments:**

    - `key`: a random key, for random weights if no `system` is given, which may be a
        network that was fitted to data, or any other system.
    - `states`, `controls`, `width`: of a network with random weights, 2, 1 and 32 by
        default; see [`delucax.systems.NeuralSystem`][].
    - `max_control`: of each control, to either side; 1 by default.

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
