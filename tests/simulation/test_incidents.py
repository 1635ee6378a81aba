"""What went wrong in a controller reaches the user; how an episode ended; cuts."""

import re

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import pytest
from helpers import assert_close, assert_gradient, needs_x64, once, user_error

import delucax as dlx


UPRIGHT = jnp.array([0.1, 0.0])


class Cautious(dlx.AbstractController):
    """Counts the steps at which the plant is fast, behind a structure of its own."""

    name: str = eqx.field(static=True, default="fast")

    def init(self, *, key=None):
        return {"tally": dlx.controllers.Tally(self.name), "steps": jnp.zeros((), int)}

    def __call__(self, t, y, state):
        tally = state["tally"].add(jnp.abs(y[1]) > 1)
        return 5 * jnp.cos(y[:1]), {"tally": tally, "steps": state["steps"] + 1}


@once
def test_incidents_are_counted_and_timed(key):
    env = dlx.make("pendulum", horizon=40)
    run = dlx.rollout(env, Cautious(), key=key, x0=UPRIGHT)
    fast = np.abs(np.asarray(run.observations[:, 1])) > 1
    clipped = np.abs(5 * np.cos(np.asarray(run.observations[:, 0]))) > 2
    assert 0 < fast.sum() < 40 and 0 < clipped.sum() < 40
    np.testing.assert_array_equal(run.incidents["fast"], fast)
    np.testing.assert_array_equal(run.incidents["clipped_control"], clipped)
    assert run.incident_counts["fast"] == fast.sum()
    assert_close(run.incident_times["fast"], run.times[np.argmax(fast)])
    assert run.controller_state["steps"] == 40
    assert run.controller_state["tally"].count == fast.sum()
    assert run.result == dlx.RESULTS.successful and not run.failed
    row = run.summary().iloc[0]
    assert row["fast_count"] == fast.sum()
    assert row["fast_time"] == run.times[fast.argmax()]
    part = run[10:20]
    assert part.incident_counts["fast"] == fast[10:20].sum()
    assert part.controller_state is None
    keys = jax.random.split(key, 3)
    batch = jax.vmap(lambda k: dlx.rollout(env, Cautious(), key=k))(keys)
    assert batch.incident_counts["fast"].shape == (3,)
    assert batch[1].incidents["fast"].shape == (40,)
    assert len(batch.summary()) == 3


@once
def test_an_incident_that_never_happened_has_no_time(key):
    env = dlx.make("pendulum", horizon=5)
    run = dlx.rollout(env, dlx.controllers.Zero(1), key=key, x0=UPRIGHT)
    assert run.incident_counts == {"clipped_control": 0}
    assert np.isnan(run.incident_times["clipped_control"])
    assert "clipped_control_count" not in run.summary()


@once
def test_incidents_need_not_be_kept(key):
    env = dlx.make("pendulum", horizon=5)
    run = dlx.rollout(env, Cautious("failed_plan"), key=key, keep=(), x0=UPRIGHT + 2)
    assert run.incidents is run.controller_state is None
    assert run.result == dlx.RESULTS.plan_failed
    assert "`keep` holds" in dlx.RESULTS[run.result]
    with user_error(match="keep must hold 'incidents'"):
        _ = run.incident_counts


@once
@pytest.mark.parametrize(
    "status", ["plan_failed", "estimate_failed", "filter_failed", "update_refused"]
)
def test_a_message_is_right_for_one_incident_and_for_many(status):
    message = dlx.RESULTS[getattr(dlx.RESULTS, status)]
    assert re.search("[Aa]t least on(e|ce)", message) and " number of " in message


@once
def test_a_failed_plan_is_a_status_and_no_error(key):
    env = dlx.make("pendulum", horizon=40)
    run = dlx.rollout(env, Cautious("failed_plan"), key=key, x0=UPRIGHT)
    assert run.result == dlx.RESULTS.plan_failed and not run.failed
    assert run.statistics()["successful"] == 1
    assert "plan" in run.summary()["result"][0]
    for k, failed in enumerate(run.incidents["failed_plan"]):
        kind = dlx.RESULTS.plan_failed if failed else dlx.RESULTS.successful
        assert run[k : k + 1].result == kind


@once
def test_a_name_of_the_rollout_is_taken():
    with user_error(match="clipped_control"):
        dlx.controllers.Tally("clipped_control")


@once
def test_a_tally_shows_its_count():
    tally, shown = dlx.controllers.Tally("failed_plan"), []
    assert repr(tally.add(jnp.array(True))) == "Tally('failed_plan', count=1)"
    add = jax.vmap(lambda happened: tally.add(happened))
    assert repr(add(jnp.array([True, False]))) == "Tally('failed_plan', count=[1 0])"
    jax.jit(lambda tally: shown.append(repr(tally)))(tally)
    assert "int32[]" in shown[0]


@once
def test_mpc_tells_of_its_plans(key):
    env = dlx.make("pendulum", dt=0.05, horizon=6)
    cost = dlx.costs.Quadratic([1.0, 0.1], [0.1])
    hasty = dlx.controllers.MPC(env.dynamics, cost, 10, planner=dlx.planning.ILQR(1))
    run = dlx.rollout(env, hasty, key=key, x0=jnp.array([np.pi, 0.0]))
    count = run.incident_counts["failed_plan"]
    assert count > 0 and count == run.controller_state.failures.count
    assert run.result == dlx.RESULTS.plan_failed


@once
def test_what_is_inside_another_controller_is_counted(key):
    env = dlx.make("pendulum", horizon=5, solver=diffrax.Euler())
    learner = dlx.controllers.gpc(
        env.dynamics, env.cost, base=dlx.controllers.Linear([[20.0, 5.0]])
    )
    adaptive = dlx.controllers.Adaptive(learner, slots=2, every=2)
    run = dlx.rollout(env, adaptive, key=key, x0=UPRIGHT)
    assert run.incident_counts["refused_update"] == 0


@once
def test_a_learner_refuses_what_is_not_finite(key):
    A, B = jnp.array([[1.0, 0.1], [0.0, 0.9]]), jnp.array([[0.0], [0.1]])
    plant = dlx.LinearDynamics(A, B)
    fine = dlx.costs.Quadratic(jnp.eye(2), jnp.eye(1))
    base = dlx.controllers.LQR(plant, jnp.eye(2), jnp.eye(1))

    def cost(t, y, u):
        return jnp.where(t == 5, jnp.nan, 1.0) * fine(t, y, u)

    learner = dlx.controllers.gpc(plant, cost, base=base, optimiser=optax.sgd(1.0))
    env = dlx.Environment(plant, fine, dlx.disturbances.Gaussian(0.1, size=2))
    with pytest.raises(RuntimeError, match="update of a learner"):
        dlx.rollout(env, learner, key=key, horizon=12)
    run = dlx.rollout(env, learner, key=key, horizon=12, throw=False)
    assert run.result == dlx.RESULTS.update_refused and run.failed
    assert run.incident_counts["refused_update"] == 1
    assert run.incident_times["refused_update"] == 5
    assert np.all(np.isfinite(run.states))
    assert np.any(np.asarray(run.controller_state.theta) != 0)


class After(eqx.Module):
    end: jax.Array

    def __call__(self, t, x):
        return t > self.end


@once
@pytest.mark.parametrize("end", [3, 8, 9])
def test_an_episode_that_ends_in_its_last_step_has_ended(key, end):
    env = dlx.make("pendulum", horizon=8, solver=diffrax.Euler())
    env = dlx.replace(env, {"terminated": After(jnp.asarray((end - 0.5) * env.dt))})
    run = dlx.rollout(env, dlx.controllers.Zero(1), key=key, x0=UPRIGHT)
    assert bool(run.ended) == (end <= 8)
    assert bool(run.summary()["terminated"][0]) == (end <= 8)
    lean = dlx.rollout(env, dlx.controllers.Zero(1), key=key, x0=UPRIGHT, keep=())
    assert lean.statistics()["terminated"] == (end <= 8)
    for start in (0, 2, 7):
        for stop in {start + 1, 3, 8} - set(range(start + 1)):
            assert bool(run[start:stop].ended) == (end <= stop)
            if end <= 8:
                assert bool(run[start:stop].terminated[-1]) == (end <= stop)


@needs_x64
def test_a_cut_keeps_the_derivative_of_the_start(key):
    env = dlx.make("pendulum", horizon=6)
    feedback = dlx.controllers.Linear([[20.0, 5.0]])

    def cost(x0, truncate, horizon=6):
        options = dict(key=key, truncate=truncate, horizon=horizon)
        return dlx.rollout(env, feedback, x0=x0, **options).total_cost

    slope = jax.jit(jax.grad(cost), static_argnums=(1, 2))
    whole = slope(UPRIGHT, None)
    assert np.all(np.asarray(whole) != 0)
    for truncate in (6, 100):
        assert_close(slope(UPRIGHT, truncate), whole, rtol=1e-12)
    # With a cut before step 2 the start is charged for steps 0 and 1.
    first = slope(UPRIGHT, None, 2)
    last = dlx.rollout(env, feedback, key=key, x0=UPRIGHT, horizon=2).final_state
    assert env.cost.final(0.1, last) == 0
    assert_close(slope(UPRIGHT, 2), first, rtol=1e-12)


class Implicit(dlx.AbstractSystem):
    """An acceleration that solves `a + m a^3 + k x = u`."""

    state_names, control_names = ("x", "v"), ("u",)
    m: jax.Array = dlx.parameter(0.7)
    stacked: bool = eqx.field(static=True, default=False)

    def vector_field(self, t, x, u, w):
        def gap(a, given):
            m, x, u = given
            return a + m * a**3 + x - u

        solver = optx.Newton(rtol=1e-10, atol=1e-10)
        given = (self.m, x[:1], u) if self.stacked else (self.m, x[0], u[0])
        start = jnp.zeros_like(given[1])
        a = optx.root_find(gap, solver, start, args=given).value
        return jnp.concatenate([x[1:], a]) if self.stacked else jnp.stack([x[1], a])


@needs_x64
@pytest.mark.parametrize(
    "stacked, checkpoint, solver",
    [
        (True, "step", diffrax.Euler()),
        (False, "sqrt", diffrax.Heun()),
        (False, None, diffrax.ImplicitEuler()),
    ],
)
def test_derivatives_through_a_field_that_solves(key, stacked, checkpoint, solver):
    system = Implicit(stacked=stacked)
    plant = dlx.Discretized(system, dt=0.1, solver=solver)
    env = dlx.Environment(plant, dlx.costs.Quadratic(jnp.eye(2), jnp.eye(1)))
    feedback = dlx.controllers.Linear([[1.0, 0.5]])

    def cost(z):
        there = dlx.replace(env, {"dynamics.system.m": z[0]})
        options = dict(key=key, horizon=8, checkpoint=checkpoint)
        return dlx.rollout(there, feedback, x0=z[1:], **options).total_cost

    z = jnp.array([0.7, 0.8, -0.3])
    assert_gradient(cost, z, step=1e-5, rtol=1e-6, atol=1e-6)


@once
def test_one_solve_counts_too(key):
    pendulum = dlx.systems.Pendulum()
    options = dict(dt=0.05, key=key, solver=diffrax.Euler())
    run = dlx.simulate(pendulum, Cautious("failed_plan"), 0.0, 1.0, UPRIGHT, **options)
    fast = np.abs(np.asarray(run.observations[:, 1])) > 1
    assert 0 < fast.sum() < 20
    np.testing.assert_array_equal(run.incidents["failed_plan"], fast)
    assert run.result == dlx.RESULTS.plan_failed and not run.failed
    ts = jnp.array([0.0, 0.5, 0.95])
    some = dlx.simulate(
        pendulum, Cautious("failed_plan"), 0.0, 1.0, UPRIGHT, ts=ts, **options
    )
    assert some.result == dlx.RESULTS.plan_failed and not some.failed
    # The first call of the controller is after the first save.
    given = Cautious("failed_plan"), 0.0, 1.0, jnp.array([0.1, 3.0])
    hurried = dlx.simulate(pendulum, *given, ts=ts, **options)
    assert hurried.incidents["failed_plan"][0]
    assert_close(hurried.incident_times["failed_plan"], 0.0)

    @jax.jit
    @jax.grad
    def slope(x0):
        given = pendulum, Cautious("failed_plan"), 0.0, 1.0, x0
        return dlx.simulate(*given, **options).final_state[0]

    assert np.all(np.isfinite(slope(UPRIGHT)))


@once
def test_a_random_key_in_the_state_is_kept_and_saved(key, tmp_path):
    env = dlx.make("pendulum", horizon=3)
    policy = dlx.controllers.Gaussian(dlx.controllers.Zero(1), [0.5])
    cost = lambda k: dlx.rollout(env, policy, key=k).total_cost
    assert np.all(np.isfinite(jax.vmap(cost)(jax.random.split(key, 2))))
    run = dlx.rollout(env, policy, key=key)
    dlx.save(tmp_path / "run.dlx", run)
    again = dlx.load(tmp_path / "run.dlx")
    data = [jax.random.key_data(r.controller_state.key) for r in (run, again)]
    np.testing.assert_array_equal(*data)


@once
def test_a_slice_has_the_result_of_its_own_incidents():
    class Unlucky(dlx.AbstractController):
        def init(self, *, key=None):
            return dlx.controllers.Tally("failed_plan"), dlx.controllers.Tally(
                "failed_estimate"
            )

        def __call__(self, t, y, state):
            plan, estimate = state
            state = plan.add(t < 0.01), estimate.add(t > 0.2)
            return jnp.zeros(1, y.dtype), state

    env = dlx.make("pendulum")
    options = dict(key=jax.random.key(0), x0=[0.1, 0.0], horizon=10)
    run = dlx.rollout(env, Unlucky(), **options)
    assert run.result == dlx.RESULTS.plan_failed
    assert run[3:].result == dlx.RESULTS.estimate_failed
    assert run[1:3].result == dlx.RESULTS.successful
