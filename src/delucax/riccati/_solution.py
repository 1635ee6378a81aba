"""What the solvers of matrix equations return."""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable, TypeVar

import equinox as eqx
from jaxtyping import Array

from .._check import is_concrete
from .._results import Result, RESULTS


@runtime_checkable
class _HasResult(Protocol):
    result: Result


Solution = TypeVar("Solution", bound=_HasResult)


class RiccatiSolution(eqx.Module):
    """What a Riccati solver found, with the facts to judge it by.

    **Attributes:**

    - `X`: the solution, shape `(n, n)`, symmetric.
    - `K`: the gain of `u = -K x`, shape `(m, n)`; of a filter that of
        `K (y - C x)`, shape `(n, p)`.
    - `residual`: the norm of the equation's residual over the sum of the norms of its
        terms: an upper bound, with rounding of its own evaluation counted.
    - `closed_loop`: the matrix of `x_next = closed_loop x` (of
        `dx/dt = closed_loop x`), shape `(n, n)`.
    - `spectral_radius`: in discrete time, that of `closed_loop`, to about eight digits
        and from above: the loop is stable if it is below 1. `None` in continuous time.
    - `iterations`: doublings or steps of the sign iteration taken.
    - `result`: success, or why not; one of `delucax.RESULTS`.
    - `spectral_abscissa`: in continuous time, the largest real part of an eigenvalue of
        `closed_loop`, likewise: the loop is stable if it is below 0. `None` in discrete
        time.

    `X`, `K` and `closed_loop` are differentiable. `residual`, `spectral_radius` and
    `spectral_abscissa` are measurements and have no gradient. Where the solve failed
    and the loop is not stable there is nothing to differentiate, and the derivatives
    are zero, so that they do not spoil a batch.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[1.0, 1.0], [0.0, 1.0]])
        B = jnp.array([[0.0], [1.0]])
        solution = dlx.riccati.dare(A, B, jnp.eye(2), jnp.eye(1))
        solution.K, solution.spectral_radius
        ```
    """

    X: Array
    K: Array
    residual: Array
    closed_loop: Array
    spectral_radius: Array | None
    iterations: Array
    result: Result
    spectral_abscissa: Array | None = None


class MatrixSolution(eqx.Module):
    """What a solver of a linear matrix equation found.

    **Attributes:**

    - `X`: the solution.
    - `residual`: the norm of the equation's residual over `(|A| + |B|) |X| + |C|`, in
        discrete time over `(|A| |B| + 1) |X| + |C|`: the relative change of the data
        that would make `X` exact.
    - `iterations`: doublings taken.
    - `result`: success, or why not; one of `delucax.RESULTS`.

    `X` is differentiable; where the solve failed, its derivatives are zero.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[-1.0, 1.0], [0.0, -2.0]])
        solution = dlx.riccati.lyap(A, jnp.eye(2))
        solution.X, solution.residual
        ```
    """

    X: Array
    residual: Array
    iterations: Array
    result: Result


def checked(
    solution: Solution,
    where: str,
    throw: bool,
    facts: Callable[[Any], str] | None = None,
) -> Solution:
    """Raise if asked to and it failed: now if that can be seen, else at run time.

    `facts` says of a solution what helps to understand its failure.
    """
    failed = solution.result != RESULTS.successful
    if not throw:
        return solution
    if not is_concrete(failed):
        return solution.result.error_if(solution, failed)
    if failed:
        known = (_facts if facts is None else facts)(solution)
        raise RuntimeError(
            f"{where}: {RESULTS[solution.result]} {known} Pass throw=False to look at "
            "the solution."
        )
    return solution


def _facts(solution: Any) -> str:
    known = f"Relative residual {float(solution.residual):.1e}"
    if isinstance(solution, RiccatiSolution):
        radius, abscissa = solution.spectral_radius, solution.spectral_abscissa
        name, bound = ("abscissa", abscissa) if radius is None else ("radius", radius)
        assert bound is not None
        known += f", spectral {name} of the closed loop {float(bound):.6g}"
    return f"{known}."
