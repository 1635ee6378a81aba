"""Lyapunov, Stein and Sylvester equations. The matrices need not be stable."""

import functools
from typing import NamedTuple

import equinox as eqx
import jax

from .._check import as_matrix
from .._jax import (
    compiled_unless_on_host,
    custom_jvp,
    host_unless_traced,
    lax,
    stop_gradient,
    while_loop,
    xp,
)
from .._module import shown
from .._results import choose, raise_on_failure, Result, RESULTS
from .._typing import Array, Numbers
from ..math._linear_solve import full_precision, no_tangent, solve
from ..math._lyapunov import smith, stable_sylvester
from ._arguments import complex_form, is_complex, real_form, square_matrix
from ._residual import if_needed, linear_residual, tolerance
from ._spectrum import spectral_abscissa


_DENSE = 256
"""The largest number of unknowns for a solve as one linear system."""
_DIRECT, _SHIFTED, _DENSE_SOLVE, _DONE = range(4)
"""The kinds of attempt: with the given spectra, with shifted spectra, and as one linear
system."""


class MatrixSolution(eqx.Module):
    r"""The solution of a linear matrix equation.

    **Attributes:**

    - `X`: the solution, shape `(n, n)`, or `(n, m)` for a Sylvester equation.
    - `residual`: the norm of the residual of the equation, divided by
        $(|A| + |B|)\, |X| + |C|$, or in discrete time by $(|A|\, |B| + 1)\, |X| + |C|$.
        This means that $X$ is the exact solution for slightly different data, and the
        relative change of the data has the size of the residual.
    - `iterations`: the number of steps of the solver (doubling or the sign iteration).
    - `result`: success, or the reason for a failure; one of `delucax.RESULTS`.

    `X` is differentiable. If the solve failed, the derivatives of the solution are
    zero.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[-1.0, 1.0], [0.0, -2.0]])
        solution = dlx.riccati.lyap(A, jnp.eye(2))
        solution.X
        ```

        ```text
        Array([[0.583, 0.083],
               [0.083, 0.25 ]], dtype=float32)
        ```
    """

    X: Array
    residual: Array
    iterations: Array
    result: Result

    __repr__ = shown

    def _facts(self) -> str:
        """The diagnostics of an error."""
        return f"Relative residual {float(self.residual):.1e}."


@host_unless_traced
def lyap(A: Numbers, Q: Numbers, *, throw: bool = True) -> MatrixSolution:
    r"""The solution $X$ of the continuous-time Lyapunov equation.

    $$A X + X A^\top + Q = 0$$

    If $A$ is stable, $X$ is the stationary covariance of $\dot{x} = A x$ driven by
    white noise of intensity $Q$.

    The solver uses the sign iteration if all eigenvalues of $A$ are on the same side of
    the imaginary axis. Otherwise the solver writes the equation as one dense linear
    system, if $n$ is at most 16. For complex data the limit is 8, because the solver
    replaces a complex matrix by a real matrix of twice the size. If $n$ is above the
    limit, `result` is `RESULTS.not_separated`.

    **Arguments:**

    - `A`: shape `(n, n)`. `A` and `Q` may be complex. Then $^\top$ is the conjugate
        transpose.
    - `Q`: shape `(n, n)`, not necessarily symmetric.
    - `throw`: raise an error if the solver finds no solution (default). If false, check
        `result`.

    **Returns:** a [`delucax.riccati.MatrixSolution`][]. The solve is successful if the
    `residual` is at most 1e-12 (1e-5 in single precision). Otherwise `result` is
    `RESULTS.not_separated`, or `RESULTS.ill_posed` if two eigenvalues of $A$ sum to
    zero.

    **Raises:** `ValueError` if a matrix has the wrong shape or is not finite. With
    `throw`, an error at run time if the solve fails.

    Source: Roberts, 1971.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[0.0, 1.0], [-1.0, -0.5]])
        dlx.riccati.lyap(A, jnp.eye(2)).X
        ```

        ```text
        Array([[ 2.25, -0.5 ],
               [-0.5 ,  2.  ]], dtype=float32)
        ```
    """
    return _equation("lyap", False, A, None, Q, throw)


@host_unless_traced
def dlyap(A: Numbers, Q: Numbers, *, throw: bool = True) -> MatrixSolution:
    r"""The solution $X$ of the discrete-time Lyapunov equation.

    $$A X A^\top - X + Q = 0$$

    If $A$ is stable, $X$ is the stationary covariance of $x_{k+1} = A x_k$ driven by
    white noise of covariance $Q$.

    The solver uses the doubling algorithm if all eigenvalues of $A$ are inside the unit
    circle, or all are outside. Otherwise the solver writes the equation as one dense
    linear system, if $n$ is at most 16. For complex data the limit is 8, because the
    solver replaces a complex matrix by a real matrix of twice the size. If $n$ is above
    the limit, `result` is `RESULTS.not_separated`.

    **Arguments:** `A`, `Q` and `throw`: as in [`delucax.riccati.lyap`][].

    **Returns:** as in [`delucax.riccati.lyap`][], but `result` is `RESULTS.ill_posed`
    if the product of two eigenvalues of $A$ is one.

    **Raises:** as in [`delucax.riccati.lyap`][].

    Source: Smith, 1968.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[0.9, 0.1], [0.0, 0.5]])
        dlx.riccati.dlyap(A, jnp.eye(2)).X
        ```

        ```text
        Array([[5.448, 0.121],
               [0.121, 1.333]], dtype=float32)
        ```
    """
    return _equation("dlyap", True, A, None, Q, throw)


@host_unless_traced
def sylvester(
    A: Numbers, B: Numbers, C: Numbers, *, throw: bool = True
) -> MatrixSolution:
    r"""The solution $X$ of the Sylvester equation.

    $$A X + X B = C$$

    If a vertical line $\mathrm{Re}\, z = s$ separates the eigenvalues of $A$ from the
    eigenvalues of $-B$, the solver shifts the matrices by $s$ and then uses the sign
    iteration. Otherwise the solver writes the equation as one dense linear system, if
    $X$ has at most 256 entries. For complex data the limit is 64 entries, because the
    solver replaces a complex matrix by a real matrix of twice the size. If $X$ has more
    entries, `result` is `RESULTS.not_separated`.

    **Arguments:**

    - `A`: shape `(n, n)`. All matrices may be complex.
    - `B`: shape `(m, m)`.
    - `C`: shape `(n, m)`.
    - `throw`: raise an error if the solver finds no solution (default). If false, check
        `result`.

    **Returns:** a [`delucax.riccati.MatrixSolution`][]. The solve is successful if the
    `residual` is at most 1e-12 (1e-5 in single precision). Otherwise `result` is
    `RESULTS.not_separated`, or `RESULTS.ill_posed` if $A$ and $-B$ share an eigenvalue.

    **Raises:** `ValueError` if a matrix has the wrong shape or is not finite. With
    `throw`, an error at run time if the solve fails.

    Source: Roberts, 1971.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A, B = jnp.array([[1.0, 2.0], [0.0, 3.0]]), jnp.array([[4.0]])
        dlx.riccati.sylvester(A, B, jnp.ones((2, 1))).X
        ```

        ```text
        Array([[0.143],
               [0.143]], dtype=float32)
        ```
    """
    return _equation("sylvester", False, A, B, C, throw)


@host_unless_traced
def dsylvester(
    A: Numbers, B: Numbers, C: Numbers, *, throw: bool = True
) -> MatrixSolution:
    r"""The solution $X$ of the Stein equation, the discrete-time Sylvester equation.

    $$A X B - X + C = 0$$

    The solver uses the doubling algorithm if the product of the spectral radii of $A$
    and $B$ is below one. If all eigenvalues of $A$ and $B$ are outside the unit circle,
    the solver uses a Cayley transform. Otherwise the solver writes the equation as one
    dense linear system, if $X$ has at most 256 entries. For complex data the limit is
    64 entries, because the solver replaces a complex matrix by a real matrix of twice
    the size. If $X$ has more entries, `result` is `RESULTS.not_separated`.

    **Arguments:** `A`, `B`, `C` and `throw`: as in [`delucax.riccati.sylvester`][].

    **Returns:** as in [`delucax.riccati.sylvester`][], but `result` is
    `RESULTS.ill_posed` if the product of an eigenvalue of $A$ and an eigenvalue of $B$
    is one.

    **Raises:** as in [`delucax.riccati.sylvester`][].

    Source: Smith, 1968.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A, B = jnp.array([[0.5, 0.2], [0.0, 0.9]]), jnp.array([[0.8]])
        dlx.riccati.dsylvester(A, B, jnp.ones((2, 1))).X
        ```

        ```text
        Array([[2.619],
               [3.571]], dtype=float32)
        ```
    """
    return _equation("dsylvester", True, A, B, C, throw)


def _equation(where, discrete, A, B, C, throw) -> MatrixSolution:
    """Check and solve an equation. If `B` is `None`, it is a Lyapunov equation."""
    name = "Q" if B is None else "C"
    A, C = square_matrix(A, "A", where), as_matrix(C, name, where)
    B = None if B is None else square_matrix(B, "B", where)
    shape = (A.shape[0], A.shape[0] if B is None else B.shape[0])
    if C.shape != shape:
        raise ValueError(
            f"{where}: {name} must have shape {shape}, got shape {C.shape}."
        )
    dtype = xp.result_type(*jax.tree.leaves((A, B, C)))
    A, B, C = jax.tree.map(lambda M: M.astype(dtype), (A, B, C))
    # In continuous time a Lyapunov equation is A X + X A' = -Q.
    C = -C if B is None and not discrete else C
    solution = _solution(discrete, A, B, C)
    return raise_on_failure(solution, where, throw, facts=solution._facts)


@compiled_unless_on_host
def _solution(discrete, A, B, C) -> MatrixSolution:
    complex_data = is_complex(A, B, C)
    if complex_data:
        A, B, C = jax.tree.map(real_form, (A, B, C))
    solution = _solved(discrete, A, B, C)
    # A dense solve fails only if the equation is singular.
    failure = RESULTS.ill_posed if C.size <= _DENSE else RESULTS.not_separated
    result = choose(solution.solved, RESULTS.successful, failure)
    return MatrixSolution(
        X=complex_form(solution.X) if complex_data else solution.X,
        residual=stop_gradient(solution.residual),
        iterations=solution.iterations,
        result=choose(solution.finite, result, RESULTS.ill_posed),
    )


class _Candidate(NamedTuple):
    X: Array
    residual: Array
    iterations: Array
    finite: Array  # whether the data are finite

    @property
    def solved(self) -> Array:
        return self.residual <= tolerance(self.X.dtype)


@functools.partial(custom_jvp, nondiff_argnums=(0,))
@full_precision
def _solved(discrete, A, B, C) -> _Candidate:
    """The solution of `A X + X B = C` or `X - A X B = C`; `B` is `A'` by default."""
    given = jax.tree.leaves((A, B, C))
    finite = xp.all(xp.stack([xp.all(xp.isfinite(M)) for M in given]))
    last = _DENSE_SOLVE if C.size <= _DENSE else _SHIFTED

    def body(carry):
        kind, before = carry
        direct, shifted = kind == _DIRECT, kind == _SHIFTED
        X, iterations = _separated(discrete, A, B, C, direct, shifted)
        if last == _DENSE_SOLVE:
            X = _dense_solution(discrete, A, B, C, X, kind == _DENSE_SOLVE)
        residual = linear_residual(discrete, A, A.T if B is None else B, C, X)
        # The residual of a linear equation is its backward error.
        better = (residual < before.residual) | direct
        after = before._replace(
            X=xp.where(better, X, before.X),
            residual=xp.where(better, residual, before.residual),
            iterations=before.iterations + iterations,
        )
        over = after.solved | (kind == last)
        return xp.where(over, _DONE, kind + 1), after

    unknown, zero = xp.asarray(xp.inf, C.dtype), xp.asarray(0)
    nothing = _Candidate(xp.full_like(C, xp.nan), unknown, zero, finite)
    start = xp.where(finite, _DIRECT, _DONE), nothing
    return while_loop(lambda carry: carry[0] != _DONE, body, start)[1]


def _separated(discrete, A, B, C, direct, shifted):
    """The solution if the spectra are separated, with or without a shift."""
    if discrete:
        # A kind that is not wanted gets a trivial problem, which takes one step.
        X, steps = smith(*_or_trivial(direct, A, B, C))
        # If both spectra are outside the circle, the Cayley transform puts them to the
        # right of the imaginary axis.
        eye_A, eye_B = (xp.eye(size, dtype=C.dtype) for size in C.shape)
        other = (A.T if B is None else B) + eye_B
        A, F = A + eye_A, solve(A + eye_A, A - eye_A)
        right = solve(A, C)
        C = -2 * solve(other.T, right.T).T
        B = None if B is None else solve(other.T, (B - eye_B).T).T
        A, sign = F, xp.where(shifted, -1.0, 1.0)
        Y, more_steps = _one_side(A, B, C, sign, xp.zeros(()), shifted)
        return xp.where(direct, X, Y), steps + more_steps
    n, m = C.shape
    # If the mean eigenvalues of A and B have a positive sum, -A and -B may be stable.
    # Then solve -(A X + X B) = -C.
    mean = xp.trace(A) / n + (xp.trace(A) / n if B is None else xp.trace(B) / m)
    sign = xp.where(mean > 0, -1.0, 1.0)
    if B is None:
        # For a Lyapunov equation only the imaginary axis can separate A from -A'.
        return _one_side(A, None, C, sign, xp.zeros(()), direct)
    # Shift by the position of a line between the spectra of A and -B.
    safe_A, safe_B = (xp.where(shifted, sign * M, 0) for M in (A, B))
    middle = (spectral_abscissa(safe_A) - spectral_abscissa(safe_B)) / 2
    shift = sign * xp.where(shifted, middle, 0)
    return _one_side(A, B, C, sign, shift, direct | shifted)


def _one_side(A, B, C, sign, shift, wanted):
    """The solution after a shift and a change of sign that make the matrices stable."""
    sign, shift = sign.astype(C.dtype), shift.astype(C.dtype)
    A = sign * (A - shift * xp.eye(A.shape[0], dtype=A.dtype))
    if B is not None:
        B = sign * (B + shift * xp.eye(B.shape[0], dtype=B.dtype))
    A, B, C = _or_trivial(wanted, A, B, sign * C, -1)
    return stable_sylvester(A, B, C)


def _or_trivial(wanted, A, B, C, scale=0):
    """The problem if it is wanted, else a trivial problem."""
    A = xp.where(wanted, A, scale * xp.eye(A.shape[0], dtype=A.dtype))
    if B is not None:
        B = xp.where(wanted, B, scale * xp.eye(B.shape[0], dtype=B.dtype))
    return A, B, xp.where(wanted, C, 0)


def _dense_solution(discrete, A, B, C, X, wanted):
    """The solution of one dense linear system if it is wanted, else `X`."""

    def dense(_):
        # vec(A X + X B), row by row, is this matrix times vec(X).
        other = A.T if B is None else B
        eye_A, eye_B = (xp.eye(size, dtype=A.dtype) for size in C.shape)
        if discrete:
            system = xp.kron(eye_A, eye_B) - xp.kron(A, other.T)
        else:
            system = xp.kron(A, eye_B) + xp.kron(eye_A, other.T)
        return solve(system, C.reshape(-1, 1)).reshape(C.shape)

    return if_needed(wanted, dense, X, ())


@_solved.defjvp
@full_precision
def _solved_jvp(discrete, primals, tangents):
    # Because the equation is linear in X, dX solves it with another right side.
    A, B, _ = primals
    solution = _solved(discrete, *primals)
    ok = solution.solved
    # Masked at input and output, so that the NaN of a failed member does not spread.
    dA, dB, dC = jax.tree.map(lambda t: xp.where(ok, t, 0), tangents)
    X = xp.where(ok, solution.X, 0)
    # A failed problem is replaced: -I/2 is trivial in continuous and discrete time.
    half = functools.partial(xp.where, ok)
    A, B = jax.tree.map(lambda M: half(M, -xp.eye(len(M), dtype=M.dtype) / 2), (A, B))
    other, d_other = (A.T, dA.T) if B is None else (B, dB)
    if discrete:
        right = dC + dA @ X @ other + A @ X @ d_other
    else:
        right = dC - dA @ X - X @ d_other
    # The transposed equation has A' and B'.
    across = None if B is None else B.T
    dX = lax.custom_linear_solve(
        lambda X: X - A @ X @ other if discrete else A @ X + X @ other,
        xp.where(ok, right, 0),
        solve=lambda _, C: _solved(discrete, A, B, C).X,
        transpose_solve=lambda _, C: _solved(discrete, A.T, across, C).X,
    )
    return solution, no_tangent(solution)._replace(X=xp.where(ok, dX, 0))
