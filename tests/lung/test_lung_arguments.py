"""What a peak pressure, a waveform and a stack of lungs may be, wherever they go."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, once, user_error

import delucax as dlx
from delucax import lung
from delucax._module import stack


pytestmark = once

KEY = jax.random.key(0)
ENV = lung.single_compartment()
WAVEFORM = ENV.cost.waveform
PID = dlx.controllers.LeakyPID(0.5, 1.0, dt=ENV.dt, reference=WAVEFORM)
MODEL = lung.LungModel(lung.SingleCompartment())


def trained(**options):
    policy = lung.BreathPolicy(WAVEFORM, 0.03, width=1, depth=1, key=KEY)
    policies = stack([stack([policy])])
    envs = stack([lung.learned_lung(MODEL, noise=0.2)])
    return lung.train_controllers(envs, policies, key=KEY, steps=1, **options)


WITH_PIPS = {
    "explore": lambda pips: lung.explore(ENV, 1, key=KEY, pips=pips),
    "breath_error": lambda pips: lung.breath_error(ENV, PID, key=KEY, pips=pips),
    "pid_grid": lambda pips: lung.pid_grid(ENV, key=KEY, pips=pips),
    "least_error": lambda pips: lung.least_error(ENV, pips=pips),
    "train_controllers": lambda pips: trained(pips=pips),
}


@pytest.mark.parametrize("name", WITH_PIPS)
def test_wrong_peak_pressures_are_named(name):
    take = WITH_PIPS[name]
    with user_error(match=rf"{name}: pips must be at least peep = 5.0, got .*3"):
        take([20.0, 3.0])
    with user_error(match=f"{name}: pips must be finite"):
        take([20.0, np.nan])
    for pips in (20.0, [], "high", [[20.0]]):
        with user_error(match=f"{name}: pips must be a vector of pressures, got"):
            take(pips)


def test_the_peep_of_every_waveform_counts():
    high = lung.BreathWaveform.at_pip(lung.BreathWaveform(peep=12.0), 30.0)
    pid = dlx.controllers.LeakyPID(0.5, 1.0, dt=ENV.dt, reference=high)
    with user_error(match="breath_error: pips must be at least peep = 12.0, got .*10"):
        lung.breath_error(ENV, pid, key=KEY, pips=[10.0])
    other = lung.single_compartment(waveform=high)
    with user_error(match="pid_grid: pips must be at least peep = 12.0, got .*10"):
        lung.pid_grid(stack([ENV, other]), key=KEY, pips=[10.0])
    for pip in (np.nan, "high"):
        with user_error(match="at_pip: pip must be"):
            lung.BreathWaveform.at_pip(ENV, pip)


@pytest.mark.parametrize("task", ["single_compartment", "delay_lung"])
def test_a_peep_below_that_of_the_valves_is_refused(task):
    make, valves = getattr(lung, task), lung.Valves(peep=8.0)
    with user_error(match=f"{task}: the peep of waveform must be at .* 8.0, .* got 5"):
        make(valves=valves)
    with user_error(match="valves, 5.0, below which no lung empties, got 3.0"):
        make(waveform=lung.BreathWaveform(peep=3.0))
    env = make(valves=valves, waveform=lung.BreathWaveform(peep=8.0))
    assert_close(env.initial_state[env.cost.index], 8.0, rtol=1e-6)


def test_traced_waveforms_are_taken():
    def error(peep, pips):
        env = eqx.tree_at(lambda e: e.cost.waveform.peep, ENV, peep)
        few = dict(key=KEY, pips=pips, horizon=2)
        return lung.breath_error(env, dlx.controllers.Zero(1), **few)

    found = jax.jit(error)(jnp.array(4.0), jnp.array([20.0, 30.0]))
    # At rest at 5 cmH2O with the valve closed.
    assert_close(found, [15.0, 25.0], atol=1e-4)


def test_grid_of_a_single_task():
    few = dict(key=KEY, kp=[0.0, 1.0], ki=[1.0], pips=[20.0])
    gains, errors = lung.pid_grid(ENV, **few)
    _, stacked = lung.pid_grid(stack([ENV]), **few)
    assert errors.shape == (1, 2)
    assert_close(errors, stacked)
    assert gains.tolist() == [[0.0, 1.0, 0.0], [1.0, 1.0, 0.0]]


def test_a_stack_is_not_one_task():
    envs = stack([ENV, ENV])
    for name, call in {
        "breath_error": lambda: lung.breath_error(envs, PID, key=KEY),
        "least_error": lambda: lung.least_error(envs),
        "explore": lambda: lung.explore(envs, 1, key=KEY),
    }.items():
        with user_error(match=f"{name}: env must be one task, got 2 that are stacked"):
            call()


@pytest.mark.parametrize(
    "kind, make",
    {
        "BangBang": lung.BangBang,
        "BreathCost": lambda w: lung.BreathCost(w, index=0),
        "Breathing": lambda w: lung.Breathing(PID, w),
        "Explorer": lambda w: lung.Explorer(dt=0.03, waveform=w),
        "BreathPolicy": lambda w: lung.BreathPolicy(w, 0.03, key=KEY),
        "BreathCost: ": lambda w: lung.learned_lung(MODEL, waveform=w),
        "BreathCost:": lambda w: lung.single_compartment(waveform=w),
    }.items(),
)
def test_a_waveform_is_one(kind, make):
    with user_error(match=f"{kind}.*waveform must be a BreathWaveform, got int"):
        make(3)


def test_wrong_numbers_are_named():
    with user_error(match="levels must be finite"):
        lung.BreathWaveform(levels=(1.0, 1.0, np.nan, 0.0))
    with user_error(match="keypoints must be finite"):
        lung.BreathWaveform(keypoints=(0.0, np.nan, 0.5, 1.0))
    with user_error(match="kp must be finite"):
        lung.pid_grid(ENV, key=KEY, kp=[1.0, np.nan])
    with user_error(match="ki must be numbers, got .."):
        lung.pid_grid(ENV, key=KEY, ki=[])
    with user_error(match="noise must be at least 0, got -1"):
        lung.learned_lung(MODEL, noise=-1.0)
    with user_error(match="limit must be positive and finite, got -1"):
        lung.learned_lung(MODEL, limit=-1.0)
    with user_error(match="sensor_delay must be a whole number of at least 0, got -1"):
        lung.single_compartment(sensor_delay=-1)
    with user_error(match="learned_lung: sensor_delay cannot be given .* model, 2 st"):
        lung.learned_lung(MODEL, sensor_delay=5)
    with user_error(match="'sensor_dely'; did you mean 'sensor_delay'"):
        lung.single_compartment(sensor_dely=1)
    for env in (MODEL, ENV):
        with user_error(match="envs must be tasks of lungs that are stacked"):
            lung.train_controllers(env, PID, key=KEY)
    with user_error(match="breath_error: controller must be an AbstractController"):
        lung.breath_error(ENV, print, key=KEY)
    with user_error(match="breath_error: env must be a task with a breath waveform"):
        lung.breath_error(dlx.make("pendulum"), PID, key=KEY)
    zeros = np.zeros(40)
    u_out = np.where(np.arange(40) == 9, np.nan, 0)
    with user_error(match="u_out must be finite"):
        lung.Breaths.from_recording(zeros, u_out, zeros, dt=0.03)
    with user_error(match="dt must be positive"):
        lung.Breaths(zeros[None], zeros[None], zeros[None], dt=-1.0)


class Gain(eqx.Module):
    k: float
    a: np.ndarray


def test_stacks_are_of_arrays():
    both = stack([Gain(1.0, np.zeros(2)), Gain(1.0, np.ones(2))])
    assert both.k == 1.0 and both.a.shape == (2, 2)
    with user_error(match="stack: trees must be the same but for .*, got 1.0, 2.0"):
        stack([Gain(1.0, np.zeros(2)), Gain(2.0, np.zeros(2))])
