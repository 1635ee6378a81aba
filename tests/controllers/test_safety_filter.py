"""The least change of a control that keeps barriers, in continuous time."""

import functools
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, assert_gradient, needs_x64, once, tolerance

import delucax as dlx


c = dlx.controllers
KEY = jax.random.key(0)


class Affine(eqx.Module):
    """`rows x + level`, a number for one row."""

    rows: jax.Array = dlx.parameter()
    level: jax.Array = dlx.parameter(0.0)

    def __call__(self, t, x):
        return self.rows @ x + self.level


def free(size, **options):
    """A point whose velocity is the control."""
    given = dict(states=size, controls=size) | options
    return dlx.system(lambda t, x, u, w: u, **given)


@functools.cache
def made(rows, size=2, **options):
    """A filter of a point, made once for all numbers."""
    shape = (rows, size) if rows else (size,)
    given = np.ones(shape) + np.arange(size)
    barrier = Affine(given, np.zeros(rows) if rows else 0.0)
    return c.SafetyFilter(c.Constant(np.zeros(size)), free(size), barrier, **options)


def act(safe, rows, level, nominal, x=None):
    """The control and the state, for other numbers."""
    where = lambda s: (
        s.barriers["barrier"].rows,
        s.barriers["barrier"].level,
        s.controller.value,
    )
    safe = eqx.tree_at(where, safe, (rows, level, nominal))
    x = jnp.zeros_like(nominal) if x is None else x
    return safe(0.0, x, safe.init())


batch = lambda safe: jax.jit(jax.vmap(functools.partial(act, safe)))


def drawn(count, size, rows=0, seed=0):
    rng = np.random.default_rng(seed)
    shape = (count, rows, size) if rows else (count, size)
    level = rng.uniform(-3, 1, size=(count, rows) if rows else count)
    return rng.normal(size=shape), level, rng.normal(size=(count, size))


@needs_x64
def test_one_condition_is_a_projection():
    """Against the linear equations of the active condition."""
    a, level, n = drawn(500, 3)
    u, state = batch(made(0, 3))(a, level, n)
    for i in range(len(a)):
        K = np.block([[np.eye(3), -a[i][:, None]], [a[i][None], np.zeros((1, 1))]])
        projected = np.linalg.solve(K, np.append(n[i], -level[i]))[:3]
        expected = n[i] if a[i] @ n[i] + level[i] >= 0 else projected
        assert_close(u[i], expected, atol=1e-12 * max(1, np.abs(expected).max()))
    assert not np.any(state.failures.count)
    assert np.all(state.missed["barrier"] < 1e-14)


def by_bisection(a, level, n, low, high, weight, price):
    """The multiplier of one condition by halving an interval."""
    control = lambda push: np.clip(n + push * a / weight, low, high)
    value = lambda push: a @ control(push) + level + push / price
    if value(0.0) >= 0:
        return control(0.0)
    lo, hi = 0.0, 1e12
    for _ in range(200):
        middle = (lo + hi) / 2
        lo, hi = (middle, hi) if value(middle) < 0 else (lo, middle)
    return control(hi)


@needs_x64
@pytest.mark.parametrize("price", [None, 1e2, 1e8])
def test_one_condition_between_bounds(price):
    a, level, n = drawn(300, 3, seed=1)
    a[:50, 0] = 0.0
    low, high, weight = np.array([-1, -0.5, -np.inf]), np.array([1, 2, 0.7]), [1, 4, 2]
    options = dict(bounds=(tuple(low), tuple(high)), weight=tuple(weight), price=price)
    u, state = batch(made(0, 3, **options))(a, level, n)
    given = low, high, np.array(weight, float), price or np.inf
    feasible = 0
    for i in range(len(a)):
        expected = by_bisection(a[i], level[i], n[i], *given)
        reaches = a[i] @ expected + level[i] >= -1e-9
        feasible += reaches
        # Halving an interval of 1e12 leaves rounding of it, which a push is scaled by.
        if reaches or price is None:
            assert_close(u[i], expected, atol=1e-3 if abs(u[i]).max() > 1e3 else 1e-9)
        assert bool(state.failures.count[i]) == (not reaches and price is None)
    assert 0 < feasible < len(a) and np.all(np.isfinite(u))


def by_enumeration(rows, level, n, low, high):
    """The least change under hard conditions, by trying every set of two of them."""
    eye = np.eye(2)
    G = np.concatenate([rows, eye, -eye])
    h = np.concatenate([-level, low * np.ones(2), -high * np.ones(2)])
    best, least = None, np.inf
    for count in range(3):
        for active in map(list, itertools.combinations(range(len(G)), count)):
            u = n + np.linalg.pinv(G[active]) @ (h[active] - G[active] @ n)
            if np.all(G @ u >= h - 1e-9) and np.sum((u - n) ** 2) < least:
                best, least = u, np.sum((u - n) ** 2)
    return best


@needs_x64
def test_several_conditions_are_a_program():
    rows, level, n = drawn(400, 2, rows=3, seed=2)
    u, state = batch(made(3, bounds=(-2.0, 2.0)))(rows, level, n)
    known = [by_enumeration(*z, -2.0, 2.0) for z in zip(rows, level, n, strict=True)]
    for i, expected in enumerate(known):
        assert bool(state.failures.count[i]) == (expected is None)
        if expected is not None:
            assert_close(u[i], expected, atol=1e-7)
    assert 20 < sum(k is None for k in known) < 380
    assert np.all(np.abs(u) <= 2)


@needs_x64
def test_little_is_missed_at_the_bounds():
    """Changes of a millionth, from controls that are mostly at their bounds."""
    rows, level, n = drawn(400, 2, rows=3, seed=2)
    n = np.clip(3 * n, -2, 2)
    level = -np.einsum("npm,nm->np", rows, n) + 1e-6 * level
    u, state = batch(made(3, bounds=(-2.0, 2.0)))(rows, level, n)
    known = [by_enumeration(*z, -2.0, 2.0) for z in zip(rows, level, n, strict=True)]
    kept = np.array([k is not None for k in known])
    expected = np.stack([k for k in known if k is not None])
    assert_close(np.asarray(u)[kept], expected, atol=3e-9)
    assert 100 < kept.sum() < 400 and not np.any(np.asarray(state.failures.count)[kept])


@needs_x64
def test_what_is_missed_is_least():
    """Two conditions that contradict each other, and one that can hold."""
    rows, level = jnp.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0]]), jnp.full(3, -1.0)
    u, state = act(made(3, bounds=(-3.0, 3.0)), rows, level, jnp.array([0.2, 0.0]))
    # Between the two all controls miss the same sum; the nearest one is taken.
    assert_close(u, [0.2, 1.0], atol=1e-6)
    assert_close(state.missed["barrier"], [0.8, 1.2, 0.0], atol=1e-6)
    assert state.result == dlx.RESULTS.no_feasible_point
    # And at the bounds, where one condition asks for more than there is.
    u, state = act(made(0, bounds=(-3.0, 3.0)), rows[0], -5.0, jnp.array([0.2, 9.0]))
    assert_close(u, [3.0, 3.0])
    assert_close(state.missed["barrier"], 2.0, atol=1e-12)
    assert state.result == dlx.RESULTS.no_feasible_point


@needs_x64
def test_a_price_by_name():
    """What is soft gives way to what is hard; the price is that of the definition."""
    barriers = {"hard": Affine([1.0, 0.0], -1.0), "soft": Affine([-1.0, 0.5], 0.0)}
    nominal = c.Constant([0.0, 0.0])
    safe = c.SafetyFilter(nominal, free(2), barriers, price={"soft": 10.0})
    u, state = safe(0.0, jnp.zeros(2), safe.init())
    # On u_0 = 1: minimise u_1^2 / 2 + 10 (1 - u_1 / 2)^2 / 2.
    assert_close(u, [1.0, 5 / 3.5], atol=1e-7)
    assert_close(state.missed["soft"], 1 - 2.5 / 3.5, atol=1e-7)
    assert state.result == dlx.RESULTS.successful


@needs_x64
def test_prices_up_to_1e8():
    """No NaN, nor in a derivative, with the control seen little or not at all."""
    for rows in (0, 2):
        for price in (1.0, 1e4, 1e8):
            safe = made(rows, price=price)
            for size in (1.0, 1e-6, 0.0):
                a = size * jnp.array([[1.0, 0.5], [-1.0, 0.2]])[: rows or 1]
                a = a if rows else a[0]
                level = jnp.full(rows, -1.0) if rows else jnp.array(-1.0)
                u, slope = _valued(safe, a, level)
                assert np.all(np.isfinite(u))
                assert rows or np.all(np.isfinite(slope))


@eqx.filter_jit
def _valued(safe, rows, level):
    control = lambda rows: act(safe, rows, level, jnp.array([0.3, -0.2]))[0]
    return control(rows), jax.jacobian(control)(rows)


def test_a_hundred_thousand_states():
    a, level, n = drawn(100_000, 2, seed=3)
    kind = jnp.zeros(()).dtype
    x = np.random.default_rng(4).normal(size=n.shape)
    given = [jnp.asarray(z, kind) for z in (a, level, n, x)]
    u, state = batch(made(0, decay=2.0))(*given)
    a, level, n, x = (np.asarray(z, float) for z in given)
    u = np.asarray(u, float)
    dot = lambda p, q: np.sum(p * q, -1)
    value = dot(a, u) + 2 * (dot(a, x) + level)
    size = 1 + dot(np.abs(a), np.abs(u)) + 2 * (dot(np.abs(a), np.abs(x)) + 1)
    assert np.all(value >= -tolerance(1e-5, 1e-14) * size)
    assert np.mean(np.any(u != n, 1)) > 0.3
    assert not np.any(state.failures.count)


def test_a_hundred_thousand_states_between_bounds():
    """Where a control meets the condition, it does; where none does, it is said."""
    a, level, n = drawn(100_000, 2, seed=5)
    kind = jnp.zeros(()).dtype
    given = [jnp.asarray(z, kind) for z in (a, level, 2 * n)]
    u, state = batch(made(0, bounds=(-1.0, 1.5)))(*given)
    a, level, n, u = (np.asarray(z, float) for z in (*given, u))
    assert np.all((u >= -1) & (u <= 1.5))
    value = np.sum(a * u, -1) + level
    most = np.sum(np.where(a > 0, 1.5 * a, -a), -1) + level
    failed = np.asarray(state.failures.count) == 1
    tol = tolerance(1e-5, 1e-14) * (1 + np.sum(np.abs(a), -1) + np.abs(level))
    assert np.all(value >= np.minimum(most, 0) - tol)
    assert np.all(failed[most < -1e-2]) and not np.any(failed[most > 1e-2])
    assert 0.05 < failed.mean() < 0.5


class Lean(eqx.Module):
    most: jax.Array = dlx.parameter(0.5)

    def __call__(self, t, x):
        return self.most + 0.1 * jnp.sin(t) - x[0]


def upright(**options):
    nominal = c.Linear(jnp.array([[-1.0, -0.5]]))
    pendulum = dlx.systems.Pendulum(damping=0.1)
    return c.SafetyFilter(nominal, pendulum, Lean(), decay=(2.0, 3.0), **options)


def test_degree_two_by_hand():
    """Of a barrier that moves, about a pendulum: `b'' + 5 b' + 6 b >= 0`."""
    safe = upright()
    assert safe.degrees == (2,) and safe.names == ("barrier",)
    t, x = 0.7, jnp.array([0.4, 0.9])
    u, _ = safe(t, x, safe.init())
    b, db = 0.5 + 0.1 * np.sin(t) - 0.4, 0.1 * np.cos(t) - 0.9
    drift = -0.1 * np.sin(t) - (15 * np.sin(0.4) - 0.1 * 0.9)
    most = (drift + 5 * db + 6 * b) / 3
    assert most < 0.4 + 0.5 * 0.9
    assert_close(u, [most], rtol=1e-5)


def test_a_degree_for_each_barrier():
    """A barrier of the speed and one of the angle, in one filter."""
    barriers = {"speed": lambda t, x: 2 - x[1], "angles": lambda t, x: 1 - x**2}
    with pytest.raises(ValueError, match="sees? the control"):
        c.SafetyFilter(c.Zero(1), dlx.systems.Pendulum(), {"t": lambda t, x: 1.0 + t})
    safe = c.SafetyFilter(c.Zero(1), dlx.systems.Pendulum(), barriers)
    assert safe.names == ("angles[0]", "angles[1]", "speed")
    assert safe.degrees == (2, 1, 1)


class Wind(eqx.Module):
    def __call__(self, t, x, u, w):
        return jnp.stack([x[1] + 0.5 * w[0], u[0] + x[0] * w[1]])


@needs_x64
def test_a_margin_for_disturbances():
    """The condition holds for the worst disturbance, and is zero there."""
    plant = dlx.system(Wind(), states=2, controls=1, disturbances=2)
    bound = jnp.array([0.3, 0.2])
    barrier = lambda t, x: 1 - x[0] - 0.5 * x[1]
    nominal = c.Constant([5.0])
    safe = c.SafetyFilter(nominal, plant, barrier, disturbance=bound)
    x = jnp.array([0.3, 0.8])
    u, _ = safe(0.0, x, safe.init())
    rates = []
    for signs in itertools.product((-1, 0.3, 1), repeat=2):
        dx = plant.vector_field(0.0, x, u, bound * np.array(signs))
        rates.append(-dx[0] - 0.5 * dx[1] + barrier(0.0, x))
    assert_close(min(rates), 0.0, atol=1e-12)
    # Of degree two the disturbance is in the first order too.
    safe = c.SafetyFilter(nominal, plant, lambda t, x: 1 - x[0], disturbance=bound)
    u, _ = safe(0.0, x, safe.init())
    first = lambda x: -x[1] - 0.5 * 0.3 + 1 - x[0]
    slopes = [
        -dx[1] - dx[0]
        for signs in itertools.product((-1, 1), repeat=2)
        for dx in [plant.vector_field(0.0, x, u, bound * np.array(signs))]
    ]
    assert_close(min(slopes) + first(x), 0.0, atol=1e-12)


@needs_x64
def test_derivatives_in_closed_form():
    rows, level = np.array([1.0, 0.5]), -2.0
    bounded = made(0, bounds=(-1.0, 1.5), price=1e3, weight=(1.0, 3.0))
    for safe in (made(0), bounded):

        def control(z, safe=safe):
            u, _ = act(safe, z[:2], z[2], z[3:5], z[5:])
            return u @ jnp.array([1.0, -2.0])

        z = np.concatenate([rows, [level], [0.3, -0.4], [0.2, 0.1]])
        assert np.any(assert_gradient(control, z, atol=1e-7))


@needs_x64
def test_derivatives_between_bounds_that_may_be_infinite():
    """If the condition is active, and if it is not."""
    free = -np.inf, np.inf
    for bounds in (free, (-np.inf, 1.5), ((-1.0, -np.inf), (np.inf, 2.0))):
        safe = made(0, bounds=bounds)

        def control(z, safe=safe):
            u, _ = act(safe, z[:2], z[2], z[3:])
            return u @ jnp.array([1.0, -2.0])

        for level in (-2.0, 2.0):
            z = np.array([1.0, 0.5, level, 0.3, -0.4])
            assert np.any(assert_gradient(control, z, atol=1e-7))


@needs_x64
def test_derivatives_of_a_program():
    """At a corner of two conditions, where there is no closed form."""
    z = np.array([1.0, 0.2, 0.0, 0.1, 1.0, -0.3, -2.0, -1.5, 0.1, 0.2, 0.3, 1, 1, 2])
    for safe in (made(2, 3), made(2, 3, bounds=(-np.inf, 9.0))):

        def control(z, safe=safe):
            safe = eqx.tree_at(lambda s: s.weight, safe, z[11:])
            u, _ = act(safe, z[:6].reshape(2, 3), z[6:8], z[8:11])
            return u @ jnp.array([1.0, -2.0, 0.5])

        gradient = assert_gradient(control, z, atol=1e-6)
        assert np.all(gradient[:8] != 0)


@needs_x64
def test_derivatives_of_the_barrier():
    """Of degree two, by its numbers, the decay and the state."""

    def control(z):
        where = lambda s: (s.barriers["barrier"].most, s.decay, s.margin)
        safe = eqx.tree_at(where, upright(), (z[0], z[1:3][None], z[3:4]))
        return safe(0.3, z[4:], safe.init())[0][0]

    z = np.array([0.5, 2.0, 3.0, 0.1, 0.45, 0.9])
    assert np.all(assert_gradient(control, z, rtol=1e-6) != 0)


@once
def test_the_state_says_what_went_wrong():
    env = dlx.make("pendulum", dt=0.02)
    push = c.Constant([1.0])
    safe = c.SafetyFilter(push, env.dynamics.system, Lean(), bounds=(-0.5, 1.0))
    run = dlx.rollout(env, safe, key=KEY, x0=[0.45, 0.0], horizon=20)
    assert run.result == dlx.RESULTS.filter_failed and not run.failed
    assert run.incidents["failed_filter"][-1] and run.incident_counts["failed_filter"]
    assert np.all(run.controls[-1] == -0.5)
    u, state = safe(0.0, jnp.array([jnp.nan, 0.0]), safe.init())
    assert np.isnan(u).all() and state.result == dlx.RESULTS.ill_posed
    assert state.failures.count == 1


@once
def test_what_the_controller_hears():
    """Its state is its own, and it hears of the control that was applied."""

    class Heard(dlx.AbstractController):
        def init(self, *, key=None):
            return jnp.zeros(())

        def __call__(self, t, y, state):
            return jnp.ones(2), state + 1

        def applied(self, u, cost, state):
            return state + 10 * u[0]

    barrier = lambda t, x: 0.5 - x[0]
    safe = c.SafetyFilter(Heard(), free(2), barrier)
    u, state = safe(0.0, jnp.zeros(2), safe.init())
    state = safe.applied(u, jnp.zeros(()), state)
    assert_close(u, [0.5, 1.0], atol=1e-6)
    assert_close(state.controller, 6.0, atol=1e-5)


@needs_x64
def test_a_policy_is_trained_through_the_filter():
    """Of a gain that drives over the edge, the gradient knows the edge."""
    plant = dlx.systems.DoubleIntegrator()
    dynamics = dlx.Discretized(plant, 0.05)
    cost = dlx.costs.Function(lambda t, x, u: (x[0] - 2.0) ** 2 + 0.01 * u[0] ** 2)
    env = dlx.Environment(dynamics, cost, horizon=80, initial_state=jnp.zeros(2))

    class Goal(dlx.AbstractController):
        gains: jax.Array = dlx.weight(jnp.array([0.5, 0.2]))

        def __call__(self, t, y, state):
            return self.gains[:1] * (2 - y[0]) - self.gains[1:] * y[1], state

    wall = lambda t, x: 1.0 - x[0]
    safe = c.SafetyFilter(Goal(), plant, wall, decay=3.0)

    @jax.jit
    @jax.value_and_grad
    def total(gains):
        trained = eqx.tree_at(lambda s: s.controller.gains, safe, gains)
        run = dlx.rollout(env, trained, key=KEY)
        return run.total_cost

    gains = jnp.array([0.5, 0.2])
    first, slope = total(gains)
    numeric = [
        (total(gains + h)[0] - total(gains - h)[0]) / 2e-6 for h in 1e-6 * np.eye(2)
    ]
    assert_close(slope, numeric, rtol=1e-5)
    for _ in range(20):
        gains = gains - 0.02 * total(gains)[1]
    assert total(gains)[0] < 0.9 * first
    trained = eqx.tree_at(lambda s: s.controller.gains, safe, gains)
    run = dlx.rollout(env, trained, key=KEY)
    assert np.max(run.states[:, 0]) <= 1.0
