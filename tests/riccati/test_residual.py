"""What the solvers say is left of an equation, against 60 digits."""

import functools

import hypothesis
import hypothesis.strategies as st
import jax
import numpy as np
import pytest
import riccati_systems
from helpers import dtype, once

import delucax as dlx
from delucax._host import host_unless_traced
from delucax.riccati._arguments import RiccatiData
from delucax.riccati._residual import linear_residual, riccati_residual


N, M = 3, 2


@functools.cache
def measured(discrete):
    return jax.jit(by_numpy(discrete, True))


def by_numpy(discrete, descriptor):
    @host_unless_traced
    def bound(accurately, A, B, Q, R, S, E, X):
        E = E if descriptor else None
        data = RiccatiData(A, B, Q, R, S, E)
        return riccati_residual(discrete, data, X, accurately).bounds[0]

    return bound


def problem(seed, spread):
    """Data and a solution of entries and of scales that differ."""
    rng = np.random.default_rng(seed)
    scale = lambda *shape: 10.0 ** rng.uniform(-spread, spread, shape)  # noqa: E731
    draw = lambda *shape: rng.normal(size=shape) * scale(*shape)  # noqa: E731
    B, S, E = draw(N, M), draw(N, M), np.eye(N) + rng.normal(size=(N, N)) / 4
    X, Q, R = (H @ H.T for H in (draw(N, N), draw(N, N), rng.normal(size=(M, M))))
    R = R + np.diag(scale(M))
    kind = dtype()
    return tuple(np.asarray(Y, kind) for Y in (draw(N, N), B, Q, R, S, E, X))


@pytest.mark.parametrize("discrete", [False, True])
@hypothesis.settings(max_examples=25, deadline=None, derandomize=True)
@hypothesis.given(seed=st.integers(0, 2**32 - 1), spread=st.floats(0, 3))
def test_it_bounds_the_true_one(discrete, seed, spread):
    """Compiled, and by NumPy."""
    A, B, Q, R, S, E, X = problem(seed, spread)
    said = [
        float(way(accurately, A, B, Q, R, S, E, X))
        for way in (measured(discrete), by_numpy(discrete, True))
        for accurately in (False, True)
    ]
    true = riccati_systems.true_residual(discrete, A, B, Q, R, X, S, E)
    assert true <= min(said)


@pytest.mark.parametrize("discrete", [False, True])
@hypothesis.settings(max_examples=25, deadline=None, derandomize=True)
@hypothesis.given(seed=st.integers(0, 2**32 - 1))
def test_it_is_close_near_a_solution(discrete, seed):
    """Where all but rounding cancels; the condition is moderate."""
    A, B, Q, R, S, _, _ = problem(seed, 0.3)
    name = "dare" if discrete else "care"
    X = getattr(dlx.riccati, name)(A, B, Q, R, throw=False).X
    if not np.all(np.isfinite(X)):
        return
    data = A, B, Q, R, 0 * S, np.eye(N, dtype=A.dtype), X
    of = by_numpy(discrete, False)
    wide, said = (float(of(np.array(flag), *data)) for flag in (False, True))
    true = riccati_systems.true_residual(discrete, A, B, Q, R, X)
    eps = np.finfo(A.dtype).eps
    assert true <= said <= 2 * true + 0.1 * eps
    assert true <= wide


@pytest.mark.parametrize("discrete", [False, True])
@hypothesis.settings(max_examples=25, deadline=None, derandomize=True)
@hypothesis.given(seed=st.integers(0, 2**32 - 1), spread=st.floats(0, 3))
def test_linear_equations(discrete, seed, spread):
    A, B, *_ = problem(seed, spread)
    rng = np.random.default_rng(seed)
    B, X = (np.asarray(rng.normal(size=s), A.dtype) for s in ((M, M), (N, M)))
    C = X - A @ X @ B if discrete else A @ X + X @ B
    said = float(linear(discrete)(A, B, C, X))
    true = riccati_systems.true_linear_residual(discrete, A, B, C, X)
    assert true <= said <= true + 10 * np.finfo(A.dtype).eps


@functools.cache
def linear(discrete):
    return jax.jit(functools.partial(linear_residual, discrete))


@pytest.mark.parametrize("name", ["hinf_care", "hinf_dare"])
def test_games(name):
    rng = np.random.default_rng(0)
    kind = dtype()
    solve = getattr(dlx.riccati, name)
    for _ in range(4):
        A = rng.normal(size=(N, N)) / 2
        data = A, rng.normal(size=(N, M)), np.eye(N), np.eye(N), np.eye(M)
        A, B, D, Q, R = (np.asarray(Y, kind) for Y in data)
        solution = solve(A, B, D, Q, R, gamma=20.0, throw=False)
        weight = np.diag([*np.diag(R), *np.full(N, -400.0, kind)])
        true = riccati_systems.true_residual(
            name == "hinf_dare", A, np.hstack([B, D]), Q, weight, solution.X, players=N
        )
        assert solution.result == dlx.RESULTS.successful
        # A bound in working precision, no closer than the worst rounding.
        assert true <= solution.residual <= 1000 * max(true, np.finfo(kind).eps)


def systems():
    """The published ones of few states in single precision, where a bound is hard.
    `test_carex.py` and `test_darex.py` have them in double precision."""
    for name, *data in riccati_systems.carex() + riccati_systems.darex():
        if len(data[0]) > 12 or any(map(np.iscomplexobj, data)):
            continue
        yield pytest.param(
            name.startswith(("DAREX", "user")),
            *(np.asarray(Y, np.float32) for Y in data),
            id=name.replace(" ", "-"),
        )


@once
@pytest.mark.parametrize("discrete, A, B, Q, R", list(systems()))
def test_published_systems(discrete, A, B, Q, R):
    solve = dlx.riccati.dare if discrete else dlx.riccati.care
    solution = solve(A, B, Q, R, throw=False)
    if solution.result != dlx.RESULTS.successful:
        return
    true = riccati_systems.true_residual(discrete, A, B, Q, R, solution.X)
    assert true <= solution.residual
