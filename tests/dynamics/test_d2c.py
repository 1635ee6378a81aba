import control
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    assert_close,
    check_first_order,
    check_second_order,
    needs_x64,
    user_error,
)
from scipy.linalg import logm

import delucax as dlx
from delucax.systems import LinearSystem


pytestmark = needs_x64


def random_system(seed, n=4):
    rng = np.random.default_rng(seed)
    return LinearSystem(
        rng.normal(size=(n, n)),
        rng.normal(size=(n, 2)),
        rng.normal(size=(3, n)),
        rng.normal(size=(n, 1)),
        x_ref=rng.normal(size=n),
        u_ref=rng.normal(size=2),
        dx_ref=rng.normal(size=n),
        state_names=tuple("abcdefghijkl"[:n]),
        control_names=("left", "right"),
    )


@pytest.mark.parametrize("method", ["zoh", "tustin"])
def test_round_trips(method):
    for seed in (0, 1):
        system = random_system(seed)
        sampled = dlx.c2d(system, 0.3, method)
        back = dlx.d2c(sampled, method)
        again = dlx.c2d(back, 0.3, method)
        assert back.state_names == system.state_names
        assert back.control_names == ("left", "right")
        close = 1e-10
        for one, two in ((system, back), (sampled, again)):
            leaves = zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True)
            for a, b in leaves:
                assert_close(a, b, rtol=close, atol=close)


def test_without_a_disturbance_matrix_there_is_none():
    system = LinearSystem(-jnp.eye(2), jnp.ones((2, 1)))
    for method in ("zoh", "tustin"):
        back = lambda s, how=method: dlx.d2c(dlx.c2d(s, 0.1, how), how)
        assert eqx.filter_eval_shape(back, system).E is None


def test_logarithm_is_scipys():
    rng = np.random.default_rng(2)
    stiff = np.diag([-30.0, -1.0, 0.0]) + np.triu(rng.normal(size=(3, 3)), 1)
    jordan = np.diag([1.0, 1.0, 1.0]) + np.diag([1.0, 1.0], 1)
    turning = np.array([[0, 1.0, 0], [-1.0, 0, 0], [0, 0, 0.1]])
    for A in (
        np.asarray(dlx.c2d(LinearSystem(stiff, np.eye(3)), 0.2).A),
        jordan,
        turning,
    ):
        found = dlx.d2c(dlx.LinearDynamics(A, np.eye(3), dt=0.2)).A
        expected = logm(np.asarray(A, np.float64)) / 0.2
        assert_close(found, expected, atol=1e-10)


def test_integrators_are_their_formula():
    A, B = jnp.array([[1.0, 0.1], [0.0, 1.0]]), jnp.array([[0.005], [0.1]])
    double = dlx.d2c(dlx.LinearDynamics(A, B, dt=0.1))
    close = 1e-13
    assert_close(double.A, [[0, 1], [0, 0]], atol=close)
    assert_close(double.B, [[0], [1]], atol=close)


@pytest.mark.parametrize("ours, theirs", [("zoh", "zoh"), ("tustin", "bilinear")])
def test_what_control_samples_comes_back(ours, theirs):
    system = random_system(3)
    D = np.zeros((3, 2))
    continuous = control.ss(system.A, system.B, system.C, D)
    sampled = control.c2d(continuous, 0.25, theirs)
    # SciPy's and python-control's trapezoidal rule moves C and D as well.
    back = dlx.d2c(dlx.LinearDynamics(sampled.A, sampled.B, dt=0.25), ours)
    assert_close(back.A, system.A, atol=1e-11)
    assert_close(back.B, system.B, atol=1e-11)


@needs_x64
def test_gradients_are_central_differences():
    A, step = jnp.array([[0.9, 0.3], [-0.4, 0.7]]), jnp.array([[0.2, -1.0], [0.5, 0.3]])
    weights = jnp.array([[1.0, -2.0, 0.5], [0.3, 1.5, -1.0]])

    def line(e):
        moved = dlx.LinearDynamics(A + e * step, jnp.ones((2, 1)), dt=0.5)
        system = dlx.d2c(moved)
        both = jnp.concatenate([system.A, system.B], axis=1)
        return jnp.sum(weights * both**2)

    check_first_order(line)


@needs_x64
def test_tustin_is_differentiable():
    A, step = jnp.array([[0.9, 0.3], [-0.4, 0.7]]), jnp.array([[0.2, -1.0], [0.5, 0.3]])

    def line(e):
        moved = A + e * step
        return jnp.sum(dlx.d2c(dlx.LinearDynamics(moved, moved), "tustin").B ** 2)

    check_second_order(line)


@jax.jit
def _compiled(A):
    return dlx.d2c(dlx.LinearDynamics(A, jnp.ones((2, 1)))).A


@pytest.mark.parametrize(
    "A, shown",
    [
        ([[-0.5, 0.0], [1.0, 0.3]], "got -0.5"),
        ([[0.0, 1.0], [0.0, 0.5]], "got 0"),
        ([[-1.0, 0.0], [0.0, 0.5]], "got -1"),
    ],
)
def test_no_real_system_has_these_samples(A, shown):
    A = jnp.array(A)
    with user_error(RuntimeError, match=f"zero or negative.*{shown}"):
        dlx.d2c(dlx.LinearDynamics(A, jnp.ones((2, 1))))
    with pytest.raises(Exception, match="eigenvalue that is zero or negative"):
        jax.block_until_ready(_compiled(A))


def test_the_trapezoidal_rule_gives_no_minus_one():
    dynamics = dlx.LinearDynamics(jnp.diag(jnp.array([-1.0, 0.5])), jnp.ones((2, 1)))
    with user_error(RuntimeError, match="eigenvalue -1, which .*, got -1"):
        dlx.d2c(dynamics, "tustin")


def test_the_trapezoidal_rule_fails_at_a_rounded_eigenvalue():
    T = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    A = T @ np.diag([40.0, -1.0, -2.0]) @ T.T
    system = dlx.systems.LinearSystem(A, np.ones((3, 1)))
    with user_error(RuntimeError, match="eigenvalue"):
        dlx.c2d(system, 0.05, "tustin")


def test_bad_arguments_of_d2c():
    A, B = jnp.eye(2), jnp.ones((2, 1))
    with user_error(match="d2c: dynamics must be a LinearDynamics"):
        dlx.d2c(LinearSystem(A, B))
    with user_error(match="time-invariant, got matrices at 2 times"):
        dlx.d2c(dlx.LinearDynamics(jnp.stack([A, A]), B))
    with user_error(match="'zoh' or 'tustin', got 'foh'"):
        dlx.d2c(dlx.LinearDynamics(A, B), "foh")
    with user_error(match="LinearSystem: state_names must have 2 names"):
        LinearSystem(A, B, state_names=("x",))
