"""Rows of what varies in time, by the time."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import once, user_error
from hypothesis import given, settings, strategies as st

import delucax as dlx
from delucax.math._steps import row_at, step_at


pytestmark = once
T = 5
A = 0.9 * jnp.tile(jnp.eye(2), (T, 1, 1))
DYNAMICS = dlx.LinearDynamics(A, jnp.ones((2, 1)), dt=0.1)
STEADY = dlx.LinearDynamics(A[0], jnp.ones((2, 1)), dt=0.1)
Q, R = jnp.eye(2), jnp.eye(1)
X = jnp.ones(2)


def acting(controller):
    return lambda t: controller(t, X, controller.init(key=None))[0]


def plan():
    cost = dlx.costs.Quadratic(Q, R)
    return dlx.planning.ilqr(STEADY, cost, X, jnp.zeros((T, 1)), t0=0.0)


def scheduled():
    regulators = dlx.controllers.Linear(jnp.ones((1, 2)))
    tiled = jax.tree.map(lambda a: jnp.tile(a, (T, 1, 1)), regulators)
    return dlx.controllers.Scheduled(tiled, dt=0.1)


ROWS = {
    "dynamics": lambda: lambda t: DYNAMICS.advance(t, X, jnp.ones(1), None)[0],
    "LQR": lambda: acting(dlx.controllers.FiniteHorizonLQR(DYNAMICS, Q, R)),
    "H-infinity": lambda: acting(dlx.controllers.HInfinity(STEADY, Q, R, horizon=T)),
    "plan": lambda: acting(plan()),
    "schedule": lambda: acting(scheduled()),
}


@pytest.mark.parametrize("name", ROWS)
def test_rows_outside_the_horizon_are_nan(name):
    at = eqx.filter_jit(eqx.filter_vmap(ROWS[name]()))
    inside = at(0.1 * jnp.arange(T))
    assert np.all(np.isfinite(inside))
    before = at(-0.1 * jnp.array([1.0, 2.0, 5.0, 100.0]))
    assert np.all(np.isnan(before))
    after = at(0.1 * jnp.array([5.0, 9.0]))
    assert np.all(np.isnan(after)) != (name == "schedule")
    assert np.all(np.isnan(at(jnp.full(1, jnp.nan))))


@settings(max_examples=100, deadline=None)
@given(k=st.integers(-(2**31), 2**31 - 1))
def test_a_row(k):
    array = np.arange(1.0, 1 + T)
    row = row_at(jnp.asarray(array), jnp.asarray(k, jnp.int32))
    np.testing.assert_array_equal(row, array[k] if 0 <= k < T else np.nan)


@settings(max_examples=100, deadline=None)
@given(
    dt=st.sampled_from([0.01, 0.02, 0.001, 1 / 3]) | st.floats(1e-5, 10),
    k=st.integers(0, 2**22),
)
def test_the_step_of_a_time(dt, k):
    dt = jnp.asarray(dt)
    t = (jnp.asarray(k) * dt).astype(dt.dtype)
    assert step_at(t, dt, 2**22, "here") == k


def test_more_rows_than_single_precision_tells_apart():
    signal = dlx.references.Sequence(jnp.zeros((2**22 + 1, 1)), dt=0.1)
    with user_error(
        match="Sequence: the horizon must have at most 4194304.*cannot tell.*ENABLE_X64"
    ):
        signal(jnp.float32(0.3))
