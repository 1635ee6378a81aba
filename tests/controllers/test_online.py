"""Learners: what they recover, what they compute and what they reach."""

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from helpers import assert_close, assert_gradient, needs_x64, user_error

import delucax as dlx


pytestmark = needs_x64


c = dlx.controllers
A, B = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.0], [1.0]])
Q, R = np.eye(2), np.eye(1)
PLANT = dlx.LinearDynamics(A, B)
COST = dlx.costs.Quadratic(Q, R)
KEY = jax.random.key(0)
STEPS = 1000
TIMES = np.arange(STEPS)
SLOW = np.sin(TIMES / (2 * np.pi))[:, None] * np.ones(2)


def run(controller, w, dynamics=PLANT, cost=COST, x0=None, **options):
    env = dlx.Environment(dynamics, cost, **options)
    x0 = jnp.zeros(dynamics.state_size) if x0 is None else x0
    return dlx.rollout(env, controller, key=KEY, x0=x0, w=w, horizon=len(w))


@eqx.filter_jit
def follow(env, controller, x0, w):
    """Every state of a controller, and of the plant, along a run."""

    def step(carry, inputs):
        x, state = carry
        k, w = inputs
        t = k * env.dt
        u, state = controller(t, env.dynamics.observe(t, x), state)
        here = env.step(t, x, u, w)
        after = controller.applied(here.control, here.cost, state)
        return (here.state, after), (state, here.control, u, here.cost, x)

    state = controller.init(key=jax.random.key(1))
    return lax.scan(step, (jnp.asarray(x0), state), (jnp.arange(len(w)), w))[1]


PENDULUM = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05)
LEARNERS = {
    "GPC": lambda d, cost: c.gpc(d, cost),
    "BPC": lambda d, cost: c.BPC(d, c.gpc(d, cost).loop.base, delta=5.0),
}


@pytest.mark.parametrize(
    "dynamics, make",
    [pytest.param(PLANT, make, id=name) for name, make in LEARNERS.items()]
    + [pytest.param(PENDULUM, LEARNERS["GPC"], id="GPC of a pendulum")],
)
def test_recovered_disturbances(dynamics, make):
    """Exactly zero where there are none, and else what they were, under saturation.
    All learners share what recovers them."""
    env = dlx.Environment(dynamics, COST, control_bounds=(-0.4, 0.4))
    learner, x0 = make(dynamics, COST), np.array([0.3, -0.5])
    quiet, *_ = follow(env, learner, x0, np.zeros((12, dynamics.disturbance_size)))
    assert np.all(np.asarray(quiet.loop.signal) == 0)
    w = 0.2 * np.random.default_rng(0).normal(size=(12, dynamics.disturbance_size))
    states, applied, asked, _, x = follow(env, learner, x0, w)
    assert np.any(np.asarray(applied) != np.asarray(asked))
    if dynamics is PLANT:
        assert_close(states.loop.signal[1:, 0], w[:-1], rtol=0, atol=1e-14)
        return
    undisturbed = jax.jit(jax.vmap(lambda x, u: dynamics(0.0, x, u)))(x, applied)
    signal = np.asarray(states.loop.signal[1:, 0])
    assert np.any(np.abs(signal) > 1e-3)
    assert_close(signal, x[1:] - undisturbed[:-1], atol=1e-13)


def partial(base=None):
    C = np.array([[1.0, 0.0]])
    plant = dlx.LinearDynamics(A, B, C)
    return plant, c.drc(plant, dlx.costs.Quadratic(R, R), base=base, memory=3)


def test_a_small_disturbance_beside_a_large_state():
    """A disturbance is compared with the terms of its own entry."""
    plant = dlx.LinearDynamics(0.9 * np.eye(2), np.eye(2))
    cost, w = dlx.costs.Quadratic(Q, np.eye(2)), np.full((4, 2), [0.0, 1e-8])
    env, learner = dlx.Environment(plant, cost), c.gpc(plant, cost)
    states, *_ = follow(env, learner, np.array([1e9, 1.0]), w)
    signal = states.loop.signal[1:, 0]
    assert np.all(signal[:, 0] == 0)
    assert_close(signal[:, 1], w[:-1, 1], atol=1e-14)


def test_natures_output():
    """It is what the base alone would have shown, whatever was added."""
    plant, learner = partial()
    env = dlx.Environment(plant, COST, control_bounds=(-1.0, 1.0))
    w = np.random.default_rng(1).normal(size=(20, 2))
    start = np.array([0.1, -0.1])
    loud = eqx.tree_at(lambda d: d.policy.start, learner, jnp.full((1, 3), 0.3))
    states, applied, asked, *_ = follow(env, loud, start, w)
    base = dlx.rollout(
        dlx.Environment(plant, COST, horizon=20),
        learner.loop.base,
        key=jax.random.key(0),
        x0=start,
        w=w,
    )
    assert np.any(np.asarray(applied) != np.asarray(asked))
    assert_close(states.loop.signal[:, 0], base.observations, rtol=0, atol=1e-12)


class Filtering(dlx.AbstractController):
    """A gain with a filter of its own."""

    K: jax.Array

    def init(self, *, key=None):
        return jnp.zeros(1)

    def __call__(self, t, y, state):
        u = -self.K @ y
        return u + 0.1 * state, 0.5 * state + 0.1 * u


@pytest.mark.parametrize(
    ("kind", "along"),
    [("once", 0), ("integral", 0), ("along the way", 1), ("over a horizon", 1)],
)
def test_loss_is_what_the_step_would_have_cost(kind, along):
    """With a roll-out as long as the run, exactly so where the loop is linear."""
    gain = dlx.riccati.dare(A, B, Q, R).K
    base = {
        "once": lambda: c.Linear(gain),
        "integral": lambda: c.LQI(PLANT, np.eye(3), R, output=np.eye(2)[:1]),
        "along the way": lambda: Filtering(gain),
        "over a horizon": lambda: c.HInfinity(PLANT, Q, R, gamma=50.0, horizon=12),
    }[kind]()
    learner = c.gpc(PLANT, COST, base=base, memory=3, horizon=12)
    assert (learner.loop.tangents is None) == along
    env = dlx.Environment(PLANT, COST)
    w = np.random.default_rng(2).normal(size=(12, 2))
    states, *_ = follow(env, learner, np.zeros(2), w)
    theta = jnp.asarray(np.random.default_rng(3).normal(size=(1, 6)))
    other = states._replace(theta=jnp.broadcast_to(theta, (12, 1, 6)))
    losses = jax.jit(jax.vmap(learner.loss))(jnp.arange(12.0), other)
    expected = run(learner.fixed(theta), w).costs
    assert_close(losses, expected, rtol=1e-10, atol=1e-10)


def hindsight_policy(A, B, K, w, memory):
    """The best disturbance-action policy, as least squares."""
    n, m = B.shape
    loop, x = A - B @ K, np.zeros(n)
    S, past = np.zeros((n, m, memory * n)), np.zeros((memory, n))
    rows, right = [], []
    for now in w:
        added = -np.einsum("mn,nkp->mkp", K, S)
        added[range(m), range(m)] += past.ravel()
        rows += [S.reshape(n, -1), added.reshape(m, -1)]
        right += [x, -K @ x]
        S = np.einsum("ij,jkp->ikp", loop, S)
        S += np.einsum("ik,p->ikp", B, past.ravel())
        x, past = loop @ x + now, np.concatenate([now[None], past[:-1]])
    rows, right = np.concatenate(rows), np.concatenate(right)
    theta = np.linalg.lstsq(rows, -right, rcond=None)[0]
    return np.sum((rows @ theta + right) ** 2)


def test_defaults_reach_what_is_possible():
    """Under noise, a slow sine and a constant, in any units of cost and disturbance."""
    learner, base = c.gpc(PLANT, COST), c.LQR(PLANT, Q, R)
    rng = np.random.default_rng(0)
    w = np.stack([rng.normal(size=(STEPS, 2)), SLOW, np.ones((STEPS, 2))])
    whole = lambda c, cost, w: run(c, w, cost=cost).total_cost
    total = jax.jit(jax.vmap(whole, (None, None, 0)))
    costs, regulated = (np.asarray(total(c, COST, w)) for c in (learner, base))
    best = [hindsight_policy(A, B, np.asarray(base.K), each, 10) for each in w]
    assert np.all(costs <= np.array([1.05, 0.15, 0.15]) * regulated)
    assert np.all(costs <= 1.5 * np.array(best))

    for size in 1e-2, 1e2:
        cost = dlx.costs.Quadratic(size * Q, size * R)
        again = total(c.gpc(PLANT, cost), cost, size * w)
        assert_close(again / size**3, costs, rtol=1e-6)


def test_published_setting():
    """The averages over 1000 steps, relative to the regulator's, to 2 percent."""
    rate = optax.scale_by_schedule(lambda k: 1 / jnp.sqrt(k + 1.0))
    learner = c.gpc(
        PLANT,
        COST,
        memory=10,
        horizon=10,
        learning_rate=0.005,
        optimiser=optax.chain(rate, optax.scale(-1.0)),
    )
    base = c.LQR(PLANT, Q, R)
    for w, published in ((SLOW, 0.091), (np.ones((STEPS, 2)), 0.073)):
        ratio = run(learner, w).total_cost / run(base, w).total_cost
        assert abs(ratio - published) < 0.02 * published


def test_best_in_hindsight():
    """The least-squares solution."""
    w = np.random.default_rng(4).normal(size=(200, 2))
    learner = c.gpc(PLANT, COST, memory=4)
    played = run(learner, w)
    env = dlx.Environment(PLANT, COST)
    found = c.best_in_hindsight(env, learner.fixed(), played)
    assert found.result == dlx.RESULTS.successful
    exact = hindsight_policy(A, B, np.asarray(learner.loop.base.K), w, 4)
    assert_close(found.trajectory.total_cost, exact, rtol=1e-9)
    assert_close(
        c.regret(played, found.trajectory)[-1],
        played.total_cost - exact,
        rtol=1e-6,
    )


def test_best_gain_in_hindsight_sees_the_noise_of_the_run():
    noise = dlx.disturbances.Gaussian(1.0, size=2)
    env = dlx.Environment(PLANT, COST, sensor_noise=noise, horizon=200)
    w = np.random.default_rng(4).normal(size=(200, 2))
    base, options = c.LQR(PLANT, Q, R), dict(x0=jnp.zeros(2), w=w)

    @jax.jit
    @jax.value_and_grad
    def cost(K):
        return dlx.rollout(env, c.Linear(K), key=KEY, **options).total_cost

    played = dlx.rollout(env, c.Linear(base.K), key=KEY, **options)
    gain = c.best_in_hindsight(env, c.Linear(base.K), played)
    least, slope = cost(gain.controller.K)
    assert_close(gain.trajectory.total_cost, least, rtol=1e-9)
    assert np.max(np.abs(slope)) < 1e-4 * least < 1e-4 * played.total_cost
    kept = "states", "disturbances"
    short = dlx.rollout(env, c.Linear(base.K), key=KEY, keep=kept, **options)
    with user_error(match="trajectory must have its observations"):
        c.best_in_hindsight(env, c.Linear(base.K), short)


def switched():
    """A plant that becomes another one halfway."""
    first = np.arange(600)[:, None, None] < 300
    A = np.where(first, [[1, 0.5], [0, 1]], [[1, 1.5], [0, 1]])
    return dlx.LinearDynamics(A, np.where(first, [[0], [1.2]], [[0], [0.9]]))


def test_adaptive_keeps_up():
    """The switching study in the setting that was published for it."""
    plant = switched()
    rate = optax.scale_by_schedule(lambda k: 1 / jnp.sqrt(k + 1.0))
    optimiser = optax.chain(rate, optax.scale(-1.0))
    options = dict(horizon=10, learning_rate=0.005, optimiser=optimiser)
    learner = c.gpc(plant, COST, **options)
    assert isinstance(learner.loop.base, c.Scheduled)
    noise = 0.2 * np.random.default_rng(0).normal(size=(5, 600, 2))
    t = np.arange(600)[:, None]
    w = np.where((t // 150) % 2 == 0, noise, 0.4 * np.sin(t))
    total = jax.jit(jax.vmap(lambda c, w: run(c, w, plant).total_cost, (None, 0)))
    one, many = total(learner, w), total(c.Adaptive(learner), w)
    assert_close(np.mean(one) / 600, 0.515, rtol=0.05)
    assert np.mean(many) / 600 < 0.45
    assert np.all(many < 0.92 * one)


def test_births_and_deaths():
    """Experts live as published, and one of the slots always holds the first. One that
    lives is followed, and for a while."""
    slots, every, steps = 6, 2, 60
    options = dict(slots=slots, every=every, play="switch")
    learner = c.Adaptive(c.gpc(PLANT, COST, memory=2), **options)
    env = dlx.Environment(PLANT, COST)
    w = np.random.default_rng(5).normal(size=(steps, 2))
    states, *_ = follow(env, learner, np.zeros(2), w)
    alive = [(0, np.inf)]
    for step in range(1, steps):
        alive = [(born, end) for born, end in alive if end > step]
        if step % every == 0:
            birth = step // every
            power = birth & -birth
            if len(alive) == slots:
                alive.remove(min(alive, key=lambda expert: expert[1]))
            alive.append((step, step + every * (4 * power + 1)))
        ends = sorted(e for _, e in alive if e < np.inf)
        # The state of step k was made after step k - 1.
        found = np.asarray(states.ends[step])
        lasting = np.iinfo(np.int32).max
        assert sorted(e for e in found if step < e < lasting) == ends
        weights = np.asarray(states.weights[step])
        assert np.all((weights > 0) == (found > step))
        assert np.isclose(weights.sum(), 1)
    chosen = np.asarray(states.chosen)
    assert len(set(chosen)) > 1 and np.mean(chosen[1:] != chosen[:-1]) < 0.5
    assert np.all(np.take_along_axis(states.weights, chosen[:, None], 1) > 0)


def test_bandit_feedback():
    """It beats its base where there is something to learn, seeing only costs."""
    dynamics = dlx.LinearDynamics(np.array([[0.8, 0.5], [0.0, 0.8]]), 0.8 * B)
    base = c.LQR(dynamics, Q, R)
    w = 0.3 * np.ones((5000, 2))
    costs = run(c.BPC(dynamics, base), w, dynamics).costs
    assert np.mean(costs[-1000:]) < 0.6 * np.mean(run(base, w, dynamics).costs[-1000:])


def build(model):
    return c.gpc(model, COST, horizon=15)


def test_explore_identifies():
    """From steps that an adversary disturbs, and then controls by what it found."""
    K = np.array([[0.2, 0.8]])
    learner = c.Explore(build, K, steps=3000, scale=3.0)
    env = dlx.Environment(PLANT, COST)
    w = np.concatenate([SLOW] * 4)
    states, *_, costs, _ = follow(env, learner, np.zeros(2), w)
    model = jax.tree.map(lambda leaf: leaf[-1], states.model)
    assert np.max(np.abs(model.A - A)) < 0.1 and np.max(np.abs(model.B - B)) < 0.1
    reached = np.mean(costs[3500:])
    # A learner that knows the plant has 0.09 of the regulator's cost.
    assert reached < 1.3 * 0.09 * mean_cost(dlx.riccati.dare(A, B, Q, R).K, w)
    assert reached < 0.3 * mean_cost(K, w)


@pytest.mark.parametrize("low, K", [(-0.5, [[0.0, 0.0]]), (-0.1, [[0.2, 0.8]])])
def test_explore_identifies_through_bounds(low, K):
    """Bounds that clip each random control, and with a gain also what it asks for."""
    A = np.array([[0.5, 0.3], [0.0, 0.4]])
    plant, w = dlx.LinearDynamics(A, B), np.full((20_001, 2), 0.1)
    learner = c.Explore(lambda model: c.Zero(1), np.array(K), steps=20_000)
    found = run(learner, w, plant, control_bounds=(low, 0.5)).controller_state.model
    assert np.max(np.abs(found.B - B)) < 0.05 and np.max(np.abs(found.A - A)) < 0.3


def test_explore_gives_its_controller_a_key():
    """`BPC` draws random controls."""
    K = np.array([[0.2, 0.8]])
    learner = c.Explore(lambda model: c.BPC(model, c.Linear(K)), K, steps=5)
    first, other = (keys_in(learner.init(key=jax.random.key(i))) for i in range(2))
    # The key of the exploration is another one than that of the learner.
    assert len(first) == 2 and not np.array_equal(first[0], first[1])
    assert not np.any(np.all(np.equal(first, other), axis=1))
    env = dlx.Environment(PLANT, COST, horizon=8)
    assert np.all(np.isfinite(dlx.rollout(env, learner, key=KEY).controls))


def keys_in(state):
    """The random keys among the leaves."""
    is_key = lambda leaf: jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return [jax.random.key_data(k) for k in jax.tree.leaves(state) if is_key(k)]


def mean_cost(K, w):
    """Of a gain, over the last 500 steps."""
    x, costs = np.zeros(2), []
    for now in w:
        u = -np.asarray(K) @ x
        costs.append(x @ x + u @ u)
        x = A @ x + B @ u + now
    return np.mean(costs[-500:])


@needs_x64
def test_online_newton_is_recursive_least_squares():
    """Against the solution of the regularised normal equations."""
    rng, d, k, prior = np.random.default_rng(0), 4, 2, 3.0
    J, target = rng.normal(size=(20, k, d)), rng.normal(size=(20, k))
    optimiser = c.online_newton(prior)
    assert optimiser == c.online_newton(prior)
    theta, found = np.zeros(d), []
    state = optimiser.init(jnp.asarray(theta))

    @jax.jit
    def update(gradient, state, root):
        # No step is too long.
        options = dict(curvature=lambda: root, learning_rate=1e3)
        return optimiser.update(gradient, state, **options)

    for A, b in zip(J, target, strict=True):
        step, state = update(A.T @ (A @ theta - b), state, A.T)
        theta = theta + 1e3 * np.asarray(step)
        found.append(theta)
    # While the prior follows the mean, all that was seen is rescaled with it.
    sizes = np.sum(J**2, axis=(1, 2))
    means = np.cumsum(sizes) / np.arange(1, 21)
    weights = np.ones(20)
    weights[0], weights[1] = means[2] / means[0], means[2] / means[1]
    Lambda = prior * means[2] / d * np.eye(d)
    Lambda = Lambda + np.einsum("t,tki,tkj->ij", weights, J, J)
    assert_close(
        np.linalg.inv(Lambda), state.root @ state.root.T, rtol=1e-9, atol=1e-12
    )
    step = np.linalg.solve(Lambda, J[-1].T @ (J[-1] @ found[-2] - target[-1]))
    assert_close(found[-1], found[-2] - step, rtol=1e-9, atol=1e-12)
    capped, _ = optimiser.update(
        jnp.ones(d), state, curvature=lambda: jnp.ones((d, 1)), learning_rate=1e-9
    )
    assert_close(np.linalg.norm(capped), 1.0, rtol=1e-12)
    with user_error(match="must be given the curvature"):
        optimiser.update(theta, state)
    with user_error(match="prior must be positive"):
        c.online_newton(0.0)


@needs_x64
def test_the_curvature_of_a_cost():
    """A convex one in full, of another what is positive, of a flat one nothing."""
    from delucax.controllers.online._optimisers import positive_root

    A = np.random.default_rng(1).normal(size=(3, 3))
    for H in (A @ A.T, np.diag([1.0, 0.0, 2.0]), np.zeros((3, 3))):
        L = np.asarray(positive_root(jnp.asarray(H)))
        assert_close(L @ L.T, H, atol=1e-12)
    assert_close(positive_root(jnp.diag(jnp.array([4.0, -1.0]))), np.diag([2.0, 0.0]))


def test_adagrad_norm():
    """Sums of squares over all leaves, and nothing before the first gradient."""
    optimiser = c.adagrad_norm()
    params = {"a": jnp.zeros(2), "b": jnp.zeros(())}
    state = optimiser.init(params)
    step, state = optimiser.update({"a": jnp.zeros(2), "b": jnp.zeros(())}, state)
    assert step["b"] == 0
    for total in 26.0, 52.0:
        gradient = {"a": jnp.array([3.0, 4.0]), "b": jnp.ones(())}
        step, state = optimiser.update(gradient, state)
        assert_close(step["a"], -np.array([3.0, 4.0]) / np.sqrt(total))
        assert_close(step["b"], -1 / np.sqrt(total))


def test_projection_holds():
    learner = c.gpc(PLANT, COST, learning_rate=100.0, radius=0.2)
    states, *_ = follow(dlx.Environment(PLANT, COST), learner, np.zeros(2), SLOW[:200])
    norms = np.linalg.norm(states.theta[:, 0], axis=-1)
    assert np.max(norms) <= 0.2 * (1 + 1e-12) and np.max(norms) > 0.199


def test_spectral_filters():
    """Few of them hold all that fades quickly enough."""
    memory, count, margin = 30, 8, 0.2
    bank = dlx.controllers.online._gpc.spectral_filters(memory, count, margin)
    k = np.arange(1, memory + 1)
    H = (1 - margin) ** (k[:, None] + k - 1) / (k[:, None] + k - 1)
    norms = np.linalg.norm(bank, axis=1)
    assert_close(norms, np.linalg.eigvalsh(H)[::-1][:count] ** 0.25, rtol=1e-6)
    for rate in np.linspace(0, 1 - margin, 9):
        wanted = rate ** (k - 1)
        weights = np.linalg.lstsq(bank.T, wanted, rcond=None)[0]
        assert np.linalg.norm(bank.T @ weights - wanted) < 2e-4


class Twice(dlx.AbstractDynamics):
    """As many outputs as states, which they are not."""

    dt = jnp.ones(())
    state_names = PLANT.state_names
    control_names = PLANT.control_names

    def advance(self, t, x, u, w):
        return PLANT.advance(t, x, u, w)

    def observe(self, t, x):
        return 2 * x


@pytest.mark.parametrize(
    "decay, memory",
    [(0.5, 10), (0.79, 10), (0.8, 11), (0.9, 22), (0.99, 50)],
)
def test_the_default_memory_follows_the_closed_loop(decay, memory):
    """The least h with decay^h <= 0.1, from 10 to 50."""
    plant = dlx.LinearDynamics(np.array([[decay]]), np.eye(1))
    cost = dlx.costs.Quadratic(np.eye(1), np.eye(1))
    base = c.Linear(np.zeros((1, 1)))
    assert c.gpc(plant, cost, base=base).loop.memory == memory
    assert c.gpc(plant, cost, base=base, memory=3).loop.memory == 3
    neural = c.neural_gpc(plant, cost, base=base, key=jax.random.key(0))
    assert neural.loop.memory == memory


def test_the_default_memory_of_a_loop_that_cannot_be_seen():
    seen = []

    def make(a):
        plant = dlx.LinearDynamics(a * jnp.eye(1), np.eye(1))
        cost = dlx.costs.Quadratic(np.eye(1), np.eye(1))
        base = c.Linear(np.zeros((1, 1)))
        seen.append(c.gpc(plant, cost, base=base, horizon=20).loop.memory)
        return a

    jax.eval_shape(make, jnp.asarray(0.9))
    assert seen == [10]


def test_a_slow_plant_needs_a_long_memory():
    """With 10 disturbances GPC has 0.41 of the regulator's cost."""
    A = np.array([[1, 0.1, 0], [0, 0.95, 0.2], [0, -0.1, 0.9]])
    plant = dlx.LinearDynamics(A, np.array([[0.0], [0.1], [1.0]]))
    cost = dlx.costs.Quadratic(np.eye(3), np.eye(1))
    learner = c.gpc(plant, cost)
    assert learner.loop.memory == 21
    w = np.sin(2 * np.pi * TIMES / 57)[:, None] * np.ones(3)
    total = run(learner, w, plant, cost).total_cost
    assert total < 0.28 * run(learner.loop.base, w, plant, cost).total_cost


UNSTABLE = c.Linear(np.zeros((1, 2)))
LOOSE = dlx.LinearDynamics(A, B, np.array([[1.0, 0.0]]))
vector = lambda t, x, u: x
NO_POINT = dlx.Discretized(dlx.systems.Lorenz(), dt=0.01)


@pytest.mark.parametrize(
    "make, match",
    [
        (lambda: c.gpc(PLANT, COST, base=UNSTABLE), "must stabilise.*radius 1"),
        (lambda: c.gpc(PLANT, COST, memory=0), "gpc: memory must be a whole"),
        (lambda: c.gpc(PLANT, COST, horizon=0), "gpc: horizon must be a whole"),
        (lambda: c.gpc(PLANT, vector), r"cost must give a scalar.*shape \(2,\)"),
        (
            lambda: c.gpc(LOOSE, COST, base=c.Linear([[1.0]])),
            r"gpc: cost must take the observation, of shape \(1,\).*Q has shape",
        ),
        (lambda: c.gpc(PLANT, 3.0), "cost must be a function"),
        (lambda: c.gpc(None, COST), "dynamics must be an AbstractDynamics.*Explore"),
        (lambda: c.gpc(PLANT, COST, base=3), "base must be an AbstractController"),
        (lambda: c.gpc(PLANT, COST, base=c.Zero(2)), "control of size 1.*shape"),
        (lambda: c.gpc(PLANT, COST, base=c.Linear(np.ones((1, 3)))), "of size 2"),
        (lambda: c.gpc(PLANT, COST, radius=-1.0), "radius must be positive"),
        (lambda: c.gpc(PLANT, COST, learning_rate=np.nan), "learning_rate must be"),
        (lambda: c.gpc(LOOSE, dlx.costs.Quadratic(R, R)), "must observe their state"),
        (lambda: c.gpc(PLANT, lambda t, x, u: jnp.abs(u[0])), "base must be given"),
        (lambda: c.drc(LOOSE, dlx.costs.Quadratic(R, R), memory=0), "memory must be"),
        (lambda: c.sfc(PLANT, COST, filters=9, memory=8), "filters must be at most"),
        (lambda: c.sfc(PLANT, COST, margin=1.0), "margin must be a number between"),
        (lambda: c.neural_gpc(PLANT, COST, key=3), "key must be one random key"),
        (lambda: c.BPC(PLANT, UNSTABLE), "must stabilise"),
        (lambda: c.BPC(PLANT, c.LQR(PLANT, Q, R)).init(), "key must be one random"),
        (lambda: c.Adaptive(c.Zero(1)), "base must be an AbstractLearner"),
        (lambda: c.Adaptive(c.gpc(PLANT, COST), slots=1), "slots must be a whole"),
        (lambda: c.Adaptive(c.gpc(PLANT, COST), share=0.0), "share must be positive"),
        (lambda: c.Adaptive(c.gpc(PLANT, COST), share=2.0), "share must be between"),
        (lambda: c.gpc(PLANT, COST, radius=[1.0, 2.0]), "radius must be a number"),
        (lambda: c.gpc(Twice(), COST, base=c.LQR(PLANT, Q, R)), "not observed"),
        (lambda: c.Adaptive(c.gpc(PLANT, COST), play="both"), "'mix' or 'switch'"),
        (lambda: c.Explore(3, np.zeros((1, 2)), 100), "build must be a function"),
        (lambda: c.Explore(build, np.zeros((1, 2)), 3), "steps must be a whole"),
        (lambda: c.Scheduled(c.Linear(np.ones((1, 2))), 0.0), "dt must be positive"),
        (lambda: c.Scheduled(3, 1.0), "controllers must be an AbstractController"),
    ],
)
def test_bad_input(make, match):
    with user_error(match=match):
        make()


def test_traced_dynamics_need_a_horizon():
    base = c.Linear([[0.4, 1.2]])

    def cost(b, **options):
        dynamics = dlx.LinearDynamics(A, b * B)
        learner = c.gpc(dynamics, COST, base=base, memory=3, **options)
        return run(learner, SLOW[:30], dynamics).total_cost

    with user_error(match="horizon must be given"):
        jax.jit(cost)(1.0)
    assert_gradient(lambda b: cost(b, horizon=10), 1.0, rtol=1e-5)


def test_a_design_compiles_little(caplog):
    """The derivatives of the cost and of the loop, each as one program."""
    plant = dlx.LinearDynamics(A, B, dt=0.25)
    with jax.log_compiles():
        c.gpc(plant, dlx.costs.Quadratic(2 * Q, R))
    compiled = [r for r in caplog.records if r.getMessage().startswith("Compiling")]
    assert len(compiled) <= 6


def test_a_pid_with_a_derivative_stabilises():
    """Its first step has no derivative of the error."""
    plant = dlx.LinearDynamics([[1.0, 0.1], [0.0, 1.0]], [[0.005], [0.1]], dt=0.1)
    law = c.PID(1.0, 0.0, 2.0, dt=0.1, output=0)
    assert c.gpc(plant, COST, base=law, horizon=50).loop.horizon == 50


def test_hindsight_from_a_controller_that_diverges():
    plant = dlx.LinearDynamics(2 * np.eye(1), np.eye(1))
    cost = dlx.costs.Quadratic(np.eye(1), np.eye(1))
    env, lqr = dlx.Environment(plant, cost), c.LQR(plant, np.eye(1), np.eye(1))
    w = np.ones((2000, 1))
    played = dlx.rollout(env, lqr, key=KEY, w=w, horizon=2000)
    found = c.best_in_hindsight(env, c.Linear(np.zeros((1, 1))), played)
    assert found.result == dlx.RESULTS.diverged


def test_an_expert_outside_of_the_domain_of_the_cost():
    cost = dlx.costs.Function(lambda t, x, u: x @ x - jnp.log(1 - u[0] ** 2))
    env = dlx.Environment(PLANT, cost, control_bounds=(-0.9, 0.9))
    learner = c.Adaptive(c.gpc(PLANT, cost, base=c.Linear([[0.4, 1.2]])))
    options = dict(key=KEY, x0=[5.0, 0.0], horizon=50, throw=False)
    run = dlx.rollout(env, learner, **options)
    assert run.result == dlx.RESULTS.successful


def test_a_cost_that_is_not_finite_does_not_end_the_learning():
    learner = c.BPC(PLANT, c.LQR(PLANT, Q, R))
    state = learner.init(key=KEY)
    for cost in (1.0, np.inf, 1.0, 3.0):
        u, state = learner(0.0, jnp.ones(2), state)
        state = learner.applied(u, jnp.asarray(cost), state)
    assert state.refused.count == 1 and np.isfinite(state.level) and state.steps == 3
