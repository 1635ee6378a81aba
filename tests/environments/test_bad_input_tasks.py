import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import once, user_error

import delucax as dlx
from delucax.environments import _registry


pytestmark = once


def environment(**arguments):
    dynamics = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05)
    return dlx.Environment(dynamics, dlx.costs.PendulumCost(), **arguments)


def step(**arguments):
    return environment(**arguments).step(0.0, jnp.zeros(2), jnp.zeros(1))


def of_another_kind():
    dlx.register("tests/system", "delucax.systems:Pendulum")
    return dlx.make("tests/system")


class Rubbing(dlx.systems.Pendulum):
    def vector_field(self, t, x, u, w):
        return super().vector_field(t, x, u - x[1:], w)


class AngleAlone(dlx.systems.Pendulum):
    def observe(self, t, x):
        return x[:1]


class Drifting(dlx.systems.CartPole):
    def diffusion(self, t, x, u):
        return jnp.ones((4, 1))


BOX = dlx.environments.UniformState(-jnp.ones(2), jnp.ones(2))


@pytest.mark.parametrize(
    "call, match",
    [
        (lambda: dlx.make("pendulum").reset(0), "reset: key must be .*got 0"),
        (lambda: BOX(0), "UniformState: key must be one random key.*got 0"),
        (lambda: environment(initial_state=[np.nan, 0]), "initial_state must be fin"),
        (
            lambda: step(terminated=lambda t, x: x[0]),
            r"terminated must return one boolean, got shape \(\) and dtype float",
        ),
        (
            lambda: step(terminated=lambda t, x: x > 0),
            r"terminated must return one boolean, got shape \(2,\)",
        ),
        (
            lambda: environment(encode=lambda y: y[0]).feature_size,
            r"encode must return a vector, got an array of shape \(\)",
        ),
        (
            lambda: dlx.make("pendulum", system=AngleAlone()).feature_size,
            r"encode: .*its states \(angle, velocity\), got an observation of shape "
            r"\(1,\)\. If the sensors show something else",
        ),
        (
            lambda: dlx.replace(environment(), {"encode": None}),
            r"encode must be a function of \(y\), got None",
        ),
        (
            lambda: environment(control_bounds=(jnp.zeros(2), jnp.ones(2))),
            r"control_bounds must be numbers or have shape \(1,\), got shape \(2,\)",
        ),
        (
            lambda: dlx.environments.UniformState(jnp.ones(2), jnp.ones(3)),
            r"UniformState: low and high must be numbers or have shape \(2,\)",
        ),
        (
            lambda: dlx.make("pendulum", lenght=1.2),
            "pendulum: no argument is called 'lenght'; did you mean 'length'",
        ),
        (
            lambda: dlx.make("lds", key=jax.random.key(0), horizn=3),
            r"lds: no argument is called 'horizn'; did you mean 'horizon'\?",
        ),
        (of_another_kind, "'tests/system' must return an Environment, got Pendulum"),
        (
            lambda: dlx.make("pendulum", system=Rubbing()),
            "GymPendulum: system must not have a vector_field of its own.*solver",
        ),
        (
            lambda: dlx.make("cartpole", system=Drifting()),
            "GymCartPole: system must not have a diffusion, which Gym's integrator",
        ),
        (
            lambda: dlx.replace(
                dlx.make("pendulum"), {"dynamics.system": dlx.systems.VanDerPol()}
            ),
            "system must be a Pendulum, got VanDerPol",
        ),
        (lambda: dlx.systems.TwoTank().equilibrium(-5.0), "level must be .*got -5"),
        (lambda: dlx.make("pendulum", dt="0.1"), "dt must be positive.*got '0.1'"),
        (lambda: dlx.make("pendulum", dt=jnp.ones(2)), r"dt must be a number.*\(2,\)"),
    ],
)
def test_bad_input(call, match):
    with user_error(match=match):
        call()


def step_with(u):
    return dlx.make("pendulum").step(0.0, jnp.zeros(2), u)


NUMBERS = {
    "acrobot": ["goal_height", "max_torque"],
    "bouncing_ball": ["height", "max_force", "rest_cost"],
    "cartpole": ["max_force"],
    "compass_gait": ["speed", "max_torque", "fall_cost"],
    "cartpole_swing_up": ["max_force", "max_position", "exit_cost"],
    "cstr": ["concentration", "min_coolant", "max_coolant"],
    "double_integrator": ["max_force"],
    "double_pendulum_cart": ["max_force", "max_position", "exit_cost"],
    "drift": ["speed", "steering", "max_steering", "max_force"],
    "dynamic_bicycle": ["speed", "max_acceleration", "max_steering"],
    "furuta": ["max_voltage"],
    "kinematic_bicycle": ["speed", "max_acceleration", "max_steering"],
    "lorenz": ["max_control"],
    "mass_spring_damper": ["max_force"],
    "mountain_car": ["goal_position", "goal_velocity"],
    "mountain_car_discrete": ["goal_position", "goal_velocity"],
    "permanent_magnet_motor": ["speed", "max_voltage"],
    "quadrotor": ["max_thrust"],
    "quadrotor_flip": ["max_thrust"],
    "reactor_start_up": ["max_coolant", "max_temperature", "shutdown_cost"],
    "rimless_wheel": ["speed", "max_torque", "stall_cost"],
    "slung_load": ["max_thrust"],
    "stick_slip": ["max_force"],
    "thermostat": ["target", "max_heat"],
    "two_tank": ["max_flow"],
    "valve_with_stops": ["max_force"],
    "van_der_pol": ["max_control"],
}


@pytest.mark.parametrize("task", NUMBERS)
def test_numbers_of_tasks(task):
    for name in NUMBERS[task]:
        for bad in ("a", np.nan):
            with user_error(match=f"{name} must be .*, got '?{bad}"):
                dlx.make(task, **{name: bad})


def test_limits_may_be_lists():
    made = dlx.make("permanent_magnet_motor", max_voltage=[150, 100])
    np.testing.assert_array_equal(made.control_bounds[0], [-150, -100])


def test_an_action_that_is_not_in_the_table_fails_the_rollout(key):
    class Constant(dlx.AbstractController):
        action: jax.Array

        def __call__(self, t, y, state):
            return self.action, state

    task = dlx.make("cartpole", horizon=3)
    for action in (-1, 2):
        law = Constant(jnp.array(action))
        assert dlx.rollout(task, law, key=key, throw=False).failed


def test_a_goal_is_one_number():
    with user_error(match=r"mountain_car: goal_velocity must be a number, got .*\(2,"):
        dlx.make("mountain_car", goal_velocity=jnp.zeros(2))


@pytest.mark.parametrize(
    "call, match",
    [
        (lambda: dlx.make(["pendulum"]), r"no task is called \['pendulum'\]"),
        (lambda: dlx.make("pendulum", max_torque=-1.0), "pendulum: max_torque must be"),
        (lambda: dlx.replace(dlx.make("pendulum"), "x"), "replace: changes must be"),
        (
            lambda: dlx.randomise(dlx.make("pendulum"), jax.random.key(0), ["x"]),
            "randomise: ranges must be",
        ),
        (
            lambda: dlx.rollout(
                dlx.make("pendulum"),
                dlx.controllers.Zero(1),
                key=jax.random.key(0),
                keep=None,
            ),
            "rollout: keep must hold",
        ),
        (
            lambda: dlx.disturbances.Gaussian(1.0, size=1.5),
            "Gaussian: size must be a whole number",
        ),
        (
            lambda: dlx.register(3, "a:b"),
            "register: name must be a non-empty string, got 3",
        ),
        (
            lambda: dlx.randomise(
                dlx.make("pendulum"), jax.random.key(0), {"dynamics.dt": ("a", "b")}
            ),
            "randomise: the range of 'dynamics.dt' must hold numbers",
        ),
        (
            lambda: step_with(None),
            r"u \(the control\) must have shape \(1,\), got None",
        ),
        (lambda: step_with("a"), r"u \(the control\) must have shape \(1,\), got 'a'"),
        (lambda: step_with([1j]), r"u \(the control\) must be real"),
        (
            lambda: dlx.make("planar_quadrotor", wind=dlx.systems.VortexWind),
            r"wind must be a function of \(t, x\), got the class VortexWind",
        ),
        (lambda: dlx.make("lds", A=jnp.eye(2)), "lds: B must be given together with A"),
        (
            lambda: dlx.make("lds", A=jnp.eye(2), B=jnp.ones((2, 1)), observations=1),
            "lds: observations applies only if the matrices are random.",
        ),
        (
            lambda: dlx.make(
                "lds", A=jnp.eye(2), B=jnp.ones((2, 1)), key=jax.random.key(0)
            ),
            "lds: pass A and B, or a key to draw them with, not both",
        ),
    ],
)
def test_wrong_kinds(call, match):
    with user_error(match=match):
        call()


def test_what_is_registered_must_be_there(monkeypatch):
    monkeypatch.setattr(_registry, "_REGISTRY", {"nowhere": "no.such.module:task"})
    with user_error(match="entry point 'no.such.module:task' of 'nowhere'"):
        dlx.make("nowhere")
