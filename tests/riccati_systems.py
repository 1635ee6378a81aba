"""Systems to try Riccati solvers on: published ones, and families of them.

Each is `(name, A, B, Q, R)`. The families are those of the collections of P. Benner,
A. J. Laub and V. Mehrmann (1995), CAREX and DAREX, in their parameters.
"""

import ast
import warnings
from pathlib import Path

import mpmath
import numpy as np
import scipy.linalg

import delucax as dlx


def scipy_cases(name):
    """The cases of one class of SciPy's own tests of its solvers.

    The assignments of the class are run alone: the module belongs to SciPy's own set-up
    of pytest.
    """
    folder = Path(scipy.linalg.__file__).parent / "tests"
    tree = ast.parse((folder / "test_solvers.py").read_text())
    (found,) = (
        node
        for node in tree.body
        if isinstance(node, ast.ClassDef) and node.name == name
    )
    body = [node for node in found.body if isinstance(node, ast.Assign)]
    names = {
        "np": np,
        "block_diag": scipy.linalg.block_diag,
        "_load_data": lambda file: np.load(folder / "data" / file),
    }
    exec(compile(ast.Module(body, []), name, "exec"), names)
    return names["cases"]


def matrices(case):
    return tuple(np.atleast_2d(np.asarray(M)) for M in case[:4])


def carex():
    """The 20 systems of CAREX with SciPy's data."""
    cases = scipy_cases("TestSolveContinuousAre")
    return [(f"CAREX {i + 1}", *matrices(case)) for i, case in enumerate(cases)]


def darex():
    """Four reported by users of SciPy (three of them complex), and the 15 of DAREX."""
    cases = scipy_cases("TestSolveDiscreteAre")
    names = [f"user {i + 1}" for i in range(4)]
    names += [f"DAREX {i + 1}" for i in range(15)]
    return [(name, *matrices(case)) for name, case in zip(names, cases, strict=True)]


def reflection():
    """Of Petkov's scaled examples."""
    return np.eye(3) - 2 / 3 * np.ones((3, 3))


def shift(n):
    """A chain of `n` integrators (of delays, in discrete time)."""
    return np.eye(n, k=1), np.eye(n)[:, -1:]


def carex_families(sizes=(6,), half_sizes=(5,)):
    """CAREX 7 to 15, 17 and 19 over their parameters."""
    I, column = np.eye, lambda *x: np.array(x, float)[:, None]
    one = np.eye(1)
    systems = []

    def add(number, parameter, *problem):
        systems.append((f"CAREX {number}, {parameter}", *problem))

    for e in 10.0 ** np.arange(-8, 5):
        add(7, f"{e:g}", np.diag([1.0, -2]), column(e, 0), np.ones((2, 2)), one)
        Q = np.array([[1e2, 1e3], [1e3, 1e4]])
        B = np.array([[0.1, 0], [0.001, 0.01]])
        R = np.ones((2, 2)) + np.diag([e, 0])
        if e >= 1e-8:
            add(8, f"{e:g}", np.diag([-0.1, -0.02]), B, Q, R)
    for e in 10.0 ** np.arange(-6, 7):
        add(9, f"{e:g}", np.array([[0, e], [0, 0]]), column(0, 1), I(2), one)
    for e in 10.0 ** np.arange(-7, 5):
        A = np.ones((2, 2)) + e * I(2)
        add(10, f"{e:g}", A, I(2), e**2 * I(2), I(2))
        add(10, f"{e:g}, Q = I", A, I(2), I(2), I(2))
    for e in 10.0 ** np.arange(-6, 1, 0.5):
        A = np.array([[3 - e, 1], [4, 2 - e]])
        Q = np.array([[4 * e - 11, 2 * e - 5], [2 * e - 5, 2 * e - 2]])
        add(11, f"{e:g}", A, column(1, 1), Q, one)
    V = reflection()
    for e in 10.0 ** np.arange(0, 7):
        A, Q = V @ np.diag([e, 2 * e, 3 * e]) @ V, V @ np.diag([1 / e, 1, e]) @ V
        add(12, f"{e:g}", (A + A.T) / 2, I(3), (Q + Q.T) / 2, e * I(3))
    for e in 10.0 ** np.arange(-6, 1):
        A = np.diag([0.4, 0.345, 0.262 / e], 1)
        A[2, 1:3], A[3, 3] = [-0.524 / e, -0.465 / e], -1 / e
        add(13, f"{e:g}", A, column(0, 0, 0, 1 / e), np.diag([1.0, 0, 1, 0]), one)
    for e in 10.0 ** np.arange(-6, 1):
        A = np.zeros((4, 4))
        A[:2, :2], A[2:, 2:] = [[-e, 1], [-1, -e]], [[e, 1], [-1, e]]
        add(14, f"{e:g}", A, np.ones((4, 1)), np.ones((4, 4)), one)
    for N in half_sizes:
        n = 2 * N - 1
        A, B = np.zeros((n, n)), np.zeros((n, N))
        for i in range(N):
            A[2 * i, 2 * i], B[2 * i, i] = -1, 1
        for i in range(N - 1):
            A[2 * i + 1, 2 * i], A[2 * i + 1, 2 * i + 2] = 1, -1
        Q = np.diag([10.0 * (i % 2) for i in range(n)])
        add(15, f"{N} vehicles", A, B, Q, I(N))
    for n in sizes:
        for q in 10.0 ** np.arange(-4, 5, 2):
            for r in 10.0 ** np.arange(-4, 5, 2):
                A, B = shift(n)
                Q = np.diag([q] + [0.0] * (n - 1))
                add(17, f"n={n}, q={q:g}, r={r:g}", A, B, Q, r * one)
    for l in half_sizes:
        for damping in (1e-2, 0.1, 1.0, 4.0):
            for stiffness in (0.1, 1.0, 100.0):
                K = 2 * I(l) - np.eye(l, k=1) - np.eye(l, k=-1)
                K[0, 0] = K[-1, -1] = 1
                A = np.block(
                    [[np.zeros((l, l)), I(l)], [-stiffness * K, -damping * I(l)]]
                )
                B = np.zeros((2 * l, 2))
                B[l, 0], B[-1, 1] = 1, -1
                name = f"{l} springs, {damping:g}, {stiffness:g}"
                add(19, name, A, B, I(2 * l), I(2))
    return systems


def darex_families(sizes=(10,)):
    """DAREX 12 to 15 over their parameters."""
    one, systems = np.eye(1), []

    def add(number, parameter, *problem):
        systems.append((f"DAREX {number}, {parameter}", *problem))

    for e in 10.0 ** np.arange(-6, 7):
        A, B = np.array([[0, e], [0, 0]]), np.array([[0.0], [1]])
        add(12, f"{e:g}", A, B, np.eye(2), one)
    V = reflection()
    for e in 10.0 ** np.arange(0, 8):
        A = V @ np.diag([0.0, 1, 3]) @ V
        add(13, f"{e:g}", (A + A.T) / 2, np.eye(3), e * np.eye(3), e * np.eye(3))
    for tau in 10.0 ** np.arange(0, 9):
        for r in (1e-4, 1e-2, 0.25, 1.0, 100.0):
            A = np.eye(4, k=-1)
            A[0, 0] = 1 - 1 / tau
            B, Q = np.eye(4)[:, :1] / tau, np.diag([0.0, 0, 0, 1])
            add(14, f"tau={tau:g}, r={r:g}", A, B, Q, r * one)
    for n in sizes:
        for r in 10.0 ** np.arange(-4, 5):
            add(15, f"n={n}, r={r:g}", *shift(n), np.eye(n), r * one)
    return systems


def discrete_residual(A, B, Q, R, X):
    """Relatively to the sum of the norms of the terms; `'` conjugates."""
    H = lambda M: M.conj().T
    cross = H(A) @ X @ B
    gain = np.linalg.solve(R + H(B) @ X @ B, H(cross))
    terms = H(A) @ X @ A, X, cross @ gain, Q
    left = terms[0] - terms[1] - terms[2] + terms[3]
    return np.linalg.norm(left) / sum(map(np.linalg.norm, terms)), A - B @ gain


def continuous_residual(A, B, Q, R, X):
    H = lambda M: M.conj().T
    gain = np.linalg.solve(R, H(B) @ X)
    terms = X @ A, H(A) @ X, X @ B @ gain, Q
    left = terms[0] + terms[1] - terms[2] + terms[3]
    return np.linalg.norm(left) / sum(map(np.linalg.norm, terms)), A - B @ gain


def sensitivity(discrete, A, B, Q, R, X):
    """How many times rounding of the equation's terms changes `X`, relatively.

    A residual `dR` changes it by at most `|P| |dR|`, `P` being the solution of the
    closed loop's Lyapunov equation with the constant `I` (Kenney and Hewer, 1990).
    """
    H = lambda M: M.conj().T
    if discrete:
        moved, weight = H(A) @ X, R + H(B) @ X @ B
    else:
        moved, weight = X, R
    cross = moved @ B
    gain = np.linalg.solve(weight, H(cross) @ A if discrete else H(cross))
    loop, eye = A - B @ gain, np.eye(len(A))
    terms = moved @ A, X if discrete else moved @ A, Q, cross @ gain
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a loop close to the boundary
        if discrete:
            P = scipy.linalg.solve_discrete_lyapunov(H(loop), eye)
        else:
            P = scipy.linalg.solve_continuous_lyapunov(H(loop), -eye)
    sizes = sum(np.linalg.norm(term) for term in terms)
    return np.linalg.norm(P, 2) * sizes / np.linalg.norm(X)


def check_both_ways(discrete, data, compiled):
    """NumPy's solution has the status of the compiled one, and is as close to it as
    rounding allows."""
    solve = dlx.riccati.dare if discrete else dlx.riccati.care
    at_once = solve(*data, throw=False)
    assert at_once.result == compiled.result
    if compiled.result == dlx.RESULTS.successful:
        eps = np.finfo(compiled.X.dtype).eps
        wide = lambda M: np.asarray(M, np.result_type(np.asarray(M), np.float64))
        X, data = wide(compiled.X), [wide(M) for M in data]
        change = np.linalg.norm(wide(at_once.X) - X) / np.linalg.norm(X)
        assert change < 100 * sensitivity(discrete, *data, X) * eps


DIGITS = 60


def exact(M):
    """A matrix of floating-point numbers, as objects of mpmath."""
    kind = mpmath.mpc if np.iscomplexobj(M) else mpmath.mpf
    number = complex if np.iscomplexobj(M) else float
    entries = [kind(number(entry)) for entry in np.ravel(M)]
    return np.array([*entries, None], object)[:-1].reshape(np.shape(M))


def adjoint(M):
    return np.frompyfunc(mpmath.conj, 1, 1)(M.T)


def product(M, N):
    """Of matrices of objects, as whole numbers of a small unit, which are fast."""
    (M, unit_M), (N, unit_N) = whole(M), whole(N)
    sums = lambda A, B: np.array([row[row != 0] @ B[row != 0] for row in A], object)
    back = np.frompyfunc(lambda k: mpmath.ldexp(int(k), unit_M + unit_N), 1, 1)
    if len(M) == len(N) == 1:
        return back(sums(M[0], N[0]))
    (a, b), (c, d) = (*M, 0 * M[0])[:2], (*N, 0 * N[0])[:2]
    both = np.frompyfunc(mpmath.mpc, 2, 1)
    return both(
        back(sums(a, c) - sums(b, d)),
        back(sums(a, d) + sums(b, c)),
    )


def whole(M):
    """The parts of a matrix in units of `2^k`, `DIGITS` and more below its largest
    entry; and `k`."""
    parts = [M]
    if any(isinstance(entry, mpmath.mpc) for entry in M.ravel()):
        parts = [np.frompyfunc(part, 1, 1)(M) for part in (mpmath.re, mpmath.im)]
    largest = max(abs(entry) for part in parts for entry in part.ravel())
    k = int(mpmath.frexp(largest)[1]) - 5 * DIGITS
    units = np.frompyfunc(lambda entry: int(mpmath.nint(mpmath.ldexp(entry, -k))), 1, 1)
    return [units(part) for part in parts], k


def quotient(M, N):
    """`M^-1 N`, by refinement of the solution in double precision."""
    is_complex = any(isinstance(x, mpmath.mpc) for x in (*M.ravel(), *N.ravel()))
    rough = lambda A: A.astype(complex if is_complex else float)  # noqa: E731
    factors = scipy.linalg.lu_factor(rough(M))
    X, rest = np.full(N.shape, mpmath.mpf(0), object), N
    for _ in range(100):
        X = X + exact(scipy.linalg.lu_solve(factors, rough(rest)))
        rest = N - product(M, X)
        if norm(rest) <= mpmath.mpf(10) ** (15 - DIGITS) * norm(N):
            return X
    raise ValueError("the matrix is singular to working precision")


def norm(M):
    return mpmath.sqrt(mpmath.fsum(abs(entry) ** 2 for entry in M.ravel()))


def true_residual(discrete, A, B, Q, R, X, S=None, E=None, players=0):
    """The relative residual of a Riccati equation, in 60 digits.

    The terms of the last `players` controls, a second player's, count apart.
    """
    with mpmath.workdps(DIGITS):
        A, B, Q, R, X = map(exact, (A, B, Q, R, X))
        H = adjoint
        weighted = X if E is None else product(H(exact(E)), X)
        moved = product(H(A), X) if discrete else weighted
        cross = product(moved, B)
        if S is not None:
            cross = cross + exact(S)
        gain = quotient(R + product(H(B), product(X, B)) if discrete else R, H(cross))
        first = B.shape[1] - players
        quadratic = [product(cross[:, :first], gain[:first])]
        if players:
            quadratic.append(product(cross[:, first:], gain[first:]))
        moved = product(moved, A)
        if discrete:
            weighted = weighted if E is None else product(weighted, exact(E))
            left = moved - weighted
        else:
            weighted = moved
            left = moved + H(moved)
        terms = [moved, weighted, Q, *quadratic]
        total = mpmath.fsum(map(norm, terms))
        return float(norm(left + Q - sum(quadratic)) / (total or 1))


def true_linear_residual(discrete, A, B, C, X):
    """That of `A X + X B = C`, or of `X - A X B = C`, relative to the data."""
    with mpmath.workdps(DIGITS):
        A, B, C, X = map(exact, (A, B, C, X))
        a, b, c, x = map(norm, (A, B, C, X))
        if discrete:
            left, scale = X - product(product(A, X), B), a * b + 1
        else:
            left, scale = product(A, X) + product(X, B), a + b
        return float(norm(left - C) / ((scale * x + c) or 1))
