"""Random dense programs: each has the right status and a certificate that holds."""

import functools

import jax
import numpy as np
import pytest
from helpers import assert_close, dtype, needs_x64, tolerance

import delucax as dlx


N, E, P = 6, 2, 9
COUNT = 27


@functools.cache
def solver():
    """One program for all, which returns failures too."""

    def run(P, q, E, b, G, lower, upper):
        rows = dlx.qp.Rows(G, lower=lower, upper=upper)
        problem = dlx.qp.Dense(P, q, equalities=(E, b), rows=rows)
        return dlx.qp.solve(problem, throw=False)

    return jax.jit(run)


def program(seed, kind):
    """Data of a program whose status is known from how it is made."""
    rng = np.random.default_rng(seed)
    scale = 10.0 ** rng.uniform(-1, 1, N)
    C = rng.standard_normal((rng.integers(0, N + 1), N)) * scale
    A, G = (rng.standard_normal((k, N)) * scale for k in (E, P))
    q = rng.standard_normal(N) * scale
    x = rng.standard_normal(N) / scale
    b, upper = A @ x, G @ x + rng.exponential(size=P)
    lower = np.where(rng.random(P) < 0.3, G @ x - rng.exponential(size=P), -np.inf)
    if kind == "feasible":
        # Dual feasible, so that the cost is bounded.
        z = rng.exponential(size=P)
        q = -(C.T @ (C @ x) + A.T @ rng.standard_normal(E) + G.T @ z)
    if kind == "infeasible":
        # The first row is minus a combination of the others, by which it cannot hold.
        y, z = rng.standard_normal(E), rng.exponential(size=P)
        G[0] = -(G[1:].T @ z[1:] + A.T @ y) / z[0]
        lower = np.full(P, -np.inf)
        upper[0] = -(upper[1:] @ z[1:] + b @ y) / z[0] - rng.uniform(0.1, 1)
    if kind == "unbounded":
        d = rng.standard_normal(N) / scale
        A, C = (M - np.outer(M @ d, d) / (d @ d) for M in (A, C))
        out = np.maximum(G @ d, 0) + 0.1
        G = G - np.outer(out, d) / (d @ d)
        b, upper, lower = A @ x, G @ x + 1, np.full(P, -np.inf)
        q = q - d * (q @ d + 1) / (d @ d)
    hessian = C.T @ C
    data = hessian, q, A, b, G, lower, upper
    return [np.asarray(a, dtype()) for a in data]


@pytest.mark.parametrize("seed", range(COUNT))
def test_a_solution_meets_the_conditions(seed):
    data = program(seed, "feasible")
    H, q, A, b, G, lower, upper = data
    s = solver()(*data)
    assert s.result == dlx.RESULTS.successful
    low, high = map(np.asarray, s.multipliers.rows)
    x, y = np.asarray(s.x), np.asarray(s.multipliers.equalities)
    close = tolerance(1e-3, 1e-7)
    size = 1 + np.abs(H @ x).max() + np.abs(q).max()
    pulled = A.T @ y + G.T @ (high - low)
    assert np.abs(H @ x + q + pulled).max() < close * (size + np.abs(pulled).max())
    row = G @ x
    assert_close(A @ x, b, atol=close * (1 + np.abs(b).max()))
    rounding = close * (1 + np.abs(row).max())
    assert np.all(row <= upper + rounding) and np.all(row >= lower - rounding)
    assert np.all(low >= 0) and np.all(high >= 0)
    slack = np.where(np.isfinite(lower), row - lower, 0)
    assert np.abs(low * slack).max() < 10 * close * (1 + np.abs(s.cost) + np.abs(q @ x))


@pytest.mark.parametrize("seed", range(COUNT))
def test_an_infeasible_program_has_a_certificate(seed):
    data = program(seed, "infeasible")
    _, _, A, b, G, _, upper = data
    s = solver()(*data)
    assert s.result == dlx.RESULTS.no_feasible_point
    low, high = map(np.asarray, s.multipliers.rows)
    y = np.asarray(s.multipliers.equalities)
    assert np.all(high >= 0) and np.all(low == 0)
    assert_close(b @ y + upper @ high, -1, atol=tolerance(1e-3, 1e-8))
    pulled = np.abs(A.T) @ np.abs(y) + np.abs(G.T) @ high
    left = np.abs(A.T @ y + G.T @ high)
    assert left.max() < tolerance(1e-3, 1e-7) * max(pulled.max(), 1)
    assert np.all(np.isnan(s.x)) and np.isposinf(s.cost)


@pytest.mark.parametrize("seed", range(COUNT))
def test_an_unbounded_program_has_a_direction(seed):
    data = program(seed, "unbounded")
    H, q, A, _, G, _, _ = data
    s = solver()(*data)
    assert s.result == dlx.RESULTS.unbounded
    d = np.asarray(s.x)
    close = tolerance(1e-3, 1e-7) * max(np.abs(d).max(), 1)
    assert_close(q @ d, -1, atol=tolerance(1e-3, 1e-8))
    size = 1 + max(np.abs(M).max(initial=0) for M in (H, A, G))
    assert np.abs(H @ d).max() < close * size and np.abs(A @ d).max() < close * size
    assert (G @ d).max() < close * size
    assert np.isneginf(s.cost)


@needs_x64
def test_a_hair_of_infeasibility_is_not_reported():
    """What violates the bounds by less than the tolerance has a solution."""
    rows = dlx.qp.Rows(np.array([[1.0], [-1.0]]), upper=np.array([0.0, -1e-12]))
    s = dlx.qp.solve(dlx.qp.Dense(np.eye(1), np.zeros(1), rows=rows), throw=False)
    assert s.result == dlx.RESULTS.successful


def test_a_hessian_that_is_not_convex_has_a_status_under_a_trace():
    data = program(0, "feasible")
    s = solver()(-data[0] - np.eye(N, dtype=dtype()), *data[1:])
    assert s.result == dlx.RESULTS.ill_posed
    s = solver()(data[0], np.nan * data[1], *data[2:])
    assert s.result == dlx.RESULTS.ill_posed


def test_a_bound_without_weights_is_no_bound():
    """The rows that are left are hard."""
    H, q, *_, G, lower, upper = program(1, "feasible")
    eye, free = np.eye(N, dtype=dtype()), np.arange(P) < 4
    weights = np.where(free, 0, np.inf).astype(dtype())
    soft = dlx.qp.Rows(G, lower=lower, upper=upper, linear=weights)
    rest = dlx.qp.Rows(G[~free], lower=lower[~free], upper=upper[~free])
    programs = (dlx.qp.Dense(H + eye, q, rows=rows) for rows in (soft, rest))
    found, expected = (dlx.qp.solve(program, throw=False) for program in programs)
    assert found.result == expected.result == dlx.RESULTS.successful
    assert_close(found.x, expected.x, atol=tolerance(1e-3, 1e-7))


@pytest.mark.parametrize("far", [1e6, 1e10])
def test_a_far_bound_does_not_excuse_another(far):
    box = np.array([0.0, -far], dtype()), np.array([1.0, far], dtype())
    q = np.array([-50.0, 0.0], dtype())
    s = dlx.qp.solve(dlx.qp.Dense(np.eye(2, dtype=dtype()), q, bounds=box))
    assert s.result == dlx.RESULTS.successful
    assert_close(s.x, [1.0, 0.0], atol=tolerance(1e-3, 1e-6))
