"""What the classic-control tasks have beyond Gymnasium's."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    assert_close,
    dtype,
    needs_x64,
    once,
    user_error,
)

import delucax as dlx


TASKS = ("acrobot", "cartpole", "mountain_car", "mountain_car_discrete")


def acrobot_energy(s, x):
    moment = s.mass_2 * s.length_1 * s.center_2
    own = s.mass_2 * s.center_2**2 + s.inertia_2
    first = s.mass_1 * s.center_1**2 + s.mass_2 * s.length_1**2 + s.inertia_1
    both = x[2] + x[3]
    kinetic = (first * x[2] ** 2 + own * both**2) / 2
    kinetic = kinetic + moment * jnp.cos(x[1]) * x[2] * both
    fall = (s.mass_1 * s.center_1 + s.mass_2 * s.length_1) * jnp.cos(x[0])
    fall = fall + s.mass_2 * s.center_2 * jnp.cos(x[0] + x[1])
    return kinetic - s.gravity * fall


def cartpole_energy(s, x):
    l, m = s.half_length, s.pole_mass
    kinetic = (s.cart_mass + m) * x[1] ** 2 / 2 + 2 / 3 * m * l**2 * x[3] ** 2
    kinetic = kinetic + m * l * x[1] * x[3] * jnp.cos(x[2])
    return kinetic + m * s.gravity * l * jnp.cos(x[2])


def mountain_car_energy(s, x):
    # Scaled to the size of the others: the drop of the valley is one.
    return (x[1] ** 2 / 2 + s.gravity * jnp.sin(3 * x[0]) / 3) * 3 / s.gravity


@needs_x64
@pytest.mark.parametrize(
    "task, arguments, energy, start, dt",
    [
        (
            "acrobot",
            dict(mass_1=1.3, mass_2=0.8, length_1=1.1, center_1=0.4, inertia_2=0.7),
            acrobot_energy,
            [1.5, 0.5, 0.0, 0.3],
            0.05,
        ),
        (
            "cartpole",
            dict(cart_mass=1.5, pole_mass=0.4, half_length=0.7),
            cartpole_energy,
            [0.1, 0.2, 2.0, 0.3],
            0.05,
        ),
        (
            "mountain_car",
            dict(gravity=0.003),
            mountain_car_energy,
            [-1.0, 0.01],
            1.0,
        ),
    ],
)
def test_energy_is_kept_under_a_solver(task, arguments, energy, start, dt):
    arguments |= dict(solver=dlx.dynamics.RK4(), substeps=20, terminated=None)
    env = dlx.make(task, dt=dt, **arguments)
    zero = dlx.controllers.Zero(1)
    x0 = jnp.array(start)
    run = dlx.rollout(env, zero, key=jax.random.key(0), x0=x0, horizon=60)
    found = jax.vmap(lambda x: energy(env.dynamics.system, x))(run.states)
    assert np.ptp(run.states[:, 0]) > 0.3
    assert_close(found, jnp.full(61, found[0]), atol=1e-8)


@needs_x64
def test_the_papers_form_does_not_keep_energy():
    x = jnp.array([1.0, 0.7, 2.0, -1.0])

    def gain(form):
        system = dlx.systems.Acrobot(form=form)
        dx = system.vector_field(0.0, x, jnp.zeros(1), None)
        return jax.jvp(lambda x: acrobot_energy(system, x), (x,), (dx,))[1]

    assert abs(gain("book")) <= 1e-12
    assert abs(gain("nips")) > 0.1


@needs_x64
@pytest.mark.parametrize("task", TASKS)
def test_the_equilibrium_rests(task):
    for env in (dlx.make(task), dlx.make(task, solver=diffrax.Heun())):
        x, u = env.dynamics.equilibrium()
        moved = env.dynamics.difference(env.dynamics(0.0, x, u), x)
        assert_close(moved, jnp.zeros_like(x), atol=1e-14)


@needs_x64
@pytest.mark.parametrize("task", TASKS)
def test_angles_wrap_in_differences(task):
    system = dlx.make(task).dynamics.system
    x = jnp.arange(1.0, 1 + system.state_size)
    turn = np.array([unit == "rad" for unit in system.state_units]) * 2 * np.pi
    assert_close(system.difference(x + turn, x), jnp.zeros_like(x), atol=1e-14)


@once
def test_arguments_reach_the_physics():
    acrobot = dlx.environments.acrobot(
        dlx.systems.Acrobot(1.1, 1.2, 1.3, 0.4, 0.6, 0.7, 0.8, 9.0, "nips"),
        dt=0.1,
        max_velocity_2=5.0,
    )
    s = acrobot.dynamics.system
    found = [s.mass_1, s.mass_2, s.length_1, s.center_1, s.center_2]
    found += [s.inertia_1, s.inertia_2, s.gravity, acrobot.dt]
    assert_close(found, [1.1, 1.2, 1.3, 0.4, 0.6, 0.7, 0.8, 9.0, 0.1], rtol=1e-6)
    assert s.form == "nips" and acrobot.dynamics.max_velocity_2 == 5
    cartpole = dlx.environments.cartpole(
        cart_mass=1.1,
        pole_mass=0.2,
        half_length=0.6,
        gravity=9.0,
        max_force=3.0,
        horizon=7,
    )
    s = cartpole.dynamics.system
    found = [s.cart_mass, s.pole_mass, s.half_length, s.gravity]
    assert_close(found, [1.1, 0.2, 0.6, 9.0], rtol=1e-6)
    assert_close(cartpole.actions, [[-3.0], [3.0]])
    assert cartpole.horizon == 7
    for task in (
        dlx.environments.mountain_car,
        dlx.environments.mountain_car_discrete,
    ):
        limits = dict(max_speed=0.1, min_position=-2.0, max_position=1.0)
        car = task(power=0.002, gravity=0.003, **limits)
        s, d = car.dynamics.system, car.dynamics
        found = [s.power, s.gravity, d.max_speed, d.min_position, d.max_position]
        assert_close(found, [0.002, 0.003, 0.1, -2.0, 1.0], rtol=1e-6)


@once
def test_integers_and_numbers_are_actions():
    for task, forces in (("acrobot", [-1, 0, 1]), ("cartpole", [-10, 10])):
        env = dlx.make(task)
        x = jnp.full(4, 0.05)
        for action, force in enumerate(forces):
            by_number = env.step(0.0, x, action)
            by_force = env.step(0.0, x, jnp.array([float(force)]))
            assert np.all(by_number.state == by_force.state)
            assert by_number.control == force
    with user_error(match=r"floating-point numbers of shape \(1,\), got integers of"):
        dlx.make("cartpole").step(0.0, jnp.zeros(4), jnp.array([1]))
    between = dlx.make("cartpole").step(0.0, jnp.zeros(4), jnp.array([3.0]))
    assert between.control == 3


@needs_x64
def test_linear_cartpole_is_the_papers():
    env = dlx.make("cartpole_linear", cart_mass=2.0, pole_mass=0.5, length=0.8)
    A, B = np.asarray(env.dynamics.A), np.asarray(env.dynamics.B)
    growth = np.sqrt(2.5 * 9.81 / (2.0 * 0.8))
    expected = [1 - 0.02 * growth, 1, 1, 1 + 0.02 * growth]
    found = np.sort(np.linalg.eigvals(A.astype(np.float64)).real)
    # A double eigenvalue moves by the root of what its matrix does.
    assert_close(found, expected, atol=1e-7)
    assert_close(B[:, 0], [0, 0, 0.02 / 2.0, 0.02 / 1.6], rtol=1e-6)
    slope = jax.jacfwd(lambda m: dlx.make("cartpole_linear", pole_mass=m).dynamics.A)
    assert_close(slope(0.1)[2, 1], 0.02 * 9.81, rtol=1e-6)


@once
def test_linear_cartpole_is_the_nonlinear_one_of_a_point_mass():
    """A rod has 4/3 of the moment of inertia of a point mass at its middle."""
    heavy = 1e6  # so that the cart does not move
    system = dlx.systems.CartPole(cart_mass=heavy, half_length=0.75)
    A = np.asarray(dlx.linearize(system).A)
    linear = dlx.make("cartpole_linear", cart_mass=heavy, gravity=9.8)
    rate = (np.asarray(linear.dynamics.A)[3, 1]) / 0.02
    assert_close(A[3, 2], rate, rtol=1e-5)


@once
def test_an_lqr_of_the_linearisation_holds_the_pole(key):
    env = dlx.make("cartpole")
    lqr = dlx.controllers.LQR(dlx.linearize(env.dynamics), jnp.eye(4), jnp.eye(1))
    run = dlx.rollout(env, lqr, key=key)
    assert run.length == 500 and run.total_cost == -500
    assert np.max(np.abs(run.states[-1])) < 1e-2


@needs_x64
def test_height_cost_has_its_minimum_upright():
    cost = dlx.costs.AcrobotHeight(0.1, 0.2, 3.0)
    u = jnp.zeros(1)
    upright = jnp.array([np.pi, 0.0, 0.0, 0.0])
    assert_close(cost(0.0, upright, u), 0, atol=1e-15)
    assert_close(cost(0.0, jnp.zeros(4), jnp.ones(1)), 16.2, rtol=1e-6)
    moving = jnp.array([np.pi / 2, 0.0, 1.0, 2.0])
    assert_close(cost(0.0, moving, u), 4.5, rtol=1e-5)
    assert_close(cost.final(0.0, moving), 13.5, rtol=1e-5)
    slope = jax.grad(lambda x: cost(0.0, x, u))(jnp.array([0.1, 0.0, 0.0, 0.0]))
    assert slope[0] < -0.5


def test_a_smooth_acrobot_has_gradients(key):
    env = dlx.make(
        "acrobot",
        solver=dlx.dynamics.RK4(),
        cost=dlx.costs.AcrobotHeight(),
        terminated=None,
        horizon=20,
    )

    def total(controls):
        controller = dlx.controllers.OpenLoop(controls)
        return dlx.rollout(env, controller, key=key, x0=0.1 * jnp.ones(4)).total_cost

    slope = jax.grad(total)(jnp.zeros((20, 1)))
    assert np.all(np.isfinite(slope)) and np.all(slope[:-1] != 0)


@once
@pytest.mark.parametrize(
    "call, match",
    [
        (lambda: dlx.make("acrobot", form="java"), "form must be 'book' or 'nips', "),
        (lambda: dlx.make("acrobot", mass_1=0.0), "mass_1 must be positive"),
        (lambda: dlx.make("acrobot", max_velocity_1=-1.0), "max_velocity_1 must be p"),
        (lambda: dlx.make("acrobot", substeps=2), "acrobot: substeps needs a solver"),
        (lambda: dlx.make("acrobot", torque_noise=-1.0), "torque_noise must be at le"),
        (
            lambda: dlx.make(
                "acrobot",
                torque_noise=0.1,
                disturbance=dlx.disturbances.Gaussian(0.1, size=1),
            ),
            "acrobot: pass torque_noise or a disturbance, not both",
        ),
        (
            lambda: dlx.make("acrobot", solver=diffrax.Heun(), max_velocity_1=1.0),
            "acrobot: max_velocity_1 applies only to Gym's.*max_velocity_1 or a solver",
        ),
        (
            lambda: dlx.make("cartpole", solver=diffrax.Heun(), semi_implicit=True),
            "cartpole: semi_implicit applies only to Gym's",
        ),
        (lambda: dlx.make("cartpole", semi_implicit=1), "must be True or False, got 1"),
        (lambda: dlx.make("cartpole", half_length=0.0), "half_length must be positive"),
        (lambda: dlx.make("cartpole", max_angle=0.0), "max_angle must be positive"),
        (lambda: dlx.make("cartpole", length=1.0), "no argument is called 'length'"),
        (lambda: dlx.make("cartpole_linear", length=-1.0), "length must be positive"),
        (lambda: dlx.make("cartpole_linear", gravity=np.nan), "A must be finite"),
        (lambda: dlx.make("mountain_car", dt=0.0), "dt must be positive"),
        (lambda: dlx.make("mountain_car", power=np.inf), "power must be finite"),
        (
            lambda: dlx.make("mountain_car", max_position=-2.0),
            "max_position must be at least -1.2",
        ),
        (
            lambda: dlx.make("mountain_car_discrete", max_speed=0.0),
            "max_speed must be positive",
        ),
    ],
)
def test_bad_arguments(call, match):
    with user_error(match=match):
        call()


@pytest.mark.parametrize("task", TASKS)
def test_it_runs_in_the_precision_of_the_state(task):
    env = dlx.make(task)
    for precision in (jnp.float32, dtype()):
        x, u = jnp.zeros(env.state_size, precision), jnp.zeros(1, precision)
        step = jax.eval_shape(lambda x, u: env.step(0.0, x, u), x, u)  # noqa: B023
        final = jax.eval_shape(lambda x: env.cost.final(0.0, x), x)  # noqa: B023
        assert step.state.dtype == step.cost.dtype == final.dtype == precision
