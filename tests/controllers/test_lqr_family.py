"""Tracking, finite-horizon, integral and sampled-data regulators."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
from helpers import assert_close, assert_gradient, needs_x64, user_error

import delucax as dlx


pytestmark = needs_x64


A = jnp.array([[1.0, 0.2], [-0.1, 1.05]])
B = jnp.array([[0.02], [0.2]])
E = jnp.array([[0.1], [0.3]])
Q, R = jnp.diag(jnp.array([2.0, 1.0])), 0.5 * jnp.eye(1)
S = jnp.array([[0.1], [-0.2]])
DT = 0.2
DYNAMICS = dlx.LinearDynamics(A, B, E=E, dt=DT)
LQR, FiniteHorizonLQR, LQI = (
    dlx.controllers.LQR,
    dlx.controllers.FiniteHorizonLQR,
    dlx.controllers.LQI,
)


def wave(t):
    return jnp.stack([jnp.sin(t), 0.3 * jnp.cos(2 * t)])


def gust(t):
    return jnp.sin(0.7 * t)[None]


def _dense_minimum(x0, T, r, v_r, w, final):
    """All controls at once, by least squares: the terms' square roots, stacked."""
    A_, B_, E_, x0 = (np.asarray(M, float) for M in (A, B, E, x0))
    W = np.linalg.cholesky(np.block([[Q, S], [S.T, R]]).astype(float)).T
    F = np.linalg.cholesky(np.asarray(final, float)).T
    x_of = np.zeros((2, T))  # the state as a function of all controls
    x_free, rows, right = x0, [], []
    for k in range(T):
        u_of = np.zeros((1, T))
        u_of[0, k] = 1
        rows.append(W @ np.vstack([x_of, u_of]))
        right.append(W @ np.concatenate([r[k] - x_free, v_r[k]]))
        x_of = A_ @ x_of + B_ @ u_of
        x_free = A_ @ x_free + E_ @ w[k]
    rows.append(F @ x_of)
    right.append(F @ (r[T] - x_free))
    rows, right = np.vstack(rows), np.concatenate(right)
    controls = np.linalg.lstsq(rows, right, rcond=None)[0]
    return controls, np.sum((rows @ controls - right) ** 2)


@pytest.mark.parametrize("parallel", [False, True])
def test_finite_horizon_tracking_is_the_best_of_all_controls(key, parallel):
    T, x0 = 12, jnp.array([1.0, -0.5])
    push = lambda t: 0.2 * jnp.cos(t)[None]
    final = 3 * jnp.eye(2)
    controller = FiniteHorizonLQR(
        DYNAMICS,
        Q,
        R,
        S,
        final=final,
        horizon=T,
        reference=wave,
        control_reference=push,
        disturbance=gust,
        parallel=parallel,
    )
    times = DT * np.arange(T + 1)
    all_times = jax.jit(lambda t: [jax.vmap(f)(t) for f in (wave, push, gust)])
    r, v_r, w = (np.asarray(signal, float) for signal in all_times(times))
    controls, minimum = _dense_minimum(x0, T, r, v_r, w, final)
    env = dlx.Environment(DYNAMICS, dlx.costs.Quadratic(Q, R))
    w = jnp.asarray(w[:T], x0.dtype)
    run = dlx.rollout(env, controller, key=key, x0=x0, w=w, horizon=T)
    assert_close(run.controls[:, 0], controls, atol=1e-12)
    e, v = np.asarray(run.states) - r, np.asarray(run.controls) - v_r[:T]
    cost = np.einsum("ti,ij,tj", e[:T], Q, e[:T]) + np.einsum("ti,ij,tj", v, R, v)
    cost = cost + 2 * np.einsum("ti,ij,tj", e[:T], S, v) + 3 * np.sum(e[T] ** 2)
    assert_close(cost, minimum, rtol=1e-11)


def test_a_planned_trajectory_needs_no_feed_forward(key):
    env = dlx.make("pendulum", solver=dlx.dynamics.RK4(), max_torque=10.0)
    controls = jnp.sin(0.3 * jnp.arange(15.0))[:, None]
    states = dlx.open_loop(env.dynamics, jnp.array([0.5, 0.0]), controls)
    at = lambda t, x, u: dlx.linearize(env.dynamics, t, x, u)
    times = 0.05 * jnp.arange(15)
    parts = jax.jit(jax.vmap(at))(times, states[:-1], controls)
    varying = dlx.LinearDynamics(
        parts.A,
        parts.B,
        dt=0.05,
        x_ref=parts.x_ref,
        u_ref=parts.u_ref,
        x_next=parts.x_next,
    )
    controller = FiniteHorizonLQR(varying, jnp.eye(2), jnp.eye(1), final=jnp.eye(2))
    assert controller.K.shape == (15, 1, 2)
    assert_close(controller.k, np.zeros((15, 1)), atol=1e-13)
    run = dlx.rollout(env, controller, key=key, x0=states[0], horizon=15)
    assert_close(run.states, states, atol=1e-12)
    shorter = FiniteHorizonLQR(varying, jnp.eye(2), jnp.eye(1), horizon=4)
    assert_close(shorter.k, np.zeros((4, 1)), atol=1e-13)
    assert np.isnan(shorter(10.0, states[0], None)[0])


def test_a_long_finite_horizon_is_the_infinite_one():
    long = FiniteHorizonLQR(DYNAMICS, Q, R, S, horizon=150)
    steady = LQR(DYNAMICS, Q, R, S)
    assert_close(long.K[0], steady.K, rtol=1e-10)
    assert_close(long.P[0], steady.P, rtol=1e-10)


@pytest.mark.parametrize("preview", [0, 120])
def test_infinite_horizon_feed_forward(preview):
    """Constant signals need no preview; others as much as the loop remembers."""
    if preview:
        signals = dict(reference=wave, disturbance=gust)
    else:
        signals = dict(reference=jnp.array([1.0, 0.2]), disturbance=jnp.array([0.4]))
    options = dict(control_reference=jnp.array([0.3]), **signals)
    steady = LQR(DYNAMICS, Q, R, S, preview=preview, **options)
    long = FiniteHorizonLQR(DYNAMICS, Q, R, S, horizon=150, **options)
    for t in (0.0, 1.0):
        y = jnp.array([0.5, -1.0])
        found, expected = steady(t, y, None)[0], long(t, y, None)[0]
        assert_close(found, expected, rtol=1e-9)


def test_feed_forward_helps(key):
    env = dlx.Environment(
        DYNAMICS,
        dlx.costs.Quadratic(Q, R),
        disturbance=dlx.disturbances.Constant([1.0]),
        horizon=100,
    )
    blind = LQR(DYNAMICS, Q, R)
    told = LQR(DYNAMICS, Q, R, disturbance=jnp.array([1.0]))
    cost = lambda c: dlx.rollout(env, c, key=key).total_cost
    assert cost(told) < 0.8 * cost(blind)


def test_integral_action_removes_the_offset(key):
    output, target = jnp.array([[1.0, 0.0]]), jnp.array([0.7])
    weights = jnp.diag(jnp.array([1.0, 1.0, 2.0]))
    env = dlx.Environment(
        DYNAMICS,
        dlx.costs.Quadratic(Q, R),
        disturbance=dlx.disturbances.Constant([0.5]),
        horizon=200,
    )
    integral = LQI(DYNAMICS, weights, R, output=output, reference=target)
    plain = LQR(DYNAMICS, Q, R, reference=jnp.array([0.7, 0.0]))
    end = lambda c: dlx.rollout(env, c, key=key).final_state[0]
    assert_close(end(integral), 0.7, atol=1e-8)
    assert abs(end(plain) - 0.7) > 0.02
    # The gains are those of the augmented system.
    augmented = np.block([[A, np.zeros((2, 1))], [-DT * output, np.eye(1)]])
    held = np.vstack([B, np.zeros((1, 1))])
    args = (np.asarray(M, float) for M in (augmented, held, weights, R))
    assert_close(integral.P, scipy.linalg.solve_discrete_are(*args), rtol=1e-9)
    at_rest = LQI(DYNAMICS, weights, R, output=output)
    assert_close(at_rest(0.0, jnp.zeros(2), at_rest.init())[0], [0.0])


def test_integral_does_not_wind_up(key):
    weights = jnp.diag(jnp.array([1.0, 0.1, 5.0]))
    double = dlx.LinearDynamics([[1.0, 0.1], [0.0, 1.0]], [[0.0], [0.1]], dt=0.1)
    controller = LQI(
        double, weights, R, output=[[1.0, 0.0]], reference=jnp.array([10.0])
    )

    class Deaf(dlx.AbstractController):
        """The same, not told what was applied."""

        inside: LQI

        def init(self, *, key=None):
            return self.inside.init(key=key)

        def __call__(self, t, y, state):
            return self.inside(t, y, state)

    cost = dlx.costs.Quadratic(Q, R)
    env = dlx.Environment(double, cost, control_bounds=(-1.0, 1.0), horizon=300)
    heard = dlx.rollout(env, controller, key=key).states[:, 0]
    deaf = dlx.rollout(env, Deaf(controller), key=key).states[:, 0]
    assert abs(heard[-1] - 10.0) < 0.05
    assert jnp.max(heard) < 12.5 < 15.0 < jnp.max(deaf)


def test_hover_holds_a_quadrotor(key):
    def field(t, x, u, w):
        lift, roll = u[0] + u[1], 2.0 * (u[1] - u[0])
        return jnp.stack(
            [
                *x[3:],
                -lift * jnp.sin(x[2]),
                lift * jnp.cos(x[2]) - 9.81,
                roll,
            ]
        )

    names = ("x", "z", "angle", "vx", "vz", "rate")
    planar = dlx.system(field, states=names, controls=("left", "right"))
    dynamics = dlx.Discretized(planar, dt=0.05)
    hover = dlx.linearize(dynamics, 0.0, jnp.zeros(6), jnp.full(2, 9.81 / 2))
    controller = LQR(hover, jnp.eye(6), 0.1 * jnp.eye(2))
    env = dlx.Environment(dynamics, dlx.costs.Quadratic(jnp.eye(6), jnp.eye(2)))
    start = jnp.array([1.0, -1.0, 0.2, 0.0, 0.0, 0.0])
    run = dlx.rollout(env, controller, key=key, x0=start, horizon=400)
    assert_close(run.final_state, np.zeros(6), atol=1e-8)


STIFF = dlx.systems.LinearSystem(
    jnp.array([[0.0, 1.0, 0.0], [2.0, -0.3, 1.0], [0.0, 0.0, -30.0]]),
    jnp.array([[0.0], [0.5], [3.0]]),
)
Q3 = jnp.diag(jnp.array([1.0, 0.5, 0.2]))
S3 = jnp.array([[0.1], [0.0], [-0.1]])


def test_sampled_weights_are_the_integral():
    dt, n = 0.4, 3
    field = np.zeros((4, 4))
    field[:n, :n], field[:n, n:] = STIFF.A, STIFF.B
    charge = np.block([[Q3, S3], [S3.T, R]]).astype(float)

    def rate(t):
        flow = scipy.linalg.expm(field * t)
        return flow.T @ charge @ flow

    expected, _ = scipy.integrate.quad_vec(rate, 0, dt, epsabs=1e-14, epsrel=1e-13)
    Qd, Rd, Sd = dlx.controllers.sampled_weights(STIFF, Q3, R, dt, S3)
    found = jnp.block([[Qd, Sd], [Sd.T, Rd]])
    assert_close(found, expected, atol=1e-12)


def test_sampled_regulator_charges_the_continuous_cost():
    dt, x0 = 0.3, np.array([1.0, -0.4, 0.2])
    controller = dlx.controllers.lqrd(STIFF, Q3, R, dt, S3)
    field = np.block([[STIFF.A, STIFF.B], [np.zeros((1, 4))]])  # of x and a held u
    charge = np.block([[Q3, S3], [S3.T, R]])
    nodes, weights = np.polynomial.legendre.leggauss(30)
    flows = scipy.linalg.expm(dt * (nodes[:, None, None] + 1) / 2 * field)
    total, x, K = 0.0, x0, np.asarray(controller.K)
    for _ in range(100):
        start = np.concatenate([x, -K @ x])
        z = flows @ start
        total += dt / 2 * np.einsum("k,ki,ij,kj", weights, z, charge, z)
        x = (scipy.linalg.expm(dt * field) @ start)[:3]
    assert_close(total, x0 @ controller.P @ x0, rtol=1e-10)


def test_sampled_regulator_of_short_steps_is_the_continuous_one():
    controller = dlx.controllers.lqrd(STIFF, Q3, R, 1e-3)
    A_, B_ = np.asarray(STIFF.A, float), np.asarray(STIFF.B, float)
    X = scipy.linalg.solve_continuous_are(A_, B_, np.asarray(Q3), np.asarray(R))
    K = np.linalg.solve(np.asarray(R), B_.T @ X)
    assert_close(controller.K, K, rtol=0.02)
    pendulum = dlx.controllers.lqrd(dlx.systems.Pendulum(), Q, R, 0.05)
    near, far = jnp.array([0.1, 0.0]), jnp.array([0.1 + 2 * np.pi, 0.0])
    u = pendulum(0.0, near, None)[0]
    assert_close(pendulum(0.0, far, None)[0], u, atol=1e-4)


def test_gradients_of_designs():
    x0, T = jnp.array([1.0, 0.5]), 8

    def total(q):
        """A row for each design."""
        signal = lambda t: q[0, 2] * wave(t)
        weights = jnp.diag(q[0, :2]), R
        varying = FiniteHorizonLQR(DYNAMICS, *weights, horizon=T, reference=signal)
        sampled = dlx.controllers.lqrd(STIFF, jnp.diag(q[1]), R, q[1, 2])
        u = varying(2 * DT, x0, varying.init())[0]
        return jnp.sum(u**2) + jnp.sum(sampled.K**2)

    assert_gradient(total, np.tile([3.0, 0.5, 0.8], (2, 1)), rtol=1e-6)


def test_wrong_arguments():
    varying = dlx.LinearDynamics(jnp.stack([A, A]), B)
    with user_error(match="horizon must be given"):
        FiniteHorizonLQR(DYNAMICS, Q, R)
    with user_error(match="horizon must be at most the 2 steps of dynamics"):
        FiniteHorizonLQR(varying, Q, R, horizon=3)
    with user_error(match="reference must be a vector of size 2.*shape \\(1,\\)"):
        LQR(DYNAMICS, Q, R, reference=gust)
    with user_error(match="disturbance"):
        LQR(DYNAMICS, Q, R, disturbance=jnp.ones(2))
    with user_error(match="preview must be a whole number of at least 0"):
        LQR(DYNAMICS, Q, R, reference=wave, preview=-1)
    with user_error(match="preview must be 0 without a reference"):
        LQR(DYNAMICS, Q, R, preview=3)
    with user_error(match=r"output must have shape \(p, 2\) with p from 1 to 1"):
        LQI(DYNAMICS, jnp.eye(4), R, output=jnp.eye(2))
    with user_error(match=r"Q must have shape \(3, 3\)"):
        LQI(DYNAMICS, Q, R, output=jnp.eye(1, 2))
    with user_error(match="LQI: dynamics must be a LinearDynamics"):
        LQI(STIFF, Q, R, output=jnp.eye(1, 2))
    with user_error(match="lqrd: system must be an AbstractSystem.*LQR"):
        dlx.controllers.lqrd(DYNAMICS, Q, R, 0.1)
    with user_error(match="dt must be positive"):
        dlx.controllers.lqrd(STIFF, Q3, R, 0.0)
    with user_error(match=r"R must have shape \(1, 1\)"):
        dlx.controllers.sampled_weights(STIFF, Q3, jnp.eye(2), 0.1)
    with user_error(match="sampled_weights: system must be a LinearSystem"):
        dlx.controllers.sampled_weights(dlx.systems.Pendulum(), Q, R, 0.1)
