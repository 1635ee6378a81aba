"""Plans through the events of a hybrid plant, and where the events change."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, needs_x64, once
from jaxtyping import Array

import delucax as dlx


Q = dlx.RESULTS


class Throw(dlx.systems.AbstractHybridSystem):
    """A ball in the plane, pushed by a hand until it is released, that bounces once it
    is free."""

    release: Array = dlx.parameter(0.25)

    state_names = "x", "y", "x rate", "y rate", "mode"
    control_names = "x force", "y force"
    mode_names = "held", "free"
    event_names, event_directions = ("release", "bounce"), (1, -1)

    def vector_field(self, t, x, u, w):
        push = jnp.where(self.mode(x) == 0, u, 0)
        return jnp.stack([x[2], x[3], push[0], push[1] - 9.81, 0 * x[4]])

    def guards(self, t, x, u):
        return t - self.release, x[1]

    def enabled(self, t, x, u):
        return self.mode(x) == 0, self.mode(x) == 1

    def resets(self, t, x, u):
        return x.at[4].set(1), x * jnp.array([1, 1, 0.9, -0.8, 1], x.dtype)


@needs_x64
def test_a_throw_with_one_bounce():
    """Its end is within a centimetre of the target."""
    dynamics = dlx.Discretized(Throw(), dt=0.1)
    target, weights = jnp.array([3.0, 1.0, 0.0, 0.0, 0.0]), [1e3, 1e3, 0.0, 0.0, 0.0]
    cost = dlx.costs.Quadratic(
        jnp.zeros((5, 5)), 1e-3 * jnp.eye(2), jnp.diag(jnp.array(weights)), target
    )
    x0 = jnp.array([0.0, 1.5, 0.0, 0.0, 0.0])
    plan = dlx.planning.ilqr(dynamics, cost, x0, jnp.zeros((12, 2)))
    run = dlx.rollout(
        dlx.Environment(dynamics, cost, horizon=12),
        plan,
        key=jax.random.key(0),
        x0=x0,
        keep=("states", "events"),
    )
    assert [name for _, name in run.event_list()] == ["release", "bounce"]
    assert np.linalg.norm((run.states[-1] - target)[:2]) < 0.01


HEIGHTS = jnp.array([0.4, 0.6, -0.1])


@pytest.mark.parametrize(
    "line_search",
    [
        pytest.param("backtracking", marks=needs_x64),
        pytest.param("parallel", marks=once),
    ],
)
def test_where_events_change(line_search):
    """A ball is pushed to a height at a time: after a bounce; after one that is best at
    the end of an interval, where the cost has a kink; and one beneath the floor, to
    which it comes nearest just as it bounces."""
    dynamics = dlx.Discretized(dlx.systems.BouncingBall(), dt=0.15)
    planner = dlx.planning.ILQR(max_iterations=60, line_search=line_search)

    @jax.jit
    @jax.vmap
    def plans(height, start):
        reach = jnp.diag(jnp.array([1e3, 0.0]))
        target = jnp.stack([height, 0 * height])
        cost = dlx.costs.Quadratic(jnp.zeros((2, 2)), 0.1 * jnp.eye(1), reach, target)
        return planner(dynamics, cost, start, jnp.zeros((7, 1)), throw=False)

    starts = jnp.array([[1.0, 0.0], [1.0, 0.0], [5.6, 0.0]])
    plan = plans(HEIGHTS, starts)
    assert_close(plan.result == Q.successful, [True, False, False])
    assert_close(plan.result == Q.events_changed, [False, True, True])
    assert_close(plan.states[:, -1, 0], [0.4, 0.6, 0.0], atol=0.01)


@once
def test_a_plan_names_the_event_that_fails():
    dynamics = dlx.Discretized(dlx.systems.BouncingBall(), dt=0.1)
    cost = dlx.costs.Quadratic([1.0, 1.0], [1.0])
    with pytest.raises(RuntimeError, match=r"the event bounce at t = 0\."):
        dlx.planning.ilqr(dynamics, cost, [-0.1, 0.0], jnp.zeros((3, 1)))
    env = dlx.Environment(dynamics, cost, horizon=3)
    with pytest.raises(RuntimeError, match=r"beyond.*the event bounce at t = 0\."):
        options = dict(key=jax.random.key(0), x0=[-0.1, 0.0])
        dlx.rollout(env, dlx.controllers.Zero(1), **options)


@once
@pytest.mark.parametrize("planner", [dlx.planning.ILQR(), dlx.planning.SQP()])
def test_a_plan_whose_steps_fail_has_their_status(planner):
    ball = dlx.Discretized(dlx.systems.BouncingBall(), dt=0.1)
    cost = dlx.costs.Quadratic([1.0, 1.0], [1.0])
    below = jnp.array([-0.1, 0.0])
    plan = planner(ball, cost, below, jnp.zeros((3, 1)), throw=False)
    assert plan.result != dlx.RESULTS.successful
    if isinstance(planner, dlx.planning.SQP):
        assert plan.result == dlx.RESULTS.beyond_guard
