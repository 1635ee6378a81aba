"""Measured records, and output-error fits to them."""

import functools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, needs_x64, once, user_error
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

import delucax as dlx
from delucax.training import sysid


RNG = np.random.default_rng(0)
TIMES = np.cumsum(RNG.uniform(0.05, 0.15, 60))
SIGNAL = np.sin(2 * TIMES) + 0.3 * np.sin(5 * TIMES + 1)


class Spring(dlx.AbstractSystem):
    """A cubic spring of which only the position is measured."""

    state_names, control_names = ("x", "v"), ("f",)
    stiffness: jax.Array = dlx.parameter(4.0, constraint=dlx.positive)
    damping: jax.Array = dlx.parameter(0.4, constraint=dlx.positive)
    cubic: jax.Array = dlx.parameter(1.0)

    def vector_field(self, t, x, u, w):
        force = self.stiffness * x[0] + self.cubic * x[0] ** 3 + self.damping * x[1]
        return jnp.stack([x[1], u[0] - force])

    def observe(self, t, x):
        return x[:1]


def spring(**constants):
    return dlx.Discretized(Spring(**constants), 0.1)


def between(hold):
    """The signal as a function of time, by another library."""
    return {
        "zero": lambda t: SIGNAL[np.searchsorted(TIMES, t, "right") - 1],
        "linear": lambda t: np.interp(t, TIMES, SIGNAL),
        "cubic": CubicSpline(TIMES, SIGNAL, bc_type="natural"),
    }[hold]


def simulated(hold):
    """The positions by SciPy, from sample to sample."""
    u, states = between(hold), [np.array([0.3, -0.2])]

    def field(t, x, k):
        f = SIGNAL[k] if hold == "zero" else u(t)
        return [x[1], f - 4.0 * x[0] - x[0] ** 3 - 0.4 * x[1]]

    for k in range(len(TIMES) - 1):
        span, exact = (TIMES[k], TIMES[k + 1]), dict(rtol=1e-10, atol=1e-12)
        states.append(solve_ivp(field, span, states[-1], args=(k,), **exact).y[:, -1])
    return np.stack(states)[:, :1]


@needs_x64
@pytest.mark.parametrize("hold", ["zero", "linear", "cubic"])
def test_a_fit_to_uneven_samples_and_any_hold(hold):
    record = sysid.Record(simulated(hold), SIGNAL, times=TIMES, hold=hold)
    assert not record.is_uniform and len(record[10:30]) == 20
    for k, share in ((3, 0.4), (40, 0.8)):
        h = np.diff(TIMES)[k]
        value = share ** np.arange(4)[: record.coefficients().shape[1]]
        at = between(hold)(TIMES[k] + share * h)
        assert_close(value @ record.coefficients()[k, :, 0], at, atol=1e-12)
    if hold == "linear":
        return  # it is between the others, and each fit is a program
    guess = spring(stiffness=3.0, damping=0.6, cubic=0.5)
    names = [f"system.{name}" for name in ("cubic", "damping", "stiffness")]
    # The velocity is hidden: output error over the whole record, from a guess of it.
    fitted = sysid.physical(guess, record, names, x0=[0.3, 0.0], window=None)
    assert_close(fitted.estimate, [1.0, 0.4, 4.0], rtol=1e-3)
    assert_close(fitted.x0, [0.3, -0.2], atol=1e-3)


@needs_x64
def test_an_uneven_last_window_and_a_burn_in():
    record = sysid.Record(simulated("zero"), SIGNAL, times=TIMES)
    fit = functools.partial(sysid.physical, spring(), record, "system.stiffness")
    cut = fit(x0=[0.3, -0.2], window=25, noise=1e-3)
    assert_close(cut.estimate, 4.0, rtol=1e-3)
    # From a wrong start that is not estimated, what comes first does not count.
    wrong = fit(x0=[0.3, 0.0], window=None, burn_in=35, noise=1e-3, throw=False)
    assert_close(wrong.x0, [0.3, 0.0])
    assert_close(wrong.estimate, 4.0, rtol=0.05)


@once
def test_bad_records():
    y, u = RNG.normal(size=(20, 2)), RNG.normal(size=20)
    record = lambda y=y, u=u, **how: sysid.Record(y, u, **({"dt": 0.1} | how))
    gap, still = y.copy(), y.copy()
    gap[7, 1], still[:, 0] = np.nan, 3.0
    times = np.arange(20.0)
    for make, match in (
        (lambda: record(gap), "outputs must be finite, got nan in row 7, column 1"),
        (lambda: record(still), "column 0 of outputs is 3 in all 20 rows"),
        (lambda: record(u=u[:-2]), "as many rows as outputs or one row less"),
        (lambda: record(u=u[:-1], hold="linear"), r"as many rows as outputs, got"),
        (lambda: record(times=times), "either dt or times, got both"),
        (lambda: record(dt=None), "either dt or times, got neither"),
        (lambda: record(dt=0.0), "dt must be"),
        (lambda: record(hold="first"), "hold must be"),
        (lambda: record(dt=None, times=times[:5]), r"times must have shape \(20,\)"),
        (lambda: record()[3:4], "must leave at least 2 of the 20 samples"),
        (lambda: record()[::2], "a slice of neighbouring samples"),
    ):
        with user_error(match=match):
            make()
    for row, time, what in ((5, 4.0, "5 repeats 4"), (9, 2.0, "9 is before 8")):
        wrong = times.copy()
        wrong[row] = time
        with user_error(match=f"times must increase, but .* in row {what}"):
            record(dt=None, times=wrong)
    late = times + 40.0 * (np.arange(len(times)) > 8)
    with user_error(match="gap of 41 between rows 8 and 9; .* at most 1"):
        record(dt=None, times=late)
    assert record(dt=None, times=late, allow_gaps=True).steps[8] == 41
    with user_error(match="column 0 of outputs is 2 in all 5 rows"):
        sysid.Record(np.full(5, 2.0), np.arange(5.0), dt=0.1)
    with user_error(match="samples must be uniform in time, but those of record"):
        sysid.linear(record(dt=None, times=times**1.5))
    with user_error(match="must be a delucax.Discretized system without events"):
        plant = dlx.LinearDynamics(np.eye(2), np.ones((2, 1)))
        sysid.physical(plant, record(), "A")


@once
def test_a_record_is_a_pytree():
    record = sysid.Record(np.arange(1.0, 6.0), np.arange(5.0), dt=0.1)
    doubled = eqx.filter_jit(lambda r: jax.tree.map(lambda a: 2 * a, r))(record)
    assert_close(doubled.controls[:, 0], 2 * np.arange(5.0))
    first, second = record.split(0.6)
    assert (len(first), len(second)) == (3, 2)
    assert_close(second.times, [0.3, 0.4], rtol=1e-6)


@once
def test_a_traced_record_is_fitted():
    y, u = RNG.normal(size=(3, 30, 1)), RNG.normal(size=(30, 1))
    fit = lambda y: sysid.linear(sysid.Record(y, u, dt=0.1), throw=False).estimate
    assert_close(eqx.filter_jit(jax.vmap(fit))(y)[1], fit(y[1]), atol=1e-5)


@needs_x64
def test_validation():
    clean = simulated("zero")
    noisy = clean + 0.01 * RNG.normal(size=clean.shape)
    record = sysid.Record(noisy, SIGNAL, times=TIMES)
    true = sysid.validate(spring(), record, x0=[0.0, 0.0], start=15, ahead=5, lags=8)
    # The start is estimated, so that nothing but the noise is left.
    errors = noisy - true.simulated[0]
    assert_close(true.rmse, np.sqrt(np.mean(errors[15:] ** 2)), rtol=1e-12)
    assert_close(true.rmse, 0.01, rtol=0.3)
    assert np.all(np.abs(true.ahead / 0.01 - 1) < 0.5) and len(true.ahead) == 5
    spread = np.std(noisy[15:])
    assert_close(true.fit, 100 * (1 - true.rmse / spread), rtol=1e-10)
    # The correlations by their definition.
    e = errors[15:, 0] - np.mean(errors[15:, 0])
    u = SIGNAL[15:] - np.mean(SIGNAL[15:])
    each = np.array([e[k:] @ e[: len(e) - k] for k in range(1, 9)]) / (e @ e)
    assert_close(true.autocorrelation[:, 0], each, atol=1e-10)
    both = e[3:] @ u[:-3] / np.sqrt((e @ e) * (u @ u))
    assert_close(true.cross_correlation[3, 0, 0], both, atol=1e-10)
    assert true.p_value > 0.01
    same = dict(start=15, ahead=5, lags=8)  # so that nothing compiles again
    wrong = sysid.validate(spring(cubic=0.0), record, x0=[0.0, 0.0], **same)
    assert wrong.p_value < 1e-6 and wrong.rmse > 3 * true.rmse
    assert "fit, %" in repr(wrong)
    # Records together count as one.
    two = [record[:30], record[30:]]
    parts = sysid.validate(spring(), two, x0=[0.0, 0.0], start=8, lags=5)
    assert [len(run) for run in parts.simulated] == [30, 30]
    with user_error(match=r"must have more than 70 samples \(start \+ the larger"):
        sysid.validate(spring(), record, x0=[0.0, 0.0], start=50)


@needs_x64
def test_bootstrap():
    """Of a straight line, whose covariance is known: y = h / mass sum of u."""
    rng = np.random.default_rng(3)

    class Integrator(dlx.AbstractSystem):
        state_names, control_names = ("x",), ("u",)
        gain: jax.Array = dlx.parameter(1.0)

        def vector_field(self, t, x, u, w):
            return self.gain * u

    plant = dlx.Discretized(Integrator(), 0.1, diffrax.Euler())
    u = rng.normal(size=(120, 1))
    past = 0.1 * np.concatenate([np.zeros((1, 1)), np.cumsum(u[:-1], axis=0)])
    y = 0.5 + 2.0 * past + 0.05 * rng.normal(size=past.shape)
    record = sysid.Record(y, u, dt=0.1)
    fitted = sysid.physical(plant, record, "system.gain", window=None)
    rows = np.concatenate([past, np.ones_like(past)], axis=1)
    std = fitted.noise[0] * np.sqrt(np.linalg.inv(rows.T @ rows)[0, 0])
    assert_close(fitted.std, std, rtol=1e-6)
    drawn = functools.partial(sysid.bootstrap, fitted, record)
    again = drawn(draws=200, key=jax.random.key(0))
    assert again.failures == 0 and again.names == fitted.names
    assert repr(again).endswith("0 of 200 fits failed")
    # The standard deviation of 200 draws is known to 5%.
    assert_close(again.std, std, rtol=0.2)
    assert_close(again.low, fitted.low, atol=float(std))
    assert_close(again.high, fitted.high, atol=float(std))
    # Windows whose states are all estimated leave half of the degrees of freedom.
    short = sysid.physical(plant, record, "system.gain", window=2)
    again = sysid.bootstrap(short, record, draws=200, key=jax.random.key(1))
    assert_close(again.std, short.std, rtol=0.2)
    # A block as long as a record is one of the two records.
    two = [sysid.Record(sign * y, sign * u, dt=0.1) for sign in (1.0, -1.0)]
    both = sysid.physical(plant, two, "system.gain", window=None)
    again = sysid.bootstrap(both, two, block=120, draws=20, key=jax.random.key(2))
    assert len(np.unique(np.round(again.estimates, 9))) <= 4
    with user_error(match="block must be at most the 120 samples of the shortest"):
        drawn(block=121, key=jax.random.key(0))
    linear = sysid.linear(record)
    with user_error(match="fitted must be a result of sysid.physical"):
        sysid.bootstrap(linear, record, key=jax.random.key(0))
