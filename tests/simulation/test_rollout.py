from pathlib import Path

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    assert_close,
    assert_gradient,
    CountCalls,
    needs_x64,
    once,
    tolerance,
    user_error,
)

import delucax as dlx


FEEDBACK = dlx.controllers.Linear(jnp.array([[20.0, 5.0]]))
UPRIGHT = jnp.array([0.1, 0.0])


class Counter(dlx.AbstractController):
    """Counts its steps, and remembers what it was told."""

    def init(self, *, key=None):
        return jnp.zeros((), int), jnp.zeros(1), jnp.zeros(())

    def __call__(self, t, y, state):
        count, u, cost = state
        return jnp.full(1, 10.0, y.dtype), (count + 1, u, cost)

    def applied(self, u, cost, state):
        count, _, _ = state
        return count, u, cost


class ShowsApplied(dlx.AbstractController):
    """Acts with what was applied one step before."""

    def init(self, *, key=None):
        return jnp.zeros(1)

    def __call__(self, t, y, state):
        return state - 1.5, state

    def applied(self, u, cost, state):
        return u


def lds(**kwargs):
    A = jnp.array([[1.0, 1.0], [0.0, 1.0]])
    B = jnp.array([[0.0], [1.0]])
    return dlx.make("lds", A=A, B=B, **kwargs)


def test_matches_a_loop_by_hand(key):
    env = dlx.make("pendulum", disturbance=dlx.disturbances.Gaussian(0.05, size=2))
    run = dlx.rollout(env, FEEDBACK, key=key, horizon=6, x0=UPRIGHT)
    x, total = UPRIGHT, 0.0
    for k in range(6):
        u, _ = FEEDBACK(k * 0.05, x, None)
        step = env.step(k * 0.05, x, u, run.disturbances[k])
        assert_close(run.controls[k], step.control, atol=tolerance(1e-5, 1e-12))
        x, total = step.state, total + step.cost
        assert_close(run.states[k + 1], x, atol=tolerance(1e-5, 1e-12))
    assert_close(run.total_cost, total, rtol=tolerance(1e-5, 1e-12))
    assert_close(run.final_state, run.states[-1])


@once
def test_shapes_and_times(key):
    run = dlx.rollout(dlx.make("pendulum"), FEEDBACK, key=key, horizon=7)
    assert run.states.shape == (8, 2) and run.controls.shape == (7, 1)
    assert run.observations.shape == (7, 2) and run.disturbances.shape == (7, 2)
    assert run.costs.shape == (7,) and run.terminated.shape == (7,)
    assert_close(run.times, 0.05 * np.arange(8), rtol=1e-6)
    assert run.length == 7 and run.result == dlx.RESULTS.successful


def test_time_is_not_summed(key):
    class Clock(dlx.AbstractController):
        def __call__(self, t, y, state):
            return t[None], state

    env = dlx.make("lds", A=0.5 * jnp.eye(1), B=0 * jnp.eye(1))
    env = dlx.replace(env, {"dynamics.dt": 0.1})
    run = dlx.rollout(env, Clock(), key=key, horizon=10_000)
    assert_close(run.controls[-1, 0], 999.9, rtol=1e-7)


@once
def test_applied_sees_the_saturated_control(key):
    env = lds(control_bounds=(-1.0, 1.0))
    run = dlx.rollout(env, ShowsApplied(), key=key, horizon=4, x0=jnp.zeros(2))
    assert_close(run.controls[:, 0], [-1.0, -1.0, -1.0, -1.0])


def test_a_batch_is_vmap(key):
    env = dlx.make("pendulum", disturbance=dlx.disturbances.Gaussian(0.05, size=2))
    keys = jax.random.split(key, 3)
    run = lambda k: dlx.rollout(env, FEEDBACK, key=k, horizon=20)
    batch = jax.jit(jax.vmap(run))(keys)
    assert batch.states.shape == (3, 21, 2) and batch.batch_shape == (3,)
    for i in range(2):
        one = run(keys[i])
        states, times = np.asarray(batch.states)[i], np.asarray(batch.times)[i]
        assert_close(states, one.states, atol=tolerance(2e-5, 1e-12))
        assert_close(times, one.times)


@needs_x64
@pytest.mark.parametrize("horizon", [1, 23])
def test_checkpoints_change_no_number(key, horizon):
    env = dlx.make("pendulum", disturbance=dlx.disturbances.Gaussian(0.05, size=2))

    def cost(K, checkpoint):
        run = dlx.rollout(
            env,
            dlx.controllers.Linear(K),
            key=key,
            x0=UPRIGHT,
            horizon=horizon,
            checkpoint=checkpoint,
        )
        return run.total_cost

    K = jnp.array([[5.0, 1.0]])
    both = jax.jit(jax.value_and_grad(cost), static_argnums=1)
    values = [both(K, c) for c in ("step", "sqrt", None)]
    for value, gradient in values[1:]:
        assert_close(value, values[0][0], rtol=1e-12)
        assert_close(gradient, values[0][1], rtol=1e-10)


@needs_x64
def test_gradient_is_that_of_central_differences(key):
    env = dlx.make("pendulum", max_torque=100.0, max_speed=100.0)

    def cost(leaves):
        plant = dlx.replace(
            env,
            {"dynamics.system.length": leaves[0], "cost.velocity_weight": leaves[1]},
        )
        K = jnp.stack([leaves[2], leaves[3]])[None]
        feedback = dlx.controllers.Linear(K)
        x0 = jnp.stack([leaves[4], leaves[5]])
        return dlx.rollout(plant, feedback, key=key, x0=x0, horizon=100).total_cost

    at = jnp.array([1.1, 0.1, 15.0, 3.0, 0.2, -0.1])
    assert_gradient(cost, at, rtol=1e-6)


def test_gradient_decay(key):
    env = dlx.make("lds", A=jnp.eye(1), B=jnp.eye(1), cost=Final())

    def cost(x0, decay):
        zero = dlx.controllers.Zero(1)
        run = dlx.rollout(env, zero, key=key, x0=x0, horizon=5, gradient_decay=decay)
        return run.total_cost

    for decay in (1.0, 0.5):
        assert_close(jax.grad(cost)(jnp.ones(1), decay), [decay**5], rtol=1e-6)
    assert_close(cost(jnp.ones(1), 0.5), 1.0)


class Final(dlx.AbstractCost):
    def __call__(self, t, x, u):
        return jnp.zeros((), x.dtype)

    def final(self, t, x):
        return x[0]


@once
def test_keep(key):
    env = dlx.make("pendulum", solver=diffrax.Euler())
    full = dlx.rollout(env, FEEDBACK, key=key, horizon=9)
    lean = dlx.rollout(env, FEEDBACK, key=key, horizon=9, keep=())
    assert lean.states is lean.controls is lean.costs is lean.observations is None
    assert lean.disturbances is lean.terminated is None
    assert_close(lean.total_cost, full.total_cost, rtol=1e-6)
    assert_close(lean.final_state, full.final_state, rtol=1e-6)
    seen = dlx.rollout(env, FEEDBACK, key=key, horizon=9, keep="observations")
    assert_close(seen.observations, full.states[:-1], rtol=1e-6)
    with user_error(match="keep"):
        dlx.rollout(env, FEEDBACK, key=key, keep=("state",))


@once
def test_one_recorded_step(key):
    one = dlx.disturbances.FromArray(jnp.array([[0.3, -0.2]]))
    env = lds(disturbance=one, sensor_noise=one)
    run = dlx.rollout(env, dlx.controllers.Zero(1), key=key, horizon=1)
    assert_close(run.disturbances, one.values)
    assert_close(run.observations[0], run.states[0] + one.values[0])
    with user_error(match="FromArray: values must have at least 2 steps"):
        dlx.rollout(env, dlx.controllers.Zero(1), key=key, horizon=2)


@once
def test_sensor_noise_reaches_the_controller_alone(key):
    env = lds(sensor_noise=dlx.disturbances.Constant(1.0, size=2))
    K = jnp.array([[0.4, 1.2]])
    run = dlx.rollout(
        env, dlx.controllers.Linear(K), key=key, x0=jnp.ones(2), horizon=3
    )
    assert_close(run.observations, run.states[:-1] + 1)
    assert_close(run.controls[0], -K @ (jnp.ones(2) + 1), rtol=1e-6)


@once
def test_termination_holds_the_state_and_charges_the_end_once(key):
    class Cost(dlx.AbstractCost):
        def __call__(self, t, x, u):
            return jnp.ones((), x.dtype)

        def final(self, t, x):
            return 100 * x[0]

    A, B = jnp.array([[1.0]]), jnp.array([[1.0]])
    env = dlx.make(
        "lds", A=A, B=B, cost=Cost(), terminated=lambda t, x: x[0] >= 3, horizon=8
    )
    push = dlx.controllers.Constant(jnp.ones(1))
    run = dlx.rollout(env, push, key=key)
    assert_close(run.states[:, 0], [0, 1, 2, 3, 3, 3, 3, 3, 3])
    assert_close(run.costs, [1, 1, 1, 0, 0, 0, 0, 0])
    assert run.length == 3 and run.final_cost == 300 and run.total_cost == 303
    assert list(np.asarray(run.terminated)) == [False] * 2 + [True] * 6
    # A part has the final cost if the run ends in it.
    parts = [run[0:2], run[2:3], run[3:8], run[0:3], run[1:8]]
    assert [float(part.final_cost) for part in parts] == [0, 300, 0, 300, 300]
    assert run[0:3].total_cost == 303 and run[3:8].total_cost == 0
    gradient = jax.grad(
        lambda u: dlx.rollout(env, dlx.controllers.Constant(u), key=key).total_cost
    )(jnp.ones(1))
    assert_close(gradient, [300.0])


@once
def test_no_second_compilation(key):
    traced = CountCalls()

    class Traced(dlx.AbstractController):
        gain: jax.Array = dlx.weight(1.0)

        def __call__(self, t, y, state):
            traced()
            return -self.gain * y[:1], state

    env = dlx.make("pendulum")
    dlx.rollout(env, Traced(1.0), key=key)
    first = traced.count
    changed = [
        dlx.replace(env, {"dynamics.system.length": 1.3}),
        dlx.replace(env, {"control_bounds.1": 1.0, "cost.torque_weight": 0.5}),
        dlx.make("pendulum", mass=3, gravity=np.float64(9.81), dt=0.01),
    ]
    for plant in changed:
        dlx.rollout(plant, Traced(2), key=jax.random.key(3))
    dlx.rollout(env, Traced(0.5), key=key, gradient_decay=1)
    assert traced.count == first
    dlx.rollout(env, Traced(1.0), key=key, x0=UPRIGHT)
    with_start = traced.count
    dlx.rollout(env, Traced(1.0), key=key, x0=np.array([0.3, 1]))
    dlx.rollout(env, Traced(1.0), key=key, x0=[0, 1])
    assert traced.count == with_start


@once
def test_divergence_is_an_error_or_a_status(key):
    env = dlx.make("lds", A=1e5 * jnp.eye(1), B=jnp.eye(1))
    zero = dlx.controllers.Zero(1)
    horizon = 50
    arguments = dict(key=key, x0=jnp.ones(1), horizon=horizon)
    with pytest.raises(RuntimeError, match=r"NaN or infinite.*step \d+ \(t = "):
        dlx.rollout(env, zero, **arguments)
    cost = lambda env: dlx.rollout(env, zero, **arguments).total_cost
    with pytest.raises(RuntimeError, match=r"NaN or infinite.*step \d+ \(t = "):
        eqx.filter_grad(cost)(env)
    run = dlx.rollout(env, zero, throw=False, **arguments)
    assert run.result == dlx.RESULTS.diverged
    assert "NaN" in run.summary()["result"][0]
    with pytest.raises(Exception, match="NaN or infinite"):
        f = eqx.filter_jit(lambda x0: dlx.rollout(env, zero, key=key, x0=x0).total_cost)
        dlx_env_horizon = f(jnp.ones(1))
        jax.block_until_ready(dlx_env_horizon)


def test_a_step_that_overflows_is_found_by_the_rollout(key):
    """The step checks no numbers: it succeeds with a state that is not finite."""
    env, zero = dlx.make("van_der_pol"), dlx.controllers.Zero(1)
    huge = jnp.full(2, float(jnp.finfo(jnp.zeros(()).dtype).max) ** 0.2)
    step = env.step(0.0, huge, jnp.zeros(1))
    assert step.result == dlx.RESULTS.successful
    assert not np.all(np.isfinite(step.state))
    run = dlx.rollout(env, zero, key=key, x0=huge, horizon=1, throw=False)
    assert run.result == dlx.RESULTS.diverged


@once
def test_one_bad_lane_harms_no_other(key):
    env = dlx.make("lds", A=1e5 * jnp.eye(1), B=jnp.eye(1))
    zero = dlx.controllers.Zero(1)
    x0 = jnp.array([[0.0], [1.0]])
    run = jax.vmap(
        lambda x: dlx.rollout(env, zero, key=key, x0=x, horizon=200, throw=False)
    )(x0)
    assert list(np.asarray(run.result == dlx.RESULTS.successful)) == [True, False]
    assert run.total_cost[0] == 0


@once
@pytest.mark.parametrize(
    "arguments, match",
    [
        ({"key": 0}, r"jax\.random\.key\(0\)"),
        ({"horizon": 0}, "horizon must be a whole number of at least 1"),
        ({"x0": jnp.zeros(3)}, r"x0 must have shape \(2,\), got shape \(3,\)"),
        ({"x0": jnp.array([jnp.nan, 0.0])}, "x0 must be finite"),
        (
            {"w": jnp.zeros((3, 2))},
            r"w must have shape \(200, 2\), .*\(3, 2\)",
        ),
        ({"checkpoint": "all"}, "checkpoint"),
    ],
)
def test_bad_arguments(key, arguments, match):
    with user_error(match=match):
        dlx.rollout(dlx.make("pendulum"), FEEDBACK, **({"key": key} | arguments))


@once
def test_wrong_kinds(key):
    env = dlx.make("pendulum")
    with user_error(match="environment must be an Environment"):
        dlx.rollout(env.dynamics, FEEDBACK, key=key)
    with user_error(match="controller must be an AbstractController"):
        dlx.rollout(env, lambda y: y, key=key)
    with pytest.raises(ValueError, match="size 3, got size 2.*features=env.encode"):
        dlx.rollout(env, dlx.controllers.Linear(jnp.ones((1, 3))), key=key)
    with pytest.raises(ValueError, match=r"must have shape \(1,\).*got shape \(2,\)"):
        dlx.rollout(env, dlx.controllers.Zero(2), key=key)


@once
def test_slicing_in_time(key):
    run = dlx.rollout(dlx.make("pendulum"), FEEDBACK, key=key, horizon=10)
    part = run[2:5]
    assert part.states.shape == (4, 2) and part.controls.shape == (3, 1)
    assert_close(part.states, run.states[2:6])
    assert_close(part.times, run.times[2:6])
    assert_close(part.total_cost, run.costs[2:5].sum(), rtol=1e-6)
    assert part.observations.shape == part.disturbances.shape == (3, 2)
    with pytest.raises(ValueError, match="slice"):
        run[3]


@once
def test_tables(key):
    env = dlx.make("pendulum")
    run = dlx.rollout(env, FEEDBACK, key=key, horizon=4)
    table = run.to_pandas()
    assert list(table.columns) == [
        *("time", "angle", "velocity", "torque", "w0", "w1", "cost")
    ]
    assert len(table) == 5 and np.isnan(table["torque"].iloc[-1])
    assert_close(table["cost"][:-1].sum(), run.total_cost, rtol=1e-6)
    keys = jax.random.split(key, 3)
    batch = jax.vmap(lambda k: dlx.rollout(env, FEEDBACK, key=k, horizon=4))(keys)
    assert list(batch.to_pandas()["batch"]) == [0] * 5 + [1] * 5 + [2] * 5
    assert_close(batch.summary()["total_cost"], batch.total_cost)


@once
def test_integer_actions(key):
    table = jnp.array([[-1.0], [1.0]])
    env = lds(actions=table, control_bounds=(-0.5, 0.5))

    class Chooser(dlx.AbstractController):
        def __call__(self, t, y, state):
            return (y[0] > 0).astype(jnp.int32), state

    run = dlx.rollout(env, Chooser(), key=key, x0=jnp.array([1.0, 0.0]), horizon=1)
    assert run.controls[0, 0] == 0.5

    class Third(dlx.AbstractController):
        def __call__(self, t, y, state):
            return jnp.asarray(2), state

    with user_error(RuntimeError, match="an integer action that the environment does"):
        dlx.rollout(env, Third(), key=key)
    run = dlx.rollout(env, Third(), key=key, throw=False)
    assert run.result == dlx.RESULTS.unknown_action


@once
def test_random_controller_state_is_kept(key):
    env = lds()
    explore = dlx.controllers.Random(jnp.ones(1))
    run = dlx.rollout(env, explore, key=key, horizon=50)
    assert len(np.unique(np.asarray(run.controls))) == 50
    with pytest.raises(ValueError, match="key"):
        explore.init()
    states = dlx.rollout(env, Counter(), key=key, horizon=5).controls
    assert np.all(states == 10)


@needs_x64
def test_what_follows_the_end_does_not_reach_the_gradient(key):
    """The root is not real beyond the end, and has no slope at it."""
    tank = dlx.system(lambda t, x, u, w: -jnp.sqrt(x), states=1, controls=1)
    env = dlx.Environment(
        dlx.Discretized(tank, 0.1, diffrax.Euler()),
        dlx.costs.Quadratic(jnp.eye(1), jnp.eye(1)),
        terminated=lambda t, x: x[0] <= 0,
        horizon=40,
    )
    zero = dlx.controllers.Zero(1)
    cost = lambda x0: dlx.rollout(env, zero, key=key, x0=x0).total_cost
    x0 = jnp.ones(1)
    assert dlx.rollout(env, zero, key=key, x0=x0).length < 40
    assert_gradient(cost, x0, rtol=1e-6)


@once
def test_a_system_without_controls(key):
    decay = dlx.system(lambda t, x, u, w: -x, states=1, controls=0)
    env = dlx.Environment(
        dlx.Discretized(decay, 0.1),
        dlx.costs.Function(lambda t, x, u: x[0] ** 2),
        initial_state=jnp.ones(1),
        horizon=10,
    )
    run = dlx.rollout(env, dlx.controllers.Zero(0), key=key)
    assert run.controls.shape == (10, 0)
    assert_close(run.final_state, [np.exp(-1.0)], rtol=1e-3)


@once
def test_a_changed_step_reaches_the_noise(key):
    """Euler-Maruyama increments follow the step that is taken."""

    class Walk(dlx.AbstractSystem):
        state_names = ("x",)
        control_names = ("u",)

        def vector_field(self, t, x, u, w):
            return jnp.zeros_like(x)

        def diffusion(self, t, x, u):
            return jnp.ones((1, 1))

    env = dlx.Environment(
        dlx.Discretized(Walk(), 1.0),
        dlx.costs.Quadratic(jnp.eye(1), jnp.eye(1)),
        horizon=1,
    )
    short = dlx.replace(env, {"dynamics.dt": 0.01})
    end = lambda e: dlx.rollout(e, dlx.controllers.Zero(1), key=key).final_state
    assert_close(end(short), 0.1 * end(env), rtol=1e-5)


@once
def test_tables_keep_every_column(key):
    names = dict(states=("time", "cost", "x"), controls=("x",))
    plant = dlx.system(lambda t, x, u, w: jnp.concatenate([u, x[:2]]), **names)
    env = dlx.Environment(
        dlx.Discretized(plant, 0.1), dlx.costs.Quadratic(jnp.eye(3), jnp.eye(1))
    )
    run = dlx.rollout(env, dlx.controllers.Constant([1.0]), key=key, horizon=3)
    table = run.to_pandas()
    assert table["time"].to_list() == list(np.asarray(run.times))
    assert {"state time", "state cost", "x", "control x", "cost"} <= set(table)
    assert list(table)[-1] == "cost"


@once
def test_statistics_of_a_batch(key):
    """Of members that go up and away, and end at different times."""
    dynamics = dlx.LinearDynamics(np.eye(1), np.ones((1, 1)), dt=1.0)
    cost = dlx.costs.Function(lambda t, x, u: x[0] + 0 * u[0])
    env = dlx.Environment(dynamics, cost, terminated=lambda t, x: x[0] > 8.5, horizon=3)
    push = dlx.controllers.Constant([1.0])
    go = lambda x0: dlx.rollout(env, push, key=key, x0=x0[None], throw=False)
    starts = jnp.array([0.0, 1.0, 2.0, 6.0, np.inf])
    batch = jax.vmap(go)(starts)
    total = np.asarray(batch.total_cost)[:4]
    for found in (batch.statistics(), jax.jit(lambda run: run.statistics())(batch)):
        for q in (5, 25, 50, 75, 95):
            assert_close(found[f"{q}%"], np.percentile(total, q), rtol=1e-6)
        assert_close(found["mean"], total.mean(), rtol=1e-6)
        assert_close(found["finite"], 0.8, rtol=1e-6)
        assert_close(found["successful"], 0.8, rtol=1e-6)
    # The one from 6 ends in its last step.
    assert_close(batch[:4].statistics()["terminated"], 0.25)
    alone = go(starts[1]).statistics()
    assert alone["5%"] == alone["95%"] == total[1] and alone["finite"] == 1


class Faulty(dlx.AbstractSystem):
    """Fails in a loop, where its state is traced."""

    state_names = ("x",)
    control_names = ("u",)
    fails: bool = eqx.field(static=True, default=False)

    def vector_field(self, t, x, u, w):
        if self.fails:
            raise ZeroDivisionError
        return u - x


@once
def test_few_frames_lie_between_the_scan_and_the_vector_field():
    """Of this library's, in the traceback that a wrong field of a user's gives."""
    cost = dlx.costs.Quadratic(jnp.ones(1), jnp.ones(1))
    env = dlx.Environment(dlx.Discretized(Faulty(), 0.1), cost)
    env = eqx.tree_at(lambda e: e.dynamics.system, env, Faulty(True))
    inside, filtering = Path(dlx.__file__).parent, jax.config.jax_traceback_filtering
    jax.config.update("jax_traceback_filtering", "off")
    try:
        with pytest.raises(ZeroDivisionError) as caught:
            dlx.rollout(env, dlx.controllers.Zero(1), key=jax.random.key(0))
    finally:
        jax.config.update("jax_traceback_filtering", filtering)
    entries = list(caught.traceback)
    scan = max(k for k, entry in enumerate(entries) if entry.name == "scan")
    paths = [Path(str(entry.path)) for entry in entries[scan:]]
    assert 0 < sum(path.is_relative_to(inside) for path in paths) <= 7
