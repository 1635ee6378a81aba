"""Where planners start, on an unstable plant above all."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, needs_x64, once, user_error

import delucax as dlx


ilqr, Start = dlx.planning.ilqr, dlx.planning.Start
T = 30
BOUNDS = 280.0, 320.0
STARTS = [[0.6495, 346.71], [0.6408, 349.82], [0.6035, 351.85]]
# Of `python -m benchmarks.reactor`.
IPOPT = [5.210338665957, 10.028732157678, 11.955587196360]


def reactor():
    """The dynamics, the LQR, and the cost with the LQR's cost to go."""
    env = dlx.make("cstr")
    x, u = env.dynamics.equilibrium()
    Q, R = jnp.diag(jnp.array([10.0, 0.01])), jnp.array([[0.01]])
    lqr = dlx.controllers.LQR(dlx.linearize(env.dynamics), Q, R)
    cost = dlx.costs.Quadratic(Q, R, final=lqr.P, state_target=x, control_target=u)
    return env.dynamics, lqr, cost


def held(dynamics):
    return jnp.tile(dynamics.equilibrium()[1], (T, 1))


@needs_x64
def test_an_unstable_plant_is_planned_by_default():
    dynamics, lqr, cost = reactor()
    env = dlx.Environment(dynamics, cost, control_bounds=BOUNDS, horizon=T)

    @jax.jit
    @jax.vmap
    def costs(x0):
        plan = ilqr(dynamics, cost, x0, T, bounds=BOUNDS, throw=False)
        run = dlx.rollout(env, lqr, key=jax.random.key(0), x0=x0)
        solved = plan.result == dlx.RESULTS.successful
        return plan.cost, run.total_cost, plan.trace[0], plan.iterations, solved

    anywhere = np.random.default_rng(0).uniform([0.3, 342.0], [0.7, 352.0], (100, 2))
    outcomes = costs(np.concatenate([STARTS, anywhere]))
    found, regulated, first, iterations, solved = (each[:3] for each in outcomes)
    assert_close(found, IPOPT, atol=1e-9)
    assert_close(first, regulated, rtol=1e-9)
    assert np.all(iterations <= 10) and np.all(solved)
    # No plan costs more than the LQR's run, wherever it starts.
    found, regulated, first, *_ = outcomes
    assert np.all(found <= regulated * (1 + 1e-9))
    assert np.all(first <= regulated * (1 + 1e-9))


@needs_x64
def test_controls_alone_lead_elsewhere():
    """What the default is for: from the equilibrium's control the plan ignites, and
    says that it is stationary."""
    dynamics, _, cost = reactor()
    x0 = jnp.array(STARTS[0])
    alone = ilqr(dynamics, cost, x0, held(dynamics), bounds=BOUNDS)
    assert alone.cost > 500
    line = jnp.tile(dynamics.equilibrium()[0], (T + 1, 1))
    planner = dlx.planning.ILQR(states=line)
    plan = planner(dynamics, cost, x0, T, bounds=BOUNDS)
    assert_close(plan.cost, IPOPT[0], atol=1e-9)


class Below(eqx.Module):
    limit: jax.Array

    def __call__(self, t, x, u):
        return x[1] - self.limit


@needs_x64
@pytest.mark.parametrize(
    "limit, x0, expected",
    [
        # A limit that is not met, and one that is.
        (352.0, STARTS[2], IPOPT[2]),
        (349.5, STARTS[0], 5.216398005207),
    ],
)
def test_a_limit_of_the_temperature(limit, x0, expected):
    dynamics, _, cost = reactor()
    below = dlx.planning.Constraints(Below(jnp.asarray(limit)))
    x0 = jnp.array(x0)
    plan = ilqr(dynamics, cost, x0, T, bounds=BOUNDS, constraints=below)
    assert_close(plan.cost, expected, atol=1e-6)
    assert jnp.max(plan.states[:-1, 1]) < limit + 1e-6


@once
def test_an_unstable_plant_in_single_precision():
    dynamics, _, cost = reactor()
    for x0, expected in zip(STARTS[:2], IPOPT[:2], strict=True):
        plan = ilqr(dynamics, cost, jnp.array(x0), T, bounds=BOUNDS)
        assert plan.cost.dtype == jnp.float32
        assert_close(plan.cost, expected, rtol=1e-4)


UNSTABLE = dlx.LinearDynamics(jnp.array([[1.6]]), jnp.ones((1, 1)))
CHEAP = dlx.costs.Quadratic([1.0], [1.0])


def law(gain, steps=8):
    return Start(
        jnp.zeros((steps, 1)), jnp.zeros((steps + 1, 1)), jnp.full((steps, 1, 1), gain)
    )


def stacked(*starts):
    return jax.tree.map(lambda *a: jnp.stack(a), *starts)


@once
def test_the_cheapest_start_is_taken():
    x0 = jnp.ones(1)
    run = lambda start: ilqr(UNSTABLE, CHEAP, x0, start, max_iterations=1, throw=False)
    alone = [run(law(gain)) for gain in (0.0, 1.2, -3e30)]
    both = run(stacked(*(law(gain) for gain in (0.0, -3e30, 1.2))))
    assert alone[1].trace[0] < alone[0].trace[0]
    assert alone[2].result == dlx.RESULTS.diverged
    assert_close(both.trace[0], alone[1].trace[0], rtol=1e-6)
    assert both.rollouts == alone[1].rollouts + 2


@once
def test_several_starts_are_shifted_in_time():
    U = np.arange(6.0).reshape(2, 3, 1)
    gains, states = U[..., None], np.arange(8.0).reshape(2, 4, 1)
    later = Start(U, states, gains).shifted()
    assert_close(later.controls[..., 0], [[1, 2, 2], [4, 5, 5]])
    assert_close(later.states[..., 0], [[1, 2, 3, 3], [5, 6, 7, 7]])
    assert_close(later.gains[..., 0, 0], later.controls[..., 0])


@once
def test_samplers_start_from_it_too():
    x0, key = jnp.ones(1), jax.random.key(0)
    few = dict(samples=4, iterations=1)
    both = stacked(law(0.0), law(1.2))
    for planner, more in (
        (dlx.planning.MPPI, {}),
        (dlx.planning.CEM, dict(elites=2)),
    ):
        plan = planner(**few, **more)(UNSTABLE, CHEAP, x0, both, key=key)
        first = ilqr(UNSTABLE, CHEAP, x0, law(1.2), max_iterations=1, throw=False)
        assert plan.cost <= first.trace[0] * (1 + 1e-6)


@once
def test_a_long_horizon_does_not_leave_an_unstable_plant():
    """Open loop the rounding of single precision would grow by 1.6^200."""
    plan = ilqr(UNSTABLE, CHEAP, jnp.ones(1), 200)
    assert plan.iterations <= 3
    again = ilqr(UNSTABLE, CHEAP, 1.01 * jnp.ones(1), plan)
    assert again.iterations <= 3
    assert_close(again.cost, 1.01**2 * plan.cost, rtol=1e-4)


def no_point(t, x, u, w):
    return jnp.stack([x[1], jnp.sin(x[0]) + u[0]])


@once
def test_the_operating_point(monkeypatch):
    euler = dict(dt=0.1, solver=diffrax.Euler())
    named = dlx.Discretized(dlx.systems.Pendulum(), **euler)
    bare = dlx.Discretized(dlx.system(no_point, states=2, controls=1), **euler)
    weights = [1.0, 1.0], [1.0]
    target = dict(state_target=[0.0, 0.0], control_target=[0.5])
    default = dlx.planning.Start.default
    # Dynamics that name a point; a cost that does; neither, but for zero; and neither.
    start = default(named, dlx.costs.PendulumCost(), 5)
    assert start.controls.shape == (2, 5, 1) and jnp.all(start.gains[0] != 0)
    assert jnp.all(start.gains[1] == 0)
    start = default(named, dlx.costs.Quadratic(*weights, **target), 5)
    assert jnp.all(start.controls == 0.5)
    start = default(bare, dlx.costs.Quadratic(*weights), 5)
    assert jnp.all(start.states == 0) and jnp.all(start.gains[0] != 0)
    # Costs that are made of others name what these do.
    cost = dlx.costs.Quadratic(*weights, **target)
    effort = dlx.costs.Function(lambda t, x, u: u @ u)
    for made in (effort + 2 * cost, dlx.costs.Rate(cost, 0.1)):
        start = default(bare, made, 5)
        assert jnp.all(start.controls == 0.5) and jnp.all(start.gains[0] != 0)
    moving = dlx.costs.Tracking(*weights, lambda t: jnp.ones(2) * t)
    start = default(bare, moving, 5)
    assert jnp.all(start.states == 0) and jnp.all(start.gains[0] != 0)


@once
def test_an_unstable_plant_that_nothing_names_a_point_of():
    """From zero control alone the plan ends in a minimum at a cost of 259."""

    def thrust(t, x, u, w):
        return jnp.stack([x[1], 30 * jnp.sin(x[0]) + u[0]])

    dynamics = dlx.Discretized(dlx.system(thrust, states=2, controls=1), dt=0.05)
    stage = lambda t, x, u: x[0] ** 2 + 0.1 * x[1] ** 2 + 0.001 * u[0] ** 2
    cost = dlx.costs.Function(stage)
    plan = ilqr(dynamics, cost, jnp.array([0.3, 0.0]), 60, bounds=(-15.0, 15.0))
    assert_close(plan.cost, 1.300551, rtol=1e-4)
    # It is a start, not a name.
    with user_error(match="Environment: trim needs"):
        dlx.Environment(dynamics, dlx.costs.Function(stage)).trim()


@once
def test_no_regulator_where_the_origin_is_singular():
    dynamics = dlx.Discretized(
        dlx.system(lambda t, x, u, w: x / jnp.abs(x) + u, states=1, controls=1), dt=0.1
    )
    cost = dlx.costs.Function(lambda t, x, u: x @ x + u @ u)
    start = dlx.planning.Start.default(dynamics, cost, 5)
    assert jnp.all(start.gains == 0) and jnp.all(start.controls == 0)


@once
def test_without_a_regulator_the_control_is_held():
    cost = dlx.costs.Quadratic([1.0, 1.0], [1.0])
    free = dlx.LinearDynamics(jnp.diag(jnp.array([1.5, 0.5])), jnp.array([[0.0], [1]]))
    flat = dlx.costs.Quadratic([1.0], [0.0])
    concave = dlx.costs.Quadratic([1.0], [-1.0])

    def not_smooth(t, x, u, w):
        shape = jax.ShapeDtypeStruct(x.shape, x.dtype)
        call = lambda x: np.asarray(-x)
        return jax.pure_callback(call, shape, x, vmap_method="sequential")

    rough = dlx.Discretized(dlx.system(not_smooth, states=1, controls=1), dt=0.1)
    for dynamics, charged in (
        (free, cost),
        (UNSTABLE, flat),
        (UNSTABLE, concave),
        (rough, CHEAP),
    ):
        start = dlx.planning.Start.default(dynamics, charged, 3)
        assert jnp.all(start.gains == 0) and jnp.all(jnp.isfinite(start.controls))


@needs_x64
def test_a_plan_does_not_depend_on_its_start():
    """Nor does its derivative, which does not go through the LQR."""

    def cost(pole, start):
        dynamics = dlx.LinearDynamics(pole[None, None], jnp.ones((1, 1)))
        return ilqr(dynamics, CHEAP, jnp.ones(1), start).cost

    values = [
        jax.jit(jax.value_and_grad(lambda pole, start=start: cost(pole, start)))(1.6)
        for start in (8, jnp.zeros((8, 1)))
    ]
    assert_close(values[0], values[1], rtol=1e-8)


@once
def test_bad_starts():
    x0 = jnp.ones(1)
    for start, match in (
        (Start(jnp.zeros(3)), r"controls.controls must have shape \(T, 1\)"),
        (Start(jnp.zeros((3, 2))), r"controls.controls must have shape \(3, 1\)"),
        (
            Start(jnp.zeros((3, 1)), jnp.zeros((3, 1)), jnp.zeros((3, 1, 1))),
            r"controls.states must have shape \(4, 1\), got shape \(3, 1\)",
        ),
        (
            Start(jnp.zeros((3, 1)), jnp.zeros((4, 1)), jnp.zeros((3, 1))),
            r"controls.gains must have shape \(3, 1, 1\)",
        ),
        (
            Start(jnp.zeros((3, 1)), gains=jnp.zeros((3, 1, 1))),
            "controls.states must be given with controls.gains",
        ),
        (Start(jnp.full((3, 1), jnp.nan)), "controls.controls must be finite"),
        (0, r"controls \(the horizon\) must be a whole number of at least 1, got 0"),
        (True, r"controls \(the horizon\) must be a whole number"),
        (2.5, r"controls must have shape \(steps, 1\)"),
    ):
        with user_error(match=match):
            ilqr(UNSTABLE, CHEAP, x0, start)
    with user_error(
        match="must be an array or a number of steps if the planner has states"
    ):
        dlx.planning.ILQR(states=jnp.zeros((9, 1)))(UNSTABLE, CHEAP, x0, law(1.0))
    with user_error(match="horizon must be a whole number"):
        dlx.planning.Start.default(UNSTABLE, CHEAP, 2.0)
    with user_error(match="Start.default: dynamics must be an AbstractDynamics"):
        dlx.planning.Start.default(3, CHEAP, 5)
    with user_error(match="Start.default: cost must be an AbstractCost"):
        dlx.planning.Start.default(UNSTABLE, 3, 5)


def test_a_trajectory_that_runs_away_is_said_to():
    plant = dlx.LinearDynamics(jnp.array([[30.0]]), jnp.ones((1, 1)), dt=0.1)
    cost = dlx.costs.Quadratic([1.0], [1.0])
    U = jnp.zeros((300, 1))
    with pytest.raises(RuntimeError, match="runs away.*stage .*Start from"):
        dlx.planning.ilqr(plant, cost, jnp.ones(1), U)
    assert dlx.planning.ilqr(plant, cost, jnp.ones(1), 300).cost < 1e3
