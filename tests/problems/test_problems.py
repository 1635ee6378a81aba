"""The published optima of optimal control, in a simulation with adaptive steps."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
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
    # What may be violated, and the bounds of the given start, do not count.
    first = jnp.full((len(plan.states), 4), -jnp.inf).at[0].set(1e3)
    always = dlx.planning.SoftConstraint(lambda t, x, u: 1.0, linear=1.0)
    for limits in (
        dict(states=dlx.qp.Soft(-jnp.inf, 0.0, linear=1.0)),
        dict(states=(first, jnp.inf)),
        dict(inequality=always),
    ):
        loose = dlx.planning.Constraints(**limits)
        simulated = dataclasses.replace(problem, constraints=loose).simulate(plan)
        assert simulated.violation <= 1e-5
    listed = dataclasses.replace(problem, bounds=([-10.0], [10.0])).simulate(plan)
    assert listed.violation <= 1e-5


class Driven(dlx.systems.Pendulum):
    """A pendulum whose torque grows with time."""

    def vector_field(self, t, x, u, w):
        return super().vector_field(t, x, u + t, w)


@once
def test_steps_of_several_lengths():
    """They are those of the inner dynamics, with its time and its disturbance."""
    widths = np.array([0.1, 0.3, 0.2])
    inner = dlx.Discretized(Driven(), dt=1.0, substeps=4)
    sampled = dlx.problems.Sampled(inner, jnp.asarray(widths), dt=2.0)
    x, w = jnp.array([0.1, 0.0]), jnp.full((3, inner.disturbance_size), 0.5)
    states = dlx.open_loop(sampled, x, jnp.zeros((3, 1)), w=w)
    for k, t in enumerate((0.0, 0.1, 0.4)):
        step = dlx.Discretized(Driven(), dt=widths[k], substeps=4)
        x = step(t, x, jnp.zeros(1), w[k])
        assert_close(states[k + 1], x, rtol=1e-5)
    turned = sampled.difference(jnp.array([2 * np.pi, 0.0]), jnp.zeros(2))
    assert sampled.angle_names == inner.angle_names and abs(turned[0]) < 1e-5
    fine = sampled.refined(2, lambda inner: inner)
    halves = dlx.open_loop(fine, states[0], jnp.zeros((6, 1)))
    assert_close(fine.dt, 1.0)
    alone = dlx.open_loop(sampled, states[0], jnp.zeros((3, 1)))
    assert_close(halves[::2], alone, rtol=1e-4)
    # There is no step after the last one.
    with user_error(RuntimeError, match="open_loop"):
        dlx.open_loop(sampled, states[0], jnp.zeros((4, 1)))
    with user_error(match="Sampled: widths must be positive"):
        dlx.problems.Sampled(inner, jnp.array([0.1, -0.1]))
    linear = dlx.linearize(inner)
    quadratic = dlx.costs.Quadratic(jnp.eye(2), jnp.eye(1))
    other = dlx.problems.OptimalControl(linear, quadratic, x, jnp.zeros((3, 1)), 0.0)
    with user_error(match="simulate: dynamics must be a delucax.Discretized"):
        other.simulate(other.solve(throw=False))


@once
def test_a_number_of_steps_is_positive():
    with user_error(match="robot_arm: steps must be"):
        dlx.problems.robot_arm(0)
