"""The published optima of optimal control, in a simulation with adaptive steps."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest
from helpers import assert_close, needs_x64, once, user_error

import delucax as dlx


@needs_x64
@pytest.mark.parametrize("name", dlx.problems.NAMES)
def test_published_optimum(name):
    problem = getattr(dlx.problems, name)()
    plan = problem.solve()
    simulated = problem.simulate(plan)
    assert_close(simulated.objective, problem.reference, rtol=1e-4)
    assert simulated.violation <= 1e-5
    assert len(simulated.times) == 10 * problem.horizon + 1


@needs_x64
def test_derivative_of_a_least_time():
    problem = dlx.problems.particle_steering(20)
    planner = dlx.planning.SQP(states=problem.states, tolerance=1e-11)

    @jax.jit
    def duration(acceleration):
        path = {"dynamics.system.acceleration": acceleration}
        return dlx.replace(problem, path).solve(planner).duration

    slope = jax.grad(duration)(100.0)
    ends = duration(100.1), duration(99.9)
    assert_close(slope, (ends[0] - ends[1]) / 0.2, rtol=1e-5)


@needs_x64
def test_violation_of_every_kind():
    problem = dlx.problems.particle_steering(20)
    plan = problem.solve()
    high = float(plan.states[:, 0].max())
    for given, least in (
        (dict(inequality=lambda t, x, u: x[0] - high / 2), 0.4 * high),
        (dict(controls=(-0.1, 0.1)), 0.7),
        (dict(states=(-jnp.inf, 40.0)), 5.0),
    ):
        constraints = dlx.planning.Constraints(**given)
        narrow = dataclasses.replace(problem, constraints=constraints)
        assert narrow.simulate(plan).violation >= least - 1e-6


@once
def test_a_number_of_steps_is_positive():
    with user_error(match="robot_arm: steps must be"):
        dlx.problems.robot_arm(0)
