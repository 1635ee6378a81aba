"""Plans: published traces, optima, every option, and what must not go wrong."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    assert_close,
    ilqr,
    needs_x64,
    once,
    original_ilqr,
    tolerance,
    user_error,
)

import delucax as dlx


START = jnp.array([1.0, 1.0, 0.0, 0.0, 0.0, 0.0])


def quadrotor():
    env = dlx.make("planar_quadrotor")
    _, hover = env.dynamics.equilibrium()
    return env, jnp.tile(hover, (100, 1))


def pendulum():
    dynamics = dlx.Discretized(dlx.systems.Pendulum(), 0.1, diffrax.Euler())
    cost = dlx.costs.Quadratic([1.0, 0.1], [0.1], final=[20.0, 2.0])
    return dynamics, cost


def swing(horizon=20, **options):
    start = jnp.array([1.3, 0.0])
    return ilqr(*pendulum(), start, jnp.zeros((horizon, 1)), **options)


class ChargedNext(dlx.AbstractCost):
    """The cost of the next state in place of that of this one, of which the original
    library took the derivatives all the same."""

    cost: dlx.AbstractCost

    def __call__(self, t, x, u):
        return self.cost(t, x, u)

    def final(self, t, x):
        return jnp.sum(jax.lax.stop_gradient(x) ** 2)


@needs_x64
def test_the_published_trace():
    env, _ = quadrotor()
    cost = ChargedNext(env.cost)
    plan = original_ilqr(env.dynamics, cost, START, jnp.zeros((100, 2)), iterations=20)
    # The state at the start is charged here, and was not there.
    trace = np.asarray(plan.trace) - float(START @ START)
    printed = [374122.0319, 3861.0703, 219.2560, 69.3763, 54.8095, 52.3808, 51.8737]
    np.testing.assert_array_equal(trace[:8].round(4), [*printed, 51.8185])
    assert trace[20].round(6) == 50.724914
    assert plan.rollouts == 33


@needs_x64
def test_the_trace_with_short_steps():
    env, hover = quadrotor()
    options = dict(line_search="backtracking", tolerance=0.0, throw=False)
    options |= dict(max_iterations=7)
    plan = ilqr(env.dynamics, env.cost, START, hover, **options)
    trace = np.asarray(plan.trace)
    printed = [200.0, 52.9279, 52.7269, 52.7128]
    np.testing.assert_array_equal(trace[:4].round(4), printed)
    assert trace[4].round(5) == 52.71158 and trace[7].round(6) == 52.711426
    assert plan.rollouts == 8
    plan = ilqr(env.dynamics, env.cost, START, 0 * hover, **options)
    assert np.round(plan.trace[0], 2) == 357221.27


@pytest.fixture(scope="module")
def best():
    return swing()


@needs_x64
@pytest.mark.parametrize(
    "options",
    [
        dict(line_search="parallel"),
        dict(second_order=True),
        dict(regularise="state"),
        dict(bounds=(-100.0, [100.0])),
    ],
)
def test_every_way_finds_the_optimum(options, best):
    plan = swing(**options)
    assert_close(plan.cost, best.cost, rtol=1e-9)
    assert plan.residual < 1e-7 and plan.iterations <= 13


@needs_x64
def test_from_states_that_do_not_follow(best):
    dynamics, cost = pendulum()
    start = best.states[0]
    straight = np.linspace(1, 0, 21)[:, None] * np.asarray(start)
    straight[0] = 5.0  # which is not where it starts
    plan = ilqr(dynamics, cost, start, np.zeros((20, 1)), states=straight)
    assert_close(plan.cost, best.cost, rtol=1e-9)
    assert_close(plan.states[0], start)
    followed = dlx.open_loop(dynamics, start, plan.controls)
    assert_close(followed, plan.states, atol=1e-9)


def test_a_plan_is_a_controller(best):
    dynamics, cost = pendulum()
    plan = best
    env = dlx.Environment(dynamics, cost, horizon=20)
    key = jax.random.key(0)
    run = dlx.rollout(env, plan, key=key, x0=plan.states[0])
    assert_close(run.controls, plan.controls, atol=tolerance(1e-5, 1e-12))
    assert_close(run.total_cost, plan.cost, rtol=tolerance(1e-5, 1e-12))
    # Feedback does better than the plan alone.
    x0 = plan.states[0] + 0.05
    alone = dlx.controllers.OpenLoop(plan.controls)
    closed, open_ = (
        dlx.rollout(env, c, key=key, x0=x0).total_cost for c in (plan, alone)
    )
    assert closed < 0.9 * open_
    u, _ = plan(0.5, plan.states[5] + 0.1, None)
    expected = plan.controls[5] - plan.gains[5] @ (0.1 * jnp.ones(2))
    assert_close(u, expected, rtol=1e-5)
    assert jnp.isnan(plan(2.0, x0, None)[0]) and jnp.isnan(plan(-0.1, x0, None)[0])
    with user_error(match="observation must have size 2"):
        plan(0.0, jnp.zeros(3), None)


@pytest.mark.parametrize("parallel", [False, pytest.param(True, marks=needs_x64)])
def test_gains_are_those_of_the_regulator_of_a_linear_problem(parallel):
    A, B = jnp.array([[1.0, 0.1], [0.3, 0.9]]), jnp.array([[0.0], [0.1]])
    Q, R, Qf = jnp.diag(jnp.array([1.0, 0.2])), 0.1 * jnp.eye(1), 3 * jnp.eye(2)
    known = dlx.riccati.dre(A, B, Q, R, final=Qf, horizon=6)
    cost = dlx.costs.Quadratic(Q, R, final=Qf)
    x0 = jnp.array([1.0, -1.0])
    linear = dlx.LinearDynamics(A, B, dt=0.1)
    options = dict(parallel=parallel, line_search="backtracking")
    plan = ilqr(linear, cost, x0, jnp.zeros((6, 1)), **options)
    assert_close(plan.gains, known.K, rtol=tolerance(1e-3, 1e-12))
    assert_close(plan.cost, x0 @ known.X[0] @ x0, rtol=tolerance(1e-5, 1e-12))
    assert plan.rollouts <= tolerance(4, 2)


@needs_x64
def test_cross_terms_of_the_cost():
    class Crossed(dlx.AbstractCost):
        def __call__(self, t, x, u):
            return x @ x + 0.5 * u @ u + 0.6 * x[0] * u[0]

    A, B = jnp.array([[1.0, 0.1], [0.3, 0.9]]), jnp.array([[0.0], [0.1]])
    S = jnp.array([[0.3], [0.0]])
    known = dlx.riccati.dre(A, B, jnp.eye(2), 0.5 * jnp.eye(1), S, horizon=15)
    linear, x0 = dlx.LinearDynamics(A, B, dt=0.1), jnp.array([1.0, -1.0])
    plan = ilqr(linear, Crossed(), x0, jnp.zeros((15, 1)))
    assert_close(plan.gains, known.K, rtol=1e-9, atol=1e-6)


@needs_x64
def test_known_disturbances_and_time(best):
    dynamics, cost = pendulum()
    w = 0.1 * jnp.ones((20, 2))
    plan = swing(w=w, t0=3.0)
    followed = dlx.open_loop(dynamics, plan.states[0], plan.controls, w)
    assert_close(plan.states, followed, atol=1e-12)
    u, _ = plan(3.1, plan.states[1], None)
    assert_close(u, plan.controls[1], rtol=1e-6)
    # It is better than the plan that does not know of it.
    unaware = dlx.open_loop(dynamics, plan.states[0], best.controls, w)
    end = jax.vmap(cost)(jnp.zeros(20), unaware[:-1], best.controls).sum()
    assert plan.cost < end + cost.final(0.0, unaware[-1])


@once
def test_bounds_hold_and_their_gains_are_zero(best):
    free, plan = best, swing(bounds=(-4.0, [5.0]))
    assert jnp.min(free.controls) < -4.0
    assert jnp.all((plan.controls >= -4.0) & (plan.controls <= 5.0))
    held = (plan.controls <= -4.0)[:, 0]
    assert 0 < jnp.sum(held) < 20
    assert jnp.all(plan.gains[held] == 0)
    assert jnp.all(plan.gains[~held, 0, 0] != 0)
    u, _ = plan(0.0, plan.states[0] + 100.0, None)
    assert -4.0 <= u[0] <= 5.0
    assert plan.cost > free.cost


@needs_x64
def test_bounds_against_scipy():
    """`test_constraints.py` has two controls."""
    optimize = pytest.importorskip("scipy.optimize")
    dynamics, cost = pendulum()
    x0, U, bounds = jnp.array([1.3, 0.0]), jnp.zeros((20, 1)), (-4.0, 4.0)
    plan = ilqr(dynamics, cost, x0, U, bounds=bounds)

    @jax.jit
    @jax.value_and_grad
    def objective(u):
        u = u.reshape(U.shape)
        x = dlx.open_loop(dynamics, x0, u)
        return jax.vmap(cost)(jnp.zeros(len(u)), x[:-1], u).sum() + cost.final(0, x[-1])

    options = dict(ftol=1e-15, gtol=1e-9, maxiter=5000, maxfun=20000, maxcor=50)
    found = optimize.minimize(
        lambda u: [np.asarray(v) for v in objective(u)],
        np.zeros(U.size),
        jac=True,
        bounds=[bounds] * U.size,
        method="L-BFGS-B",
        options=options,
    )
    assert_close(plan.cost, found.fun, rtol=1e-8)
    assert_close(plan.controls.ravel(), found.x, atol=1e-4)
    assert plan.residual < 1e-6


@needs_x64
def test_a_bound_that_is_far_is_not_taken_for_met():
    """The second derivatives about hovering make the problem concave, and its slopes
    grow without limit back in time."""
    env, hover = quadrotor()
    weights = jnp.array([0.2, 0.2, 0.1, 0.1, 0.1, 0.1]), 0.1 * jnp.ones(2)
    ends = jnp.array([50.0, 50.0, 5.0, 5.0, 5.0, 5.0])
    cost = dlx.costs.Quadratic(*weights, final=ends, control_target=hover[0])
    x0 = jnp.array([-2.5, 0.3, 0.0, 0.0, 0.0, 0.0])
    options = dict(bounds=(0.0, 1.0), second_order=True, throw=False)
    plan = ilqr(env.dynamics, cost, x0, hover[:80], **options)
    assert plan.iterations > 5 and plan.residual < 1e-6
    assert plan.cost < 0.1 * plan.trace[0]


@needs_x64
def test_a_quadratic_program_between_bounds():
    """Of a few controls: the Karush-Kuhn-Tucker conditions."""
    from delucax.planning._lq import solve_box_qp

    @jax.jit
    @jax.vmap
    def check(root, g, low):
        H, high = root @ root.T + 0.01 * jnp.eye(4), low + 1.0
        u, free = solve_box_qp(H, g, low, high)
        slope = g + H @ u
        step = jnp.clip(u - slope, low, high) - u
        return jnp.max(jnp.abs(step)), jnp.max(jnp.abs(jnp.where(free, slope, 0)))

    rng = np.random.default_rng(0)
    root, g = rng.normal(size=(200, 4, 4)), 3 * rng.normal(size=(200, 4))
    off, slope = check(root, g, -rng.uniform(size=(200, 4)))
    assert jnp.max(off) < 1e-10 and jnp.max(slope) < 1e-10


@once
def test_a_concave_control_cost_is_regularised_and_it_shows():
    class Concave(dlx.AbstractCost):
        def __call__(self, t, x, u):
            # Its least values are at u = +-1, and its curvature at 0 is negative.
            return jnp.sum((u**2 - 1) ** 2) + 0.01 * x @ x

    dynamics, _ = pendulum()
    u = 0.1 * jnp.ones((10, 1))
    plan = ilqr(dynamics, Concave(), jnp.zeros(2), u)
    assert jnp.all(jnp.abs(jnp.abs(plan.controls) - 1) < 0.1)
    assert jnp.all(jnp.diff(plan.trace) <= 1e-5) and plan.trace[0] > 9
    early = ilqr(dynamics, Concave(), jnp.zeros(2), u, max_iterations=2, throw=False)
    assert early.regularisation > 0
    assert early.result == dlx.RESULTS.not_converged


def stiff():
    """A system that runs away from all but small controls."""
    field = lambda t, x, u, w: jnp.stack([x[0] ** 3 + u[0]])
    system = dlx.system(field, states=("x",), controls=("u",))
    return dlx.Discretized(system, dt=0.5)


@once
def test_candidates_that_diverge_are_rejected():
    cost = dlx.costs.Quadratic([1.0], [1e-4], final=[10.0], state_target=[1.0])
    plan = ilqr(stiff(), cost, jnp.zeros(1), jnp.zeros((12, 1)), throw=False)
    assert all(jnp.all(jnp.isfinite(a)) for a in jax.tree.leaves(plan) if a.ndim)
    assert plan.cost < plan.trace[0]
    assert plan.rollouts > plan.iterations


@once
def test_a_start_that_diverges():
    cost = dlx.costs.Quadratic([1.0], [1.0])
    start = stiff(), cost, jnp.array([0.7]), jnp.zeros((12, 1))
    plan = ilqr(*start, throw=False)
    assert plan.result == dlx.RESULTS.diverged and jnp.isinf(plan.cost)
    assert_close(plan.controls, start[3])
    with pytest.raises(RuntimeError, match="NaN or infinite"):
        ilqr(*start)
    # From states that do not diverge, it finds a way.
    plan = ilqr(*start, states=jnp.zeros((13, 1)))
    assert plan.cost < 1e4


@once
def test_no_descent():
    class Kinked(dlx.AbstractCost):
        def __call__(self, t, x, u):
            return jnp.sum(jnp.abs(u - 0.3)) + 1e-3 * jnp.sum(u**2)

    dynamics, _ = pendulum()
    plan = ilqr(dynamics, Kinked(), jnp.zeros(2), jnp.zeros((4, 1)), throw=False)
    assert plan.result in (dlx.RESULTS.no_descent, dlx.RESULTS.not_converged)
    assert plan.cost < plan.trace[0] and jnp.all(jnp.isfinite(plan.gains))
    with pytest.raises(RuntimeError, match="throw=False"):
        ilqr(dynamics, Kinked(), jnp.zeros(2), jnp.zeros((4, 1)))


@needs_x64
@pytest.mark.parametrize("line_search", ["backtracking", "parallel"])
def test_a_bad_member_of_a_batch_harms_no_other(line_search):
    cost = dlx.costs.Quadratic([1.0], [0.1], final=[1.0])
    u = jnp.zeros((8, 1))

    @jax.jit
    @jax.vmap
    def costs(x0):
        options = dict(throw=False, line_search=line_search)
        plan = ilqr(stiff(), cost, x0, u, **options)
        return plan.cost, plan.result == dlx.RESULTS.successful

    found, ok = costs(np.array([[0.3], [4.0], [np.nan], [0.2]]))
    assert ok.tolist() == [True, False, False, True]
    beside, ok = costs(np.array([[0.3], [0.1], [-0.2], [0.2]]))
    assert np.all(ok)
    assert_close(found[::3], beside[::3], rtol=1e-13)


@once
@pytest.mark.parametrize(
    "arguments, match",
    [
        (dict(x0=[jnp.nan, 0.0]), "x0 must be finite"),
        (dict(x0=[0.0]), r"x0 must have shape \(2,\)"),
        (dict(controls=jnp.zeros((0, 1))), "controls must have at least one step"),
        (dict(controls=jnp.zeros(5)), "controls must have shape"),
        (dict(controls=jnp.full((5, 1), jnp.inf)), "controls must be finite"),
        (dict(bounds=(1.0, -1.0)), "bounds must have low <= high"),
        (dict(bounds=3.0), "bounds must be a pair"),
        (dict(bounds=([0.0, 0.0], 1.0)), "bounds must be numbers or have shape"),
        (dict(w=jnp.zeros((4, 2))), "w must have shape"),
        (dict(states=jnp.zeros((5, 2))), "states must have shape"),
        (dict(states=jnp.full((6, 2), jnp.nan)), "states must be finite"),
        (dict(t0=jnp.zeros(2)), "t0 must be a number"),
        (dict(cost=lambda t, x, u: 0.0), "cost must be an AbstractCost"),
        (dict(dynamics=dlx.make("pendulum")), "dynamics must be an AbstractDynamics"),
        (dict(line_search="exact"), "line_search must be .parallel. or .backtracking."),
        (dict(regularise="both"), "regularise must be"),
        (dict(parallel=True, bounds=(-1.0, 1.0)), "parallel"),
        (dict(parallel=True, regularise="state"), "parallel"),
        (
            dict(finite_difference=0.1, second_order=True),
            "finite_difference is incompatible",
        ),
        (dict(fallback=3), "fallback must be a Plan, or"),
        (
            dict(fallback=dlx.planning.Start(np.zeros((3, 1)))),
            "fallback must be a Plan",
        ),
        (dict(max_iterations=0), "max_iterations"),
        (dict(tolerance=-1.0), "tolerance must be at least 0"),
        (dict(constraint_tolerance=-1.0), "constraint_tolerance"),
        (dict(difference=3.0), "difference must be a function"),
        (dict(constraints=lambda t, x, u: x), "constraints must be"),
    ],
)
def test_bad_arguments_are_named(arguments, match):
    dynamics, cost = pendulum()
    given = dict(
        dynamics=dynamics, cost=cost, x0=[1.0, 0.0], controls=jnp.zeros((5, 1))
    )
    with user_error(match=match):
        ilqr(**(given | arguments))


@once
def test_it_compiles_once():
    dynamics, cost = pendulum()

    @eqx.filter_jit
    @eqx.debug.assert_max_traces(max_traces=1)
    def plan(mass, x0):
        heavier = dlx.replace(dynamics, {"system.mass": mass})
        options = dict(line_search="backtracking", throw=False, max_iterations=3)
        return ilqr(heavier, cost, x0, jnp.zeros((5, 1)), **options)

    first = plan(jnp.asarray(1.0), jnp.array([1.0, 0.0]))
    second = plan(jnp.asarray(2.0), jnp.array([0.5, 0.0]))
    assert second.cost != first.cost
    assert first.states.dtype == jnp.zeros(()).dtype


@needs_x64
def test_a_batch_over_what_a_cost_closes_over():
    dynamics = dlx.Discretized(dlx.systems.Pendulum(), 0.05, diffrax.Euler())
    x0, start = jnp.array([0.2, 0.1]), jnp.zeros((5, 1))

    def total(weight):
        class Weighted(dlx.AbstractCost):
            def __call__(self, t, x, u):
                return weight * x[0] ** 2 + 0.1 * x[1] ** 2 + 0.1 * u[0] ** 2

        return dlx.planning.ilqr(dynamics, Weighted(), x0, start, throw=False).cost

    weights = jnp.array([1.0, 2.0])
    alone = [jax.jit(total)(weight) for weight in weights]
    assert_close(jax.vmap(total)(weights), alone, rtol=1e-12)


def test_a_cost_that_looks_up_a_table():
    # JAX lowers `jnp.interp` late, and a plan is lowered as a whole.
    table = jnp.linspace(0.0, 1.0, 5)
    dynamics, _ = pendulum()

    def cost(t, x, u):
        return (x[0] - jnp.interp(t, table, table**2)) ** 2 + 0.1 * u[0] ** 2

    def planned(x0):
        cost_of = dlx.costs.Function(cost)
        return ilqr(dynamics, cost_of, x0, jnp.zeros((10, 1))).cost

    starts = jnp.array([[1.0, 0.0], [0.5, 0.0]])
    each = jnp.stack([planned(x0) for x0 in starts])
    assert_close(jax.jit(jax.vmap(planned))(starts), each)
