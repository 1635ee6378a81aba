"""Iterative learning, on the paper's problems: published traces to all their digits."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, needs_x64, original_ilqr, user_error

import delucax as dlx
from delucax.planning._lq import in_sequence, model
from delucax.planning._problem import Problem, roll_out


pytestmark = needs_x64
ilc, igpc = dlx.planning.ilc, dlx.planning.igpc


def problem(dynamics, cost, x0):
    return Problem(dynamics, cost, x0, jnp.zeros(()), *(None,) * 5)


@jax.jit
def pass_back(problem, states, controls):
    stages = model(problem, states, controls, None, False)
    return in_sequence(stages, jnp.zeros(()), False)


def printed(value, number):
    """Whether a value agrees with a number to all its digits."""
    digits = len(str(number).partition(".")[2])
    return round(float(value), digits) == float(str(number))


def run_with(plan, states, controls, policy):
    """A plan whose first run takes the last step of the warm-up once more, as the
    original did."""
    where = lambda p: (p.states, p.controls, p.gains)
    return eqx.tree_at(where, plan, (states, controls - policy.k, policy.K))


@pytest.fixture(scope="module")
def windy():
    """The quadrotor, planned without wind, in a wind of 0.4."""
    env = dlx.make("planar_quadrotor")
    plant = dlx.make("planar_quadrotor", wind="dissipative", wind_strength=0.4)
    x0, (_, hover) = env.initial_state, env.dynamics.equilibrium()
    sim = problem(env.dynamics, env.cost, x0)

    @jax.jit
    def follow(states, controls, k, K, length):
        return roll_out(sim, states, controls, K, k, length, None)[:3]

    U = jnp.tile(hover, (100, 1))
    X = dlx.open_loop(env.dynamics, x0, U)
    # A plan of which all that matters is put in below.
    shape = eqx.filter_eval_shape(dlx.planning.ilqr, env.dynamics, env.cost, x0, U)
    plan = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shape)
    # Eight iterations of the original's warm-up, which lengthened its step by a tenth
    # each time, and took the one before.
    for i in range(8):
        policy = pass_back(sim, X, U)
        X, U, _ = follow(X, U, policy.k, policy.K, 0.5 * 1.1**i)
    given = plant.dynamics, env.dynamics, env.cost
    return *given, run_with(plan, X, U, policy)


def test_learning_in_wind(windy):
    run = ilc(*windy, step=0.2)
    assert printed(run.trace[0], 4487.19)
    assert printed(run.cost, 118.05) and run.rollouts == 57
    assert run.result == dlx.RESULTS.successful and run.iterations == 40
    assert jnp.all(jnp.diff(run.trace) <= 0)
    # The plan is what the plant did, and a controller that does it again.
    plant, _, cost, _ = windy
    followed = dlx.open_loop(plant, run.states[0], run.controls)
    assert_close(followed, run.states, atol=1e-6)
    env = dlx.Environment(plant, cost, initial_state=run.states[0], horizon=100)
    again = dlx.rollout(env, run, key=jax.random.key(0))
    assert_close(again.total_cost, run.cost, rtol=1e-8)


def test_learning_in_wind_and_online(windy):
    options = dict(step=0.2, learning_rate=0.001)
    run = igpc(*windy, indices="deluca", **options)
    assert printed(run.trace[0], 4487.19)
    assert printed(run.cost, 100.72) and run.rollouts == 55
    assert printed(run.trace[12], 414)  # after 15 runs
    ours = igpc(*windy, **options)
    assert 100 < ours.cost < 104


class Arm(dlx.AbstractDynamics):
    """The reacher with the offset of its tip among the states, as in the original."""

    arm: dlx.AbstractDynamics
    cost: dlx.AbstractCost
    state_names = ("s", "e", "ds", "de", "x", "y")
    control_names = ("s", "e")

    @property
    def dt(self):
        return self.arm.dt

    def advance(self, t, x, u, w):
        angles, result = self.arm.advance(t, x[:4], u, None)
        return self.seen(angles), result

    def seen(self, angles):
        return jnp.concatenate([angles, self.cost.offset(angles)])


class ChargedNext(dlx.AbstractCost):
    """Of the next state in place of this one, of which the original took the
    derivatives all the same; less what the first state is charged."""

    first: jax.Array

    def __call__(self, t, x, u):
        return x[4] ** 2 + x[5] ** 2 + 0.1 * (u @ u)

    def final(self, t, x):
        return jax.lax.stop_gradient(x[4] ** 2 + x[5] ** 2) - self.first


def test_an_arm_under_gravity():
    def arm(gravity):
        env = dlx.make("reacher", gravity=gravity)
        return Arm(env.dynamics, env.cost), env.initial_state

    sim, start = arm(0.0)
    plant, _ = arm(-10.0)
    x0, U = sim.seen(start), jnp.zeros((200, 2))
    cost = ChargedNext(x0[4] ** 2 + x0[5] ** 2)
    plans = [original_ilqr(sim, cost, x0, U, iterations=n) for n in (4, 5)]
    trace = [29.7662, 11.2718, 11.1185, 11.1127, 11.1127, 11.1125]
    np.testing.assert_array_equal(np.asarray(plans[1].trace).round(4), trace)
    policy = pass_back(problem(sim, cost, x0), plans[0].states, plans[0].controls)
    plan = run_with(plans[1], plans[1].states, plans[1].controls, policy)
    options = dict(learning_rate=0.01, anneal=False, indices="deluca")
    online = igpc(plant, sim, cost, plan, iterations=10, **options)
    assert printed(online.cost, "780.20") and online.rollouts == 15
    # And without learning online, until the search fails, which it says.
    learned = ilc(plant, sim, cost, plan)
    assert printed(learned.trace[0], 2413.706) and printed(learned.trace[10], 782.81)
    assert learned.result == dlx.RESULTS.no_descent and learned.iterations < 40
    assert printed(learned.cost, 782.81)


def test_where_the_problem_is_not_convex():
    """The distance of the tip is concave in the angles somewhere on the way: without
    regularisation there is no step."""
    env, plant = dlx.make("reacher"), dlx.make("reacher", gravity=-8.0)
    start = env.initial_state, jnp.zeros((200, 2))
    plan = dlx.planning.ilqr(env.dynamics, env.cost, *start)
    run = ilc(plant.dynamics, env.dynamics, env.cost, plan)
    assert run.cost < 0.8 * run.trace[0] and jnp.all(jnp.diff(run.trace) <= 0)


def pendulums():
    """A model and a heavier plant."""
    light, heavy = dlx.systems.Pendulum(), dlx.systems.Pendulum(mass=1.2)
    solver = diffrax.Euler()
    return dlx.Discretized(light, 0.1, solver), dlx.Discretized(heavy, 0.1, solver)


COST = dlx.costs.Quadratic([1.0, 0.1], [0.1], final=[20.0, 2.0])


def test_batches_of_plants_and_no_rate():
    sim, plant = pendulums()
    plan = dlx.planning.ilqr(sim, COST, jnp.array([1.3, 0.0]), jnp.zeros((12, 1)))

    @jax.jit
    def learned(mass, rate=0.01):
        there = dlx.replace(plant, {"system.mass": mass})
        options = dict(iterations=3, throw=False, learning_rate=rate, anneal=False)
        return igpc(there, sim, COST, plan, **options).trace

    masses = np.array([1.1, 1.3])
    batch = jax.jit(jax.vmap(learned))(masses)
    for i, mass in enumerate(masses):
        assert_close(batch[i], learned(mass), rtol=1e-8)
    # Without a rate it learns nothing online.
    same = ilc(plant, sim, COST, plan, iterations=3, throw=False)
    plain = learned(1.2, 0.0)
    assert_close(plain, same.trace, rtol=1e-9)
    assert plain[-1] != learned(1.2)[-1]


@pytest.mark.parametrize("learner", [ilc, igpc])
def test_bounds_disturbances_and_what_diverges(learner):
    (sim, plant), cost = pendulums(), COST
    x0, U, bounds = jnp.array([1.3, 0.0]), jnp.zeros((12, 1)), (-4.0, 4.0)
    plan = dlx.planning.ilqr(sim, cost, x0, U, bounds=bounds)
    push = 0.02 * jnp.ones((12, 2))
    run = learner(plant, sim, cost, plan, w=push, iterations=8)
    assert run.cost < run.trace[0]
    assert jnp.all(jnp.abs(run.controls) <= 4) and jnp.any(run.controls == -4)
    followed = dlx.open_loop(plant, x0, run.controls, push)
    assert_close(followed, run.states, atol=1e-8)
    field = lambda t, x, u, w: jnp.stack([x[1], jnp.exp(100 * x[0]) + u[0]])
    system = dlx.system(field, states=("angle", "rate"), controls=("u",))
    wild = dlx.Discretized(system, 0.1, diffrax.Euler())
    lost = learner(wild, sim, cost, plan, throw=False)
    assert lost.result == dlx.RESULTS.diverged and lost.iterations == 0
    with pytest.raises(RuntimeError, match="NaN or infinite"):
        learner(wild, sim, cost, plan)
    with user_error(match="plan must be a Plan, such as ilqr makes"):
        learner(plant, sim, cost, U)
    with user_error(match="model must have the states and controls of plan"):
        learner(plant, dlx.make("planar_quadrotor").dynamics, cost, plan)
    with user_error(match="w must have shape"):
        learner(plant, sim, cost, plan, w=push[:3])
    with user_error(match="indices must be"):
        igpc(plant, sim, cost, plan, indices="late")
    with user_error(match="learning_rate must be at least 0"):
        igpc(plant, sim, cost, plan, learning_rate=-1.0)
    igpc(plant, sim, cost, plan, learning_rate=np.float32(0), iterations=1)
