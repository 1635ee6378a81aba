"""The tasks that are not Gym's: the paper's numbers, and what each takes."""

import inspect

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from helpers import assert_close, needs_x64, once, user_error

import delucax as dlx


def cost_of(env, controls, key):
    return dlx.rollout(env, dlx.controllers.Constant(controls), key=key)


@needs_x64
def test_planar_quadrotor_costs_what_the_paper_says(key):
    """Totals of the original: hovering, and falling without thrust; the latter with the
    cost of the next state too."""
    env = dlx.make("classic/planar_quadrotor")
    hover = cost_of(env, [0.4905, 0.4905], key)
    assert_close(hover.total_cost, 200.0, rtol=1e-12)
    fallen = cost_of(env, [0.0, 0.0], key)
    assert_close(fallen.total_cost, 357221.27, atol=0.005)
    moved = jnp.sum(fallen.states[1:] ** 2) + 100 * 0.1 * 2 * 0.4905**2
    assert_close(moved, 374122.0319, atol=5e-5)


@needs_x64
def test_reacher_costs_what_the_paper_says(key):
    env = dlx.make("classic/reacher")
    run = cost_of(env, [0.0, 0.0], key)
    assert_close(run.total_cost, 29.7662, atol=5e-5)
    features = env.encode(run.states[0])
    half, whole = np.sqrt(0.5), np.sqrt(2)
    expected = [half, half, 0, 1, 0, 0, 0, whole - 1.8]
    assert_close(features, expected, atol=1e-12)


@once
def test_planar_quadrotor_in_wind():
    blown = dlx.make("planar_quadrotor", wind="dissipative", wind_strength=0.4)
    assert_close(blown.dynamics.system.wind.strength, 0.4, rtol=1e-6)
    assert_close(blown.cost.control_target, [0.4905, 0.4905], rtol=1e-6)
    pushes = []
    for wind in (None, "dissipative", "constant", "vortices", lambda t, x: 0.1 * x[:2]):
        system = dlx.make("planar_quadrotor", wind=wind).dynamics.system
        dx = system.vector_field(0.0, jnp.arange(6.0), jnp.ones(2), None)
        pushes.append(np.asarray(dx[3:5]))
    *named, function = pushes
    assert_close(function, named[1], rtol=1e-6)
    for i, one in enumerate(named):
        assert not any(np.allclose(one, other) for other in named[:i])


@once
def test_disturbances_are_forces(key):
    push = dlx.disturbances.Constant(jnp.array([0.1, 0.2]))
    env = dlx.make("planar_quadrotor", disturbance=push, horizon=3)
    wind = lambda t, x: jnp.array([0.1, 0.2])
    same = dlx.make("planar_quadrotor", wind=wind, horizon=3)
    states = [cost_of(e, [0.5, 0.5], key).states for e in (env, same)]
    assert_close(*states, rtol=1e-6)


@once
def test_a_solver_swaps_the_arithmetic():
    euler = dlx.make("planar_quadrotor").dynamics.solver
    assert isinstance(euler, diffrax.Euler)
    finer = dlx.make("planar_quadrotor", solver=diffrax.Tsit5(), substeps=2).dynamics
    assert isinstance(finer.solver, diffrax.Tsit5) and finer.substeps == 2


@once
def test_quadrotor_starts_level_enough_and_is_bounded():
    env = dlx.make("quadrotor")
    x0 = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 200))
    assert_close(np.linalg.norm(x0[:, 3:7], axis=1), np.ones(200), rtol=1e-6)
    assert np.all(x0[:, 3] > np.cos(np.deg2rad(40) / 2))
    wrench = dlx.make("quadrotor", inputs="wrench", max_thrust=5.0)
    low, high = wrench.control_bounds
    assert_close(high, [20.0, 0.85, 0.85, 0.16], rtol=1e-6)
    assert_close(low, [0.0, -0.85, -0.85, -0.16], rtol=1e-6)


@once
def test_lanes_and_levels_are_held(key):
    """Each target is where the cost is least."""
    for name, at in (
        ("kinematic_bicycle", jnp.array([3.0, 0.0, 2 * jnp.pi, 10.0])),
        ("dynamic_bicycle", jnp.array([3.0, 0.0, 0.0, 20.0, 0.0, 0.0])),
    ):
        assert_close(dlx.make(name).cost(0.0, at, jnp.zeros(2)), 0.0, atol=1e-10)
    for name, arguments in (
        ("two_tank", dict(level=12.0)),
        ("cstr", dict(concentration=0.6)),
        ("permanent_magnet_motor", dict(speed=80.0)),
    ):
        env = dlx.make(name, **arguments)
        (value,) = arguments.values()
        x, u = env.dynamics.system.equilibrium(value)
        assert env.cost(0.0, x, u) == 0 and env.cost(0.0, 1.1 * x, u) > 0
        assert_close(env.dynamics(0.0, x, u), x, rtol=1e-5)


@once
def test_constants_reach_the_physics():
    for name, constants in (
        ("double_integrator", dict(mass=2.0)),
        ("mass_spring_damper", dict(mass=2.0, stiffness=3.0, damping=0.2)),
        ("van_der_pol", dict(mu=2.0)),
        ("lorenz", dict(sigma=9.0, rho=27.0, beta=2.0)),
        ("planar_quadrotor", dict(mass=0.2, length=0.3, gravity=9.0)),
        (
            "reacher",
            dict(mass_1=1.1, mass_2=1.2, length_1=1.3, length_2=1.4, gravity=1.5),
        ),
        ("kinematic_bicycle", dict(front=1.2, rear=1.3)),
        (
            "dynamic_bicycle",
            dict(
                mass=1e3,
                inertia=2e3,
                front=1.2,
                rear=1.3,
                front_stiffness=1e5,
                rear_stiffness=2e5,
                standstill=0.5,
            ),
        ),
        (
            "quadrotor",
            dict(
                mass=0.8,
                arm=0.2,
                inertia_x=0.008,
                inertia_y=0.009,
                inertia_z=0.01,
                moment=0.02,
                drag=0.1,
                gravity=9.0,
            ),
        ),
        (
            "two_tank",
            dict(
                upper_area=29.0,
                lower_area=30.0,
                upper_outlet=0.06,
                lower_outlet=0.05,
                gravity=980.0,
                smoothing=0.02,
            ),
        ),
        (
            "cstr",
            dict(
                flow=1.1,
                feed_concentration=1.2,
                feed_temperature=345.0,
                rate=7e10,
                activation=8700.0,
                heat=200.0,
                cooling=2.0,
            ),
        ),
        (
            "permanent_magnet_motor",
            dict(
                resistance=2.0,
                d_inductance=0.007,
                q_inductance=0.008,
                flux=0.2,
                inertia=0.001,
                friction=0.002,
                pole_pairs=3.0,
            ),
        ),
    ):
        system = dlx.make(name, **constants).dynamics.system
        for constant, value in constants.items():
            assert_close(getattr(system, constant), value, rtol=1e-6)


@once
@pytest.mark.parametrize(
    "name, constants",
    [
        ("acrobot", dict(mass_2=1.2, form="nips")),
        ("bouncing_ball", dict(drag=0.1, restitution=0.9)),
        ("compass_gait", dict(slope=0.0)),
        ("kinematic_bicycle", dict(front=1.2)),
        ("mass_spring_damper", dict(mass=2.0, masses=2)),
        ("mountain_car_discrete", dict(power=0.001, gravity=0.003)),
        ("planar_quadrotor", dict(mass=0.2, wind=dlx.systems.VortexWind())),
        ("quadrotor", dict(drag=0.1, inputs="wrench")),
        ("two_tank", dict(upper_area=29.0)),
    ],
)
def test_a_task_takes_a_system_or_its_arguments(name, constants):
    by_name = dlx.make(name, horizon=3, **constants)
    system = type(by_name.dynamics.system)(**constants)
    task = getattr(dlx.environments, name)
    assert eqx.tree_equal(task(system, horizon=3), by_name)
    constant = next(iter(constants))
    with user_error(match=f"{name}: pass a system or its {constant}, not both"):
        task(system, **{constant: constants[constant]})
    with user_error(match=f"{name}: system must be an? {type(system).__name__}, got V"):
        task(dlx.systems.VanDerPol())


@once
def test_defaults_of_tasks_that_are_not_those_of_their_systems():
    for name, constant in (("bouncing_ball", "drag"), ("stick_slip", "damping")):
        system = dlx.make(name).dynamics.system
        assert getattr(system, constant) > 0 == getattr(type(system)(), constant)
    weak = dlx.make("mountain_car_discrete").dynamics.system
    assert_close(weak.power, 0.001, rtol=1e-6)
    given = dlx.make("mountain_car_discrete", system=dlx.systems.MountainCar())
    assert_close(given.dynamics.system.power, 0.0015, rtol=1e-6)
    field = dlx.make("neural", key=jax.random.key(0)).dynamics.system
    assert field.network.width_size == 32 and field.control_size == 1


@once
def test_all_names_of_a_task_are_known():
    """Those of its system, its arithmetic and the environment."""
    for name in ("powr", "max_spead", "goal_positon", "sensor_nois"):
        with user_error(match=f"mountain_car: no argument is called '{name}'; did you"):
            dlx.make("mountain_car", **{name: 1.0})
    with user_error(
        match="two_tank: no argument is called 'zzz'.*'upper_area'.*'cost'"
    ):
        dlx.make("two_tank", zzz=1.0)


@once
def test_the_signature_of_a_task_has_its_options():
    parameters = inspect.signature(dlx.environments.planar_quadrotor).parameters
    options = ["wind", "wind_strength", "dt", "horizon", "solver", "substeps"]
    assert list(parameters) == ["system", *options, "others"]
    assert parameters["horizon"].default == 100
    documented = inspect.getdoc(dlx.environments.planar_quadrotor)
    assert "`horizon`: the number of steps per episode, 100 by default." in documented
    assert "solver, `diffrax.Euler()` by default." in documented
    with user_error(match="make: no task is called 'planar'; did you mean"):
        dlx.make("planar")


@once
def test_a_linear_model_is_a_task():
    upright = dlx.linearize(dlx.systems.Pendulum())
    env = dlx.make("lds", system=upright, dt=0.05)
    expected = dlx.c2d(upright, 0.05)
    assert_close(env.dynamics.A, expected.A)
    assert_close(env.dt, 0.05, rtol=1e-6)
    again = dlx.make("lds", system=expected)
    assert_close(again.dynamics.B, expected.B)
    assert_close(dlx.make("lds", A=jnp.eye(2), B=jnp.eye(2), dt=0.2).dt, 0.2, rtol=1e-6)


@once
def test_a_fitted_field_is_a_task():
    env = dlx.make("neural", system=dlx.systems.VanDerPol(), key=None, dt=0.1)
    expected = dlx.make("van_der_pol", dt=0.1).dynamics
    x, u = jnp.ones(2), jnp.ones(1)
    assert_close(env.dynamics(0.0, x, u), expected(0.0, x, u))


@once
def test_a_network_is_fitted_and_kept(tmp_path, key):
    """`fit` moves the network; saved and loaded, the system is the same."""
    start = dlx.systems.NeuralSystem(("a", "b"), 1, width=8, depth=1, key=key)
    x = jax.random.normal(jax.random.key(1), (64, 2))
    u = jax.random.normal(jax.random.key(2), (64, 1))
    true = dlx.systems.VanDerPol()
    truth = jax.vmap(lambda x, u: true.vector_field(0.0, x, u, None))(x, u)

    def loss(model, key):
        found = jax.vmap(lambda x, u: model.vector_field(0.0, x, u, None))(x, u)
        return jnp.mean((found - truth) ** 2)

    fitted = dlx.training.fit(loss, start, optax.adam(0.03), 100, key=key).model
    assert loss(fitted, key) < 0.3 * loss(start, key)
    dlx.save(tmp_path / "field.dlx", fitted)
    again = dlx.load(tmp_path / "field.dlx")
    assert jax.tree.structure(again) == jax.tree.structure(fitted)
    assert loss(again, key) == loss(fitted, key)
    assert again.state_names == ("a", "b") and again.control_names == ("u0",)
    env = dlx.make("neural", system=again, horizon=3)
    assert np.isfinite(cost_of(env, [0.1], key).total_cost)


PLANT = dlx.LinearDynamics(jnp.eye(1), jnp.eye(1), dt=0.1)
FLOW = dlx.systems.LinearSystem(jnp.eye(1), jnp.eye(1))


@once
@pytest.mark.parametrize(
    "name, arguments, match",
    [
        (
            "planar_quadrotor",
            dict(wind="tornado"),
            "one of 'dissipative'.*got 'tornado",
        ),
        ("planar_quadrotor", dict(wind_strength=1.0), "needs the name of a wind"),
        ("planar_quadrotor", dict(mass=0.0), "mass must be positive"),
        ("reacher", dict(goal=[1.0]), r"goal must have shape \(2,\), got shape \(1,\)"),
        ("reacher", dict(goal=[1.0, np.nan]), "goal must be finite"),
        ("two_tank", dict(level=-1.0), "level must be at least 0"),
        ("cstr", dict(concentration=-0.1), "concentration must be positive"),
        (
            "cstr",
            dict(concentration=2.0),
            "concentration must be above 0 and below feed_concentration, 1.0, got 2.0",
        ),
        ("bouncing_ball", dict(height=0.0), "bouncing_ball: height must be positive"),
        ("compass_gait", dict(max_torque=-1.0), "max_torque must be at least 0"),
        ("thermostat", dict(low=21.0), "low must be below high, got 21.0 and 21.0"),
        ("lorenz", dict(max_control=-1.0), "max_control must be at least 0"),
        ("quadrotor", dict(inputs="motors"), "inputs must be 'rotors' or 'wrench'"),
        ("neural", {}, "pass a system, or a key .* got neither"),
        (
            "neural",
            dict(system=dlx.systems.VanDerPol(), key=jax.random.key(0)),
            "neural: pass a system or its key, not both",
        ),
        (
            "neural",
            dict(system=dlx.systems.VanDerPol(), states=2),
            "neural: pass a system or its states, not both",
        ),
        ("lds", dict(system=PLANT, dt=0.1), "dt must be left out"),
        ("lds", dict(system=FLOW), "dt must be given"),
        ("lds", dict(system=FLOW, A=jnp.eye(1)), "pass A or a system, not both"),
        ("lds", dict(system="plant.mat"), "read_linear` from a file\\), got str"),
        ("van_der_pol", dict(dt=-0.1), "dt must be positive"),
        ("double_integrator", dict(substeps=0), "substeps must be a whole number"),
    ],
)
def test_bad_arguments(name, arguments, match):
    with user_error(match=match):
        dlx.make(name, **arguments)
