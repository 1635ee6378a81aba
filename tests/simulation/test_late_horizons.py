"""One solve in single precision that begins late."""

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, needs_x32, user_error

import delucax as dlx


pytestmark = needs_x32
SWITCHED = dlx.systems.LinearSystem(-jnp.eye(1), jnp.eye(1))
CONTROLS = jnp.asarray(np.random.default_rng(0).uniform(-2, 2, (10, 1)), "float32")
HOW = {
    "fixed": dict(solver=dlx.dynamics.RK4(), substeps=2),
    "adaptive": dict(stepsize_controller=diffrax.PIDController(rtol=1e-4, atol=1e-6)),
}
X = jnp.ones(1)


@pytest.mark.parametrize(
    "how, source", [("fixed", "controls"), ("adaptive", "feedback")]
)
def test_an_autonomous_solve_does_not_depend_on_the_start(how, source):
    feedback = dlx.controllers.Linear(2 * jnp.eye(1))
    source, dt = (CONTROLS, None) if source == "controls" else (feedback, 2.0**-7)
    runs = [
        dlx.simulate(SWITCHED, source, t0, t0 + 10 * 2.0**-7, X, dt=dt, **HOW[how])
        for t0 in (0.0, 1000.0, 1e5)
    ]
    for run in runs[1:]:
        np.testing.assert_array_equal(run.states, runs[0].states)
        np.testing.assert_array_equal(run.controls, runs[0].controls)
    assert runs[2].times[0] == 1e5


@pytest.mark.parametrize("how, source", [("fixed", "field"), ("adaptive", "control")])
def test_a_late_field_of_time(how, source):
    wave = lambda t: jnp.sin(2 * t)  # noqa: E731
    field, controls, given = (
        (lambda t, x, u, w: wave(t) + u, jnp.zeros((10, 1)), {})
        if source == "field"
        else (lambda t, x, u, w: u, lambda t: wave(t)[None], dict(hold=None, dt=0.05))
    )
    system, t0, length = dlx.system(field, states=1, controls=1), 1e5, 0.5
    run = dlx.simulate(system, controls, t0, t0 + length, X, **given, **HOW[how])
    exact = 1 + (np.cos(2 * t0) - np.cos(2 * (t0 + length))) / 2
    assert_close(run.final_state, [exact], rtol=2e-6)  # the rounding of 20 steps


def test_late_save_times_are_of_their_interval():
    k = np.array([1, 2, 3, 7, 10])
    t0, dt = 1000.0, 0.01
    run = dlx.simulate(
        SWITCHED, CONTROLS, t0, t0 + 10 * dt, X, ts=t0 + dt * k, **HOW["adaptive"]
    )
    early = dlx.simulate(SWITCHED, CONTROLS, 0.0, 10 * dt, X, **HOW["adaptive"])
    assert_close(run.controls, CONTROLS[k[1:] - 1])
    assert_close(run.states, early.states[k], atol=1e-6)


def test_more_steps_than_single_precision_tells_apart():
    with user_error(match="simulate: the horizon .* at most 4194304.*X64"):
        dlx.simulate(SWITCHED, jnp.zeros((2**22 + 1, 1)), 0.0, 1e5, X)
