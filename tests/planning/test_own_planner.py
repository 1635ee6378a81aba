"""A planner of a user's own, written with public names alone."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from helpers import once, user_error

import delucax as dlx


pytestmark = once


class Shooting(dlx.planning.AbstractPlanner):
    """Gradient descent on the controls."""

    def solve(self, problem, start, key):
        if problem.constraints is not None:
            raise ValueError("Shooting: constraints must be None.")
        _, _, controls, _ = start.cheapest(problem)

        def descend(_, controls):
            return controls - 0.02 * jax.grad(lambda u: problem.roll_out(u)[2])(
                controls
            )

        controls = jax.lax.fori_loop(0, 50, descend, controls)
        return problem.plan(*problem.roll_out(controls))


PENDULUM = dlx.Discretized(dlx.systems.Pendulum(), 0.1, diffrax.Euler())
COST = dlx.costs.Quadratic([1.0, 0.1], [0.1])
X0 = jnp.array([0.3, 0.0])


def test_a_planner_of_ones_own():
    given = PENDULUM, COST, X0
    first = Shooting()(*given, jnp.zeros((8, 1)), bounds=(-2.0, 2.0))
    assert first.result == dlx.RESULTS.successful and first.is_usable
    assert np.all(np.abs(first.controls) <= 2.0)
    alone = dlx.open_loop(PENDULUM, X0, first.controls)
    np.testing.assert_allclose(first.states, alone, rtol=1e-5, atol=1e-6)
    start = dlx.planning.Start(jnp.stack([jnp.zeros((8, 1)), first.controls]))
    again = Shooting()(*given, start, bounds=(-2.0, 2.0))
    assert again.cost <= first.cost
    with user_error(match="Shooting: constraints must be None"):
        rest = dlx.planning.Constraints(final_equality=lambda t, x: x)
        Shooting()(*given, 8, constraints=rest)


def test_a_plan_that_diverges_gives_way_to_the_fallback():
    wild = dlx.system(lambda t, x, u, w: 1e3 * x**3 + u, states=1, controls=1)
    wild = dlx.Discretized(wild, 0.1, diffrax.Euler())
    given = wild, dlx.costs.Quadratic([1.0], [1.0]), [1.0]
    plan = Shooting()(*given, jnp.zeros((8, 1)), throw=False)
    assert plan.result == dlx.RESULTS.diverged and not plan.is_usable
    spare = dlx.planning.Start(jnp.ones((8, 1)), jnp.ones((9, 1)), jnp.ones((8, 1, 1)))
    plan = Shooting()(*given, jnp.zeros((8, 1)), fallback=spare, throw=False)
    assert plan.result == dlx.RESULTS.diverged
    np.testing.assert_array_equal(plan.controls, spare.controls)


def test_it_works_in_receding_horizon_control():
    mpc = dlx.controllers.MPC(PENDULUM, COST, 8, planner=Shooting(), bounds=(-2.0, 2.0))
    env = dlx.Environment(PENDULUM, COST, horizon=5)
    run = dlx.rollout(env, mpc, key=jax.random.key(0), x0=X0)
    assert run.result == dlx.RESULTS.successful
