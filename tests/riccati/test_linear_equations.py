import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from helpers import assert_close, needs_x64, tolerance, user_error

import delucax as dlx


rng = np.random.default_rng(0)
A, B = rng.normal(size=(6, 6)) / np.sqrt(6), rng.normal(size=(3, 3)) / np.sqrt(3)
Q, C = rng.normal(size=(6, 6)), rng.normal(size=(6, 3))
EYE = np.eye(6)
CLOSE = {"rtol": tolerance(1e-4, 1e-10), "atol": tolerance(1e-4, 1e-11)}


@pytest.mark.parametrize("moved", [-2, 2, 0], ids=["stable", "unstable", "both"])
def test_lyap(moved):
    matrix = A + moved * EYE
    solution = dlx.riccati.lyap(matrix, Q)
    X = scipy.linalg.solve_continuous_lyapunov(matrix, -Q)
    assert_close(solution.X, X, **CLOSE)
    assert solution.residual < tolerance(1e-5, 1e-13)


@pytest.mark.parametrize(
    "matrix",
    [0.7 * A, scipy.linalg.expm(A + 2 * EYE), 1.5 * A],
    ids=["stable", "unstable", "both"],
)
def test_dlyap(matrix):
    solution = dlx.riccati.dlyap(matrix, Q)
    X = scipy.linalg.solve_discrete_lyapunov(matrix, Q)
    assert_close(solution.X, X, **CLOSE)
    assert solution.residual < tolerance(1e-5, 1e-13)


@pytest.mark.parametrize("a, b", [(-2, -2), (-5, 2), (5, -2), (0, 0)])
def test_sylvester(a, b):
    left, right = A + a * EYE, B + b * np.eye(3)
    solution = dlx.riccati.sylvester(left, right, C)
    assert_close(solution.X, scipy.linalg.solve_sylvester(left, right, C), **CLOSE)


@pytest.mark.parametrize("a, b", [(-1, -1), (3, 3), (1, -1)])
def test_dsylvester(a, b):
    left, right = scipy.linalg.expm(A + a * EYE), scipy.linalg.expm(B + b * np.eye(3))
    solution = dlx.riccati.dsylvester(left, right, C)
    rest = left @ solution.X @ right - solution.X + C
    assert np.linalg.norm(rest) < tolerance(1e-4, 1e-10) * np.linalg.norm(C)


@needs_x64
def test_large_and_wide():
    rng = np.random.default_rng(1)
    n = 60
    basis = np.eye(n) + 0.3 * rng.normal(size=(n, n)) / np.sqrt(n)
    back = np.linalg.inv(basis)
    modes = -np.logspace(-4, 4, n)
    solution = dlx.riccati.lyap(basis @ np.diag(modes) @ back, np.eye(n))
    exact = basis @ (-(back @ back.T) / np.add.outer(modes, modes)) @ basis.T
    # SciPy has 1e-9 here.
    error = np.linalg.norm(solution.X - exact) / np.linalg.norm(exact)
    assert error < 1e-9 and solution.residual < 1e-13


def test_honest_where_it_cannot_be_done():
    solve = dlx.riccati.lyap
    singular = solve(np.diag([1.0, -1, 2, 3, 4, 5]), EYE, throw=False)
    assert singular.result == dlx.RESULTS.ill_posed
    both = np.diag([(-1.0) ** i * (i + 1) for i in range(60)])
    apart = solve(both, np.eye(60), throw=False)
    assert apart.result == dlx.RESULTS.not_separated
    with pytest.raises(RuntimeError, match="lyap: .*cannot be separated"):
        solve(both, np.eye(60))
    # Complex data are solved as real matrices of twice the size.
    for n, status in (8, "successful"), (9, "not_separated"):
        apart = solve(both[:n, :n] + 0j, np.eye(n), throw=False)
        assert apart.result == getattr(dlx.RESULTS, status)


def test_complex_data():
    turn = np.diag(np.exp(1j * np.arange(3)))
    stable, weight = A[:3, :3] - 2 * np.eye(3), Q[:3, :3]
    plain = scipy.linalg.solve_continuous_lyapunov(stable, -weight)
    turned = dlx.riccati.lyap(
        turn @ stable @ turn.conj(), turn @ weight @ turn.conj()
    ).X
    assert_close(turned, turn @ plain @ turn.conj(), atol=tolerance(1e-5, 1e-12))


def test_one_bad_member_harms_no_other():
    eye = np.eye(2)
    As = np.stack([-eye, np.diag([1.0, -1]), -2 * eye, np.full((2, 2), np.nan)])

    @jax.jit
    @functools.partial(jax.value_and_grad, has_aux=True)
    def total(Q):
        def value(A):
            solution = dlx.riccati.lyap(A, Q, throw=False)
            good = solution.result == dlx.RESULTS.successful
            ill_posed = solution.result == dlx.RESULTS.ill_posed
            return jnp.where(good, jnp.sum(solution.X), 0), (good, ill_posed)

        values, which = jax.vmap(value)(As)
        return jnp.sum(values), which

    (value, (good, ill_posed)), gradient = total(eye)
    np.testing.assert_array_equal(good, [True, False, True, False])
    np.testing.assert_array_equal(ill_posed, [False, True, False, True])
    assert_close(value, 2 * (1 / 2 + 1 / 4), rtol=1e-6)
    assert_close(gradient, np.full((2, 2), 3 / 4), rtol=1e-6)


@pytest.mark.parametrize(
    "call, match",
    [
        (lambda: dlx.riccati.lyap(C, Q), r"lyap: A must be square, got shape \(6, 3\)"),
        (lambda: dlx.riccati.lyap(A, C), r"lyap: Q must have shape \(6, 6\)"),
        (lambda: dlx.riccati.dlyap(A * np.nan, Q), "dlyap: A must be finite"),
        (lambda: dlx.riccati.sylvester(A, B, Q), r"sylvester: C must have .*\(6, 3\)"),
        (lambda: dlx.riccati.dsylvester(A, C, C), "dsylvester: B must be square"),
    ],
)
def test_wrong_arguments(call, match):
    with user_error(match=match):
        call()
