"""A controller at a ventilator: what a machine needs, proved on a simulated one."""

import dataclasses

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, CountCalls, once, user_error

import delucax as dlx
from delucax import lung
from delucax._check import check_key


pytestmark = once

KEY = jax.random.key(0)
SOLVER = diffrax.Euler()
ENV = lung.single_compartment(resistance=50.0, compliance=10.0, solver=SOLVER)
WAVEFORM = ENV.cost.waveform


def breathing(kp):
    pid = dlx.controllers.LeakyPID(kp, 3.0, dt=ENV.dt, reference=WAVEFORM)
    return lung.Breathing(pid, WAVEFORM)


@eqx.filter_jit
def closed_loop(controller):
    return dlx.rollout(ENV, controller, key=KEY, horizon=134)


def test_run_is_that_of_the_closed_loop():
    runner = lung.SimulatedRunner(ENV, key=KEY)
    found = lung.run_breaths(runner, breathing(0.5), 40)
    run = closed_loop(breathing(0.5))
    assert_close(found.pressure, run.observations[:40, 0], rtol=1e-4)
    assert_close(found.u_in, run.controls[:40, 0], atol=1e-3)
    assert not found.aborted and runner.is_clean
    assert_close(found.u_out, run.controls[:40, 1])


def test_aborts_on_overpressure_and_cleans_up():
    runner = lung.SimulatedRunner(ENV, key=KEY, abort=60.0)
    found = lung.run_breaths(runner, breathing(10.0), 40)
    assert found.aborted and runner.is_clean and len(found.times) < 40
    assert np.all(found.pressure[:-1] <= 60) and found.pressure[-1] > 60
    assert (found.u_in[-1], found.u_out[-1]) == (0.0, 1.0)
    # The air has been let out, and both valves are closed.
    assert runner.observe() < 5.5 and runner.controls == (0.0, 0.0)


TRACED = CountCalls()


class Counted(dlx.AbstractController):
    def __call__(self, t, y, state):
        TRACED()
        return jnp.stack([0 * y[0], 1 + 0 * y[0]]), state


class Watched(lung.SimulatedRunner):
    seen = ()

    def observe(self):
        self.seen = (*self.seen, TRACED.count)
        return super().observe()


def test_nothing_compiles_while_a_valve_is_open():
    runner = Watched(ENV, key=KEY)
    lung.run_breaths(runner, Counted(), 3)
    assert runner.seen == (1, 1, 1)


class Clock:
    """A clock that only sleep moves."""

    def __init__(self):
        self.now = 0.0

    def perf_counter(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds


def test_a_late_step_is_not_caught_up_with(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(lung._runner, "time", clock)
    runner = lung.SimulatedRunner(ENV, key=KEY, real_time=True)
    runner.wait()
    assert_close(clock.now, runner.dt)
    clock.sleep(3 * runner.dt)
    runner.wait()
    assert_close(clock.now, 4 * runner.dt)
    runner.wait()
    assert_close(clock.now, 5 * runner.dt)


class Failing(dlx.AbstractController):
    def __call__(self, t, y, state):
        return jnp.full(2, jnp.nan), state


class Broken(lung.SimulatedRunner):
    def actuate(self, u_in, u_out):
        if self.steps == 3:
            self.steps += 1
            raise OSError("the valve does not answer")
        super().actuate(u_in, u_out)


def test_cleans_up_after_an_error():
    runner = lung.SimulatedRunner(ENV, key=KEY)
    with user_error(match="controls must be finite, got .nan, nan. at step 0"):
        lung.run_breaths(runner, Failing(), 5)
    assert runner.is_clean
    runner = Broken(ENV, key=KEY)
    with pytest.raises(OSError, match="does not answer"):
        lung.run_breaths(runner, breathing(0.5), 10)
    assert runner.is_clean


def test_wrong_arguments():
    with user_error(match="runner must have dt, observe"):
        lung.run_breaths(object(), breathing(0.5))
    with user_error(match="controller must be an AbstractController"):
        lung.run_breaths(lung.SimulatedRunner(ENV, key=KEY), print)
    with user_error(match="must be a task of a lung"):
        lung.SimulatedRunner(dlx.make("pendulum"), key=KEY)
    runner = lung.SimulatedRunner(ENV, key=KEY)
    with user_error(match=r"both valves, shape \(2,\), got shape \(1,\)\. lung.Breath"):
        lung.run_breaths(runner, dlx.controllers.Zero(1))
    assert runner.is_clean and runner.steps == 100  # of the clean-up alone


def test_every_breath_begins_alike():
    """The controller is fresh at each breath, and silent between them."""
    run = closed_loop(breathing(0.5))
    first, second = run.controls[:34], run.controls[100:]
    assert_close(first[0], second[0], atol=0.1)
    assert np.all(run.controls[34:100, 0] == 0) and np.all(run.controls[34:100, 1] == 1)
    held = dlx.replace(breathing(0.5), {"expiratory_opening": 5.0})
    run = closed_loop(held)
    times = np.arange(50, 100) * 0.03
    assert_close(
        run.controls[50:100, 0], 5 * (1 - np.exp(5 * (1.5 - times))), atol=1e-3
    )


class Drawn(dlx.AbstractController):
    """A control that is drawn, and then halves."""

    def init(self, *, key=None):
        return jax.random.uniform(check_key(key, "Drawn"))

    def __call__(self, t, y, state):
        return jnp.reshape(state, (1,)), state / 2


def test_every_breath_begins_with_the_state_that_was_drawn():
    u_in = closed_loop(lung.Breathing(Drawn(), WAVEFORM)).controls[:, 0]
    drawn = u_in[0]
    assert drawn > 0
    assert_close(u_in[:5], drawn * 0.5 ** np.arange(5))
    assert_close(u_in[100:105], u_in[:5])


class Counting(dlx.AbstractController):
    """Counts the steps, and what was applied of its controls."""

    def init(self, *, key=None):
        return jnp.zeros(2)

    def __call__(self, t, y, state):
        return jnp.reshape(0.1 * state[0], (1,)), state.at[0].add(1)

    def applied(self, u, cost, state):
        return state.at[1].add(u[0])


def test_another_controller_of_the_expiratory_valve():
    pid = dlx.controllers.LeakyPID(0.5, 3.0, dt=ENV.dt, reference=WAVEFORM)
    whole = lung.Breathing(pid, WAVEFORM, valve=Counting())
    run = dlx.rollout(ENV, whole, key=KEY, horizon=6)
    assert_close(run.controls[:, 1], 0.1 * np.arange(6), rtol=1e-6)
    assert_close(run.controller_state.valve, [6.0, 1.5], rtol=1e-6)
    own = closed_loop(breathing(0.5))
    assert_close(run.controls[0, 0], own.controls[0, 0])
    with user_error(match="valve must be an AbstractController"):
        lung.Breathing(pid, WAVEFORM, valve=1.0)


class Dithering(dlx.AbstractController):
    """Draws at each step, and fails in the first breath."""

    def init(self, *, key=None):
        return check_key(key, "Dithering"), dlx.controllers.Tally("failed_plan")

    def __call__(self, t, y, state):
        key, tally = state
        key, now = jax.random.split(key)
        u = 50 + jax.random.uniform(now, (1,), y.dtype)
        return u, (key, tally.add(jnp.asarray(t < 0.3)))


def test_keys_and_tallies_go_on_from_breath_to_breath():
    run = closed_loop(lung.Breathing(Dithering(), WAVEFORM))
    drawn = np.concatenate([run.controls[:34, 0], run.controls[100:, 0]])
    assert len(np.unique(drawn)) == len(drawn) == 68
    assert run.result == dlx.RESULTS.plan_failed


def test_the_noise_of_a_simulated_sensor_is_that_of_an_episode():
    noise = dlx.disturbances.FromArray(0.1 * jnp.arange(200.0)[:, None])
    runner = lung.SimulatedRunner(dataclasses.replace(ENV, sensor_noise=noise), key=KEY)
    quiet = lung.SimulatedRunner(ENV, key=KEY)
    for k in range(3):
        assert_close(runner.observe() - quiet.observe(), 0.1 * k, atol=1e-4)
        runner.wait()
        quiet.wait()
