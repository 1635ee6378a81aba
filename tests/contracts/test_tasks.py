"""What every named task must do. A new one is covered by being registered."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    assert_close,
    assert_refuses_nan,
    assert_same,
    needs_x64,
    once,
    user_error,
)
from hypothesis import given, settings, strategies as st
from jax.flatten_util import ravel_pytree
from scipy.integrate import solve_ivp
from systems_catalogue import box, Case, sample, SYSTEMS

import delucax as dlx


# What a task cannot be made without.
ARGUMENTS = {
    "lds": dict(key=jax.random.key(1), states=3, observations=2),
    "neural": dict(key=jax.random.key(2), width=8),
}
NAMES = dlx.environments.registered()
ONCE = [n for n in NAMES if "/" not in n]
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
@pytest.mark.parametrize("name", ONCE)
def test_task(name, key, tmp_path):
    """It runs within its bounds at finite cost, encodes to the size that it says, and
    comes back from a file as it was."""
    env = task(name)
    controller = dlx.controllers.OpenLoop(sequence(env, 6))
    run = dlx.rollout(env, controller, key=key, horizon=6)
    for array in (run.states, run.observations, run.costs, run.final_cost):
        assert np.all(np.isfinite(array)) and array.dtype == jnp.zeros(()).dtype
    # NumPy compiles nothing.
    states, controls = np.asarray(run.states), np.asarray(run.controls)
    assert np.any(states[1:] != states[:-1])
    if env.control_bounds is not None:
        low, high = map(np.asarray, env.control_bounds)
        assert np.all(controls >= low) and np.all(controls <= high)
        assert np.any(controls != np.asarray(controller.values))
    features = np.asarray(jax.jit(jax.vmap(env.encode))(run.observations))
    assert features.shape == (6, env.feature_size)
    assert run.observations.shape == (6, env.observation_size)
    assert np.all(np.isfinite(features))
    if env.observation_bounds is not None:
        low, high = map(np.asarray, env.observation_bounds)
        assert low.shape == high.shape == features.shape[1:]
        assert np.all(features >= low) and np.all(features <= high)

    dlx.save(tmp_path / "task.dlx", env)
    again = dlx.load(tmp_path / "task.dlx")
    assert_same(again, env)


@once
@pytest.mark.parametrize("name", ONCE)
def test_a_wrong_argument_is_named(name):
    with user_error(match=f"{name}: no argument is called 'horizn'"):
        dlx.make(name, horizn=3, **ARGUMENTS.get(name, {}))


@once
@pytest.mark.parametrize("name", ONCE)
def test_no_number_can_be_replaced_by_nan(name):
    assert_refuses_nan(task(name))


def states_of(env, size, seed, edges):
    """States and controls of a task, at the ends of their boxes too."""
    rng, n, m = np.random.default_rng(seed), env.state_size, env.control_size
    system = getattr(env.dynamics, "system", None)
    case = SYSTEMS.get(type(system).__name__)
    if case is None or len(case.low) != n:
        case = Case(None, *box(*[1.0] * n), *box(*[1.0] * m), None)
    low, high = case.u_low, case.u_high
    if env.control_bounds is not None:
        low, high = (np.broadcast_to(end, m) for end in env.control_bounds)
    return sample(rng, size, edges, case.low, case.high), sample(
        rng, size, edges, low, high
    )


# Whose step is not that of a field, which `test_systems` has: the arithmetic of Gym and
# of the lungs.
STEPPED = ["acrobot", "cartpole", "lds", "mountain_car", "pendulum"]
STEPPED += ["balloon_lung", "double_compartment", "learned_lung"]


@functools.cache
def compiled_step(name):
    """A step with its cost, or the costs and features at a point, and the gradients
    with respect to all."""

    @jax.jit
    def step(env, x, u):
        arrays, rest = eqx.partition(env, eqx.is_inexact_array)

        def outputs(arrays, x, u):
            env = eqx.combine(arrays, rest)
            costs = env.cost(0.3, x, u), env.cost.final(0.3, x)
            return *costs, env.encode(env.dynamics.observe(0.3, x))

        def stepped(arrays, x, u):
            step = eqx.combine(arrays, rest).step(0.3, x, u)
            return step.state, step.cost

        def one(x, u):
            at = stepped if name in STEPPED else outputs
            out, back = jax.vjp(at, arrays, x, u)
            return out, back(jax.tree.map(jnp.ones_like, out))

        return jax.vmap(one)(x, u)

    return step


@once
@pytest.mark.parametrize("name", ONCE)
@settings(max_examples=10, deadline=None, database=None)
@given(seed=st.integers(0, 2**32 - 1), edges=st.sampled_from([0.0, 0.1, 0.5, 1.0]))
def test_a_step_is_finite_on_many(name, seed, edges):
    """Eight thousand states an example, in the precision that overflows first."""
    env = task(name)
    x, u = states_of(env, 8_000, seed, edges)
    for leaf in jax.tree.leaves(compiled_step(name)(env, x, u)):
        assert np.all(np.isfinite(leaf))


# Where a state runs into no limit within 200 steps.
CALM = {
    "acrobot": ([0.5, -0.4, 0.0, 0.0], 0.1),
    "cartpole": ([0.0, 0.1, 3.0, 0.0], 0.3),
    "mountain_car": ([-0.5, 0.0], 0.1),
    "pendulum": ([3.0, 0.0], 0.3),
}


@needs_x64
@pytest.mark.parametrize("name", CALM)
def test_gradient(name):
    """The gradient of a task's whole cost, by its own arithmetic, with respect to the
    start, the controls and every constant, along a direction, against its difference
    quotient. Arrivals have no gradient: a quadratic cost is in their place."""
    start, strength = CALM[name]
    n, steps = len(start), 200
    arguments = dict(terminated=None)
    if name != "pendulum":
        arguments["cost"] = dlx.costs.Quadratic(np.ones(n), np.ones(1))
    env = dlx.make(name, **arguments)
    rng = np.random.default_rng(4)
    controls = jnp.asarray(strength * rng.uniform(-1, 1, (steps, 1)))
    parts = eqx.partition(env.dynamics, eqx.is_inexact_array)
    theta, unravel = ravel_pytree((parts[0], jnp.array(start), controls))
    direction = rng.normal(0, 1, theta.size) * (np.abs(theta) + 0.01)

    def cost(theta):
        arrays, x0, controls = unravel(theta)
        plant = eqx.tree_at(lambda e: e.dynamics, env, eqx.combine(arrays, parts[1]))
        controller = dlx.controllers.OpenLoop(controls)
        key = jax.random.key(0)
        run = dlx.rollout(plant, controller, key=key, x0=x0, horizon=steps)
        return run.total_cost / steps

    @jax.jit
    def both(theta, direction):
        h = 3e-5
        near = jnp.array([2.0, 1.0, -1.0, -2.0]) * h
        f = jax.vmap(lambda s: cost(theta + s * direction))(near)
        quotient = (8 * (f[1] - f[2]) - (f[0] - f[3])) / (12 * h)
        gradient = jax.grad(cost)(theta)
        return gradient, jnp.dot(gradient, direction), quotient

    gradient, ours, theirs = both(theta, jnp.asarray(direction))
    assert np.all(np.isfinite(gradient)) and theirs != 0
    assert_close(ours, theirs, rtol=1e-6)


# The order of Gym's own arithmetic, where that is the default.
OWN_ORDERS = {
    "acrobot": 4,
    "cartpole": 1,
    "mountain_car": 1,
    "mountain_car_discrete": 1,
    "pendulum": 1,
}


@needs_x64
@pytest.mark.parametrize("name", [*OWN_ORDERS, "cstr", "planar_quadrotor", "quadrotor"])
def test_convergence(name):
    """With finer steps under controls that switch, it goes to what SciPy finds, at the
    order of its solver: by Gym's own arithmetic, with several steps an interval, by
    Euler's method, and with a constraint on the state."""
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

    pieces = 2 if order > 1 else 16

    def error(pieces, most=2 * pieces):
        dynamics = dlx.make(
            name, dt=interval / pieces, **ARGUMENTS.get(name, {})
        ).dynamics
        # As many steps as with the finest, so that one program does for all.
        held = np.repeat(controls, pieces, axis=0)
        held = np.pad(held, ((0, len(controls) * (most - pieces)), (0, 0)), "edge")
        states = dlx.open_loop(dynamics, x0, held)
        last = np.asarray(states)[len(controls) * pieces]
        return np.max(np.abs(last - x) / (1 + np.abs(x)))

    coarse, fine = error(pieces), error(2 * pieces)
    if coarse < 1e-12:  # where the solver is exact
        assert fine < 1e-12
        return
    assert fine < 0.01
    assert 0.8 * 2**order < coarse / fine < 1.5 * 2**order
