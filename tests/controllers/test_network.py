import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from helpers import assert_close, once, user_error

import delucax as dlx


MLP, mlp_policy = dlx.controllers.MLP, dlx.controllers.mlp_policy


@once
def test_arithmetic(key):
    policy = MLP(3, 2, width=5, depth=1, key=key)
    y = np.array([0.3, -1.0, 2.0], np.float32)
    hidden, out = jax.tree.map(
        np.asarray, eqx.filter(policy.network.layers, eqx.is_array)
    )
    act = eqx.filter_jit(lambda policy: policy(0.0, jnp.asarray(y), None)[0])
    before = hidden.weight @ y + hidden.bias
    assert_close(act(policy), out.weight @ np.tanh(before) + out.bias, rtol=1e-6)
    relu = MLP(3, 2, width=5, depth=1, activation=jax.nn.relu, key=key)
    expected = out.weight @ np.maximum(before, 0) + out.bias
    assert_close(act(relu), expected, rtol=1e-6)
    assert len(MLP(3, 2, depth=0, key=key).network.layers) == 1


@once
def test_first_weights_are_those_of_equinox(key):
    for depth in (0, 2):
        network = MLP(3, 2, width=5, depth=depth, key=key).network
        theirs = eqx.filter_jit(eqx.nn.MLP)(3, 2, 5, depth, key=key)
        for ours, other in zip(network.layers, theirs.layers, strict=True):
            np.testing.assert_array_equal(ours.weight, other.weight)
            np.testing.assert_array_equal(ours.bias, other.bias)


def test_squashed_into_bounds(key):
    low, high = jnp.array([0.0, -3.0]), jnp.array([100.0, -1.0])
    policy = MLP(1, 2, width=4, depth=1, bounds=(low, high), key=key)
    act = lambda scale: policy(0.0, jnp.full(1, scale), None)[0]
    for y in (-1e6, -1.0, 0.5, 1e6):
        assert np.all((act(y) >= low) & (act(y) <= high))
    arrays, rest = eqx.partition(policy, eqx.is_array)
    zeroed = jax.tree.map(jnp.zeros_like, arrays.network)
    arrays = eqx.tree_at(lambda p: p.network, arrays, zeroed)
    policy = eqx.combine(arrays, rest)
    assert_close(act(1.0), [50.0, -2.0])


@once
def test_deep_fits_the_environment(key):
    env = dlx.make("pendulum")
    policy = mlp_policy(env, width=8, depth=3, key=key)
    assert isinstance(policy, MLP)
    sizes = [layer.weight.shape for layer in policy.network.layers]
    assert sizes == [(8, 3), (8, 8), (8, 8), (1, 8)]
    y = jnp.array([2.0, -1.0])
    turned = y + jnp.array([2 * np.pi, 0.0])
    assert_close(policy(0.0, turned, None)[0], policy(0.0, y, None)[0], atol=1e-4)
    run = dlx.rollout(env, policy, key=key, horizon=5)
    assert np.all(np.abs(run.controls) < 2)


@once
def test_deep_heads(key):
    env = dlx.make("pendulum")
    policy = mlp_policy(env, width=8, head="gaussian", key=key)
    assert isinstance(policy, dlx.controllers.Gaussian)
    assert_close(np.exp(policy.log_std), [1.0], rtol=1e-6)  # a quarter of -2 to 2
    assert policy.base.bounds is not None and policy.bounds is not None
    open_ended = dlx.make("lds", A=jnp.eye(2), B=jnp.ones((2, 1)))
    policy = mlp_policy(open_ended, width=8, head="gaussian", key=key)
    assert policy.bounds is None and policy.base.bounds is None
    assert_close(policy.log_std, [0.0])
    half = dlx.make(
        "lds", A=jnp.eye(2), B=jnp.ones((2, 1)), control_bounds=(0.0, jnp.inf)
    )
    policy = mlp_policy(half, width=8, head="gaussian", key=key)
    assert policy.base.bounds is None

    @eqx.filter_jit
    def drawn(policy):
        run = dlx.rollout(half, policy, key=key, horizon=5)
        return run.controls, policy.total_log_prob(run)

    controls, score = drawn(policy)
    assert np.min(controls) >= 0 and np.isfinite(score)


@once
def test_deep_learns_what_lqr_knows(key):
    A, B = jnp.array([[0.9, 0.3], [0.0, 0.6]]), jnp.array([[0.0], [0.5]])
    env = dlx.make("lds", A=A, B=B, initial_state=jnp.array([1.0, 0.0]))
    loss = dlx.training.expected_cost(env, batch=1, horizon=20)
    policy = mlp_policy(env, width=8, depth=1, key=key)
    fitted = dlx.training.fit(loss, policy, optax.adam(0.03), steps=100, key=key)
    best = dlx.controllers.LQR(env.dynamics, jnp.eye(2), jnp.eye(1)).P[0, 0]
    loss = eqx.filter_jit(loss)
    assert loss(policy, key) > 1.1 * best
    assert loss(fitted.model, key) < 1.01 * best


@once
def test_wrong_arguments(key):
    with user_error(match="in_size must be a whole number of at least 1"):
        MLP(0, 1, key=key)
    with user_error(match="depth must be a whole number of at least 0, got -1"):
        MLP(1, 1, depth=-1, key=key)
    with user_error(match="key must be one random key"):
        MLP(1, 1, key=3)
    with user_error(match="bounds must be finite to squash into"):
        MLP(1, 1, bounds=(0.0, np.inf), key=key)
    with user_error(match=r"bounds must be numbers or have shape \(1,\).*\(2,\)"):
        MLP(1, 1, bounds=(0.0, jnp.ones(2)), key=key)
    with user_error(match="MLP: .*size 3, got size 2.*features=env.encode"):
        MLP(3, 1, key=key)(0.0, jnp.zeros(2), None)
    with user_error(match="environment must be an Environment, got GymPendulum"):
        mlp_policy(dlx.make("pendulum").dynamics, key=key)
    with user_error(match="head must be .* got 'softmax'"):
        mlp_policy(dlx.make("pendulum"), head="softmax", key=key)


@once
@pytest.mark.parametrize("depth", [True, 1.0])
def test_depth_is_a_whole_number(key, depth):
    with user_error(match="depth must be a whole number"):
        MLP(1, 1, depth=depth, key=key)


@once
def test_the_mean_has_an_entry_for_each_feature():
    env = dlx.make("pendulum")
    scaled = dlx.controllers.Standardise(jnp.zeros(1), 1.0, env.encode)
    with user_error(
        match=r"mean must have an entry for each .*\(3,\), got shape \(1,\)"
    ):
        scaled(jnp.zeros(2))
