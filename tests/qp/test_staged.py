"""Programs in stages are the same programs without stages."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, dtype, needs_x64, once, tolerance

import delucax as dlx


N, M, T = 3, 2, 6


def data(seed=0):
    """A program that varies in time, with a bit of everything."""
    rng = np.random.default_rng(seed)
    draw = lambda *shape: rng.standard_normal(shape).astype(dtype())
    A = np.eye(N, dtype=dtype()) + 0.3 * draw(T, N, N)
    root = draw(T, N + M, N + M)
    H = root @ np.swapaxes(root, 1, 2) / 4
    return dict(
        A=A,
        B=draw(T, N, M),
        Q=H[:, :N, :N],
        S=H[:, :N, N:],
        R=H[:, N:, N:],
        d=0.3 * draw(T, N),
        q=draw(T, N),
        r=draw(T, M),
        final=np.eye(N, dtype=dtype()),
        final_q=draw(N),
        start=draw(N),
        C=draw(2, N),
        D=draw(2, M),
        low=np.full(N, -2, dtype()),
    )


def constraints(given, soft):
    """Of the keywords of a problem: those of bounds and rows."""
    upper = np.array([1.0, 1.5], dtype())
    lower = np.array([-np.inf, -1.5], dtype())
    weights = dict(linear=1.0, quadratic=2.0) if soft else {}
    states = given["low"], np.inf
    return dict(
        controls=(-1.0, 1.0),
        states=dlx.qp.Soft(*states, linear=3.0) if soft else states,
        rows=dlx.qp.Rows(given["C"], given["D"], lower=lower, upper=upper, **weights),
        final_rows=dlx.qp.Rows(given["C"][:1], lower=0.25, upper=0.25),
    )


@functools.partial(jax.jit, static_argnames=("soft", "free"))
def staged(given, soft, free):
    """The staged solution."""
    skipped = ("C", "D", "low", *(("start",) if free else ()))
    matrices = {k: v for k, v in given.items() if k not in skipped}
    problem = dlx.qp.Staged(**matrices, **constraints(given, soft))
    return dlx.qp.solve(problem, throw=False)


@functools.partial(jax.jit, static_argnames=("soft", "free"))
def dense(given, soft, free):
    """The same program with one vector of all states and controls and, where it is
    soft, of all violations."""
    g, size = given, N + M
    total = T * size + N
    P, q = jnp.zeros((total, total), dtype()), jnp.zeros(total, dtype())
    state = lambda k: slice(k * size, k * size + N)
    control = lambda k: slice(k * size + N, (k + 1) * size)
    E, b, G, lower, upper = [], [], [], [], []

    def row(pairs, count):
        R = jnp.zeros((count, total), dtype())
        for at, matrix in pairs:
            R = R.at[:, at].set(matrix)
        return R

    eye = jnp.eye(N, dtype=dtype())
    if not free:
        E.append(row([(state(0), eye)], N)), b.append(g["start"])
    soft_rows = []
    for k in range(T):
        at = slice(k * size, (k + 1) * size)
        H = jnp.block([[g["Q"][k], g["S"][k]], [g["S"][k].T, g["R"][k]]])
        P = P.at[at, at].set(H)
        q = q.at[at].set(jnp.concatenate([g["q"][k], g["r"][k]]))
        pairs = [(state(k + 1), eye), (state(k), -g["A"][k]), (control(k), -g["B"][k])]
        E.append(row(pairs, N)), b.append(g["d"][k])
        G.append(row([(control(k), jnp.eye(M))], M))
        lower.append(-jnp.ones(M)), upper.append(jnp.ones(M))
        soft_rows.append(
            (row([(state(k), g["C"]), (control(k), g["D"])], 2), (1.0, 2.0))
        )
        lower_upper = jnp.array([-jnp.inf, -1.5]), jnp.array([1.0, 1.5])
        soft_rows[-1] += lower_upper
    for k in range(0 if free else 1, T + 1):
        weights = (3.0, 0.0)
        bounds = g["low"], jnp.full(N, jnp.inf)
        soft_rows.append((row([(state(k), eye)], N), weights, *bounds))
    P = P.at[state(T), state(T)].set(g["final"])
    q = q.at[state(T)].set(g["final_q"])
    E.append(row([(state(T), g["C"][:1])], 1)), b.append(jnp.array([0.25]))
    parts = [jnp.concatenate(a) for a in (E, b, G, lower, upper)]
    R, low, high = (jnp.concatenate([s[i] for s in soft_rows]) for i in (0, 2, 3))
    E, b, G, lower, upper = parts
    if not soft:
        G, lower, upper = (
            jnp.concatenate(pair) for pair in ((G, R), (lower, low), (upper, high))
        )
        rows = dlx.qp.Rows(G, lower=lower, upper=upper)
        problem = dlx.qp.Dense(P, q, equalities=(E, b), rows=rows)
        return dlx.qp.solve(problem, throw=False)
    # R z - t_upper <= high, R z + t_lower >= low, t >= 0.
    v, W = (
        jnp.concatenate([jnp.full(len(s[0]), s[1][i]) for s in soft_rows])
        for i in range(2)
    )
    count, eye = len(R), jnp.eye(len(R))
    none = jnp.zeros((count, count))
    P = jax.scipy.linalg.block_diag(P, jnp.diag(W), jnp.diag(W))
    q = jnp.concatenate([q, v, v])
    E = jnp.pad(E, ((0, 0), (0, 2 * count)))
    G = jnp.pad(G, ((0, 0), (0, 2 * count)))
    tall = [[R, -eye, none], [R, none, eye]]
    G = jnp.concatenate([G, jnp.block(tall)])
    infinite = jnp.full(count, jnp.inf)
    rows = dlx.qp.Rows(
        G,
        lower=jnp.concatenate([lower, -infinite, low]),
        upper=jnp.concatenate([upper, high, infinite]),
    )
    bounds = jnp.where(jnp.arange(len(q)) < total, -jnp.inf, 0.0), jnp.inf
    problem = dlx.qp.Dense(P, q, equalities=(E, b), rows=rows, bounds=bounds)
    return dlx.qp.solve(problem, throw=False)


@needs_x64
@pytest.mark.parametrize("soft, free", [(True, False), (False, True)])
def test_stages_are_the_same_program(soft, free):
    """Soft with the start given, and hard with it free."""
    given = data(5)
    ours, other = staged(given, soft, free), dense(given, soft, free)
    assert ours.result == other.result == dlx.RESULTS.successful
    z = np.concatenate([np.hstack([ours.x[:-1], ours.u]).ravel(), ours.x[-1]])
    assert_close(z, other.x[: len(z)], atol=1e-6)
    assert_close(ours.cost, other.cost, rtol=1e-7)


def test_without_bounds_it_is_the_riccati_recursion():
    given = data(1)
    keys = "A", "B", "Q", "R", "S", "d", "q", "r", "final", "final_q"
    linear = {k: given[k] for k in keys}
    s = dlx.qp.solve(dlx.qp.Staged(**linear, start=given["start"]))
    plan = dlx.riccati.dre(**linear)
    x = given["start"]
    for k in range(T):
        u = -plan.K[k] @ x - plan.k[k]
        assert_close(s.u[k], u, atol=tolerance(1e-2, 1e-7))
        x = given["A"][k] @ x + given["B"][k] @ u + given["d"][k]


@needs_x64
def test_the_costates_are_derivatives_of_the_cost():
    given = data(5)
    s = staged(given, True, False)
    value = lambda d: staged(given | dict(d=d), True, False).cost
    gradient = jax.grad(value)(jnp.asarray(given["d"]))
    assert_close(-s.multipliers.costates[1:], gradient, atol=1e-6)


@once
def test_a_batch_is_its_members():
    given = data(5)
    starts = given["start"] + 0.1 * np.random.default_rng(1).standard_normal((3, N))
    starts = starts.astype(dtype())
    one = lambda start: staged(given | dict(start=start), True, False)
    batch = jax.jit(jax.vmap(one))(starts)
    for k, start in enumerate(starts):
        assert_close(batch.u[k], one(start).u, atol=1e-5)


@needs_x64
@pytest.mark.parametrize("soft", [True, False])
def test_a_solution_starts_the_next_problem_warm(soft):
    given = data(5)
    problem = lambda start: dlx.qp.Staged(
        **{k: v for k, v in given.items() if k not in ("C", "D", "low", "start")},
        **constraints(given, soft),
        start=start,
    )
    cold = dlx.qp.solve(problem(given["start"]))
    warm = dlx.qp.solve(problem(given["start"]), start=cold)
    # The sides that are active are known: one linear system.
    assert warm.iterations == 1 < cold.iterations
    assert_close(warm.u, cold.u, atol=1e-6)
    # A few of them change, near it and in the program without a start.
    near = problem(1.05 * given["start"])
    moved, anew = dlx.qp.solve(near, start=cold), dlx.qp.solve(near)
    assert moved.iterations <= anew.iterations <= 5
    assert_close(moved.u, anew.u, atol=1e-6)
    # Where too many change, the method begins anew.
    far = problem(-given["start"])
    moved, anew = dlx.qp.solve(far, start=cold), dlx.qp.solve(far)
    assert moved.result == anew.result == dlx.RESULTS.successful
    assert_close(moved.u, anew.u, atol=1e-6)
    lost = jax.tree.map(lambda a: a * np.nan, cold.x)
    ignored = dlx.qp.solve(
        problem(given["start"]), start=eqx.tree_at(lambda s: s.x, cold, lost)
    )
    assert_close(ignored.u, cold.u, atol=tolerance(1e-2, 1e-6))


def test_rounding_of_a_semidefinite_weight_is_no_negative_eigenvalue():
    c = jnp.array([[1.0, 1 / 3]])
    A, B = jnp.array([[1.0, 0.1], [0.0, 1.0]]), jnp.array([[0.0], [0.1]])
    given = A, B, c.T @ c, jnp.eye(1)
    problem = dlx.qp.Staged(*given, start=jnp.ones(2), horizon=5)
    assert dlx.qp.solve(problem).result == dlx.RESULTS.successful


@once
@pytest.mark.parametrize(
    "limits",
    [
        dict(rows=dlx.qp.Rows(np.eye(2), upper=np.ones((5, 2)))),
        dict(controls=([[-1.0]] * 5, [[1.0]] * 5)),
        dict(states=([[-1.0, -1.0]] * 6, 1.0)),
    ],
)
def test_bounds_that_vary_tell_the_horizon(limits):
    A, B = jnp.array([[1.0, 0.1], [0.0, 1.0]]), jnp.array([[0.0], [0.1]])
    assert dlx.qp.Staged(A, B, jnp.eye(2), jnp.eye(1), **limits).horizon == 5
