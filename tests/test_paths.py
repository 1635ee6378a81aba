"""`replace` and `randomise`: all changes at once, and then every owner's checks."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, assert_same, Drift, once, user_error
from hypothesis import given, settings, strategies as st
from jaxtyping import Array

import delucax as dlx
from delucax._module import _paths


d = dlx.disturbances
A, B = np.array([[1.0, 0.1], [0.0, 0.9]]), np.array([[0.0], [0.1]])


def plant(n=2):
    return dlx.LinearDynamics(np.eye(n), np.ones((n, 1)), dt=0.1)


def cost(n=2):
    return dlx.costs.Quadratic(np.ones(n), np.ones(1))


def task(n=2):
    return dlx.Environment(plant(n), cost(n), control_bounds=(-2.0, 2.0))


def noisy(**options):
    noise = d.Gaussian(0.1, size=2)
    return dlx.Environment(plant(), cost(), noise, **options)


class Split(dlx.AbstractController):
    """Its gains sum to one, and lie in a dictionary in a tuple."""

    gains: tuple[dict[str, Array], ...]
    base: Any

    def __check_init__(self):
        total = sum(sum(part.values()) for part in self.gains)
        if np.abs(total - 1) > 1e-6:
            raise ValueError(f"Split: gains must sum to 1, got {total}.")
        if np.any(self.base.K < 0):
            raise ValueError("Split: K must not be negative.")

    def __call__(self, t, y, state):
        return self.base(t, y, state)


def split():
    part = {"a": jnp.array(0.2), "b": jnp.array(0.3)}
    return Split((part, {"a": jnp.array(0.5)}), dlx.controllers.Linear([[1.0, 2.0]]))


@once
@pytest.mark.parametrize(
    "make, changes, match",
    [
        (plant, {"dt": -1.0}, "dt must be positive"),
        (plant, {"dt": [0.1, 0.2]}, "dt must be a number"),
        (plant, {"A": np.eye(3)}, "B must have as many rows as A"),
        (plant, {"A": np.eye(3), "B": np.ones((3, 1))}, r"x_ref must .*\(3,\)"),
        (plant, {"x_ref": np.ones(3)}, r"x_ref must have shape \(2,\)"),
        (task, {"dynamics.dt": -1.0}, "dt must be positive"),
        (task, {"dynamics.A": np.eye(3)}, "B must have as many rows as A"),
        (task, {"dynamics": plant(3)}, "cost must fit a state of size 3 .*Q has"),
        (task, {"dynamics": plant(3), "cost": cost(3), "disturbance": d.Zero(2)},
            "disturbance must have size 3, got size 2"),
        (noisy, {"dynamics": plant(3), "cost": cost(3)},
            "disturbance must have size 3, got size 2"),
        (lambda: noisy(initial_state=np.ones(2)),
            {"dynamics": plant(3), "cost": cost(3), "disturbance": d.Zero(3)},
            r"initial_state must have shape \(3,\)"),
        (task, {"cost.R": np.ones(2)}, "cost must fit .*control of size 1"),
        (task, {"control_bounds.0": 5.0}, "control_bounds must have low <= high"),
        (task, {"control_bounds.0": [1.0, 2.0]}, r"control_bounds must be .*\(1,\)"),
        (task, {"initial_state": [np.nan, 0.0]}, "initial_state must be finite"),
        (task, {"cost.Q": [np.nan, 0.0]}, "must be finite"),
        (task, {"dynamics.state_names.0": "x"}, "structure"),
        (task, {"dynamics.state_size": 3}, "has no 'state_size'"),
        (split, {"gains.0.a": 0.3}, "gains must sum to 1"),
        (split, {"gains.1": {"a": jnp.array(0.7)}}, "gains must sum to 1"),
        (split, {"base.K": [[-1.0, 2.0]]}, "K must not be negative"),
        (lambda: d.Constant(1.0, size=2) + d.Constant(2.0, size=2),
            {"terms.0": d.Constant(1.0, size=3)}, "must have the same size"),
        (lambda: (plant(), {"p": plant()}), {"1.p.dt": -1.0}, "dt must be positive"),
        (lambda: dlx.controllers.LQR(dlx.LinearDynamics(A, B), np.eye(2), np.eye(1)),
            {"K": np.ones((3, 3))}, r"LQR: shapes must fit each other, .*\(3, 3\)"),
        (lambda: dlx.make("single_compartment"),
            {"dynamics.dynamics.system.resistance": [1.0, 2.0]}, "does not accept"),
    ],
)  # fmt: skip
def test_what_the_constructor_refuses(make, changes, match):
    with user_error(match=match):
        dlx.replace(make(), changes)


@once
@pytest.mark.parametrize(
    "make, changes",
    [
        (lambda: d.Uniform(-1.0, 1.0, size=2), {"low": 3.0, "high": 5.0}),
        (lambda: d.Constant(1.0, size=1).between(0.0, 1.0), {"stop": 8, "start": 5}),
        (lambda: dlx.environments.UniformState([0.0], [1.0]), {"low": 2, "high": 3}),
        (split, {"gains.0.a": 0.4, "gains.1.a": 0.3}),
        (split, {"gains.0.a": 0.4, "base": dlx.controllers.Linear([[1.0]]),
            "gains.1.a": 0.3}),
        (task, {"control_bounds.0": 5.0, "control_bounds.1": 6.0}),
        (task, {"control_bounds": None}),
        (task, {
            "initial_state": np.ones(3),
            "dynamics": plant(3),
            "disturbance": d.Zero(3),
            "cost": cost(3),
        }),
        (noisy, {"dynamics": plant(3), "cost": cost(3), "disturbance": d.Zero(3)}),
    ],
)  # fmt: skip
def test_changes_that_fit_together(make, changes):
    """In any order, though values between may not be legal."""
    forwards = dlx.replace(make(), changes)
    assert jax.tree.structure(forwards) is not None
    backwards = dlx.replace(make(), dict(reversed(changes.items())))
    assert_same(forwards, backwards)


@once
@pytest.mark.parametrize("n", [1, 3])
def test_defaults_follow_the_dynamics(n):
    env = dlx.replace(task(), {"dynamics": plant(n), "cost": cost(n)})
    assert_same(env, task(n))
    inner = (env, {"dynamics": plant(2), "cost": cost(2)})
    pair = dlx.replace(inner, {"0.dynamics": plant(2), "0.cost": cost(2)})
    assert_same(pair[0], task())
    own = dlx.replace(env, {"dynamics": plant(2), "cost": cost(2),
                            "disturbance": d.Gaussian(0.1, size=2)})  # fmt: skip
    assert isinstance(own.disturbance, d.Gaussian)
    assert own.initial_state.shape == (2,)
    drift = dlx.Discretized(Drift(), 0.1, substeps=3)
    noise = dlx.replace(env, {"dynamics": drift, "cost": cost(1)}).disturbance
    assert isinstance(noise, d.Brownian) and noise.size == noise.substeps == 3
    # That there is no noise was said, and is not the default.
    calm = dlx.Environment(drift, cost(1), d.Zero(3))
    fewer = dlx.Discretized(Drift(), 0.1, substeps=2)
    with user_error(match="disturbance must have size 2, got size 3"):
        dlx.replace(calm, {"dynamics": fewer})
    batch = jax.vmap(lambda _: task())(jnp.arange(4))
    new = jax.vmap(lambda _: task(n))(jnp.arange(4))
    changes = {k: getattr(new, k) for k in ("dynamics", "cost", "initial_state")}
    assert dlx.replace(batch, changes).disturbance.size == n


def test_a_changed_number_adds_nothing_to_the_program():
    env = task()
    traced = jax.make_jaxpr(lambda dt: dlx.replace(env, {"dynamics.dt": dt}).dt)
    assert not traced(0.2).jaxpr.eqns


@once
def test_a_random_window_crosses_the_old_one(key):
    window = d.Constant(1.0, size=1).between(0.0, 1.0)
    ranges = {"start": (5.0, 6.0), "stop": (7.0, 8.0)}
    draw = lambda key: dlx.randomise(window, key, ranges)
    for one in (draw(key), jax.jit(draw)(key)):
        assert 5 <= one.start <= 6 and 7 <= one.stop <= 8
    with user_error(match="stop must be at least"):
        dlx.randomise(window, key, {"start": (9.0, 9.5), "stop": (7.0, 8.0)})


@once
@settings(max_examples=50, deadline=None, database=None)
@given(
    st.permutations(["low", "high", "bounds"]), st.integers(-50, 50), st.integers(0, 9)
)
def test_any_order_of_any_legal_box(order, low, width):
    box = d.Uniform(-1.0, 1.0, size=1)
    pair = (box, (task(), box))
    values = {
        "low": {"1.1.low": low},
        "high": {"1.1.high": low + width},
        "bounds": {"1.0.control_bounds": (low, low + width)},
    }
    changes = {}
    for name in order:
        changes |= values[name]
    env, changed = dlx.replace(pair, changes)[1]
    assert changed.low == low and changed.high == low + width
    assert env.control_bounds[1] == low + width


def test_traced_values():
    """Their shapes are checked, and their values cannot be."""
    env = task()

    def paid(low, dt):
        changes = {"control_bounds.0": low, "control_bounds.1": 9.0, "dynamics.dt": dt}
        env_ = dlx.replace(env, changes)
        step = env_.step(0.0, jnp.ones(2), jnp.full(1, -4.0))
        return step.cost + env_.dt

    # The control is clipped to `low`, and pays its square.
    assert_close(paid(-3.0, 0.1), 2 + 9 + 0.1, rtol=1e-6)
    value, slopes = jax.jit(jax.value_and_grad(paid, (0, 1)))(-3.0, 0.1)
    assert_close(value, 2 + 9 + 0.1, rtol=1e-6)
    assert_close(jnp.stack(slopes), [-6.0, 1.0], rtol=1e-6)
    values = jax.vmap(paid, (0, None))(jnp.array([-1.0, -2.0]), 0.1)
    assert_close(values, np.array([2 + 1 + 0.1, 2 + 4 + 0.1]), rtol=1e-6)
    with user_error(match="initial_state must have shape"):
        jax.jit(lambda x: dlx.replace(env, {"initial_state": x}))(jnp.ones(3))


@once
def test_a_batch_of_modules(key):
    """What `vmap` made has one more axis everywhere, and can be changed."""
    ranges = {"dynamics.A": lambda k: jax.random.normal(k, (2, 2))}
    keys = jax.random.split(key, 3)
    batch = jax.vmap(lambda k: dlx.randomise(task(), k, ranges))(keys)
    starts = jnp.arange(6.0).reshape(3, 2)
    changed = dlx.replace(batch, {"initial_state": starts})
    assert_close(changed.initial_state, starts)
    with user_error(match="must be finite"):
        dlx.replace(batch, {"dynamics.B": jnp.full((3, 2, 1), jnp.nan)})
    low, high = -jnp.ones(3), jnp.ones(3)
    with user_error(match="low <= high.* member 1 of a batch"):
        dlx.replace(batch, {"control_bounds.0": low.at[1].set(5.0)})
    one = jax.vmap(lambda a, b: d.Uniform(a, b, size=1))(low, high)
    assert_close(dlx.replace(one, {"high": 2 * high}).high, 2.0)
    with user_error(match="member 2 of a batch"):
        dlx.replace(one, {"high": high.at[2].set(-9.0)})
    rows = jax.vmap(jax.vmap(lambda a, b: d.Uniform(a, b, size=1)))
    grid = rows(jnp.stack([low, low]), jnp.stack([high, high]))
    with user_error(match="member 2 of a batch. It is member 1 of a batch"):
        dlx.replace(grid, {"high": grid.high.at[1, 2].set(-9.0)})
    ends = jax.jit(lambda high: dlx.replace(one, {"high": high}).high)
    assert_close(ends(-9 * high), -9.0)  # traced, so that it cannot be looked at
    gains = eqx.filter_vmap(dlx.controllers.Linear)(jnp.ones((5, 1, 2)))
    scheduled = dlx.controllers.Scheduled(gains, 0.1)
    doubled = dlx.replace(scheduled, {"controllers.K": 2 * jnp.ones((5, 1, 2))})
    assert_close(doubled.controllers.K, 2.0)
    with user_error(match="arrays with one leading axis"):
        scalar = eqx.tree_at(lambda c: c.K, doubled.controllers, jnp.ones(()))
        dlx.replace(scheduled, {"controllers": scalar})


@once
def test_every_member_of_a_batch_is_checked():
    """Those with no extreme number too: here the others reach further."""
    low = jnp.tile(jnp.array([-9.0, -1.0]), 500)
    batch = jax.vmap(lambda low: d.Uniform(low, -low, size=1))(low)
    with user_error(match="member 777 of a batch"):
        dlx.replace(batch, {"high": batch.high.at[777].set(-2.0).at[0].set(-8.0)})


@once
def test_a_large_batch(monkeypatch):
    """Of which the extreme members are looked at, and others, and a warning says so."""
    monkeypatch.setattr(_paths, "_MOST_MEMBERS", 64)
    batch = jax.vmap(lambda high: d.Uniform(-1.0, high, size=1))(jnp.ones(500))
    assert 32 <= len(_paths._members(batch)) <= 64
    with user_error(match="member 321 of a batch"):
        dlx.replace(batch, {"high": batch.high.at[321].set(-2.0)})
    with pytest.warns(UserWarning, match="Uniform is a batch of 500 members, and only"):
        dlx.replace(batch, {"high": 2 * batch.high})


LEGAL = [
    {"start": (5.0, 6.0), "stop": (7.0, 8.0)},
    {"start": (5.0, 6.0), "stop": (6.0, 8.0)},
    {"start": (5, 6), "stop": lambda key: 7 + jax.random.uniform(key)},
    {"start": (0.5, 0.5), "stop": (0.5, 0.5)},
]
CROSSED = [
    {"start": (-1.0, 1.5)},
    {"start": (5.0, 7.5), "stop": (7.0, 8.0)},
    {"start": (7.5, 8.5), "stop": (7.0, 9.0)},
]


def under(how, draw, key):
    keys = jax.random.split(key, 3)
    calls = {
        "eager": lambda: [draw(key) for key in keys],
        "jit": lambda: jax.jit(draw)(key),
        "vmap": lambda: jax.vmap(draw)(keys),
        "grad": lambda: jax.jvp(lambda x: draw(key, x), (1.0,), (1.0,)),
    }
    return calls[how]()


@once
@pytest.mark.parametrize("how", ["eager", "jit", "vmap", "grad"])
def test_ranges_are_checked_by_their_ends(how, key):
    def draw(ranges, make):
        made = make(1.0)  # what is made under jit is traced, all of it

        def draw(key, x=None):
            tree = made if x is None else make(x)
            return jax.tree.leaves(dlx.randomise(tree, key, ranges))

        return draw

    window = lambda x: d.Constant(1.0 * x, size=1).between(0.0, 1.0)
    for ranges in LEGAL:
        under(how, draw(ranges, window), key)
    for ranges in CROSSED:
        with user_error(match="stop must be at least.*within the ranges of randomise"):
            under(how, draw(ranges, window), key)
    pendulum = lambda x: dlx.replace(
        dlx.make("pendulum"), {"dynamics.system.length": x}
    )
    mass = "dynamics.system.mass"
    under(how, draw({mass: (0.0, 1.0)}, pendulum), key)  # 0 itself is hardly drawn
    for low, high in ((-2.0, -1.0), (-0.01, 1.0), (0.0, 0.0)):
        with user_error(match="Pendulum: mass must be positive"):
            under(how, draw({mass: (low, high)}, pendulum), key)
    for low, high in ((2.0, 1.0), (1.0, np.inf), (np.nan, 1.0)):
        with user_error(match="must be finite and have low <= high"):
            under(how, draw({mass: (low, high)}, pendulum), key)
    with user_error(match="control_bounds must have low <= high"):
        under(how, draw({"control_bounds.0": (0.0, 5.0)}, pendulum), key)


@once
def test_a_module_that_checks_nothing():
    """Its parameters are checked all the same."""

    class Bare(eqx.Module):
        gain: Array = dlx.parameter(1.0, constraint=dlx.positive)

    with user_error(match="gain must be positive"):
        dlx.replace(Bare(), {"gain": -1.0})
    assert_close(dlx.replace({"a": [Bare()]}, {"a.0.gain": 2.0})["a"][0].gain, 2.0)


@once
def test_bounds_become_arrays():
    pid = dlx.controllers.PID(1.0, dt=0.1)
    for controller in (
        dlx.replace(pid, {"bounds": (-1, 1), "reference": lambda t: jnp.ones(1)}),
        dlx.replace(dlx.controllers.Gaussian(pid, -1.0), {"bounds": (-1, 1)}),
    ):
        assert all(eqx.is_array(leaf) for leaf in jax.tree.leaves(controller))
        with user_error(match="bounds must have low <= high"):
            dlx.replace(controller, {"bounds.0": 3.0})
    wide = dlx.replace(pid, {"kp": [1.0, 2.0]})
    assert wide.loops == 2 and wide.init().integral.shape == (2,)
    with user_error(match="one entry per loop"):
        dlx.replace(wide, {"ki": [1.0, 2.0, 3.0]})


@once
@pytest.mark.parametrize(
    "changes, match",
    [
        (
            {"dynamics.A": 2 * A, "dynamics": plant()},
            "paths must not overlap, got 'dynamics' and 'dynamics.A'",
        ),
        (
            {"dynamics": plant(), "dynamics.A": 2 * A},
            "paths must not overlap, got 'dynamics' and 'dynamics.A'",
        ),
        ({3: 1.0}, "a path must be a string.*got 3"),
        ({"": 1.0}, "a path must not be empty"),
        ({None: 1.0}, "a path must be a string.*got None"),
    ],
)
def test_paths_that_cannot_be(changes, match, key):
    with user_error(match=f"replace: {match}"):
        dlx.replace(task(), changes)
    with user_error(match=f"randomise: {match}"):
        dlx.randomise(task(), key, changes)
