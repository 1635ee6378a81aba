"""What every controller must do. A new one is covered by being listed in
`controllers_catalogue.py`."""

import inspect
from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
import pytest
from controllers_catalogue import A, B, CASES, DT
from helpers import (
    assert_close,
    assert_refuses_nan,
    assert_same,
    needs_x64,
    once,
    user_error,
)
from jax.flatten_util import ravel_pytree

import delucax as dlx


c = dlx.controllers
CLOSE = dict(rtol=1e-4, atol=1e-5)  # in single precision


def over(cases):
    parameters = [pytest.param(case, id=name) for name, case in cases.items()]
    return pytest.mark.parametrize("case", parameters)


every = over(CASES)
particular = over({name: case for name, case in CASES.items() if case.reads_all})


def environment(dtype=None):
    """Smooth, unstable without control, and disturbed."""
    dtype = jnp.zeros(()).dtype if dtype is None else dtype
    dynamics = dlx.LinearDynamics(A.astype(dtype), B.astype(dtype), dt=DT)
    eye = jnp.eye(2, dtype=dtype)
    return dlx.Environment(
        dynamics,
        dlx.costs.Quadratic(eye, 0.1 * eye[:1, :1], final=eye),
        disturbance=dlx.disturbances.Gaussian(0.05, size=2),
        initial_state=jnp.array([0.5, -0.3], dtype),
        control_bounds=(-20.0, 20.0),
        horizon=8,
    )


@once
def test_every_controller_is_listed():
    members = {
        name
        for name, member in vars(c).items()
        if inspect.isclass(member) and issubclass(member, dlx.AbstractController)
    }
    made = lambda case: eqx.filter_eval_shape(case.make, 1.0)
    others = [case for name, case in CASES.items() if name not in members]
    listed = {type(made(case)).__name__ for case in others}
    assert members - listed - set(CASES) == set()
    assert members >= {"Zero", "LQR", "PID", "MLP", "Gaussian"}


def stacked(modules):
    return jax.tree.map(lambda *leaves: np.stack(leaves), *modules)


def drawn_for(key, count):
    """Keys, and disturbances: they are given, because to draw them takes half of the
    time that a rollout compiles."""
    rng = np.random.default_rng(0)
    w = 0.05 * rng.normal(size=(count, 8, 2)).astype(jnp.zeros(()).dtype)
    return jax.random.split(key, count), w


class Known(dlx.AbstractController):
    """A controller whose key is known beforehand."""

    base: dlx.AbstractController
    key: Any

    def init(self, *, key=None):
        return self.base.init(key=self.key)

    def __call__(self, t, y, state):
        return self.base(t, y, state)

    def applied(self, u, cost, state):
        return self.base.applied(u, cost, state)


@needs_x64
@every
def test_gradient(case, key):
    """It goes into plain `jax.jit`, where other numbers in it do not compile again.
    Every number that it holds has a finite gradient, and the right one."""
    env, traced, (keys, w) = environment(), 0, drawn_for(key, 1)
    arrays, rest = eqx.partition(case.make(1.0), eqx.is_inexact_array)
    flat, unravel = ravel_pytree(arrays)
    flat = np.asarray(flat)

    @jax.jit
    def both(controller):
        nonlocal traced
        traced += 1

        @eqx.filter_value_and_grad
        def cost(controller):
            return dlx.rollout(env, controller, key=keys[0], w=w[0]).total_cost

        return cost(controller)

    def at(numbers):
        return both(eqx.combine(unravel(numbers), rest))

    value, gradient = at(flat)
    gradient = [np.ravel(leaf) for leaf in jax.tree.leaves(gradient)]
    gradient = np.concatenate([np.zeros(0), *gradient])
    assert np.isfinite(value) and np.all(np.isfinite(gradient))
    # One direction a leaf, so that none hides behind a larger one.
    rng, start, h = np.random.default_rng(0), 0, 1e-6
    for path, leaf in jax.tree_util.tree_leaves_with_path(arrays):
        way = np.zeros(flat.shape)
        way[start : start + leaf.size] = rng.choice([-1.0, 1.0], size=leaf.size)
        start += leaf.size
        exact = np.dot(gradient, way)
        up, down = (at(flat + s * way)[0] for s in (h, -h))
        numeric = float(up - down) / (2 * h)
        assert abs(exact - numeric) < 1e-5 * max(1.0, abs(exact)), path
    arrays = eqx.filter(case.make(1.1), eqx.is_inexact_array)
    assert at(ravel_pytree(arrays)[0])[0] != value or not flat.size
    assert traced == 1


# With an integral, an estimator, a learner that hears of costs, a planner.
BY_HAND = ("Gaussian of PID", "LQG", "DRC", "MPC")


@once
@over({name: CASES[name] for name in BY_HAND})
def test_a_batch_is_each_by_hand(case, key):
    """A batch over controllers and keys is what calling each by hand does, its state
    carried by `lax.scan`."""
    env, pair = environment(), [case.make(1.0), case.make(1.1)]
    keys, w = drawn_for(key, 2)

    @jax.jit
    @jax.vmap
    def run(controller, known, w):
        return dlx.rollout(env, Known(controller, known), key=key, w=w).controls

    @jax.jit
    def by_hand(controller, known, w):
        state = controller.init(key=known)
        assert all(eqx.is_array(leaf) for leaf in jax.tree.leaves(state))

        def step(carry, inputs):
            x, state = carry
            k, w = inputs
            t = k * DT
            u, state = controller(t, env.dynamics.observe(t, x), state)
            step = env.step(t, x, u, w)
            state = controller.applied(step.control, step.cost, state)
            return (step.state, state), step.control

        return lax.scan(step, (env.reset(key), state), (jnp.arange(8), w))[1]

    batch = np.asarray(run(stacked(pair), keys, w))
    assert batch.shape == (2, 8, 1)
    for i, controller in enumerate(pair):
        assert_close(batch[i], by_hand(controller, keys[i], w[i]), **CLOSE)


@needs_x64
@every
def test_vmap_and_precision(case, key):
    """A batch over controllers and keys is traced as any; controls have the precision
    of the observation."""
    dtype = jnp.float32
    env, controller = environment(dtype), case.make(1.0)
    pair, (keys, w) = stacked([controller, case.make(1.1)]), drawn_for(key, 2)

    def act():  # nothing is compiled for the types alone
        state = controller.init(key=key)
        u, after = controller(0.1, jnp.array([0.3, -0.2], dtype), state)
        after = controller.applied(u, jnp.zeros((), dtype), after)
        return u, state, after

    @jax.vmap
    def run(controller, known, w):
        found = dlx.rollout(env, Known(controller, known), key=key, w=w)
        return found.controls, found.total_cost

    u, state, after = eqx.filter_eval_shape(act)
    assert u.dtype == dtype and u.shape == (1,)
    same = lambda a, b: a.shape == b.shape and a.dtype == b.dtype
    assert jax.tree.all(jax.tree.map(same, state, after))
    controls, cost = jax.eval_shape(run, pair, keys, w)
    assert controls.shape == (2, 8, 1) and cost.shape == (2,)
    assert controls.dtype == cost.dtype == dtype


@once
@particular
def test_wrong_observation(case, key):
    """An observation of another size is an error that names both sizes."""

    def act():  # sizes are known before anything is compiled
        controller = case.make(1.0)
        return controller(0.0, jnp.zeros(5), controller.init(key=key))

    match = "observation must have size 2, got size 5.*features=env.encode"
    with user_error(match=match):
        eqx.filter_eval_shape(act)


@once
@every
def test_no_number_can_be_replaced_by_nan(case):
    assert_refuses_nan(case.make(1.0))


@once
@every
def test_saved_and_loaded(case, tmp_path):
    """What is loaded is what was saved to the last bit, functions included, so that it
    acts alike and compiles no more."""
    controller = case.make(1.0)
    dlx.save(tmp_path / "controller.dlx", controller)
    loaded = dlx.load(tmp_path / "controller.dlx", trust=["controllers_catalogue"])
    assert type(loaded) is type(controller)
    assert_same(loaded, controller)
