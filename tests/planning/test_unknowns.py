"""Unknown first states, parameters and durations of a plan."""

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from examples import check_output, output_of
from helpers import assert_close, needs_x64, once, user_error

import delucax as dlx


SQP, Constraints = dlx.planning.SQP, dlx.planning.Constraints
Unknowns = dlx.planning.Unknowns
CART = dlx.systems.LinearSystem([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
LEAST_TIME = dlx.costs.Function(lambda t, x, u: 0.0 * u[0], lambda t, x: t)
AT_REST = Constraints(final_equality=lambda t, x: x)


def least_time(strongest, start=-1.0, planner=None, **changes):
    """A cart that comes to rest at the origin, by the forces -1 to `strongest`."""
    given = dict(
        bounds=(-1.0, strongest),
        constraints=AT_REST,
        unknowns=Unknowns(duration=(0.5, 10.0)),
    )
    dynamics = dlx.Discretized(CART, dt=0.1)
    x0 = jnp.stack([jnp.asarray(start), jnp.zeros(())])
    planner = SQP() if planner is None else planner
    return planner(dynamics, LEAST_TIME, x0, jnp.zeros((20, 1)), **given | changes)


def test_least_time_of_a_cart():
    plan = least_time(1.0)
    # Half of the way at full force each: T^2 / 4 is the distance.
    assert_close(plan.duration, 2.0, rtol=1e-3)
    assert_close(plan.parameters["dynamics.dt"], plan.dt)
    assert plan.states.shape == (21, 2) and plan.gains.shape == (20, 1, 2)


@needs_x64
def test_derivatives_of_a_least_time():
    # The last control before the switch is between the bounds.
    duration = jax.jit(lambda force, start: least_time(force, start).duration)
    slopes = jax.grad(duration, (0, 1))(1.3, -1.0)
    step = 1e-4
    for i, slope in enumerate(slopes):
        moved = [[1.3, -1.0], [1.3, -1.0]]
        moved[0][i] += step
        moved[1][i] -= step
        ends = [duration(*at) for at in moved]
        assert_close(slope, (ends[0] - ends[1]) / (2 * step), rtol=1e-6)


@needs_x64
def test_the_derivative_of_the_page():
    page = Path(__file__).parents[2] / "docs" / "optimal_control.md"
    pattern = r"(?ms)^```python\n(.*?)^```\n\n(?:```text\n(.*?)```)?"
    blocks = re.findall(pattern, page.read_text())
    namespace = {}
    for code, shown in (*blocks[:2], next(b for b in blocks if "jax.grad(" in b[0])):
        check_output(output_of(code, namespace), shown)


def test_times_of_the_user():
    # The cost and the constraints see true times, after a start at t0 = 3.
    late = Constraints(
        {"late": lambda t, x, u: 3.0 - t}, final_equality=AT_REST.final_equality
    )
    plan = least_time(1.0, constraints=late, t0=3.0)
    assert_close(plan.cost, 3.0 + plan.duration, rtol=1e-5)
    assert plan.violation <= 1e-4


class Rate(dlx.AbstractSystem):
    rate: jax.Array = dlx.parameter(1.0)
    state_names, control_names = ("x",), ()

    def vector_field(self, t, x, u, w):
        return -self.rate * x


class Fit(dlx.AbstractCost):
    data: jax.Array = dlx.parameter()
    weight: jax.Array = dlx.parameter(1.0)

    def __call__(self, t, x, u):
        return (x[0] - self.data[jnp.round(t / 0.1).astype(int)]) ** 2

    def final(self, t, x):
        return (x[0] - self.data[-1]) ** 2


def fitted(rate=2.0, start=3.0, **changes):
    """The rate and the start of a decay that is measured at 21 times."""
    data = start * jnp.exp(-rate * 0.1 * jnp.arange(21))
    bounds = dict(
        parameters={"dynamics.system.rate": (0.0, 10.0)}, start={"x": (0.0, jnp.inf)}
    )
    dynamics = dlx.Discretized(Rate(), dt=0.1, substeps=2)
    given = Fit(data), jnp.ones(1), jnp.zeros((20, 0))
    return SQP()(dynamics, *given, unknowns=Unknowns(**bounds | changes))


@needs_x64
def test_a_start_and_a_parameter_from_data():
    plan = fitted()
    assert_close(plan.parameters["dynamics.system.rate"], 2.0, rtol=1e-5)
    assert_close(plan.states[0, 0], 3.0, rtol=1e-5)
    bounded = fitted(parameters={"dynamics.system.rate": (0.0, 1.5)})
    assert_close(bounded.parameters["dynamics.system.rate"], 1.5)


@needs_x64
def test_derivatives_of_an_estimate():
    def estimate(start):
        plan = fitted(1.7, start)
        return plan.parameters["dynamics.system.rate"] + plan.states[0, 0]

    at = jnp.asarray(3.0)
    ends = estimate(at + 1e-4), estimate(at - 1e-4)
    assert_close(jax.grad(estimate)(at), (ends[0] - ends[1]) / 2e-4, rtol=1e-6)


BAD = {
    "time does not run backwards": dict(duration=(-1.0, 1.0)),
    "at least one unknown": dict(),
    "must have low <= high": dict(duration=(2.0, 1.0)),
    r"start\['x'\] must be a pair": dict(start={"x": 1.0}),
    "parameters must be a dictionary": dict(parameters=(0.0, 1.0)),
}


@once
@pytest.mark.parametrize("message", BAD)
def test_bad_unknowns(message):
    with user_error(match=message):
        Unknowns(**BAD[message])


@once
def test_unknowns_that_are_not_there():
    with user_error(match="names the state 'x2'"):
        least_time(1.0, unknowns=Unknowns(start={"x2": (0.0, 1.0)}))
    with user_error(match="must start with dynamics, cost or constraints"):
        least_time(1.0, unknowns=Unknowns(parameters={"system.A": (0.0, 1.0)}))
    with user_error(match="time does not run backwards"):
        path = {"dynamics.dt": (-1.0, 1.0)}
        least_time(1.0, unknowns=Unknowns(parameters=path))
    with user_error(match="LinearSystem has no 'mass'"):
        path = {"dynamics.system.mass": (0.0, 1.0)}
        least_time(1.0, unknowns=Unknowns(parameters=path))
    with user_error(match="whose start value in the problem must be a number"):
        path = {"dynamics.system.C": (0.0, 1.0)}
        least_time(1.0, unknowns=Unknowns(parameters=path))
    with user_error(match="a system in continuous time"):
        dynamics = dlx.LinearDynamics(jnp.eye(2), jnp.ones((2, 1)), dt=0.1)
        given = LEAST_TIME, jnp.ones(2), jnp.zeros((5, 1))
        SQP()(dynamics, *given, unknowns=Unknowns(duration=(0.1, 1.0)))
    with user_error(match="Only `delucax.planning.SQP` takes unknowns"):
        least_time(1.0, planner=dlx.planning.ILQR())
