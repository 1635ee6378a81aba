"""Lungs learned from breaths, and controllers learned in lungs.

Precision plays no part: what compiles for long runs in double precision, where nothing
checks annotations; the examples of the functions run with those checks.
"""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from helpers import assert_close, needs_x64, once, user_error

import delucax as dlx
from delucax import lung
from delucax._module import stack, unstack
from delucax.studies.ventilator._contenders import FeedForward


KEY = jax.random.key(0)


@pytest.fixture(scope="module")
def breaths():
    """Of a lung of which Euler's method is true, so that what learns it is small."""
    rng = np.random.default_rng(0)
    u_in = 50 * np.sin(np.arange(29) / rng.uniform(2, 12, (32, 1))) ** 2
    truth = jax.jit(jax.vmap(single(20.0).predict))(jnp.asarray(u_in))
    noise = 0.2 * rng.normal(size=u_in.shape)
    return lung.Breaths(u_in, 0 * u_in, np.asarray(truth) + noise, dt=0.03)


def single(resistance, compliance=20.0):
    system = lung.SingleCompartment(resistance, compliance)
    return lung.LungModel(system, solver=diffrax.Euler())


def learned(breaths, **options):
    small = dict(width=8, boundary=1, u_window=2, p_window=2)
    return lung.LearnedLung(breaths, **(small | options), key=KEY)


@needs_x64
@pytest.mark.parametrize("published", [False, True])
def test_prediction_is_what_the_dynamics_do(breaths, published):
    model = learned(breaths, boundary=2, published=published)

    @eqx.filter_jit
    def predictions(model, u):
        states = dlx.open_loop(model, model.resting(), jnp.stack([u, 0 * u], 1))
        found = model.predict(u)
        # Given its own predictions for the records, it predicts the same.
        again = model.one_step(u, found)
        opened = model(0.0, states[7], jnp.array([30.0, 1.0]))
        return jax.vmap(model.pressure)(states)[:-1], found, again, opened

    expected, found, again, opened = predictions(model, breaths.u_in[0])
    assert_close(found, expected, rtol=1e-4)
    assert_close(again, found, rtol=1e-4)
    # The expiratory valve makes it forget.
    assert_close(opened, model.resting())
    assert len(model.state_names) == model.state_size


@needs_x64
def test_fitting_learns(breaths):
    train, test = breaths[:24], breaths[24:]
    model = learned(train)
    few = dict(teacher_steps=60, steps=40, batch_size=None, learning_rate=1e-2)
    fitted = lung.fit_lungs(model, train, key=KEY, **few).model
    error = eqx.filter_jit(test.open_loop_error)
    assert error(fitted) < 0.3 * error(model)


class Asked(Exception):
    pass


@once
def test_another_optimiser(breaths):
    """Of both parts."""

    def ask(values):
        raise Asked

    asked = dict(optimiser=optax.GradientTransformation(ask, ask), key=KEY)
    model = learned(breaths)
    for steps in dict(teacher_steps=1, steps=0), dict(teacher_steps=0, steps=1):
        with pytest.raises(Asked):
            lung.fit_lungs(model, breaths, **asked, **steps)
    with user_error(ValueError, match="teacher_steps must be"):
        lung.fit_lungs(model, breaths, key=KEY, teacher_steps=-1)


@needs_x64
def test_physics_is_found(breaths):
    path = "dynamics.dynamics.system."
    start = single(10.0, 30.0)
    moved = {path + name: dlx.positive for name in ("resistance", "compliance")}
    fitted = lung.fit_lungs(
        start, breaths, key=KEY, steps=80, learning_rate=0.05, trainable=moved
    ).model
    assert_close(fitted.system.resistance, 20.0, rtol=0.03)
    assert_close(fitted.system.compliance, 20.0, rtol=0.05)
    assert fitted.system.valves.max_flow == start.system.valves.max_flow


def euler_task(resistance):
    return lung.single_compartment(resistance=resistance, solver=diffrax.Euler())


@needs_x64
def test_controller_learns_and_the_grid_knows_the_best():
    models = stack([single(R) for R in (5.0, 50.0)])
    simulated = eqx.filter_vmap(lambda m: lung.learned_lung(m, noise=0.2))(models)
    forward = FeedForward(lung.BreathWaveform(), gain=1.0)
    start = stack([stack([forward, forward])])
    few = dict(steps=30, pips=[15.0, 30.0], learning_rate=0.1, horizon=15)
    fitted = lung.train_controllers(simulated, start, key=KEY, **few)
    assert fitted.history.loss[-1] < 0.8 * fitted.history.loss[0]
    gains = fitted.model.gain[0]
    assert gains[0] > gains[1]  # the narrow lung needs less flow

    envs = [euler_task(R) for R in (5.0, 50.0)]
    wide = envs[0]
    envs = stack(envs)
    few = dict(kp=[0.0, 1.0], ki=[0.0, 3.0], pips=[20.0, 30.0])
    grid, errors = lung.pid_grid(envs, key=KEY, **few)
    assert grid.shape == (4, 3) and errors.shape == (2, 4)
    assert np.all(grid[np.argmax(errors, axis=1)] == 0)
    gains = grid[np.argmin(errors[0])]
    pid = dlx.controllers.LeakyPID(*gains, dt=0.03, reference=lung.BreathWaveform())
    own = lung.breath_error(wide, pid, key=KEY, pips=[20.0, 30.0])
    assert_close(np.mean(own), np.min(errors[0]), rtol=1e-4)
    least = lung.least_error(wide, pips=[20.0], steps=150)
    assert least[0] < own[0]


@once
def test_a_learned_lung_is_corrected_by_what_is_read(breaths):
    model = learned(breaths)
    before = model.resting()
    after = model.corrected(before, 15.0, 0.3)
    expected = 0.7 * model.pressure(before) + 0.3 * 15.0
    assert_close(model.pressure(after), expected, rtol=1e-5)
    assert np.sum(np.asarray(after != before)) == 1


@once
def test_an_alarm_costs_more_than_an_error():
    cost = lung.BreathCost(lung.BreathWaveform(), index=2, limit=45.0)
    u = jnp.zeros(2)
    assert_close(cost(0.5, jnp.array([0.0, 0.0, 44.0]), u), 9.0)
    assert_close(cost(0.5, jnp.array([0.0, 0.0, 47.0]), u), 12.0 + 20.0)
    lower = lung.BreathWaveform.at_pip(cost, 20.0)
    assert_close(lower(0.5, jnp.array([0.0, 0.0, 44.0]), u), 24.0)


@once
def test_expiration_counts_if_it_is_told_to():
    x, u = jnp.array([0.0, 0.0, 9.0]), jnp.zeros(2)  # 4 above PEEP
    assert_close(lung.BreathCost(lung.BreathWaveform(), 2)(2.0, x, u), 0.0)
    assert_close(lung.BreathCost(lung.BreathWaveform(), 2, 0.25)(2.0, x, u), 1.0)
    env = dlx.make("lung/single_compartment", expiration_weight=0.5)
    assert_close(env.cost.expiration_weight, 0.5)
    with user_error(match="expiration_weight must be at least 0, got -1"):
        dlx.make("lung/single_compartment", expiration_weight=-1.0)


@once
def test_stacks_come_apart():
    lungs = [lung.SingleCompartment(R) for R in (5.0, 20.0)]
    both = stack(lungs)
    assert_close(both.resistance, [5.0, 20.0])
    assert_close(unstack(both)[1].resistance, 20.0)
    traced = jax.jit(lambda r: stack([lungs[0].resistance, r]))(jnp.asarray(7.0))
    assert_close(traced, [5.0, 7.0])
    keys = stack([jax.random.key(0), jax.random.key(1)])
    assert jax.random.bits(unstack(keys)[1]) == jax.random.bits(jax.random.key(1))
    with user_error(match="trees must not be empty"):
        stack([])


@once
def test_a_damaged_checkpoint_is_refused(breaths, tmp_path):
    path = tmp_path / "lungs.fit"
    path.write_bytes(b"delucax-file 1 0000\nnonsense")
    model = learned(breaths)
    with user_error(match="lungs.fit' must be a file that fit has written"):
        lung.fit_lungs(
            model, breaths, key=KEY, teacher_steps=0, steps=1, checkpoint=path
        )


@once
def test_wrong_arguments(breaths):
    with user_error(match="kind must be 'mlp' or 'cnn', got 'rnn'"):
        lung.BreathPolicy(lung.BreathWaveform(), 0.03, "rnn", key=KEY)
    with user_error(match="model must be a LearnedLung, a LungModel or a"):
        lung.learned_lung(lung.SingleCompartment())
    with user_error(match="env must be a task with a breath waveform"):
        lung.explore(dlx.make("pendulum"), 3, key=KEY)
    with user_error(match="system must be an AbstractLung"):
        lung.LungModel(dlx.systems.Pendulum())
    with user_error(match="trees must have the same structure"):
        stack([lung.SingleCompartment(), lung.BalloonLung()])


class Root(dlx.AbstractController):
    """Not finite below 0, and no slope at 0."""

    gain: jax.Array = dlx.weight()

    def __call__(self, t, y, state):
        return 10 * jnp.sqrt(self.gain)[None].astype(y.dtype), state


@needs_x64
@pytest.mark.parametrize("shared", [False, True])
def test_those_that_diverge_harm_no_other(shared):
    env = lung.learned_lung(single(20.0))
    envs = stack([env, env])

    def trained(gains, throw):
        start = Root(jnp.array(gains))
        few = dict(shared=shared, steps=2, horizon=2, pips=[20.0], throw=throw)
        return lung.train_controllers(envs, start, key=KEY, **few)

    begin = [1.0, -1.0, 0.0] if shared else [[1.0, -1.0], [0.0, 1.0]]
    if not shared:
        with user_error(RuntimeError, match="is not finite at step 0"):
            trained(begin, True)
    found = trained(begin, False)
    expected = trained(np.ones(np.shape(begin)), False)
    bad = found.model.gain < 0.5
    assert_close(found.model.gain[bad], [-1.0, 0.0])
    assert_close(found.model.gain[~bad], expected.model.gain[~bad])
    assert np.all(expected.model.gain != 1)
    assert found.history["diverged"].tolist() == [2, 2]


@once
def test_the_error_of_a_run_that_failed_is_nan():
    class Late(dlx.AbstractController):
        def __call__(self, t, y, state):
            return jnp.where(t > 0.83, jnp.nan, 30.0) * jnp.ones(1, y.dtype), state

    env = dlx.make("lung/single_compartment")
    assert np.isnan(lung.breath_error(env, Late(), key=KEY, pips=[20.0])).all()
