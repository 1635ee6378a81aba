"""PPO, SHAC, surrogates and batches of seeds."""

import re

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optax
import pytest
from helpers import assert_close, needs_x64, once, user_error

import delucax as dlx
from delucax.training import (
    actor_critic,
    ActorCritic,
    expected_cost,
    fit,
    PPO,
    SHAC,
)
from delucax.training._actor_critic import Moments


A = np.array([[1.0, 0.3], [-0.2, 0.9]])
B = np.array([[0.0], [0.5]])
GAMMA, LAMBDA = 0.9, 0.8
c = dlx.controllers


class Grows(eqx.Module):
    """Ends the episode."""

    def __call__(self, t, x):
        return x[0] > 1.2


def environment(**options):
    """A double integrator that ends where it has gone too far."""
    given = dict(
        cost=dlx.costs.Quadratic(np.eye(2), np.eye(1), final=3 * np.eye(2)),
        control_bounds=(-1.0, 1.0),
        initial_state=jnp.array([0.5, 0.4]),
        horizon=6,
    )
    return dlx.Environment(dlx.LinearDynamics(A, B, dt=0.1), **(given | options))


def model_of(policy=None, key=0):
    base = c.MLP(2, 1, width=4, depth=1, key=jr.key(key)) if policy is None else policy
    policy = c.Gaussian(base, -0.5, bounds=(-1.0, 1.0))
    return ActorCritic(policy, c.MLP(2, 1, width=4, depth=1, key=jr.key(1)))


@eqx.filter_jit
def started(surrogate, model):
    """The first memory, and of the loss of it the metrics and the gradient."""
    memory = surrogate.init(model, jr.key(0))
    loss = lambda model: surrogate(model, memory, jr.key(2))
    slope, metrics = eqx.filter_grad(loss, has_aux=True)(model)
    return memory, metrics, slope


def has_not_moved(metrics):
    """As the policy has not, the ratio is 1."""
    return abs(metrics["kl"]) < 1e-13


def by_hand(costs, values, ends_with, stops):
    """Advantages by the definition: the weighted mean of the n-step estimates."""
    n = len(costs)
    follow = np.append(values[1:], ends_with)
    delta = costs + GAMMA * follow - values
    found = np.zeros(n)
    for k in range(n):
        found[k] = sum((GAMMA * LAMBDA) ** (i - k) * delta[i] for i in range(k, n))
    assert stops == n
    return found


@needs_x64
@pytest.mark.parametrize(
    "ends, bootstrap", [(False, True), (False, False), (True, True)]
)
def test_advantages_know_an_end_from_a_cut(ends, bootstrap):
    env = environment(terminated=Grows() if ends else None)
    model = model_of()
    ppo = PPO(env, 1, discount=GAMMA, decay=LAMBDA, bootstrap=bootstrap)
    batch = eqx.filter_jit(ppo._episodes)(model, jr.key(12))
    record = jax.tree.map(lambda leaf: leaf[0], batch)
    run = dlx.rollout(env, model.policy, key=jr.split(jr.key(12), 1)[0])
    length = int(run.length)
    assert (length < 6) == ends
    values = [float(v) for v in jax.vmap(lambda x: model.value(0.0, x))(run.states)]
    cut = bootstrap and not ends
    last = values[6] if cut else float(run.final_cost)
    costs = np.asarray(run.costs)[:length]
    expected = by_hand(costs, np.asarray(values[:length]), last, length)
    assert_close(record.advantages[:length], expected, rtol=1e-12)
    assert_close(record.targets[:length], expected + values[:length], rtol=1e-12)
    assert_close(record.valid, np.arange(6) < length)


@needs_x64
def test_gradient_of_ppo_is_the_policy_gradient_at_first():
    """Where nothing has moved, the ratio is 1 and its gradient that of the score."""
    env = environment()
    model = model_of()
    ppo = PPO(env, 5, epochs=1, minibatches=1, value_weight=0.0)
    memory, metrics, slope = started(ppo, model)
    assert has_not_moved(metrics)
    rows = memory.rows

    def scored(model):
        policy = model.policy
        state = policy.init(key=jr.key(0))
        one = lambda t, y, u: policy.log_prob(t, y, state, u)
        flat = lambda a: a.reshape(-1, *a.shape[2:])
        score = jax.vmap(one)(
            *map(flat, (rows.times, rows.observations, rows.controls))
        )
        return jnp.mean(score * flat(rows.advantages))

    expected = eqx.filter_jit(eqx.filter_grad(scored))(model)
    for a, b in zip(
        jax.tree.leaves(slope.policy), jax.tree.leaves(expected.policy), strict=True
    ):
        assert_close(a, b, atol=1e-12)
    assert_close(np.mean(rows.advantages), 0, atol=1e-12)


@needs_x64
def test_ppo_follows_the_memory_of_a_policy():
    """What a recurrent policy is scored by is what it drew with."""
    policy = c.GRU(2, 1, 3, key=jr.key(4))
    model = model_of(policy)
    ppo = PPO(environment(), 4, epochs=1, minibatches=1)
    memory, metrics, slope = started(ppo, model)
    assert has_not_moved(metrics)
    assert memory.rows.times.shape == (4, 6)
    assert np.max(np.abs(slope.policy.base.cell.weight_hh)) > 0


@needs_x64
def test_window_of_shac_is_the_whole_gradient_where_it_spans_the_horizon():
    """With one window and no discount it is the gradient of the cost and its end."""
    env = environment(control_bounds=None)
    base = c.MLP(2, 1, width=4, depth=1, key=jr.key(0))
    model = ActorCritic(base, c.MLP(2, 1, width=4, depth=1, key=jr.key(1)))
    shac = SHAC(env, 1, window=6, discount=1.0, bootstrap=False, value_weight=0.0)
    memory, _, slope = started(shac, model)
    total = expected_cost(env, batch=1)
    expected = eqx.filter_jit(eqx.filter_grad(total))(base, jr.key(5))
    scale = 6 * np.asarray(memory.statistics.targets.std)
    for a, b in zip(
        jax.tree.leaves(slope.policy), jax.tree.leaves(expected), strict=True
    ):
        assert_close(np.asarray(a) * scale, b, rtol=1e-9, atol=1e-12)


@needs_x64
def test_gradient_is_cut_between_windows():
    """A cut rollout has the gradient of its stretches, each from a start held fixed."""
    env = environment(control_bounds=None)
    gain = jnp.array([[0.3, -0.2]])

    def total(K, **options):
        run = dlx.rollout(env, c.Linear(K), key=jr.key(0), **options)
        return run.total_cost, run.states

    def stretches(K, states):
        own = environment(control_bounds=None, cost=_without_end(env.cost))
        first = dlx.rollout(own, c.Linear(K), key=jr.key(0), x0=states[0], horizon=4)
        last = dlx.rollout(env, c.Linear(K), key=jr.key(0), x0=states[4], horizon=2)
        return first.total_cost + last.total_cost

    @jax.jit
    def slopes(K):
        slope = lambda f: jax.value_and_grad(f, has_aux=True)
        (whole, states), plain = slope(total)(K)
        (cut, _), found = slope(lambda K: total(K, truncate=4))(K)
        return whole, cut, plain, found, jax.grad(stretches)(K, states)

    whole, cut, plain, found, expected = map(np.asarray, slopes(gain))
    assert_close(found, expected, rtol=1e-12)
    assert_close(cut, whole, rtol=1e-14)
    assert np.max(np.abs(found - plain)) > 1e-3


def _without_end(cost):
    return dlx.costs.Quadratic(cost.Q, cost.R)


@needs_x64
def test_moments_are_those_of_all_rows():
    rows = np.random.default_rng(0).normal(size=(21, 3)) * 4 + 2
    valid = np.arange(21) % 3 > 0
    valid[7:] = np.arange(14) % 5 > 0

    @jax.jit
    def joined(rows, valid):
        moments = Moments.empty(jnp.zeros(3))
        for part in (slice(0, 7), slice(7, 21)):
            moments = moments.joined(rows[part], valid[part])
        return moments.mean, moments.std

    mean, std = joined(rows, valid)
    assert_close(mean, np.mean(rows[valid], axis=0), rtol=1e-12)
    assert_close(std, np.std(rows[valid], axis=0), rtol=1e-12)


@once
def test_the_deviation_of_a_small_quantity_is_known():
    rows = jnp.stack([1e-6 * jnp.arange(4.0), jnp.full(4, 350.0)], axis=1)
    moments = Moments.empty(jnp.zeros(2)).joined(rows, jnp.ones(4, bool))
    assert_close(moments.std, [1e-6 * np.std(np.arange(4)), 1.0], rtol=1e-5)


@needs_x64
def test_ppo_learns():
    """From doing nothing nearly to the best."""
    start = np.array([0.5, 0.4])
    env = environment(control_bounds=(-3.0, 3.0))
    model = actor_critic(env, width=4, depth=1, key=jr.key(0))
    ppo = PPO(env, 32, epochs=2, minibatches=2, discount=1.0, bootstrap=False)
    optimiser = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(1e-2))
    fitted = fit(ppo, model, optimiser, 1000, key=jr.key(1), progress=False)
    cost = eqx.filter_jit(expected_cost(env, batch=1))
    found = float(cost(fitted.model.policy.base, jr.key(0)))
    idle = least = 3 * np.eye(2)
    for _ in range(6):
        K = np.linalg.solve(np.eye(1) + B.T @ least @ B, B.T @ least @ A)
        least = np.eye(2) + A.T @ least @ (A - B @ K)
        idle = np.eye(2) + A.T @ idle @ A
    assert start @ idle @ start > 1.5 * start @ least @ start
    assert start @ least @ start < found < 1.05 * start @ least @ start


@once
def test_one_seed_that_diverges_leaves_the_others():
    class Trap(dlx.training.AbstractSurrogate):
        def init(self, model, key):
            return jnp.zeros((), int)

        def update(self, model, memory, step, key):
            return memory + 1

        def __call__(self, model, memory, key):
            gone = (memory > 3) & (model.K[0, 0] < 0)
            return jnp.sum((model.K - 5) ** 2) + jnp.where(gone, jnp.nan, 0.0)

        def finished(self, model, memory):
            return eqx.tree_at(lambda m: m.K, model, model.K + memory)

    models = eqx.filter_vmap(c.Linear)(jnp.array([[[1.0]], [[-9.0]]]))
    keys = jr.split(jr.key(0), 2)
    options = dict(key=keys, progress=False, throw=False)
    found = fit(Trap(), models, optax.sgd(0.01), 8, **options)
    assert (found.result == dlx.RESULTS.diverged).tolist() == [False, True]
    step = lambda k, n: 5 + (k - 5) * 0.98**n
    assert_close(found.model.K.ravel(), [step(1, 8) + 8, step(-9, 3) + 3], rtol=1e-5)
    with pytest.raises(RuntimeError, match="seed 1 is not finite"):
        fit(Trap(), models, optax.sgd(0.01), 8, key=keys, progress=False)


class Drawn(dlx.training.AbstractSurrogate):
    """Descends to a target that is drawn every third step."""

    def init(self, model, key):
        return jnp.zeros_like(model.K), jnp.zeros((), int)

    def update(self, model, memory, step, key):
        target, count = memory
        fresh = model.K + jr.normal(key, model.K.shape)
        return jnp.where(step % 3 == 0, fresh, target), count + 1

    def __call__(self, model, memory, key):
        loss = jnp.sum((model.K - memory[0] + 0.1 * jr.normal(key)) ** 2)
        return loss, {"count": memory[1]}


@once
def test_batch_of_keys_trains_each_as_if_alone():
    keys = jr.split(jr.key(0), 3)
    models = eqx.filter_vmap(c.Linear)(jr.normal(jr.key(1), (3, 1, 2)))
    # The norm that is clipped is that of each seed.
    optimiser = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(0.1))
    both = fit(Drawn(), models, optimiser, 10, key=keys, progress=False)
    one = c.Linear(models.K[1])
    alone = fit(Drawn(), one, optimiser, 10, key=keys[1], progress=False)
    assert both.history["count"].tolist() == [[k] * 3 for k in range(1, 11)]
    assert_close(both.history.loss[:, 1], alone.history.loss, rtol=1e-5)
    assert_close(both.model.K[1], alone.model.K, rtol=1e-5)


@once
def test_surrogate_goes_on_from_a_checkpoint(tmp_path):
    drawn, model = Drawn(), c.Linear(jnp.ones((1, 2)))
    optimiser = optax.adam(1e-2)
    path = tmp_path / "run"

    class Stop(Exception):
        pass

    def stop(step, metrics):
        if step == 6:
            raise Stop

    options = dict(key=jr.key(1), progress=False, block=3)
    whole = fit(drawn, model, optimiser, 9, **options)
    kept = dict(checkpoint=path, checkpoint_every=3)
    with pytest.raises(Stop):
        fit(drawn, model, optimiser, 9, **options, **kept, callbacks=[stop])
    again = fit(drawn, model, optimiser, 9, **options, **kept)
    assert np.array_equal(whole.history.loss, again.history.loss)


class Infinite(dlx.training.AbstractSurrogate):
    """Starts with a number of Python in its memory."""

    first: object = eqx.field(static=True)

    def init(self, model, key):
        return {"gain": model.K, "best": (jnp.zeros(()), self.first)}

    def update(self, model, memory, step, key):
        return memory

    def __call__(self, model, memory, key):
        return jnp.sum(model.K**2)


@once
@pytest.mark.parametrize("first, shown", [(jnp.inf, "inf"), ("none", "'none'")])
def test_memory_that_is_no_array_is_named_by_its_path(first, shown):
    where = re.escape(f"got {shown} at memory['best'][1]. Use")
    with user_error(match=f"^fit: the memory that Infinite.init returns .*{where}"):
        fit(
            Infinite(first),
            c.Linear(jnp.ones((1, 2))),
            optax.sgd(0.1),
            1,
            key=jr.key(0),
            progress=False,
        )


class Dithered(dlx.AbstractStochasticPolicy):
    """A policy that does not know its entropy."""

    gain: jax.Array = dlx.weight(0.2)

    def init(self, *, key=None):
        return key

    def __call__(self, t, y, state):
        state, now = jr.split(state)
        return -self.gain * y[:1] + 0.1 * jr.normal(now, (1,), y.dtype), state

    def log_prob(self, t, y, state, u):
        return -0.5 * jnp.sum(((u + self.gain * y[:1]) / 0.1) ** 2)


@once
def test_log_probability_stands_for_an_entropy_that_is_not_known():
    model = ActorCritic(Dithered(), model_of().critic)
    assert model.policy.has_memory  # as no policy is asked what it remembers
    env = environment()
    ppo = PPO(env, 2, 3, epochs=1, minibatches=1)
    memory, metrics, slope = started(ppo, model)
    assert memory.rows.times.shape == (2, 3)
    assert_close(metrics["entropy"], -np.mean(memory.rows.log_prob), rtol=1e-5)
    # The gradient of E[-log p] is that of -log p times -log p, as of any mean.
    more = eqx.tree_at(lambda ppo: ppo.entropy_weight, ppo, jnp.asarray(1.0))
    _, _, other = started(more, model)

    def by_hand(policy):
        given = memory.rows.observations, memory.rows.controls
        score = lambda y, u: policy.log_prob(0.0, y, None, u)
        log_prob = jax.vmap(jax.vmap(score))(*given)
        return jnp.mean((jax.lax.stop_gradient(log_prob) + 1) * log_prob)

    bonus = eqx.filter_grad(by_hand)(model.policy).gain
    assert_close(other.policy.gain - slope.policy.gain, bonus, rtol=1e-3, atol=1e-5)
    assert not model_of().policy.has_memory


@once
def test_bad_input():
    env = environment()
    model = model_of()
    with user_error(match="batch must be a whole number"):
        PPO(env, 0)
    with user_error(match="discount must be between 0 and 1"):
        SHAC(env, 2, discount=1.5)
    with user_error(match="model must be an ActorCritic, got Linear"):
        fit(PPO(env, 2), c.Linear([[1.0, 0.0]]), optax.sgd(0.1), 1, key=jr.key(0))
    free = ActorCritic(c.Gaussian(c.Linear([[1.0, 0.0]]), 0.0), model.critic)
    with user_error(match="must have the bounds of the environment"):
        fit(PPO(env, 2), free, optax.sgd(0.1), 1, key=jr.key(0))
    with user_error(match="minibatches must be at most the 12 rows"):
        fit(PPO(env, 2, minibatches=13), model, optax.sgd(0.1), 1, key=jr.key(0))
    with user_error(match="data must be None"):
        data = jnp.ones(3)
        fit(PPO(env, 2), model, optax.sgd(0.1), 1, key=jr.key(0), data=data)
    with user_error(match="axis of the 3 keys in front"):
        fit(PPO(env, 2), model, optax.sgd(0.1), 1, key=jr.split(jr.key(0), 3))
    with user_error(match="critic must have no memory"):
        ActorCritic(model.policy, c.GRU(2, 1, key=jr.key(0)))
    with user_error(match="must have a table of actions"):
        actor_critic(env, head="categorical", key=jr.key(0))


@once
def test_policy_and_critic_begin_flat():
    """The slope of a critic that has seen nothing would lead the policy astray."""
    env = dlx.make("double_integrator")
    model = actor_critic(env, head="deterministic", key=jr.key(0))
    y = jnp.array([1.0, -1.0])
    for network in (model.critic, model.policy):
        slope = jax.grad(lambda y, network=network: network(0.0, y, None)[0].sum())(y)
        assert 0 < jnp.linalg.norm(slope) < 0.02
