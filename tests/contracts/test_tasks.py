"""What every named task must do. A new one is covered by being registered."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, needs_x64, once, thorough, user_error
from scipy.integrate import solve_ivp

import delucax as dlx


# What a task cannot be made without.
ARGUMENTS = {
    "lds": dict(key=jax.random.key(1), states=3, observations=2),
    "neural": dict(key=jax.random.key(2), width=8),
}
NAMES = dlx.environments.registered()
PAPERS = {
    "classic/acrobot",
    "classic/cartpole",
    "classic/mountain_car",
    "classic/pendulum",
    "classic/planar_quadrotor",
    "lds",
    "reacher",
}


@functools.cache
def task(name):
    return dlx.make(name, **ARGUMENTS.get(name, {}))


def sequence(env, steps, seed=0):
    """Controls of which some are beyond the bounds."""
    rng = np.random.default_rng(seed)
    controls = rng.normal(0, 1, (steps, env.control_size))
    if env.control_bounds is not None:
        low, high = (np.asarray(end) for end in env.control_bounds)
        controls = (low + high) / 2 + (high - low) * controls
    return jnp.asarray(controls)


@once
def test_the_papers_names_are_there():
    assert PAPERS <= set(NAMES)


@once
@pytest.mark.parametrize("name", [n for n in NAMES if "/" in n])
def test_a_name_of_the_paper_is_the_same_task(name):
    short = task(name.partition("/")[2])
    assert jax.tree.structure(task(name)) == jax.tree.structure(short)
    leaves = zip(jax.tree.leaves(task(name)), jax.tree.leaves(short), strict=True)
    for a, b in leaves:
        assert_close(a, b)


@once
@pytest.mark.parametrize("name", [n for n in NAMES if "/" not in n])
def test_task(name, key, tmp_path):
    """It runs within its bounds at finite cost, encodes to the size that it says, and
    comes back from a file as it was."""
    env = task(name)
    controller = dlx.controllers.Sequence(sequence(env, 6))
    run = dlx.rollout(env, controller, key=key, horizon=6)
    for array in (run.states, run.observations, run.costs, run.final_cost):
        assert np.all(np.isfinite(array)) and array.dtype == jnp.zeros(()).dtype
    assert np.any(run.states[1:] != run.states[:-1])
    if env.control_bounds is not None:
        low, high = env.control_bounds
        assert np.all(run.controls >= low) and np.all(run.controls <= high)
        assert np.any(run.controls != controller.values)
    features = env.encode(run.observations[0])
    assert features.shape == (env.feature_size,)
    assert run.observations.shape == (6, env.observation_size)
    assert np.all(np.isfinite(features))

    dlx.save(tmp_path / "task.dlx", env)
    again = dlx.load(tmp_path / "task.dlx")
    assert jax.tree.structure(again) == jax.tree.structure(env)
    back = dlx.rollout(again, controller, key=key, horizon=6)
    np.testing.assert_array_equal(back.states, run.states)
    np.testing.assert_array_equal(back.costs, run.costs)


@once
@pytest.mark.parametrize("name", [n for n in NAMES if "/" not in n])
def test_a_wrong_argument_is_named(name):
    with user_error(match=f"{name}: no argument is called 'horizn'"):
        dlx.make(name, horizn=3, **ARGUMENTS.get(name, {}))


# The order of Gym's own arithmetic, where that is the default.
OWN_ORDERS = {
    "acrobot": 4,
    "cartpole": 1,
    "mountain_car": 1,
    "mountain_car_discrete": 1,
    "pendulum": 1,
}


def integrated():
    for name in NAMES:
        if "/" not in name and hasattr(task(name).dynamics, "system"):
            yield name


CONVERGENCE = ["acrobot", "reacher"]


@needs_x64
@pytest.mark.parametrize("name", CONVERGENCE)
def test_convergence(name):
    converges(name)


@thorough
@needs_x64
@pytest.mark.parametrize("name", [n for n in integrated() if n not in CONVERGENCE])
def test_convergence_of_the_others(name):
    converges(name)


def converges(name):
    """With finer steps under controls that switch, it goes to what SciPy finds, at the
    order of its solver."""
    env = task(name)
    system, interval = env.dynamics.system, float(env.dt)
    if isinstance(env.dynamics, dlx.Discretized):
        order = env.dynamics.solver.order(None)
    else:
        order = OWN_ORDERS[name]
    rng = np.random.default_rng(3)
    controls = sequence(env, 8, seed=6)
    if env.control_bounds is None:
        controls = 0.5 + 0.1 * controls
    else:
        low, high = env.control_bounds
        controls = low + (high - low) * rng.uniform(0.2, 0.8, controls.shape)
    x = np.asarray(env.reset(jax.random.key(5)))
    x0 = x + (0.01 if type(system) is not dlx.systems.Quadrotor else 0.0)
    w = jnp.zeros(system.disturbance_size) if system.disturbance_names else None
    field = jax.jit(lambda x, u: system.vector_field(0.0, x, u, w))
    x = x0
    for u in controls:
        found = solve_ivp(
            lambda _, x, u=u: np.asarray(field(x, u)),
            (0.0, interval),
            x,
            method="DOP853",
            rtol=1e-12,
            atol=1e-13,
        )
        assert found.success
        x = found.y[:, -1]

    def error(pieces):
        dynamics = dlx.make(
            name, dt=interval / pieces, **ARGUMENTS.get(name, {})
        ).dynamics
        states = dlx.open_loop(dynamics, x0, jnp.repeat(controls, pieces, axis=0))
        return np.max(np.abs(states[-1] - x) / (1 + np.abs(x)))

    pieces = 2 if order > 1 else 16
    coarse, fine = error(pieces), error(2 * pieces)
    if coarse < 1e-12:  # where the solver is exact
        assert fine < 1e-12
        return
    assert fine < 0.01
    assert 0.8 * 2**order < coarse / fine < 1.5 * 2**order
