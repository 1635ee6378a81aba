import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
from helpers import (
    assert_close,
    check_first_order,
    check_second_order,
    needs_x64,
    user_error,
)

import delucax as dlx


pytestmark = needs_x64


A = np.array([[1.0, 1.0], [0.0, 1.0]])
B = np.array([[0.0], [1.0]])
Q, R = np.eye(2), np.eye(1)
TIMES = np.array([0.0, 0.7, 1.0])


def random_stages(seed, T, n, m):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(T, n + m, n + m))
    weight = root @ np.swapaxes(root, 1, 2) / n
    stage = dict(
        A=1.2 * rng.normal(size=(T, n, n)) / np.sqrt(n),
        B=rng.normal(size=(T, n, m)),
        Q=weight[:, :n, :n],
        R=weight[:, n:, n:],
        S=weight[:, :n, n:],
    )
    affine = dict(
        d=rng.normal(size=(T, n)), q=rng.normal(size=(T, n)), r=rng.normal(size=(T, m))
    )
    end = dict(final=np.eye(n), final_q=rng.normal(size=n))
    return stage | affine | end


def best_controls(stages, x0):
    """The minimum as one dense quadratic program of all controls at once."""
    A, B, d = stages["A"], stages["B"], stages["d"]
    T, n, m = B.shape
    # x_t = free[t] + forced[t] u, with u all controls in a row.
    free, forced = [x0], [np.zeros((n, T * m))]
    for t in range(T):
        free.append(A[t] @ free[-1] + d[t])
        following = A[t] @ forced[-1]
        following[:, t * m : (t + 1) * m] += B[t]
        forced.append(following)
    H, g, constant = np.zeros((T * m, T * m)), np.zeros(T * m), 0.0
    for t in range(T + 1):
        here, x = forced[t], free[t]
        last = t == T
        Q, q = (
            (stages["final"], stages["final_q"])
            if last
            else (stages["Q"][t], stages["q"][t])
        )
        H += here.T @ Q @ here
        g += here.T @ (Q @ x + q)
        constant += x @ Q @ x + 2 * q @ x
        if not last:
            pick = np.zeros((m, T * m))
            pick[:, t * m : (t + 1) * m] = np.eye(m)
            cross = here.T @ stages["S"][t] @ pick
            H += pick.T @ stages["R"][t] @ pick + cross + cross.T
            g += pick.T @ (stages["S"][t].T @ x + stages["r"][t])
    u = -np.linalg.solve(H, g)
    return u.reshape(T, m), constant + g @ u


@pytest.mark.parametrize("parallel", [False, True])
def test_is_the_minimum_over_all_controls(parallel):
    stages = random_stages(7, 7, 3, 2)
    x0 = np.array([1.0, -2.0, 0.5])
    controls, cost = best_controls(stages, x0)
    solution = dlx.riccati.dre(**stages, parallel=parallel)
    assert solution.result == dlx.RESULTS.successful
    x, K, k = x0, np.asarray(solution.K), np.asarray(solution.k)
    for t in range(7):
        u = -K[t] @ x - k[t]
        assert_close(u, controls[t], atol=1e-10)
        x = stages["A"][t] @ x + stages["B"][t] @ u + stages["d"][t]
    to_go = x0 @ solution.X[0] @ x0 + 2 * solution.p[0] @ x0 + solution.s[0]
    assert_close(to_go, cost, rtol=1e-11)
    loops = stages["A"] - stages["B"] @ K
    assert_close(solution.closed_loop, loops, atol=1e-12)


def free_controls(stages):
    return stages | dict(R=0 * stages["R"], S=0 * stages["S"])


@pytest.mark.parametrize("T, n, m", [(1, 2, 1), (7, 3, 2), (9, 6, 6)])
def test_in_parallel_as_in_sequence(T, n, m):
    problem = random_stages(T, T, n, m)
    for stages in [problem, free_controls(problem)] if n == m else [problem]:
        one = dlx.riccati.dre(**stages)
        other = dlx.riccati.dre(**stages, parallel=True)
        for name in ("X", "K", "k", "p", "s", "closed_loop"):
            a, b = np.asarray(getattr(one, name)), np.asarray(getattr(other, name))
            assert np.max(np.abs(a - b)) < 1e-10 * np.max(np.abs(a)), name


def sequential_stages(jaxpr):
    """The longest chain of equations, one after the other, with loops written out."""
    depth = {}

    def of(variables):
        known = (v for v in variables if not hasattr(v, "val"))
        return max((depth.get(v, 0) for v in known), default=0)

    for equation in jaxpr.eqns:
        inner, times = 1, 1
        for value in equation.params.values():
            for sub in value if isinstance(value, tuple | list) else [value]:
                sub = getattr(sub, "jaxpr", sub)
                if hasattr(sub, "eqns"):
                    inner = max(inner, sequential_stages(sub))
        if equation.primitive.name == "scan":
            times = equation.params["length"]
        assert equation.primitive.name != "while"
        after = of(equation.invars) + inner * times
        for variable in equation.outvars:
            depth[variable] = after
    return of(jaxpr.outvars)


def test_depth_is_logarithmic():
    def depth(T, parallel):
        solve = lambda A, d: dlx.riccati.dre(
            A, B, Q, R, d=d, horizon=T, parallel=parallel, throw=False
        )
        solve = lambda A, d, solve=solve: solve(A, d).k
        return sequential_stages(jax.make_jaxpr(solve)(A, jnp.ones(2)).jaxpr)

    depths = [depth(T, True) for T in (16, 64, 256)]
    # Twice as many steps add the same each time, and little of it.
    assert abs((depths[2] - depths[1]) - (depths[1] - depths[0])) < 0.2 * depths[0]
    assert depths[2] < 2 * depths[0]
    assert depth(256, False) > 10 * depth(16, False)


def test_long_horizon_is_the_stationary_solution():
    stationary = dlx.riccati.dare(A, B, Q, R)
    solution = dlx.riccati.dre(A, B, Q, R, horizon=60)
    assert_close(solution.X[0], stationary.X, rtol=1e-12)
    assert_close(solution.K[0], stationary.K, rtol=1e-12)
    assert_close(solution.X[-1], np.zeros((2, 2)))
    assert_close(solution.p, np.zeros((61, 2)))


def test_tracks_a_reference():
    # A reference that the dynamics can follow at no cost is followed, given time.
    ramp = np.stack([np.arange(41.0), np.ones(41)], axis=1)
    final = 10 * np.eye(2)
    solution = dlx.riccati.dre(
        A, B, Q, R, q=-ramp[:-1] @ Q, final=final, final_q=-final @ ramp[-1]
    )
    x, K, k = ramp[0], np.asarray(solution.K), np.asarray(solution.k)
    for t in range(40):
        assert_close(x, ramp[t], atol=1e-10)
        x = A @ x + B @ (-K[t] @ x - k[t])


@pytest.mark.parametrize("parallel", [False, True])
def test_no_minimum(parallel):
    # R + B'XB is negative from the third step back on: 1 - 2, and 1 and 1 before it.
    weights = np.array([1.0, 1.0, -2.0, 1.0, 1.0]).reshape(5, 1, 1)
    scalar = np.ones((1, 1))
    options = dict(final=scalar, parallel=parallel)
    solve = lambda R, **more: dlx.riccati.dre(
        scalar, scalar, 0 * scalar, R, **options, **more
    )
    solution = solve(weights, throw=False)
    assert solution.result == dlx.RESULTS.infeasible
    assert np.all(np.isnan(solution.X[:3])) and np.all(np.isnan(solution.K[:3]))
    assert_close(solution.X[3:, 0, 0], [1 / 3, 1 / 2, 1.0], rtol=1e-6)
    assert_close(solution.K[3:, 0, 0], [1 / 3, 1 / 2], rtol=1e-6)
    with pytest.raises(RuntimeError, match="dre: .*not positive definite at step 2"):
        solve(weights)
    if not parallel:
        with pytest.raises(eqx.EquinoxRuntimeError):
            eqx.filter_jit(solve)(jnp.asarray(weights))
    # With nothing to move the control by, any control is as good.
    nothing = dlx.riccati.dre(
        scalar, 0 * scalar, scalar, 0 * weights, parallel=parallel, throw=False
    )
    assert nothing.result == dlx.RESULTS.infeasible


@pytest.mark.parametrize("parallel", [False, True])
def test_one_bad_member_harms_no_other(parallel):
    def total(R):
        solution = dlx.riccati.dre(
            A, B, Q, R, final=Q, horizon=2, parallel=parallel, throw=False
        )
        good = solution.result == dlx.RESULTS.successful
        return jnp.where(good, jnp.sum(solution.X[0]) + jnp.sum(solution.K), 0.0), good

    @jax.jit
    def gradients(Rs):
        (_, good), gradient = jax.vmap(jax.value_and_grad(total, has_aux=True))(Rs)
        return good, gradient

    good, gradient = gradients(np.array([1.0, -1.0, 2.0]).reshape(3, 1, 1))
    np.testing.assert_array_equal(good, [True, False, True])
    beside, expected = gradients(np.array([1.0, 3.0, 2.0]).reshape(3, 1, 1))
    assert np.all(beside) and np.all(expected != 0)
    assert_close(gradient[::2], expected[::2], rtol=1e-12)
    assert gradient[1] == 0


@pytest.mark.parametrize("parallel", [False, True])
def test_derivatives_of_the_recursion(parallel):
    stages = random_stages(3, 2, 2, 1)
    rng = np.random.default_rng(0)
    direction = {k: rng.normal(size=v.shape) for k, v in stages.items()}

    def line(e):
        moved = {name: stages[name] + e * direction[name] for name in stages}
        for name in ("Q", "R", "final"):
            moved[name] = (moved[name] + moved[name].swapaxes(-1, -2)) / 2
        solution = dlx.riccati.dre(**moved, parallel=parallel, throw=False)
        parts = solution.X, solution.K, solution.k, solution.p, solution.s
        return sum(jnp.sum(jnp.sin(part)) for part in parts)

    check = check_first_order if parallel else check_second_order
    assert_close(check(line), line(0.1), rtol=1e-11)


def test_differential_equation():
    rng = np.random.default_rng(0)
    n, m = 2, 2
    root = rng.normal(size=(n + m, n + m))
    weight = root @ root.T
    A, B = rng.normal(size=(n, n)), rng.normal(size=(n, m))
    Q, R, S = weight[:n, :n], weight[n:, n:], weight[:n, n:]
    times = np.array([0.0, 0.1, 0.5, 1.5])

    def field(t, x):
        X = x.reshape(n, n)
        cross = X @ B + S
        rate = A.T @ X + X @ A - cross @ np.linalg.solve(R, cross.T) + Q
        return -rate.ravel()

    options = dict(method="DOP853", rtol=1e-12, atol=1e-12, t_eval=times[::-1])
    run = scipy.integrate.solve_ivp(field, (1.5, 0.0), np.eye(n).ravel(), **options)
    expected = run.y.T[::-1].reshape(-1, n, n)
    solution = dlx.riccati.cre(A, B, Q, R, S, times=times, final=np.eye(n))
    assert_close(solution.X, expected, atol=1e-9)
    gains = np.linalg.solve(R, np.swapaxes(expected @ B + S, 1, 2))
    assert_close(solution.K, gains, atol=1e-9)
    assert_close(solution.closed_loop, A - B @ gains, atol=1e-9)
    # However long the interval, it ends at the stationary solution.
    X = scipy.linalg.solve_continuous_are(A, B, Q, R, s=S)
    for T in (1e2, 1e6):
        long = dlx.riccati.cre(A, B, Q, R, S, times=[-T, -0.5, -0.1, 0.0])
        assert_close(long.X[0], X, rtol=1e-11)


def test_stiff_differential_equation():
    # Rates of 1e5 and 1 over a time of 3, where an exponential would overflow.
    rates = np.array([1e5, 1.0])
    solution = dlx.riccati.cre(np.diag(rates), Q, Q, Q, times=[0.0, 3.0])
    assert_close(solution.X[0, 0, 0], 1e5 + np.sqrt(1e10 + 1), rtol=1e-12)
    # dX/ds = 2aX - X^2 + 1 in closed form.
    a = 1.0
    w = np.hypot(a, 1)
    exact = np.tanh(3 * w) / (w - a * np.tanh(3 * w))
    assert_close(solution.X[0, 1, 1], exact, rtol=1e-12)


def test_escape_in_finite_time():
    # dX/ds = X^2 (-1) - 1 from 0 is -tan s, which is beyond its pole at 2 and at 10:
    # there, the first interval goes past two poles.
    solve = lambda T, **more: dlx.riccati.cre(
        0 * Q, Q, -Q, Q, times=np.linspace(0.0, T, 4), **more
    )
    assert_close(solve(1.5).X[0], -np.tan(1.5) * Q, rtol=1e-10)
    for T in (2.0, 10.0):
        solution = solve(T, throw=False)
        assert solution.result == dlx.RESULTS.infeasible
        assert np.all(np.isnan(solution.X[0])) and np.all(np.isfinite(solution.X[-1]))
    with pytest.raises(RuntimeError, match="cre: .*no solution over the time"):
        solve(2.0)
    bad = dlx.riccati.cre(A, Q, Q, -Q, times=np.linspace(0.0, 1.0, 4), throw=False)
    assert bad.result == dlx.RESULTS.infeasible


def test_derivatives_of_the_differential_equation():
    arguments = (A, B, Q, R, np.array([[0.1], [-0.2]]), Q)
    rng = np.random.default_rng(0)
    direction = [rng.normal(size=M.shape) for M in arguments]

    def line(e):
        A, B, Q, R, S, final = (
            M + e * D for M, D in zip(arguments, direction, strict=True)
        )
        Q, final = (Q + Q.T) / 2, (final + final.T) / 2
        options = dict(final=final, times=TIMES[:2], throw=False)
        solution = dlx.riccati.cre(A, B, Q, R, S, **options)
        return jnp.sum(jnp.sin(solution.X)) + jnp.sum(jnp.sin(solution.K))

    assert_close(check_first_order(line), line(0.1), rtol=1e-11)


@pytest.mark.parametrize(
    "change, match",
    [
        ({"A": np.ones((2, 3))}, r"A must have shape \(2, 2\).*got \(2, 3\)"),
        ({"B": np.ones(2)}, r"B must have shape \(n, m\).*got shape \(2,\)"),
        ({"Q": np.array([[1.0, 1.0], [0.0, 1.0]])}, "Q must be symmetric"),
        ({"Q": np.ones((4, 2, 2)) * [[1, 1], [0, 1]]}, "Q must be symmetric"),
        ({"R": np.eye(2)}, r"R must have shape \(1, 1\).*got \(2, 2\)"),
        ({"d": np.array([np.nan, 0])}, "d must be finite"),
        ({"final": np.eye(3)}, r"final must have shape \(2, 2\)"),
        ({"final_q": np.ones(3)}, r"final_q must have shape \(2,\)"),
        ({"final_q": np.array([np.nan, 0])}, "final_q must be finite"),
        ({"horizon": None}, "horizon must be given"),
        ({"horizon": 0}, "horizon must be a whole number"),
        ({"q": np.ones((3, 2))}, r"length of the time axis of q \(3\), got 4"),
        ({"q": np.ones((4, 2)), "d": np.ones((3, 2))}, "must have the same length"),
    ],
)
def test_wrong_arguments_of_the_recursion(change, match):
    given = {"A": A, "B": B, "Q": Q, "R": R, "horizon": 4}
    with user_error(match=match):
        dlx.riccati.dre(**(given | change))


@pytest.mark.parametrize(
    "change, match",
    [
        ({"B": np.ones((3, 1))}, r"B must have shape \(2, 1\).*got \(3, 1\)"),
        ({"S": np.ones((1, 2))}, r"S must have shape \(2, 1\).*got \(1, 2\)"),
        ({"times": 1.0}, "times must be at least two numbers"),
        ({"times": [0.0, 0.0]}, "times must increase"),
        ({"final": np.eye(3)}, r"final must have shape \(2, 2\)"),
    ],
)
def test_wrong_arguments_of_the_differential_equation(change, match):
    given = {"A": A, "B": B, "Q": Q, "R": R, "times": TIMES}
    with user_error(match=match):
        dlx.riccati.cre(**(given | change))
