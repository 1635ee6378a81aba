import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, dtype, once, user_error

import delucax as dlx


class Spring(dlx.AbstractSystem):
    state_names = ("x", "v")
    control_names = ("force",)
    stiffness: jax.Array = dlx.parameter(4.0, constraint=dlx.positive)

    def vector_field(self, t, x, u, w):
        return jnp.stack([x[1], u[0] - self.stiffness * x[0]])


@pytest.mark.parametrize("value", [2, 2.0, np.float64(2), np.float32(2), np.array(2)])
def test_parameters_follow_the_precision(value):
    spring = Spring(value)
    assert spring.stiffness.weak_type and spring.stiffness.dtype == dtype()
    for precision in (jnp.float32, dtype()):
        x = jnp.ones(2, precision)
        dx = spring.vector_field(0.0, x, jnp.zeros(1, precision), None)
        assert dx.dtype == precision


@once
def test_parameters_are_leaves():
    gradient = eqx.filter_grad(
        lambda s: s.vector_field(0.0, jnp.ones(2), jnp.zeros(1), None)[1]
    )(Spring())
    assert gradient.stiffness == -1
    batch = jax.vmap(Spring)(jnp.array([1.0, 2.0]))
    field = lambda s: s.vector_field(0.0, jnp.ones(2), jnp.zeros(1), None)
    assert_close(jax.vmap(field)(batch)[:, 1], [-1, -2])


@once
def test_illegal_parameters():
    with user_error(match="Spring: stiffness must be positive, got -1"):
        Spring(-1.0)
    with user_error(match="Spring: stiffness must be finite"):
        Spring(float("inf"))


@once
def test_names_are_needed():
    class Nameless(dlx.AbstractSystem):
        state_names = "x"
        control_names = ("u",)

        def vector_field(self, t, x, u, w):
            return x

    with user_error(match="state_names must be a tuple of strings"):
        Nameless()


@once
def test_sizes_and_defaults():
    spring = Spring()
    assert (spring.state_size, spring.control_size, spring.disturbance_size) == (
        2,
        1,
        2,
    )
    x = jnp.array([1.0, 2.0])
    assert spring.observe(0.0, x) is x and spring.project(x) is x
    assert_close(spring.difference(x, x), [0, 0])
    with user_error(match="defines no equilibrium"):
        spring.equilibrium()


@once
def test_system_from_a_function():
    car = dlx.system(
        lambda t, x, u, w: jnp.stack([x[1], u[0] + w[0]]),
        states=("position", "speed"),
        controls=1,
        disturbances=("wind",),
    )
    assert car.state_names == ("position", "speed") and car.control_names == ("u0",)
    assert car.disturbance_size == 1
    dynamics = dlx.Discretized(car, dt=0.5)
    x = dynamics(0.0, jnp.zeros(2), jnp.ones(1), jnp.ones(1))
    assert_close(x, [0.25, 1.0], rtol=1e-6)
    with user_error(match="states must be a whole number or a tuple of names"):
        dlx.system(lambda t, x, u, w: x, states=1.5, controls=1)
    with user_error(match="f must be a function"):
        dlx.system(3.0, states=1, controls=1)
    with user_error(match=r"f must be a function of \(t, x, u, w\), got <lambda>"):
        dlx.system(lambda x, u: x, states=1, controls=1)
    with user_error(match=r"state_names must differ, got \('a', 'a'\)"):
        dlx.system(lambda t, x, u, w: x, states=("a", "a"), controls=1)


@once
def test_pendulum_angles_wrap():
    pendulum = dlx.systems.Pendulum()
    x = jnp.array([3.0, 1.0])
    assert_close(
        pendulum.difference(x, -x), [6.0 - 2 * np.pi, 2.0], rtol=1e-5, atol=1e-6
    )


@once
def test_angles_are_states():
    class Arm(Spring):
        angle_names = ("y",)

    with user_error(match=r"Arm: angle_names must be among state_names, .*got \('y',"):
        Arm()


@once
def test_linear_system():
    A, B = jnp.array([[0.0, 1.0], [-2.0, -3.0]]), jnp.array([[0.0], [1.0]])
    point = dict(x_ref=jnp.ones(2), u_ref=jnp.ones(1), dx_ref=jnp.array([0.5, 0.0]))
    system = dlx.systems.LinearSystem(A, B, C=jnp.ones((1, 2)), E=B, **point)
    dx = system.vector_field(0.0, 2 * jnp.ones(2), jnp.zeros(1), jnp.ones(1))
    assert_close(dx, A @ jnp.ones(2) + jnp.array([0.5, 0.0]))
    assert_close(system.observe(0.0, jnp.ones(2)), [2.0])
    for arguments, match in [
        ((A[:1], B), "A must be square"),
        ((A, B[:1]), "B must have as many rows"),
        ((A, B, jnp.ones((1, 3))), "C must have as many columns"),
        ((A, B, None, jnp.ones((3, 1))), "E must have as many rows"),
        ((A * jnp.nan, B), "A must be finite"),
    ]:
        with user_error(match=match):
            dlx.systems.LinearSystem(*arguments)
    with user_error(match=r"x_ref must have shape \(2,\)"):
        dlx.systems.LinearSystem(A, B, x_ref=jnp.ones(3))


class Shaken(dlx.AbstractSystem):
    """Noise that is proportional to the control."""

    state_names, control_names = ("x",), ("u",)

    def vector_field(self, t, x, u, w):
        return u - x

    def equilibrium(self):
        return jnp.ones(1), jnp.ones(1)

    def diffusion(self, t, x, u):
        return u


@once
def test_a_calibrated_actuator_shakes_and_rests():
    scaled = dlx.systems.Calibrated(Shaken(), control_scale=2.0, control_offset=0.5)
    assert_close(scaled.diffusion(0.0, jnp.zeros(1), jnp.ones(1)), [2.5])
    x, u = scaled.equilibrium()
    assert_close(u, [0.25])
    assert_close(scaled.vector_field(0.0, x, u, None), [0.0])


@once
def test_a_wrapper_may_override_each_hook():
    class Wrapper(dlx.systems.AbstractSystemWrapper):
        system: dlx.AbstractSystem

        def vector_field(self, t, x, u, w):
            return self.system.vector_field(t, x, u, None)

    class Noisy(Wrapper):
        def diffusion(self, t, x, u):
            return 0.5 * jnp.ones(2)

    class Gusty(Wrapper):
        disturbance_names = ("gust",)

    class Turned(Wrapper):
        def project(self, x):
            return x % 1

    inner = dlx.systems.Pendulum()
    plain, noisy, gusty, turned = (c(inner) for c in (Wrapper, Noisy, Gusty, Turned))
    assert (plain.noise, plain.disturbance_size) == ("additive", 2)
    assert (noisy.noise, noisy.disturbance_size) == ("brownian", 2)
    assert (gusty.noise, gusty.disturbance_size) == (None, 1)
    assert turned.projects_state and not plain.projects_state
    assert Wrapper(noisy).noise == "brownian" and Wrapper(turned).projects_state
    assert dlx.Discretized(noisy, 0.05).increments == 1


@once
def test_names_may_be_a_list(key):
    plant = dlx.systems.FunctionSystem(lambda t, x, u, w: u - x, ["x"], ["u"])
    steps = dlx.Discretized(plant, dt=0.1)
    run = dlx.open_loop(steps, jnp.ones(1), jnp.zeros((2, 1)))
    assert_close(run[-1], [np.exp(-0.2)], rtol=1e-5)

    class Listed(Spring):
        state_names = ["x", "v"]  # noqa: RUF012

    cost = dlx.costs.Quadratic(jnp.eye(2), jnp.eye(1))
    env = dlx.Environment(dlx.Discretized(Listed(), dt=0.1), cost, horizon=3)
    run = dlx.rollout(env, dlx.controllers.Zero(1), key=key, x0=[1.0, 0.0])
    assert jax.jit(lambda run: run.total_cost)(run) == run.total_cost
