import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, needs_x64, once, user_error

import delucax as dlx


d = dlx.disturbances
TIMES = 0.1 * jnp.arange(2000)
ALL = {
    "zero": d.Zero(2),
    "constant": d.Constant(0.5, size=2),
    "sinusoid": d.Sinusoid(jnp.array([0.1, 0.2]), frequency=0.5, phase=0.3, offset=0.1),
    "square": d.Square(0.3, period=jnp.array([2.0, 3.0])),
    "array": d.FromArray(jnp.ones((2000, 2))),
    "gaussian": d.Gaussian(jnp.array([0.1, 0.2]), mean=0.05),
    "uniform": d.Uniform(-0.1, jnp.array([0.1, 0.3])),
    "walk": d.RandomWalk(size=2),
    "brownian": d.Brownian(1, dt=0.1, substeps=2),
    "sum": d.Gaussian(0.1, size=2) + d.Constant(1.0, size=2),
    "window": d.Gaussian(0.1, size=2).between(1.0, 2.0),
    "shock": d.shock(jnp.array([0.0, 1.0]), start=5.0, duration=0.5),
}


@eqx.filter_jit
def draw(disturbance, key, times):
    return disturbance.sequence(key, times)


@once
@pytest.mark.parametrize("name", ALL)
def test_contract(name, key):
    disturbance = ALL[name]
    w = disturbance.sequence(key, TIMES)
    assert w.shape == (2000, disturbance.size) == (2000, 2)
    assert w.dtype == TIMES.dtype
    keys = jnp.stack([key, jax.random.key(1)])
    batch = jax.jit(jax.vmap(lambda k: disturbance.sequence(k, TIMES)))(keys)
    assert_close(batch[0], w, atol=1e-4)
    other = name in ("gaussian", "uniform", "walk", "brownian", "sum", "window")
    assert np.any(np.asarray(batch[1] != batch[0])) == other


@once
def test_a_sequence_is_few_programs(key):
    """Each operation outside of a compiled function would be a program of its own."""
    compiled = []

    def heard(event, seconds, **_):
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(event)

    keys = jax.random.split(key)
    times = jax.device_put(np.arange(13, dtype=np.float32))
    jax.monitoring.register_event_duration_secs_listener(heard)
    try:
        for name, disturbance in ALL.items():
            before = len(compiled)
            disturbance.sequence(keys[0], times)
            assert len(compiled) - before <= 6, name
    finally:
        jax.monitoring.unregister_event_duration_listener(heard)


@once
def test_every_public_disturbance_is_listed():
    kinds = {type(x) for x in ALL.values()}
    public = {
        v
        for v in vars(d).values()
        if isinstance(v, type)
        and issubclass(v, dlx.AbstractDisturbance)
        and v is not dlx.AbstractDisturbance
    }
    assert public <= kinds


@once
def test_deterministic_values():
    t = jnp.array([0.0, 0.25, 0.5, 1.0])
    sine = d.Sinusoid(2.0, frequency=1.0, size=1).sequence(None, t)
    assert_close(sine[:, 0], [0, 2, 0, 0], atol=1e-6)
    square = d.Square(3.0, period=1.0, duty=0.4, size=1).sequence(None, t)
    assert_close(square[:, 0], [3, 3, -3, 3])
    shock = d.shock(2.0, start=0.25, duration=0.5, size=1).sequence(None, t)
    assert_close(shock[:, 0], [0, 2, 2, 0])
    recorded = d.FromArray(jnp.arange(6.0).reshape(6, 1)).sequence(None, t)
    assert_close(recorded[:, 0], [0, 1, 2, 3])


@once
def test_moments(key):
    normal = ALL["gaussian"].sequence(key, TIMES)
    assert_close(normal.mean(axis=0), [0.05, 0.05], atol=0.015)
    assert_close(normal.std(axis=0), [0.1, 0.2], rtol=0.05)
    uniform = ALL["uniform"].sequence(key, TIMES)
    assert np.all((uniform >= -0.1) & (uniform <= jnp.array([0.1, 0.3]) + 1e-6))
    assert_close(uniform.mean(axis=0), [0.0, 0.1], atol=0.01)
    increments = ALL["brownian"].sequence(key, TIMES)
    assert_close(increments.std(axis=0), np.sqrt(0.05) * np.ones(2), rtol=0.05)
    walk = ALL["walk"].sequence(key, TIMES)
    assert np.all(np.abs(walk) <= 1) and np.max(np.abs(np.diff(walk, axis=0))) < 1.5


RANDOM = {
    "gaussian": lambda n: d.Gaussian(0.1, mean=0.05, size=n),
    "uniform": lambda n: d.Uniform(-0.1, 0.3, size=n),
    "walk": lambda n: d.RandomWalk(size=n),
    "brownian": lambda n: d.Brownian(n, dt=0.1),
    "sum": lambda n: d.Gaussian(0.1, size=n) + d.Uniform(-1, 1, size=n).between(1, 20),
}


@needs_x64
@pytest.mark.parametrize("name", RANDOM)
def test_a_short_horizon_is_the_beginning_of_a_long_one(name, key):
    """In both precisions."""
    for size, times, shorter in (
        (1, TIMES, (2,)),
        (3, TIMES.astype(jnp.float32), (17,)),
    ):
        disturbance = RANDOM[name](size)
        long = draw(disturbance, key, times[:100])
        for steps in shorter:
            short = draw(disturbance, key, times[:steps])
            # Programs of two sizes may round differently.
            close = 4 * np.finfo(times.dtype).eps * np.max(np.abs(long))
            assert_close(short, long[:steps], atol=close)


@once
def test_recorded_steps():
    recorded = d.FromArray(jnp.ones((5, 1)))
    assert recorded.recorded_steps == 5
    assert recorded.between(0.0, 1.0).recorded_steps == 5
    longer = d.FromArray(jnp.ones((7, 1)))
    assert (d.Gaussian(0.1, size=1) + longer + recorded).recorded_steps == 5
    assert ALL["gaussian"].recorded_steps is None


class Half(d.AbstractDisturbance):
    """A wrapper that forwards nothing."""

    inside: d.AbstractDisturbance

    @property
    def size(self):
        return self.inside.size

    def sequence(self, key, times):
        return self.inside.sequence(key, times) / 2


@once
def test_a_wrapper_need_not_forward_the_recorded_steps(key):
    half = Half(d.FromArray(jnp.ones((1, 1))))
    assert half.recorded_steps == 1
    assert Half(d.Gaussian(0.1, size=1)).recorded_steps is None
    dynamics = dlx.LinearDynamics(jnp.eye(1), jnp.ones((1, 1)), dt=0.1)
    cost = dlx.costs.Quadratic([1.0], [1.0])
    env = dlx.Environment(dynamics, cost, half, sensor_noise=half, horizon=1)
    run = dlx.rollout(env, dlx.controllers.Zero(1), key=key)
    assert run.observations == 0.5 and run.final_state == 0.5
    theirs = dlx.interop.gymnax.to_gymnax(env)
    observation, _ = theirs.reset(key, theirs.default_params)
    assert_close(observation, [0.5])


@once
def test_sum_draws_each_with_its_own_key(key):
    one = d.Gaussian(1.0, size=1)
    both = (one + one).sequence(key, TIMES)
    assert_close(both.std(), np.sqrt(2), rtol=0.05)


@once
@pytest.mark.parametrize("name", ["gaussian", "uniform", "walk", "brownian", "sum"])
def test_a_seed_for_a_key(name):
    with user_error(match="key must be one random key.*got 0"):
        ALL[name].sequence(0, TIMES)


@once
def test_ends_that_meet_are_legal(key):
    times = TIMES[:3]
    for still in (d.Gaussian(0.0, size=1), d.Uniform(0.0, 0.0, size=1)):
        assert np.all(still.sequence(key, times) == 0)
    moved = jax.jit(lambda s: d.Gaussian(s, size=1).sequence(key, times))(0.0)
    assert np.all(moved == 0)


@once
@pytest.mark.parametrize(
    "make, match",
    [
        (lambda: d.Gaussian(0.1), "size must be given"),
        (lambda: d.Gaussian(jnp.ones(2), jnp.ones(3)), "must have 2 entries, got 3"),
        (lambda: d.Constant(jnp.ones((2, 2))), "value must be a number or a vector"),
        (lambda: d.Constant(jnp.array([jnp.nan])), "value must be finite"),
        (lambda: d.Square(1.0, period=0.0, size=1), "period must be positive"),
        (lambda: d.FromArray(jnp.ones(3)), "values must be a matrix"),
        (lambda: d.FromArray(jnp.ones((3, 1))).sequence(None, TIMES), "horizon, got 3"),
        (lambda: d.Gaussian(1.0, size=1).sequence(None, TIMES), "key must be"),
        (lambda: d.Sum(d.Zero(1), d.Zero(2)), "same size"),
        (lambda: d.Brownian(1, dt=-1.0), "dt must be positive"),
        (lambda: d.Zero(0), "size must be a whole number of at least 1"),
        (lambda: d.Gaussian(-0.1, size=1), "std must be at least 0, got -0.1"),
        (lambda: d.Uniform(1, -1, size=1), "high must be at least 1.0, got -1"),
        (lambda: d.RandomWalk(-0.1, size=1), "std must be at least 0, got -0.1"),
        (lambda: d.RandomWalk(bound=-1, size=1), "bound must be at least 0, got -1"),
        (lambda: d.Square(1.0, 1.0, duty=2, size=1), "duty must be between 0 and 1"),
        (lambda: d.shock(1.0, 1.0, duration=-1, size=1), "duration must be at least 0"),
        (lambda: d.shock(1.0, 1.0, "long", size=1), "at least 0, got 'long'"),
        (lambda: d.Zero(1).between(3.0, 2.0), "stop must be at least 3.0, got 2"),
        (lambda: d.Sum(d.Zero(1), 1.0), "every term must be an .*got float"),
        (lambda: d.Brownian(1, dt="x"), "dt must be positive and finite, got 'x'"),
    ],
)
def test_bad_arguments(make, match):
    with user_error(match=match):
        make()


@once
def test_the_built_in_sum_adds_disturbances_and_costs():
    two = [d.Constant(1.0, size=2), d.Constant(0.5, size=2)]
    assert_close(sum(two).sequence(None, TIMES[:1]), [[1.5, 1.5]])
    cost = dlx.costs.Quadratic([1.0], [1.0])
    one = jnp.ones(1)
    assert_close(sum([cost, 2 * cost])(0.0, one, one), 3 * cost(0.0, one, one))
