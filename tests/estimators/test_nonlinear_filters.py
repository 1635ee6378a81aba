from typing import ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    assert_close,
    assert_gradient,
    needs_x64,
    user_error,
)

import delucax as dlx


pytestmark = needs_x64


c = dlx.estimators
EKF, UKF = c.ExtendedKalmanFilter, c.UnscentedKalmanFilter
CLOSE = dict(rtol=1e-10, atol=1e-11)
both = pytest.mark.parametrize("kind", [EKF, UKF])


@pytest.mark.parametrize(
    "kind, options",
    [
        (EKF, {}),
        (UKF, {}),
        (UKF, {"alpha": 0.5, "beta": 1.0, "kappa": 1.0}),
    ],
)
def test_is_the_kalman_filter_of_linear_dynamics(kind, options):
    rng = np.random.default_rng(0)
    A = 0.5 * rng.standard_normal((3, 3))
    B, C = rng.standard_normal((3, 1)), rng.standard_normal((2, 3))
    E, x_ref = rng.standard_normal((3, 2)), rng.standard_normal(3)
    dynamics = dlx.LinearDynamics(A, B, C, E, x_ref=x_ref)
    noise = jnp.diag(jnp.array([0.3, 0.1])), jnp.diag(jnp.array([0.2, 0.5]))
    start = dict(mean=jnp.ones(3), covariance=jnp.diag(jnp.array([1.0, 0.5, 2.0])))
    ys, us = rng.standard_normal((6, 2)), rng.standard_normal((6, 1))
    found = c.smooth(kind(dynamics, *noise, **start, **options), ys, us)
    expected = c.smooth(c.KalmanFilter(dynamics, *noise, **start), ys, us)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert_close(a, b, **CLOSE)


class Square(dlx.AbstractSystem):
    """A number at rest, whose square is seen."""

    state_names: ClassVar = ("x",)
    control_names: ClassVar = ("u",)

    def vector_field(self, t, x, u, w):
        return u

    def observe(self, t, x):
        return x**2


@pytest.mark.parametrize("alpha", [1.0, 0.3])
def test_moments_of_a_square(alpha):
    """Unscented, the square of a normal number has the right mean and variance."""
    mean, variance, V = 0.7, 0.4, 0.1
    dynamics = dlx.Discretized(Square(), dt=0.1)
    options = dict(mean=[mean], covariance=[[variance]])
    ukf = UKF(dynamics, jnp.eye(1), [[V]], alpha=alpha, **options)
    y = jnp.array([2.0])
    expected = mean**2 + variance
    S = 4 * mean**2 * variance + 2 * variance**2 + V
    gain = 2 * mean * variance / S
    after = eqx.filter_jit(ukf.update)(0.0, y, ukf.init())
    close = dict(rtol=1e-12)
    assert_close(after.mean, [mean + gain * (2.0 - expected)], **close)
    assert_close(after.covariance, [[variance - gain**2 * S]], **close)
    ekf = EKF(dynamics, jnp.eye(1), [[V]], **options)
    S = 4 * mean**2 * variance + V
    gain = 2 * mean * variance / S
    after = eqx.filter_jit(ekf.update)(0.0, y, ekf.init())
    assert_close(after.mean, [mean + gain * (2.0 - mean**2)], **close)


class Sight(dlx.AbstractSystem):
    """A pendulum, of which the place of the bob is seen; driven by noise torque."""

    pendulum: dlx.systems.Pendulum
    state_names: ClassVar = ("angle", "velocity")
    control_names: ClassVar = ("torque",)
    disturbance_names: ClassVar = ("noise",)

    def vector_field(self, t, x, u, w):
        return self.pendulum.vector_field(t, x, u + w, None)

    def observe(self, t, x):
        return jnp.stack([jnp.sin(x[0]), jnp.cos(x[0])])

    def difference(self, x, x_ref):
        return self.pendulum.difference(x, x_ref)


def swinging(length=1.0):
    system = Sight(dlx.systems.Pendulum(length=length))
    return dlx.Discretized(system, 0.05, diffrax.Midpoint())


STD_W, STD_V = 1.0, 0.1
NOISE = STD_W**2 * jnp.eye(1), STD_V**2 * jnp.eye(2)
START = dict(mean=jnp.array([1.0, 0.0]), covariance=0.3**2 * jnp.eye(2))


def test_better_than_dead_reckoning(key):
    """On noisy swings the extended filter beats the model alone and the sensor alone,
    the smoother beats the filter, and both know how good they are."""
    dynamics = swinging()
    env = dlx.Environment(
        dynamics,
        dlx.costs.Quadratic(jnp.eye(2), jnp.eye(1)),
        disturbance=dlx.disturbances.Gaussian(STD_W, size=1),
        sensor_noise=dlx.disturbances.Gaussian(STD_V, size=2),
        horizon=60,
    )
    estimator = EKF(dynamics, *NOISE, **START)

    @eqx.filter_jit
    @jax.vmap
    def errors(key):
        start, run = jax.random.split(key)
        x0 = START["mean"] + 0.3 * jax.random.normal(start, (2,))
        run = dlx.rollout(env, dlx.controllers.Zero(1), key=run, x0=x0)
        states = run.states[:-1]
        dead = dlx.open_loop(dynamics, START["mean"], run.controls)[:-1]
        seen = jnp.arctan2(run.observations[:, 0], run.observations[:, 1])
        off = jax.vmap(dynamics.difference)
        smoothed = c.smooth(estimator, run.observations, run.controls)
        return {
            "dead": off(dead, states),
            "seen": dlx.math.wrap(seen - states[:, 0]),
            "filtered": off(smoothed.filtered.updated.mean, states),
            "smoothed": off(smoothed.mean, states),
            "covariance": smoothed.covariance,
        }

    found = {k: np.asarray(v) for k, v in errors(jax.random.split(key, 64)).items()}
    deviation, covariance = found["smoothed"], found.pop("covariance")
    rms = {k: np.sqrt(np.mean(np.square(v), axis=(0, 1))) for k, v in found.items()}
    assert np.all(rms["filtered"] < 0.3 * rms["dead"])
    assert rms["filtered"][0] < 0.8 * rms["seen"]
    assert np.all(rms["smoothed"] < 0.85 * rms["filtered"])
    # Of a normal estimate of two entries the surprise is 2 on average.
    surprise = np.linalg.solve(covariance, deviation[..., None])[..., 0]
    assert 1.8 < np.mean(np.sum(surprise * deviation, axis=-1)) < 2.2


class Wrapped(dlx.AbstractSystem):
    """A pendulum whose angle is wrapped, or not."""

    wraps: jax.Array
    pendulum: dlx.systems.Pendulum
    state_names: ClassVar = ("angle", "velocity")
    control_names: ClassVar = ("torque",)

    def vector_field(self, t, x, u, w):
        return self.pendulum.vector_field(t, x, u, w)

    def project(self, x):
        angle = jnp.where(self.wraps, dlx.math.wrap(x[0]), x[0])
        return jnp.stack([angle, x[1]])

    def difference(self, x, x_ref):
        return self.pendulum.difference(x, x_ref)


@both
def test_angles_wrap(kind):
    """Over the top, the spread of the points and of the record is over the circle."""
    pendulum = dlx.systems.Pendulum()
    ys = np.stack([3.0 + 0.1 * np.arange(5), np.full(5, 2.0)], axis=1)
    turned = ys - np.array([[0], [0], [1], [1], [1]]) * [2 * np.pi, 0.0]
    options = dict(mean=ys[0], covariance=0.1 * np.eye(2))
    options["observation_difference"] = pendulum.difference

    @jax.jit
    @jax.vmap
    def smooth(wraps, ys):
        dynamics = dlx.Discretized(Wrapped(wraps, pendulum), 0.05, diffrax.Midpoint())
        noise = 0.01 * jnp.eye(2), 0.01 * jnp.eye(2)
        found = c.smooth(kind(dynamics, *noise, **options), ys, throw=False)
        return found, jax.vmap(pendulum.difference, (0, None))(found.mean, ys[0])

    found, off = smooth(np.array([False, True]), np.stack([ys, turned]))
    assert np.all(found.result == dlx.RESULTS.successful)
    assert_close(off[1], off[0], atol=1e-11)
    assert_close(found.covariance[1], found.covariance[0], **CLOSE)
    angles = np.abs(found.filtered.predicted.mean[..., 0])
    assert np.max(angles[1]) < 3.5 and np.max(found.mean[0, :, 0]) > 3.2


@pytest.mark.parametrize("kind", [EKF, UKF])
def test_gradient_of_the_likelihood(kind):
    """With respect to a length and to noise levels."""
    ys = jnp.stack([jnp.sin(0.2 * jnp.arange(6)), jnp.cos(0.2 * jnp.arange(6))], 1)

    def likelihood(z):
        noise = jnp.exp(z[1]) * NOISE[0], jnp.exp(z[2]) * NOISE[1]
        estimator = kind(swinging(z[0]), *noise, **START)
        return c.run_filter(estimator, ys, throw=False).log_likelihood

    assert_gradient(likelihood, jnp.array([1.1, 0.2, -0.3]), rtol=1e-6)


def test_points_of_a_singular_covariance():
    """What is known for certain stays so, and a negative variance is a failure."""
    dynamics = dlx.LinearDynamics(jnp.eye(2), jnp.ones((2, 1)))
    noise = jnp.zeros((2, 2)), jnp.eye(2)
    half = jnp.diag(jnp.array([0.0, 1.0]))
    ys = jnp.ones((3, 2))
    kalman, ukf = (
        kind(dynamics, *noise, covariance=half) for kind in (c.KalmanFilter, UKF)
    )
    found, expected = c.run_filter(ukf, ys), c.run_filter(kalman, ys)
    assert_close(found.updated.mean, expected.updated.mean, **CLOSE)
    assert_close(found.updated.mean[:, 0], np.zeros(3))
    spoilt = eqx.tree_at(lambda k: k.covariance, ukf, -jnp.eye(2))
    with pytest.raises(RuntimeError, match="states.*At observation 0"):
        c.run_filter(spoilt, ys)


class Unsolved(dlx.dynamics.AbstractWrapper):
    """Dynamics of which no step is solved, though numbers come out."""

    dynamics: dlx.AbstractDynamics

    def advance(self, t, x, u, w):
        return x, dlx.RESULTS.stage_not_solved


@both
def test_solver_that_fails(kind):
    """A step that is not solved is not passed off as a prediction."""
    linear = dlx.LinearDynamics(jnp.eye(2), jnp.ones((2, 1)))
    estimator = kind(Unsolved(linear), jnp.eye(2), jnp.eye(2))
    found = c.run_filter(estimator, jnp.ones((2, 2)), throw=False)
    assert found.result == dlx.RESULTS.diverged
    assert np.all(np.isnan(found.predicted.mean[1:]))


def test_precision_batch_and_file(tmp_path):
    """The tests of all controllers say the same of feedback of the extended one."""
    ys = jnp.ones((2, 4, 2), jnp.float32)
    pendulum = dlx.systems.Pendulum()
    dynamics = dlx.Discretized(pendulum, 0.05, diffrax.Euler())
    eye = 0.1 * jnp.eye(2, dtype=jnp.float32)
    options = dict(observation_difference=pendulum.difference)
    estimator = UKF(dynamics, eye, eye, **options)
    assert estimator.init().mean.dtype == jnp.float32
    run = jax.jit(jax.vmap(c.run_filter, in_axes=(None, 0)))
    found = run(estimator, ys)
    assert found.updated.covariance.dtype == jnp.float32
    assert found.log_likelihood.shape == (2,) and found.log_likelihoods.shape == (2, 4)
    dlx.save(tmp_path / "filter.dlx", estimator)
    again = run(dlx.load(tmp_path / "filter.dlx"), ys)
    np.testing.assert_array_equal(again.updated.mean, found.updated.mean)


class Lifted(Square):
    """A difference that is not of the size of the state."""

    def difference(self, x, x_ref):
        return jnp.concatenate([x, x_ref])


BAD = [
    (
        {"dynamics": dlx.systems.Pendulum()},
        "dynamics must be an AbstractDynamics.*Pend",
    ),
    ({"W": jnp.eye(2)}, r"W must have shape \(1, 1\), .*disturbance, got \(2, 2\)"),
    ({"W": -jnp.eye(1)}, "W must be positive semidefinite"),
    ({"V": jnp.eye(1)}, r"V must have shape \(2, 2\), .*observation, got \(1, 1\)"),
    ({"V": jnp.full((2, 2), jnp.nan)}, "V must be finite"),
    ({"mean": jnp.zeros(1)}, r"mean must have shape \(2,\)"),
    ({"covariance": -jnp.eye(2)}, "covariance must be positive semidefinite"),
]
BAD_POINTS = [
    ({"alpha": 0.0}, "alpha must be positive"),
    ({"alpha": jnp.ones(2)}, r"alpha must be a number, got shape \(2,\)"),
    ({"beta": jnp.ones(2)}, r"beta must be a number, got shape \(2,\)"),
    ({"beta": float("nan")}, "beta must be finite"),
    ({"kappa": -2.0}, "kappa must be above -n = -2.*got -2.0"),
]


@pytest.mark.parametrize(
    "kind, arguments, message",
    [(kind, *bad) for kind in (EKF, UKF) for bad in BAD]
    + [(UKF, *bad) for bad in BAD_POINTS],
)
def test_wrong_arguments(kind, arguments, message):
    given = {"dynamics": swinging(), "W": NOISE[0], "V": NOISE[1]} | arguments
    with user_error(match=f"{kind.__name__}: {message}"):
        kind(**given)


@both
def test_wrong_difference(kind):
    lifted = dlx.Discretized(Lifted(), dt=0.1)
    with user_error(
        match=r"difference must return a vector of shape \(1,\), .*, got shape \(2"
    ):
        kind(lifted, jnp.eye(1), jnp.eye(1))
