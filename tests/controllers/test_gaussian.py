import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats
from helpers import assert_close, assert_gradient, needs_x64, user_error

import delucax as dlx
from delucax._module import stack


pytestmark = needs_x64


Gaussian = dlx.controllers.Gaussian
A = jnp.array([[1.0, 0.1], [0.0, 0.9]])
B = jnp.array([[0.0], [0.1]])
MEAN = dlx.controllers.Linear(jnp.array([[1.0, 0.5]]))
BOUNDS = (-0.5, 0.7)


def lds(**options):
    return dlx.make("lds", A=A, B=B, initial_state=jnp.array([0.4, -0.2]), **options)


def test_draws(key):
    policy = Gaussian(dlx.controllers.Constant(jnp.array([1.0, -2.0])), [0.0, -1.0])
    keys = jax.random.split(key, 4000)
    draw = lambda k: policy(0.0, jnp.zeros(2), policy.init(key=k))[0]
    u = np.asarray(jax.jit(jax.vmap(draw))(keys))
    assert_close(u.mean(0), [1.0, -2.0], atol=0.06)
    assert_close(u.std(0), np.exp([0.0, -1.0]), rtol=0.05)
    run = dlx.rollout(lds(), Gaussian(MEAN, 0.0), key=key, horizon=50)
    noise = np.asarray(run.controls[:, 0]) + run.states[:-1] @ np.asarray(MEAN.K[0])
    assert len(np.unique(noise)) == 50  # a fresh draw a step
    assert_close(np.corrcoef(noise[1:], noise[:-1])[0, 1], 0.0, atol=0.5)


def test_density():
    policy = Gaussian(dlx.controllers.Constant(jnp.array([1.0, -2.0])), [0.3, -1.0])
    u = jnp.array([0.2, -2.5])
    state = policy.init(key=jax.random.key(0))
    expected = scipy.stats.norm.logpdf(u, [1.0, -2.0], np.exp([0.3, -1.0])).sum()
    found = policy.log_prob(0.0, jnp.zeros(2), state, u)
    assert found.shape == ()
    assert_close(found, expected, rtol=1e-12)


def test_clipped_probabilities_sum_to_one():
    policy = Gaussian(dlx.controllers.Constant(jnp.array([0.4])), -0.5, bounds=BOUNDS)
    state = policy.init(key=jax.random.key(0))
    log_prob = lambda u: policy.log_prob(0.0, jnp.zeros(1), state, u[None])
    # The ends, what lies between them, and what lies beyond.
    u = np.concatenate([np.linspace(-0.5, 0.7, 2001), [-3.0, 9.0]])
    p = np.exp(jax.jit(jax.vmap(log_prob))(u))
    ends, beyond = p[[0, 2000]], p[2001:]
    total = np.sum(p[1:2000]) * (u[1] - u[0]) + ends.sum()
    assert_close(total, 1.0, atol=2e-3)
    std = np.exp(-0.5)
    exact = scipy.stats.norm.cdf([(-0.5 - 0.4) / std, (0.4 - 0.7) / std])
    assert_close(ends, exact, rtol=1e-5)
    assert_close(beyond, ends)  # counts as clipped
    keys = jax.random.split(jax.random.key(1), 4000)
    draw = lambda k: policy(0.0, jnp.zeros(1), policy.init(key=k))[0][0]
    u = np.asarray(jax.jit(jax.vmap(draw))(keys))
    assert_close([np.mean(u == u.min()), np.mean(u == u.max())], exact, atol=0.03)
    assert_close([u.min(), u.max()], BOUNDS, rtol=1e-6)


def test_infinite_bounds_are_none(key):
    state = Gaussian(MEAN, 0.0).init(key=key)
    y, u = jnp.array([0.3, -0.4]), jnp.array([0.6])

    def both(bounds):
        policy = Gaussian(MEAN, 0.0, bounds=bounds)
        score = lambda p: p.log_prob(0.0, y, state, u)
        slope = eqx.filter_jit(eqx.filter_value_and_grad(score))
        value, gradient = slope(policy)
        return value, gradient.base.K, gradient.log_std

    for bounded, free in zip(both((-jnp.inf, jnp.inf)), both(None), strict=True):
        assert_close(bounded, free, rtol=1e-6)


def test_total_is_the_sum_over_the_run(key):
    env = lds(control_bounds=BOUNDS)
    policy = Gaussian(MEAN, -1.0, bounds=env.control_bounds)
    state = policy.init(key=key)

    @jax.jit
    @jax.vmap
    def totals(key):
        run = dlx.rollout(env, policy, key=key, horizon=30)
        each = jax.vmap(lambda t, y, u: policy.log_prob(t, y, state, u))
        scores = each(run.times[:-1], run.observations, run.controls)
        return policy.total_log_prob(run), scores, run.controls

    found, scores, controls = map(np.asarray, totals(jax.random.split(key, 3)))
    for u in controls:
        assert 1 < np.sum((u == u.min()) | (u == u.max())) < 29
    assert_close(found, scores.sum(1), rtol=1e-5)


def test_follows_the_state_of_its_base(key):
    env = lds(control_bounds=BOUNDS)
    pid = dlx.controllers.PID(1.0, 2.0, 0.3, dt=1.0, output=0)
    policy = Gaussian(pid, -1.0, bounds=env.control_bounds)
    known = jax.random.key(3)

    class Known(dlx.AbstractController):
        """Scores what it draws, on the way."""

        def init(self, *, key=None):
            return policy.init(key=known), jnp.zeros(())

        def __call__(self, t, y, state):
            state, total = state
            u, after = policy(t, y, state)
            return u, (after, total + policy.log_prob(t, y, state, u))

        def applied(self, u, cost, state):
            state, total = state
            return policy.applied(u, cost, state), total

    @jax.jit
    def act(t, x, state):
        u, state = Known()(t, x, state)
        step = env.step(t, x, u)
        return step.state, Known().applied(step.control, step.cost, state)

    x, state = env.reset(key), Known().init()
    for k in range(12):
        x, state = act(1.0 * k, x, state)
    total = state[1]

    class Fixed(dlx.AbstractController):
        def init(self, *, key=None):
            return policy.init(key=known)

        def __call__(self, t, y, state):
            return policy(t, y, state)

        def applied(self, u, cost, state):
            return policy.applied(u, cost, state)

    run = jax.jit(lambda: dlx.rollout(env, Fixed(), key=key, horizon=12))()
    assert_close(eqx.filter_jit(policy.total_log_prob)(run), total, rtol=1e-10)


def test_nothing_counts_after_termination(key):
    env = lds(terminated=lambda t, x: t > 4.5)
    policy = Gaussian(MEAN, -1.0)

    @jax.jit
    def totals():
        runs = [dlx.rollout(env, policy, key=key, horizon=n) for n in (9, 5)]
        return runs[0].length, [policy.total_log_prob(run) for run in runs]

    length, (found, expected) = totals()
    assert length == 5
    assert_close(found, expected, rtol=1e-5)


@needs_x64
def test_gradient_of_the_total(key):
    env = lds(control_bounds=BOUNDS)
    policy = Gaussian(MEAN, -1.0, bounds=env.control_bounds)
    run = dlx.rollout(env, policy, key=key, horizon=10)

    def total(weights):
        changed = eqx.tree_at(
            lambda p: (p.base.K, p.log_std), policy, (weights[None, :2], weights[2])
        )
        return changed.total_log_prob(run)

    gradient = assert_gradient(total, jnp.array([1.0, 0.5, -1.0]), rtol=1e-6)

    def through_the_run(log_std):
        changed = eqx.tree_at(lambda p: p.log_std, policy, log_std)
        again = dlx.rollout(env, changed, key=key, horizon=10)
        return changed.total_log_prob(again)

    # The record is data: making it anew adds nothing to the gradient.
    again = jax.jit(jax.grad(through_the_run))(policy.log_std)
    assert_close(again, gradient[2], rtol=1e-9)


def test_score_function_gradient(key):
    """The score gives the gradient of the expected cost, clipped controls and all."""
    env = lds(control_bounds=BOUNDS)
    base = Gaussian(MEAN, -0.5, bounds=env.control_bounds)
    keys = jax.random.split(key, 20000)

    def changed(log_std):
        return eqx.tree_at(lambda p: p.log_std, base, log_std)

    def cost(log_std, key):
        return dlx.rollout(env, changed(log_std), key=key, horizon=3).total_cost

    @jax.jit
    def scored(log_std):
        def one(key):
            run = dlx.rollout(env, changed(log_std), key=key, horizon=3)
            score = jax.grad(lambda s: changed(s).total_log_prob(run))(log_std)
            return run.total_cost, score

        costs, scores = jax.vmap(one)(keys)
        return jnp.mean((costs - costs.mean()) * scores)

    # The draw is differentiable as it is written, which is the same gradient.
    pathwise = jax.jit(
        jax.grad(lambda s: jnp.mean(jax.vmap(lambda k: cost(s, k))(keys)))
    )
    expected = pathwise(base.log_std)
    assert expected > 0.1
    assert_close(scored(base.log_std), expected, rtol=0.1)


def test_wrong_arguments(key):
    with user_error(match="base must be an AbstractController, got int"):
        Gaussian(3, 0.0)
    with user_error(match="log_std must be a number or a vector"):
        Gaussian(MEAN, jnp.zeros((1, 1)))
    with user_error(match="key must be one random key"):
        Gaussian(MEAN, 0.0).init()
    wrong = Gaussian(MEAN, jnp.zeros(3))
    with user_error(match=r"have shape \(1,\).*got shape \(3,\)"):
        wrong(0.0, jnp.zeros(2), wrong.init(key=key))
    policy = Gaussian(MEAN, 0.0)
    batch = dlx.rollout(lds(), policy, key=key, horizon=3)
    batch = stack([batch, batch])
    with user_error(match=r"one run \(use jax.vmap.*shape \(2,\)"):
        policy.total_log_prob(batch)
    bare = dlx.rollout(lds(), policy, key=key, horizon=3, keep=("states",))
    with user_error(match="must keep observations, controls and costs"):
        policy.total_log_prob(bare)
