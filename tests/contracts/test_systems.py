"""What every system must do. A new one is covered by being listed in
`systems_catalogue.py`."""

import functools
import inspect

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, needs_x64, once
from hypothesis import given, settings, strategies as st
from jax.flatten_util import ravel_pytree
from systems_catalogue import CONSERVED, sample, SYSTEMS

import delucax as dlx


# "Quadrotor by its wrench" is another form of the same class.
every = pytest.mark.parametrize("name", list(SYSTEMS))


@functools.cache
def system_of(name):
    return SYSTEMS[name].make()


def drawn(name, size, seed=0, edges=0.5):
    """States and controls inside their boxes, a share of the entries at the ends."""
    case, rng = SYSTEMS[name], np.random.default_rng(seed)
    states = sample(rng, size, edges, case.low, case.high)
    return states, sample(rng, size, edges, case.u_low, case.u_high)


def disturbed(system, size, seed=1):
    rng = np.random.default_rng(seed)
    return jnp.asarray(rng.normal(0, 0.1, (size, system.disturbance_size)))


@once
def test_every_system_is_listed():
    members = {
        name
        for name, member in inspect.getmembers(dlx.systems, inspect.isclass)
        if issubclass(member, dlx.AbstractSystem)
        and not issubclass(member, dlx.systems.AbstractSystemWrapper)
        and not inspect.isabstract(member)
    }
    assert members == {type(system_of(name)).__name__ for name in SYSTEMS}
    assert set(CONSERVED) <= members


@once
@every
def test_names_and_units(name):
    system = system_of(name)
    for names in (system.state_names, system.control_names, system.disturbance_names):
        assert len(set(names)) == len(names)
    assert len(system.state_units) in (0, system.state_size)
    assert len(system.control_units) in (0, system.control_size)


@functools.cache
def compiled_field(name):
    @jax.jit
    def both(system, x, u, w):
        def one(x, u, w):
            field = lambda system, x, u, w: system.vector_field(0.3, x, u, w)
            dx, back = jax.vjp(field, system, x, u, w)
            x_next = system.project(x + 0.01 * dx)
            apart = system.difference(x_next, x)
            return dx, apart, back(jnp.ones_like(dx))

        return jax.vmap(one, in_axes=(0, 0, None if w is None else 0))(x, u, w)

    return both


@once
@every
@settings(max_examples=10, deadline=None, database=None)
@given(seed=st.integers(0, 2**32 - 1), edges=st.sampled_from([0.0, 0.1, 0.5, 1.0]))
def test_finite_on_many(name, seed, edges):
    """Values, and gradients with respect to all there is, on eight thousand states and
    controls an example, in the precision that overflows first."""
    system = system_of(name)
    x, u = drawn(name, 8_000, seed, edges)
    w = disturbed(system, 8_000) if system.disturbance_names else None
    dx, apart, gradients = compiled_field(name)(system, x, u, w)
    assert dx.shape == apart.shape == x.shape and dx.dtype == x.dtype
    for leaf in jax.tree.leaves((dx, apart, gradients)):
        assert np.all(np.isfinite(leaf))
    assert np.mean(np.any(np.asarray(dx) != 0, axis=1)) > 0.9


@needs_x64
@every
def test_derivatives_are_central_differences(name):
    """The linearisation entry by entry, and the gradient with respect to every constant
    along a direction."""
    system = system_of(name)
    held = jnp.zeros(system.disturbance_size) if system.disturbance_names else None
    x, u = (one[0] for one in drawn(name, 1, seed=2))

    z = np.concatenate([x, u] if held is None else [x, u, held])
    cuts = (x.size, x.size + u.size)

    def linearised(system, z):
        def field(z):
            x, u, w = jnp.split(z, cuts)
            return system.vector_field(0.0, x, u, None if held is None else w)

        h, eye = 1e-4, jnp.eye(z.size)
        f = jax.vmap(field)(z + h * jnp.concatenate([eye, -eye, 2 * eye, -2 * eye]))
        a, b, c, d = jnp.split(f, 4)
        slopes = (8 * (a - b) - (c - d)) / (12 * h)
        return dlx.linearize(system, 0.0, *jnp.split(z, cuts)[:2]), slopes, field(z)

    rng = np.random.default_rng(5)
    theta, unravel = ravel_pytree(eqx.filter(system, eqx.is_inexact_array))
    rest = eqx.filter(system, eqx.is_inexact_array, inverse=True)
    weight = rng.normal(size=system.state_size)

    @jax.jit
    def both(theta):
        def weighed(theta):
            one = eqx.combine(unravel(theta), rest)
            return weight @ one.vector_field(0.0, x, u, held)

        one = eqx.combine(unravel(theta), rest)
        return jax.value_and_grad(weighed)(theta), linearised(one, z)

    theta = np.asarray(theta)
    way = rng.normal(size=theta.size) * (np.abs(theta) + 0.01)
    (value, gradient), (model, slopes, dx) = both(theta)
    f = [both(theta + s * 1e-4 * way)[0][0] for s in (2, 1, -1, -2)]
    quotient = (8 * (f[1] - f[2]) - (f[0] - f[3])) / (12 * 1e-4)
    assert np.all(np.isfinite(gradient))
    close = 1e-8 * (1 + abs(value) + abs(quotient))
    assert_close(np.dot(gradient, way), quotient, atol=close)

    blocks = [model.A, model.B] + ([] if model.E is None else [model.E])
    assert (model.E is None) == (held is None)
    ours = np.concatenate(blocks, axis=1).T
    assert_close(ours, slopes, atol=1e-8 * (1 + np.max(np.abs(slopes))))
    assert_close(model.dx_ref, dx, rtol=1e-12)


# The others rest somewhere.
NEVER_STILL = ["FunctionSystem", "NeuralSystem", "BouncingBall", "RimlessWheel"]
NEVER_STILL += ["SimplestWalker", "CompassGait"]


@needs_x64
@pytest.mark.parametrize("name", [n for n in SYSTEMS if n not in NEVER_STILL])
def test_equilibria_rest(name):
    system = system_of(name)
    x, u = system.equilibrium()
    held = jnp.zeros(system.disturbance_size) if system.disturbance_names else None
    dx = jax.jit(type(system).vector_field)(system, 0.0, x, u, held)
    scale = 1 + np.max(np.abs(x)) + np.max(np.abs(u))
    assert_close(dx, 0 * x, atol=1e-13 * scale)
    assert x.dtype == u.dtype == jnp.zeros(()).dtype


# A field of forces, one with a constraint on the state, one with disturbances.
ROLLED = [n for n in SYSTEMS if n in ("Acrobot", "Quadrotor")]
ROLLED += [n for n in SYSTEMS if "vortices" in n]


@needs_x64
@pytest.mark.parametrize("name", ROLLED)
def test_gradient_of_a_rollout(name):
    """The gradient of a rollout with respect to the start, the controls and every
    constant, along a direction, against its difference quotient."""
    system, case = system_of(name), SYSTEMS[name]
    x, u = drawn(name, 200, seed=4, edges=0.0)
    theta, unravel = ravel_pytree((eqx.filter(system, eqx.is_array), 0.5 * x[0], u))
    direction = np.random.default_rng(5).normal(0, 1, theta.size)
    direction = jnp.asarray(direction * (np.abs(theta) + 0.01))
    rest = eqx.filter(system, eqx.is_array, inverse=True)
    scale = 1 + jnp.max(jnp.abs(x), axis=0)

    def cost(theta):
        arrays, x0, controls = unravel(theta)
        dynamics = dlx.Discretized(eqx.combine(arrays, rest), case.dt)
        states = dlx.open_loop(dynamics, x0, controls)
        return jnp.mean(jnp.sum((states / scale) ** 2, axis=1))

    both, h = jax.jit(jax.value_and_grad(cost)), 3e-5
    f = [both(theta + s * h * direction)[0] for s in (2, 1, -1, -2)]
    quotient = (8 * (f[1] - f[2]) - (f[0] - f[3])) / (12 * h)
    gradient = both(theta)[1]
    assert np.all(np.isfinite(gradient)) and quotient != 0
    assert_close(np.dot(gradient, direction), quotient, rtol=1e-6)


@needs_x64
@pytest.mark.parametrize("name", CONSERVED)
def test_what_is_conserved_is_conserved(name):
    """To the fourth order of the solver, and exactly so where that is exact."""
    case = CONSERVED[name]
    system, steps = case.make(), 40

    @jax.jit
    def drift(dt):
        dynamics = dlx.Discretized(system, dt)
        value = functools.partial(case.value, system)
        controls = jnp.tile(jnp.array(case.u), (steps, 1))
        states = dlx.open_loop(dynamics, jnp.array(case.x0), controls)
        found = jax.vmap(value)(dt * jnp.arange(steps + 1), states)
        largest = jnp.max(jnp.abs(found), axis=0)
        return jnp.max(jnp.abs(found - found[0]) / (1e-3 + largest)), states

    (coarse, states), (fine, _) = drift(case.dt), drift(case.dt / 2)
    # The run moves: what stays is not merely the state.
    assert np.max(np.abs(states - states[0])) > 0.03
    assert 1e-14 < coarse < 1e-3
    # Over half the time with half the step, an error of order four falls 32-fold, and
    # an oscillating one at least 16-fold.
    assert fine < coarse / 12
