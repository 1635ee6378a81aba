"""Neural state-space models of outputs and controls."""

import jax
import jax.numpy as jnp
import numpy as np
from helpers import assert_close, needs_x64, once, user_error

import delucax as dlx
from delucax.training import sysid


RNG = np.random.default_rng(0)
KEY = jax.random.key(0)


def spring(u, dt=0.1, substeps=5):
    """The position of a mass on a spring that hardens, by Euler's method."""
    x, v, rows = 0.0, 0.0, []
    for f in u:
        rows.append(x)
        for _ in range(substeps):
            v += dt / substeps * (f - 0.3 * v - x - 1.5 * x**3)
            x += dt / substeps * v
    return np.array(rows)


def root_mean_square(error):
    return np.sqrt(np.mean(np.asarray(error) ** 2))


OPTIONS = dict(past=6, horizon=30, batch_size=32, steps=400, progress=False, key=KEY)


@once
def test_a_hidden_oscillator_is_better_than_its_linear_start():
    u = np.repeat(1.5 * RNG.normal(size=250), 4)
    y = spring(u)
    y = y + 0.01 * np.std(y) * RNG.normal(size=y.shape)
    record = sysid.Record(y[:800], u[:800], dt=0.1)
    held = sysid.Record(y[800:], u[800:], dt=0.1)
    fitted = sysid.state_space(record, 2, **OPTIONS)
    assert fitted.result == dlx.RESULTS.successful
    assert fitted.error.shape == (1,)
    assert fitted.error[0] < 0.3 * fitted.start_error[0]
    least = np.min(fitted.history["validation"]) * np.std(y[:640])
    assert_close(least, fitted.error[0], rtol=1e-4)
    # On data that neither has met, in a free run from the sixth sample on.
    model = fitted.model
    x = fitted.encoder(held.outputs[:6], held.controls[:6])
    states = dlx.open_loop(model, x, held.controls[6:-1])
    run = jax.vmap(lambda x: model.observe(0.0, x))(states)
    linear = sysid.subspace(record[:640], 2, affine=True).model
    A, B, C = (np.asarray(M) for M in (linear.A, linear.B, linear.C))
    straight, z = [], np.zeros(2)
    for control in u[800:]:
        straight.append(C @ (z + linear.x_ref))
        z = A @ z + B @ (control - linear.u_ref)
    best = root_mean_square(np.stack(straight)[50:] - held.outputs[50:])
    assert root_mean_square(run[44:] - held.outputs[50:]) < 0.6 * best


@once
def test_controls_that_tell_nothing_of_a_linear_model():
    """The networks then start from random numbers."""
    u = np.ones(800)
    fitted = sysid.state_space(sysid.Record(spring(u), u, dt=0.1), 2, **OPTIONS)
    assert fitted.result == dlx.RESULTS.successful
    assert np.any(fitted.model.output.layers[-1].weight)
    assert fitted.error < 0.3 * fitted.start_error


@needs_x64
def test_a_linear_system_is_its_own_start():
    """Of two outputs and two controls, in units far from one, in several records."""
    A = np.array([[0.9, 0.3, 0.0], [-0.3, 0.9, 0.1], [0.0, 0.0, 0.5]])
    B = np.array([[0.0, 0.2], [1.0, 0.0], [0.3, 1.0]])
    C = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, -2.0]])
    records = []
    for length in (150, 130):
        u, x, rows = RNG.normal(size=(length, 2)), RNG.normal(size=3), []
        for control in u:
            rows.append(C @ x)
            x = A @ x + B @ control
        y = np.stack(rows) * [1e3, 1e-2] + [500.0, 3.0]
        records.append(sysid.Record(y, u * [1.0, 20.0] + [0.0, 5.0], dt=0.1))
    options = dict(past=5, horizon=10, steps=1, progress=False, key=KEY)
    fitted = sysid.state_space(records, 3, **options)
    assert np.all(np.asarray(fitted.start_error) < [1e-3, 1e-8])
    assert np.all(fitted.error <= fitted.start_error)
    assert_close(fitted.model.dt, 0.1, rtol=1e-12)
    assert fitted.model.observe(0.0, jnp.zeros(3)).shape == (2,)


@once
def test_bad_input():
    record = sysid.Record(RNG.normal(size=(50, 1)), RNG.normal(size=(50, 1)), dt=0.1)

    def fit(record=record, states=2, **options):
        given = dict(past=5, horizon=10, progress=False, key=KEY) | options
        return sysid.state_space(record, states, **given)

    for call, match in (
        (lambda: fit(3.0), "record must be a delucax.training.sysid.Record"),
        (lambda: fit(states=0), "states must be a whole number of at least 1"),
        (lambda: fit(past=0), "past must be a whole number of at least 1"),
        (lambda: fit(learning_rate=0.0), "learning_rate must be positive"),
        (lambda: fit(validation=1.0), "validation must be between 0 and 1, got 1.0"),
        (lambda: fit(key=0), "key must be one random key"),
        (lambda: fit(horizon=36), r"record\[0\] must have at least 41 .* got 40"),
    ):
        with user_error(match=match):
            call()
    encoder = sysid.Encoder(jnp.ones((2, 10)), 5, 1, 4, key=KEY)
    with user_error(match=r"Encoder: outputs must have shape \(5, 1\), got shape"):
        encoder(jnp.ones((4, 1)), jnp.ones((5, 1)))
    with user_error(match="have 4 columns for each of 1 outputs"):
        sysid.Encoder(jnp.ones((2, 10)), 4, 1, key=KEY)
    with user_error(match="LatentDynamics: y_size must be positive"):
        sysid.LatentDynamics([[0.5]], [[1.0]], [[1.0]], y_size=0.0, key=KEY)
