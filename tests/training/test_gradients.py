import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from helpers import (
    assert_close,
    central_difference,
    dtype,
    needs_x64,
    user_error,
)
from jaxtyping import Array

import delucax as dlx
from delucax.training import (
    analytic,
    ClippedSamples,
    EvolutionStrategies,
    LikelihoodRatio,
    scored_cost,
)


pytestmark = needs_x64


A = np.array([[1.0, 0.3], [-0.2, 0.9]])
B = np.array([[0.0], [0.5]])
Q = np.array([[1.0, 0.2], [0.2, 0.5]])
R = np.array([[0.1]])
FINAL = 2 * np.eye(2)
START = np.array([1.0, -0.5])
NOISE = 0.3
HORIZON = 4


class Recalling(dlx.AbstractStochasticPolicy):
    """`h = decay h + y_0` is remembered, and `u ~ N(-gain h, exp(log_std)^2)`."""

    gain: Array = dlx.weight(0.8)
    decay: Array = dlx.weight(0.4)
    log_std: Array = dlx.weight(-1.0)

    def init(self, *, key=None):
        return jnp.zeros(()), key

    def _mean(self, y, memory):
        memory = self.decay * memory + y[0]
        return -self.gain * memory[None], memory

    def __call__(self, t, y, state):
        memory, key = state
        key, now = jr.split(key)
        mean, memory = self._mean(y, memory)
        u = mean + jnp.exp(self.log_std) * jr.normal(now, (1,), y.dtype)
        return u.astype(y.dtype), (memory, key)

    def log_prob(self, t, y, state, u):
        mean, _ = self._mean(y, state[0])
        z = (u - mean) / jnp.exp(self.log_std)
        return jnp.sum(-0.5 * z**2 - self.log_std - 0.5 * jnp.log(2 * jnp.pi))


def environment(*, bound=1e6, **kwargs):
    options = dict(
        control_bounds=(-bound, bound),
        cost=dlx.costs.Quadratic(Q, R, final=FINAL),
        disturbance=dlx.disturbances.Gaussian(NOISE, size=2),
        initial_state=jnp.asarray(START),
        horizon=HORIZON,
    )
    return dlx.environments.lds(A, B, **(options | kwargs))


def exact_cost(weights):
    """E[J] by the moments of the joint state (x, h), in closed form."""
    gain, decay, log_std = weights
    variance = np.exp(2 * log_std)
    moments = np.outer(np.append(START, 0.0), np.append(START, 0.0))
    remember = np.array([[1.0, 0.0]])
    total = 0.0
    for _ in range(HORIZON):
        row = np.concatenate([remember, decay * np.ones((1, 1))], axis=1)  # next h
        act = -gain * row
        total += np.trace(Q @ moments[:2, :2])
        total += R[0, 0] * ((act @ moments @ act.T)[0, 0] + variance)
        plant = np.concatenate([A, np.zeros((2, 1))], axis=1) + B @ act
        step = np.concatenate([plant, row])
        drive = np.append(B[:, 0], 0.0)
        w = np.diag(np.array([NOISE**2, NOISE**2, 0.0]))
        moments = step @ moments @ step.T + variance * np.outer(drive, drive) + w
    return total + np.trace(FINAL @ moments[:2, :2])


@functools.cache
def episodes():
    """One loss for all tests of it: another one would compile again."""
    return scored_cost(environment())


@eqx.filter_jit
def _estimates(estimator, loss, model, keys):
    def one(key):
        value, gradient = estimator(loss, model, key)
        cost = value[0] if isinstance(value, tuple) else value
        leaves = [jnp.ravel(leaf) for leaf in jax.tree.leaves(gradient)]
        return cost, jnp.concatenate(leaves)

    return jax.vmap(one)(keys)


def estimates(estimator, loss, model, count):
    """Independent estimates of the loss and of the gradient, as matrices."""
    costs, gradients = _estimates(estimator, loss, model, jr.split(jr.key(1), count))
    return np.asarray(costs, float), np.asarray(gradients, float)


def assert_mean(samples, exact, power=0.2):
    """The mean is `exact` within 4 standard errors, which are small beside it."""
    error = samples.std(0) / np.sqrt(len(samples))
    assert np.all(error < power * np.abs(exact)), (error, exact)
    assert np.all(np.abs(samples.mean(0) - exact) < 4 * error), (
        samples.mean(0) - exact
    ) / error


# The numbers of draws are the same throughout, so that each estimator compiles once.
ANALYTIC = (analytic, 4000)
SCORED = (LikelihoodRatio(32), 4000)
NO_BASELINE = (LikelihoodRatio(32, baseline=False), 16000)


@pytest.mark.parametrize(
    "estimator", [ANALYTIC, SCORED, NO_BASELINE], ids=["analytic", "scored", "plain"]
)
def test_the_gradient_of_a_random_closed_loop_is_unbiased(estimator):
    estimator, count = estimator
    weights = np.array([0.8, 0.4, -1.0])
    exact = central_difference(exact_cost, weights)
    loss = episodes()
    costs, gradients = estimates(estimator, loss, Recalling(), count)
    assert_mean(costs, exact_cost(weights))
    assert_mean(gradients, exact, power=0.25)


def test_a_baseline_lowers_the_variance():
    loss = episodes()
    _, scored = estimates(SCORED[0], loss, Recalling(), SCORED[1])
    _, plain = estimates(NO_BASELINE[0], loss, Recalling(), NO_BASELINE[1])
    assert np.all(scored.var(0) < 0.5 * plain.var(0))


def test_the_scored_episode_is_that_of_a_rollout():
    env, policy, key = environment(), Recalling(), jr.key(7)
    cost, metrics = scored_cost(env)(policy, key)
    keep = ("observations", "controls")
    run = dlx.rollout(env, policy, key=key, horizon=HORIZON, keep=keep)
    assert cost == run.total_cost
    state, score = policy.init(), 0.0
    for y, u in zip(run.observations, run.controls, strict=True):
        score += policy.log_prob(0.0, y, state, u)
        state = policy._mean(y, state[0])[1], None
    assert_close(metrics["log_prob"], score)


def test_saturated_controls_are_scored_as_drawn():
    # The bounds cut most draws. The gradient through the clip is unbiased too.
    loss = scored_cost(environment(bound=0.3))
    _, pathwise = estimates(ANALYTIC[0], loss, Recalling(), ANALYTIC[1])
    _, scored = estimates(SCORED[0], loss, Recalling(), SCORED[1])
    error = np.hypot(*(g.std(0) / np.sqrt(len(g)) for g in (pathwise, scored)))
    assert np.all(np.abs(scored.mean(0) - pathwise.mean(0)) < 4 * error)
    assert np.all(error < 0.15 * np.abs(pathwise.mean(0)).max())


def test_a_score_stops_where_the_episode_does():
    env = environment(terminated=lambda t, x: t > 1.5)  # two steps
    loss = scored_cost(env)
    slope = eqx.filter_jit(
        jax.grad(lambda model: loss(model, jr.key(0))[1]["log_prob"])
    )(Recalling()).log_std
    # Each step adds e^2 - 1 to the slope in log_std; drawn again here from the key.
    *_, key = env.split_key(jr.key(0))
    _, key = Recalling().init(key=key)
    total = 0.0
    for _ in range(2):
        key, now = jr.split(key)
        total += jr.normal(now, (1,), dtype())[0] ** 2 - 1
    assert_close(slope, total, rtol=1e-9)


def quadratic(model, key):
    """Quadratic in the weights: smoothing moves its value, not its gradient."""
    w, b = model["w"], model["b"]
    pull = jnp.sum(jnp.array([1.0, 2.0]) * (w - 1.0) ** 2) + 3 * (b - 0.5) ** 2
    return pull + b * w[0] + (1 + w[1]) * jr.normal(key, dtype=w.dtype)


WEIGHTS = {"b": jnp.asarray(2.0), "w": jnp.array([-1.0, 0.5])}
EXACT = np.array([6 * 1.5 - 1.0, -4.0 + 2.0, -2.0])  # b, w0, w1


@pytest.mark.parametrize("antithetic", [True, False])
def test_evolution_strategies_are_unbiased_on_a_quadratic(antithetic):
    estimator = EvolutionStrategies(0.5, samples=64, antithetic=antithetic)
    costs, gradients = estimates(estimator, quadratic, WEIGHTS, 4000)
    assert_mean(gradients, EXACT)
    # The value is that of the unperturbed weights: pulls of 4, 0.5 and 6.75, less 2.
    assert_mean(costs, 4.0 + 0.5 + 6.75 - 2.0)


def test_evolution_strategies_smooth_the_loss():
    # d/dm E[(m + s e)^3] = 3 m^2 + 3 s^2
    estimator = EvolutionStrategies(0.5, samples=64)
    _, gradients = estimates(estimator, lambda m, key: m**3, jnp.asarray(0.2), 4000)
    assert_mean(gradients, np.array([3 * 0.2**2 + 3 * 0.5**2]))


def test_antithetic_noise_cancels_even_terms():
    def loss(m, key):
        return 100 * m**2 + m

    start = jnp.asarray(0.0)
    one = EvolutionStrategies(0.1, 8, antithetic=False)
    _, one = estimates(one, loss, start, 50)
    _, both = estimates(EvolutionStrategies(0.1, 8), loss, start, 50)
    assert both.std() < 0.5 * one.std()


def test_samples_that_run_away_are_shortened():
    # Slopes 1, ..., 7; one of a million; and one that is not finite.
    slopes = jnp.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 1e6, jnp.nan])
    keys = jr.split(jr.key(0), slopes.size)

    def loss(m, key):
        matches = jnp.all(jr.key_data(keys) == jr.key_data(key), axis=1)
        return m * jnp.sum(jnp.where(matches, slopes, 0))

    start = jnp.asarray(2.0)
    value, slope = ClippedSamples(slopes.size, factor=2.0)(loss, start, jr.key(0))
    # The middle one of the eight is 4.5.
    assert_close(slope, (28 + 2 * 4.5) / 8, rtol=1e-6)
    assert_close(value, 2 * (28 + 1e6) / 8, rtol=1e-6)
    _, slope = ClippedSamples(4)(lambda m, key: m * jnp.nan, start, jr.key(0))
    assert np.isnan(slope)
    (value, _), _ = ClippedSamples(4)(lambda m, key: [m**2, {}], start, jr.key(0))
    assert_close(value, 4.0)


ESTIMATORS = [
    analytic,
    ClippedSamples(4),
    EvolutionStrategies(0.1, 4),
    LikelihoodRatio(4),
]


@pytest.mark.parametrize("estimator", ESTIMATORS, ids=lambda e: type(e).__name__)
def test_estimators_share_one_signature(estimator):
    class Part(dlx.AbstractController):
        gain: Array = dlx.weight()
        limit: Array = dlx.parameter(2.0)

        def __call__(self, t, y, state):
            return -self.gain, state

    def loss(model, key):
        cost = jnp.sum(model.gain**2) + model.limit
        return cost, {"log_prob": jnp.sum(model.gain), "limit": model.limit}

    model = Part(gain=jnp.ones(2))
    estimate = eqx.filter_jit(estimator)
    value, gradient = estimate(loss, model, jr.key(0))
    cost, metrics = value
    assert_close(cost, 4.0, rtol=1e-6)
    assert metrics["limit"] == 2.0  # a constant is not perturbed
    assert gradient.gain.shape == (2,) and gradient.limit is None
    assert gradient.gain.dtype == model.gain.dtype
    again = estimate(loss, model, jr.key(0))[1]
    np.testing.assert_array_equal(gradient.gain, again.gain)
    # Under jit, and on plain arrays, where every one moves.
    _, gradient = jax.jit(
        lambda x: estimator(lambda x, k: (x @ x, {"log_prob": x[0]}), x, jr.key(0))
    )(jnp.ones(3))
    assert gradient.shape == (3,)


def test_a_loss_without_metrics_returns_a_scalar():
    for estimator in ESTIMATORS[:3]:
        value, _ = estimator(lambda x, key: jnp.sum(x**2), jnp.ones(2), jr.key(0))
        assert_close(value, 2.0, rtol=1e-6)


def test_wrong_estimators_are_named():
    for match, make in (
        ("factor must be positive", lambda: ClippedSamples(factor=0.0)),
        ("sigma must be positive", lambda: EvolutionStrategies(0.0, 4)),
        (
            "samples must be even when antithetic is true, got 3",
            lambda: EvolutionStrategies(1, 3),
        ),
        ("samples must be a whole number", lambda: EvolutionStrategies(1.0, 0)),
        ("samples must be at least 2 with a baseline", lambda: LikelihoodRatio(1)),
    ):
        with user_error(match=match):
            make()
    assert LikelihoodRatio(1, baseline=False).samples == 1
    with user_error(
        match=r"loss must return \(cost, \{'log_prob': ...\}\), got the met"
    ):
        LikelihoodRatio(4)(lambda m, k: (m, {"x": m}), jnp.asarray(1.0), jr.key(0))
    with user_error(
        match="scored_cost: the controller must be a .*Stochastic.* got Zero"
    ):
        scored_cost(environment())(dlx.controllers.Zero(1), jr.key(0))
