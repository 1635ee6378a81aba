import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    assert_close,
    assert_gradient,
    needs_x64,
    tolerance,
    user_error,
)
from scipy.integrate import quad_vec
from scipy.linalg import expm, solve_continuous_lyapunov, solve_discrete_lyapunov

import delucax as dlx
from delucax.systems import LinearSystem


an = dlx.analysis
_RNG = np.random.default_rng(1)
A = _RNG.normal(size=(4, 4)) - 2.5 * np.eye(4)
B = _RNG.normal(size=(4, 2))
C = _RNG.normal(size=(3, 4))
A_STEP = A / 6


def test_infinite_gramians_are_scipys():
    system, dynamics = LinearSystem(A, B, C), dlx.LinearDynamics(A_STEP, B, C)
    close = tolerance(1e-5, 1e-13)
    expected = solve_continuous_lyapunov(A, -B @ B.T)
    assert_close(an.controllability_gramian(system), expected, atol=close)
    expected = solve_continuous_lyapunov(A.T, -C.T @ C)
    assert_close(an.observability_gramian(system), expected, atol=close)
    expected = solve_discrete_lyapunov(A_STEP, B @ B.T)
    assert_close(an.controllability_gramian(dynamics), expected, atol=10 * close)
    expected = solve_discrete_lyapunov(A_STEP.T, C.T @ C)
    assert_close(an.observability_gramian(dynamics), expected, atol=10 * close)


@pytest.mark.parametrize("horizon", [0.03, 2.0])
def test_gramian_over_a_time_is_a_fine_quadrature(horizon):
    unstable = A + 3 * np.eye(4)

    def integrand(t):
        moved = expm(unstable * t) @ B
        return moved @ moved.T

    expected = quad_vec(integrand, 0, horizon, epsabs=1e-13, epsrel=1e-13)[0]
    W = an.controllability_gramian(LinearSystem(unstable, B), horizon)
    scale = np.abs(expected).max()
    assert_close(W / scale, expected / scale, atol=tolerance(1e-5, 1e-12))


def test_gramian_over_a_long_time_is_that_over_all_time():
    stiff = LinearSystem(np.diag([-1.0, -1e3]), np.ones((2, 1)))
    both = an.controllability_gramian(stiff), an.controllability_gramian(stiff, 100.0)
    assert_close(*both, rtol=tolerance(1e-4, 1e-12))


@pytest.mark.parametrize("steps", [1, 2, 7, 20])
def test_gramian_of_steps_is_the_sum(steps):
    dynamics = dlx.LinearDynamics(A_STEP, B, C)
    powers = [np.linalg.matrix_power(A_STEP, k) for k in range(steps)]
    close = tolerance(1e-5, 1e-13)
    expected = sum(P @ B @ B.T @ P.T for P in powers)
    assert_close(an.controllability_gramian(dynamics, steps), expected, atol=close)
    expected = sum(P.T @ C.T @ C @ P for P in powers)
    assert_close(an.observability_gramian(dynamics, steps), expected, atol=close)


def test_disturbances_enter_through_E():
    E = np.ones((4, 1))
    dynamics = dlx.LinearDynamics(A_STEP, B, E=E)
    W = an.controllability_gramian(dynamics, inputs="disturbances")
    expected = solve_discrete_lyapunov(A_STEP, E @ E.T)
    assert_close(W, expected, rtol=tolerance(1e-4, 1e-12))
    plain = an.controllability_gramian(
        dlx.LinearDynamics(A_STEP, B), inputs="disturbances"
    )
    expected = solve_discrete_lyapunov(A_STEP, np.eye(4))
    assert_close(plain, expected, atol=tolerance(1e-5, 1e-12))


@needs_x64
@pytest.mark.parametrize(
    "make, horizon",
    [
        # Over all time `test_an_unstable_lane_harms_no_other` has it.
        (LinearSystem, 0.7),
        (dlx.LinearDynamics, None),
    ],
)
def test_gradients_are_central_differences(make, horizon):
    start = jnp.asarray((A if make is LinearSystem else A_STEP)[:2, :2])
    weight = jnp.array([[1.0, -2.0], [0.5, 3.0]])

    def loss(A):
        model = make(A.reshape(2, 2), jnp.asarray(B[:2]))
        return jnp.sum(weight * an.controllability_gramian(model, horizon))

    assert_gradient(loss, start.ravel(), rtol=1e-6, atol=1e-7)


def test_an_unstable_lane_harms_no_other():
    As = jnp.stack([jnp.array([[-1.0]]), jnp.array([[0.5]])])

    def gramian(A):
        system = LinearSystem(A, jnp.ones((1, 1)))
        return an.controllability_gramian(system, throw=False)[0, 0]

    value, slope = jax.vmap(jax.value_and_grad(gramian))(As)
    assert_close(value, [0.5, np.inf], rtol=1e-6)
    assert_close(slope[0], [[0.5]], rtol=1e-5)
    assert np.all(np.isfinite(slope))
    unstable = LinearSystem(As[1], jnp.ones((1, 1)))
    with user_error(RuntimeError, match="controllability_gramian: the model must"):
        an.controllability_gramian(unstable)
    with pytest.raises(Exception, match="observability_gramian: the model must"):
        jax.block_until_ready(
            jax.jit(lambda A: an.observability_gramian(LinearSystem(A, A)))(As[1])
        )


def test_bad_horizons():
    with user_error(match="horizon must be positive and finite, got 0"):
        an.controllability_gramian(LinearSystem(A, B), 0.0)
    with user_error(match="horizon must be a number, got shape"):
        an.controllability_gramian(LinearSystem(A, B), [1.0, 2.0])
    with user_error(match="horizon must be a whole number of at least 1, got 2.5"):
        an.observability_gramian(dlx.LinearDynamics(A_STEP, B), 2.5)
