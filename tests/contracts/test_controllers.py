"""What every controller must do. A new one is covered by being listed here."""

import inspect
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
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
from jax.flatten_util import ravel_pytree

import delucax as dlx


c = dlx.controllers
DT = 0.1
A = jnp.array([[1.0, DT], [0.3 * DT, 0.98]])
B = jnp.array([[0.0], [DT]])
FEEDBACK = jnp.array([[1.0, 1.5]])
CLOSE = dict(rtol=1e-4, atol=1e-5)  # in single precision


class Case(NamedTuple):
    """`make(size)` is the controller with its numbers near `size` times some others."""

    make: Any
    reads_all: bool = True  # whether an observation of the wrong size is an error


def lqr(size):
    return c.LQR(dlx.LinearDynamics(A, B, dt=DT), size * jnp.eye(2), jnp.eye(1))


def hinfinity(size, horizon=None):
    dynamics = dlx.LinearDynamics(A, B, dt=DT)
    weights = size * jnp.eye(2), jnp.eye(1)
    return c.HInfinity(dynamics, *weights, gamma=100.0, horizon=horizon)


def ramp(t):
    return jnp.stack([0.1 * t, 0.1 + 0 * t])


def finite(size):
    dynamics, eye = dlx.LinearDynamics(A, B, dt=DT), jnp.eye(2)
    options = dict(final=size * eye, horizon=12, reference=ramp)
    return c.FiniteHorizonLQR(dynamics, size * eye, jnp.eye(1), **options)


def lqi(size):
    dynamics = dlx.LinearDynamics(A, B, dt=DT)
    output, target = jnp.eye(1, 2), jnp.array([0.2])
    return c.LQI(
        dynamics, size * jnp.eye(3), jnp.eye(1), output=output, reference=target
    )


def ahead(size):
    dynamics = dlx.LinearDynamics(A, B, dt=DT)
    signals = dict(reference=[0.1 * size, 0.0], disturbance=[0.0, 0.1], preview=2)
    return c.LQR(dynamics, size * jnp.eye(2), jnp.eye(1), **signals)


def lqg(size, **options):
    noise = 0.05 * size * jnp.eye(2), 0.1 * jnp.eye(2)
    dynamics = dlx.LinearDynamics(A, B, dt=DT)
    return c.LQG(dynamics, size * jnp.eye(2), jnp.eye(1), *noise, **options)


def estimated(kind, size):
    noise = 0.05 * size * jnp.eye(2), 0.1 * jnp.eye(2)
    filtered = kind(dlx.LinearDynamics(A, B, dt=DT), *noise, covariance=noise[0])
    return c.OutputFeedback(c.PID(size, 2.0, dt=DT, output=[[1.0, 0.1]]), filtered)


def moving(*given, **options):
    return dlx.estimators.MHE(*given, 3, robust=0.5, **options)


def mlp(size, in_size=2, features=None):
    key = jax.random.key(int(10 * size))
    options = dict(features=features, bounds=(-2.0 * size, 2.0), key=key)
    return c.MLP(in_size, 1, width=4, depth=2, **options)


def choosing(size):
    logits = c.MLP(2, 3, width=4, depth=1, key=jax.random.key(int(10 * size)))
    return c.Categorical(logits, size * jnp.array([[-1.0], [0.0], [1.0]]))


def learner(kind, size, **options):
    """As fast as it need be for its weights to matter."""
    dynamics = dlx.LinearDynamics(A, B, dt=DT)
    cost = dlx.costs.Quadratic(size * jnp.eye(2), 0.1 * jnp.eye(1))
    options = dict(horizon=3, learning_rate=size) | options
    return kind(dynamics, cost, **options)


def swing(size):
    """A learner that linearises along the way."""
    dynamics = dlx.Discretized(dlx.systems.Pendulum(), dt=DT)
    cost = dlx.costs.Quadratic(size * jnp.eye(2), 0.1 * jnp.eye(1))
    base = c.Linear(size * jnp.array([[20.0, 5.0]]))
    return c.drc(dynamics, cost, base=base, memory=2, horizon=3, learning_rate=size)


def network(size):
    key = jax.random.key(int(10 * size))
    return learner(c.neural_gpc, size, memory=2, width=3, key=key)


def bandit(size):
    dynamics = dlx.LinearDynamics(A, B, dt=DT)
    options = dict(memory=2, horizon=3, learning_rate=size, delta=size)
    return c.BPC(dynamics, c.Linear(size * FEEDBACK), **options)


def build(model):
    cost = dlx.costs.Quadratic(jnp.eye(2), 0.1 * jnp.eye(1))
    # A base by default is a Riccati equation, which the case `LQR` has.
    base = c.Linear(FEEDBACK)
    return c.gpc(model, cost, base=base, memory=2, horizon=3)


def explorer(size):
    return c.Explore(build, size * FEEDBACK, steps=5, scale=2 * size, dt=DT)


def scheduled(size):
    gains = size * jnp.linspace(1, 2, 5)
    return c.Scheduled(eqx.filter_vmap(lambda g: c.Linear(g * FEEDBACK))(gains), DT)


def receding(size, **options):
    cost = dlx.costs.Quadratic(size * jnp.eye(2), 0.1 * jnp.eye(1), final=jnp.eye(2))
    return c.MPC(dlx.LinearDynamics(A, B, dt=DT), cost, 4, **options)


def drawn(size):
    planner = dlx.planning.MPPI(8, 1, scale=2.0, temperature=size)
    # Constant controls would tie with a plan of them a step later: the cheaper of two
    # starts has a kink there.
    start = jnp.array([[0.1], [-0.2], [0.3], [0.1]])
    return receding(size, planner=planner, start=start)


class Below(eqx.Module):
    """A barrier on the first state and the speed."""

    level: jax.Array = dlx.parameter()

    def __call__(self, t, x):
        return self.level + 0.1 * t - x[0] - 0.3 * x[1]


def filtered(size):
    plant = dlx.systems.LinearSystem([[0.0, 1.0], [0.3, -0.2]], [[0.0], [1.0]])
    options = dict(decay=2 * size, price=50 * size, bounds=(-20.0, 20.0))
    options["degrees"] = 1  # it is made while it is traced
    return c.SafetyFilter(c.Linear(FEEDBACK), plant, Below(0.1 * size), **options)


def filtered_in_steps(size):
    plant = dlx.LinearDynamics(A, B, dt=DT)
    barriers = {"below": Below(0.2 * size), "above": above}
    options = dict(decay=0.3 * size, disturbance=0.01 * size, weight=size, degrees=1)
    return c.SafetyFilter(c.Linear(FEEDBACK), plant, barriers, **options)


def above(t, x):
    return x[1] + 0.3


def features(y):
    return jnp.stack([y[0], y[1], y[0] * y[1]])


CASES = {
    "Zero": Case(lambda size: c.Zero(1), reads_all=False),
    "Constant": Case(lambda size: c.Constant([size]), reads_all=False),
    "Random": Case(lambda size: c.Random([size], 0.1), reads_all=False),
    "OpenLoop": Case(lambda size: c.OpenLoop(size * jnp.ones((4, 1))), False),
    "Linear": Case(lambda size: c.Linear(size * FEEDBACK)),
    "LQR": Case(lqr),
    "LQR that looks ahead": Case(ahead),
    "FiniteHorizonLQR": Case(finite),
    "LQI": Case(lqi),
    "LQG": Case(lqg),
    "LQG from the start": Case(lambda size: lqg(size, steady_state=False)),
    "OutputFeedback": Case(
        lambda size: estimated(dlx.estimators.ExtendedKalmanFilter, size)
    ),
    "OutputFeedback of an unscented filter": Case(
        lambda size: estimated(dlx.estimators.UnscentedKalmanFilter, size)
    ),
    "OutputFeedback of a moving horizon": Case(lambda size: estimated(moving, size)),
    "HInfinity": Case(hinfinity),
    "HInfinity over a horizon": Case(lambda size: hinfinity(size, horizon=8)),
    "PID": Case(lambda size: c.PID(size, 2 * size, 0.3, dt=DT, output=[[1.0, 0.1]])),
    "PID on an index": Case(
        lambda size: c.PID([size], 2.0, 0.3, dt=DT, output=0, reference=0.1 * size),
        reads_all=False,
    ),
    "LeakyPID": Case(lambda size: c.LeakyPID(size, dt=DT, output=[[1.0, 0.1]])),
    "MLP": Case(mlp),
    "MLP of features": Case(lambda size: mlp(size, 3, features), reads_all=False),
    "Gaussian": Case(lambda size: c.Gaussian(c.Linear(size * FEEDBACK), [-1.0])),
    "Gaussian of PID": Case(
        lambda size: c.Gaussian(
            c.PID(size, 2.0, dt=DT, output=[[1.0, 0.1]]), -1.0, bounds=(-9.0, 9.0)
        )
    ),
    "GRU": Case(lambda size: c.GRU(2, 1, 3, key=jax.random.key(int(10 * size)))),
    "History": Case(lambda size: c.History(mlp(size, 5), 2, 1)),
    "Categorical": Case(choosing, reads_all=False),
    "Categorical, greedy": Case(lambda size: choosing(size).greedy, reads_all=False),
    "Scheduled": Case(scheduled),
    "GPC": Case(lambda size: learner(c.gpc, size, memory=2)),
    "DRC": Case(lambda size: learner(c.drc, size, memory=2)),
    "DRC along the way": Case(swing),
    "SFC": Case(lambda size: learner(c.sfc, size, memory=4, filters=2)),
    "DSC": Case(lambda size: learner(c.sfc, size, memory=3, filters=1, double=True)),
    "NeuralGPC": Case(network),
    "GPC, fixed": Case(
        lambda size: learner(c.gpc, size, memory=2).fixed(size * jnp.ones((1, 4)))
    ),
    "Adaptive": Case(
        lambda size: c.Adaptive(learner(c.gpc, size, memory=2), slots=2, every=3)
    ),
    "BPC": Case(bandit),
    "Explore": Case(explorer),
    "MPC": Case(receding),
    "MPC that samples": Case(drawn),
    "SafetyFilter": Case(filtered),
    "SafetyFilter in steps": Case(filtered_in_steps),
}


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

    with user_error(match="observation of size 2, got size 5.*features=env.encode"):
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
    loaded = dlx.load(tmp_path / "controller.dlx", trust=[__name__])
    assert type(loaded) is type(controller)
    assert_same(loaded, controller)
