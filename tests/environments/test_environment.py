import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, CountCalls, Drift, once, user_error

import delucax as dlx


DYNAMICS = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05)
COST = dlx.costs.PendulumCost()


@once
def test_a_step_compiles_as_a_method_and_as_a_function(key):
    """What holds for every task is in `contracts/test_tasks.py`."""
    env = dlx.make("pendulum")
    x0, u = env.reset(key), jnp.zeros(1)
    step = eqx.filter_jit(env.step)(0.0, x0, u)
    assert step.state.shape == x0.shape == (env.state_size,)
    assert step.cost.shape == () and step.result == dlx.RESULTS.successful
    same = jax.jit(dlx.Environment.step)(env, 0.0, x0, u)
    assert_close(same.state, step.state, rtol=1e-6)


def test_unknown_name_lists_the_close_ones():
    with user_error(match="did you mean.*'pendulum'"):
        dlx.make("pendulm")


@once
def test_register():
    dlx.register("tests/pendulum", "delucax.environments:pendulum")
    assert_close(dlx.make("tests/pendulum", length=2.0).dynamics.system.length, 2.0)
    with user_error(match="entry_point must be 'module:function'"):
        dlx.register("tests/other", "delucax.environments.pendulum")
    with user_error(match="already registered"):
        dlx.register("tests/pendulum", "delucax.environments:lds")


@once
def test_replace():
    env = dlx.make("pendulum")
    changed = dlx.replace(
        env, {"dynamics.system.length": 1.2, "control_bounds.1": 1, "dynamics.dt": 0.1}
    )
    assert_close(changed.dynamics.system.length, 1.2, rtol=1e-6)
    assert jax.tree.structure(changed) == jax.tree.structure(env)
    for new, old in zip(jax.tree.leaves(changed), jax.tree.leaves(env), strict=True):
        assert new.dtype == old.dtype and new.weak_type == old.weak_type
    with user_error(match="GymPendulum has no 'sytem'.*did you mean.*system"):
        dlx.replace(env, {"dynamics.sytem.length": 1.0})
    with user_error(match="length must be positive"):
        dlx.replace(env, {"dynamics.system.length": -1.0})
    with user_error(match="it is a leaf"):
        dlx.replace(env, {"dynamics.dt.size": 1.0})


@once
def test_randomise_is_domain_randomisation_without_compiling(key):
    env = dlx.make("pendulum")
    ranges = {
        "dynamics.system.length": (0.8, 1.2),
        "dynamics.system.mass": lambda k: jnp.exp(0.1 * jax.random.normal(k)),
    }
    traced = CountCalls()

    class Traced(dlx.AbstractController):
        def __call__(self, t, y, state):
            traced()
            return jnp.zeros(1, y.dtype), state

    def cost(k):
        plant_key, k = jax.random.split(k)
        plant = dlx.randomise(env, plant_key, ranges)
        run = dlx.rollout(plant, Traced(), key=k, horizon=5)
        return plant.dynamics.system.length, plant.dynamics.system.mass, run.total_cost

    keys = jax.random.split(key, 50)
    lengths, masses, costs = map(np.asarray, jax.jit(jax.vmap(cost))(keys))
    counts = [traced.count]
    assert np.all((lengths >= 0.8) & (lengths <= 1.2)) and len(np.unique(costs)) == 50
    assert_close(np.log(masses).std(), 0.1, rtol=0.3)
    for k in (3, 4):
        assert_close(cost(keys[k])[2], costs[k], rtol=1e-4)
        counts.append(traced.count)
    assert counts[0] == 1 and counts[1] == counts[2] <= 2
    with user_error(match="must be a pair"):
        dlx.randomise(env, key, {"dynamics.dt": 1.0})
    with user_error(match="low <= high"):
        dlx.randomise(env, key, {"dynamics.dt": (2.0, 1.0)})
    with user_error(match=r"jax\.random\.key\(0\)"):
        dlx.randomise(env, 3, {"dynamics.dt": (1.0, 2.0)})


@once
def test_lds(key):
    env = dlx.make("lds", key=key, states=5, controls=2, observations=3)
    eigenvalues = np.linalg.eigvals(env.dynamics.A)
    assert_close(np.max(np.abs(eigenvalues)), 0.9, rtol=1e-4)
    assert env.dynamics.B.shape == (5, 2) and env.observation_size == 3
    radii = jnp.array([0.5, 0.99])
    batch = jax.vmap(
        lambda k, r: dlx.make("lds", key=k, states=3, spectral_radius=r).dynamics.A
    )(jax.random.split(key), radii)
    found = np.max(np.abs(np.linalg.eigvals(np.asarray(batch))), axis=1)
    assert_close(found, radii, rtol=1e-4)
    with user_error(match="key"):
        dlx.make("lds")
    with user_error(match="B must be given"):
        dlx.make("lds", A=jnp.eye(2))


@once
def test_default_noise_of_a_diffusion():
    dynamics = dlx.Discretized(Drift(), dt=0.1, substeps=4)
    env = dlx.Environment(dynamics, dlx.costs.Function(lambda t, x, u: x[0] ** 2))
    assert env.disturbance.size == dynamics.disturbance_size == 4
    run = dlx.rollout(env, dlx.controllers.Zero(1), key=jax.random.key(0))
    assert np.std(run.states) > 0.1


@once
@pytest.mark.parametrize(
    "arguments, match",
    [
        ({"dynamics": dlx.systems.Pendulum()}, "dynamics must be an AbstractDynamics"),
        ({"cost": lambda t, x, u: 0.0}, "cost must be an AbstractCost"),
        (
            {"disturbance": dlx.disturbances.Zero(3)},
            "disturbance must have size 2",
        ),
        (
            {"sensor_noise": dlx.disturbances.Zero(1)},
            "sensor_noise must have size 2",
        ),
        ({"disturbance": 0.1}, "disturbance must be an AbstractDisturbance"),
        ({"initial_state": jnp.zeros(3)}, r"initial_state must have shape \(2,\)"),
        ({"control_bounds": (1.0, -1.0)}, "low <= high"),
        ({"control_bounds": 2.0}, "must be a pair"),
        ({"control_bounds": (jnp.zeros(2), jnp.ones(2))}, r"or have shape \(1,\)"),
        ({"horizon": 0}, "horizon must be a whole number of at least 1"),
        ({"actions": jnp.ones((2, 2))}, "actions must have shape"),
    ],
)
def test_bad_arguments(arguments, match):
    with user_error(match=match):
        dlx.Environment(**({"dynamics": DYNAMICS, "cost": COST} | arguments))


@once
@pytest.mark.parametrize(
    "x, u, w, match",
    [
        (jnp.zeros(3), jnp.zeros(1), None, r"x \(the state\) must have shape \(2,\)"),
        (jnp.zeros(2), jnp.zeros(2), None, r"u \(the control\) must have shape \(1,\)"),
        (jnp.zeros(2), jnp.zeros(1), jnp.zeros(3), r"w \(the disturbance\)"),
    ],
)
def test_bad_shapes_of_a_step(x, u, w, match):
    env = dlx.Environment(DYNAMICS, COST)
    with user_error(match=match):
        env.step(0.0, x, u, w)
    with user_error(match=match):
        env.dynamics(0.0, x, u, w)


@once
def test_a_cost_that_is_no_scalar():
    env = dlx.Environment(DYNAMICS, dlx.costs.Function(lambda t, x, u: x))
    with user_error(match=r"stage cost must be a scalar, got an array of shape \(2,\)"):
        env.step(0.0, jnp.zeros(2), jnp.zeros(1))


@once
def test_whole_numbers_are_clipped_as_numbers():
    env = dlx.Environment(DYNAMICS, COST, control_bounds=(-0.5, 0.5), horizon=2)
    assert env.saturate(jnp.array([1])) == 0.5

    class Whole(dlx.AbstractController):
        def __call__(self, t, y, state):
            return jnp.array([1]), state

    run = dlx.rollout(env, Whole(), key=jax.random.key(0))
    assert run.incident_counts["clipped_control"] == 2


@once
def test_uniform_state():
    with user_error(match="low <= high"):
        dlx.environments.UniformState(jnp.ones(2), jnp.zeros(2))


@once
def test_replace_checks_and_converts():
    env = dlx.make("pendulum")
    wider = dlx.replace(env, {"control_bounds": (-3, 3.0)})
    assert all(eqx.is_array(end) for end in wider.control_bounds)
    with user_error(match="control_bounds must have low <= high"):
        dlx.replace(env, {"control_bounds": (2.0, -2.0)})
    with user_error(match="cost must be an AbstractCost"):
        dlx.replace(env, {"cost": 3.0})
    with user_error(match="disturbance must have size 3, got size 2"):
        dynamics = dlx.LinearDynamics(jnp.eye(3), jnp.ones((3, 1)))
        noise = dlx.disturbances.Gaussian(0.1, size=2)
        dlx.replace(env, {"dynamics": dynamics, "disturbance": noise})
    with user_error(match="horizon.*structure"):
        dlx.replace(env, {"horizon": 100})
    with user_error(match="pendulum: max_speed"):
        dlx.environments.pendulum(solver=dlx.dynamics.RK4(), max_speed=1.0)


@once
@pytest.mark.parametrize("u", [1.0, jnp.ones(1), jnp.ones(3)])
def test_a_control_of_another_size_is_not_broadcast(u):
    env = dlx.make("kinematic_bicycle")
    for call in (lambda: env.step(0.0, jnp.zeros(4), u), lambda: env.saturate(u)):
        with user_error(match=r"u \(the control\) must have shape \(2,\)"):
            call()


@once
def test_sizes_of_matrices_that_are_given():
    model = dlx.linearize(dlx.systems.Pendulum())
    for given in (dict(A=jnp.eye(2), B=jnp.ones((2, 1))), dict(system=model, dt=0.05)):
        for size in (dict(states=5), dict(observations=1), dict(spectral_radius=0.5)):
            with user_error(match=f"lds: {next(iter(size))} applies only if"):
                dlx.make("lds", **given, **size)
