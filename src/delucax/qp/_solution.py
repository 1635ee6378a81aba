"""What a solver of quadratic programs returns."""

import equinox as eqx

from .._module import shown
from .._results import Result
from .._typing import Array, Scalar
from ._dense_problem import DenseMultipliers
from ._staged_problem import StagedMultipliers


class Solution(eqx.Module):
    """What the method found: a solution, or a proof that there is none.

    Where `result` is `RESULTS.no_feasible_point`, the multipliers are the certificate:
    those of inequalities are not negative, `E'equalities + G'(upper - lower)` is zero,
    and the sum of each multiplier times its bound is -1, which no feasible point
    allows. `x` and `u` are NaN, and `cost` is infinite. Where it is
    `RESULTS.unbounded`, `x` and `u` are a direction that keeps within all constraints,
    along which the Hessian is zero and the cost falls by 1 each unit; the multipliers
    are NaN.

    **Attributes:**

    - `x`: the variables, shape `(n,)`; of a staged program the states, `(T+1, n)`.
    - `u`: the controls of a staged program, shape `(T, m)`; `None` of a dense one.
    - `multipliers`: a [`delucax.qp.DenseMultipliers`][] or a
        [`delucax.qp.StagedMultipliers`][].
    - `cost`: of the solution, violations of soft sides included.
    - `primal_residual`: the largest violation of a constraint that is not soft.
    - `dual_residual`: the largest entry of the gradient of the Lagrangian.
    - `complementarity`: the largest product of a multiplier and its slack.
    - `gap`: the difference of the cost and that of the dual program, absolute.
    - `iterations`: the iterations taken, each with one factorisation.
    - `result`: success, or why not; one of `delucax.RESULTS`.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        rows = dlx.qp.Rows(jnp.array([[1.0, 1.0]]), upper=5.0)
        bounds = 2.0, 3.0
        problem = dlx.qp.Dense(jnp.eye(2), jnp.ones(2), bounds=bounds, rows=rows)
        solution = dlx.qp.solve(problem)
        solution.x, solution.multipliers.bounds, solution.gap
        ```
    """

    x: Array
    u: Array | None
    multipliers: DenseMultipliers | StagedMultipliers
    cost: Scalar
    primal_residual: Scalar
    dual_residual: Scalar
    complementarity: Scalar
    gap: Scalar
    iterations: Array
    result: Result

    __repr__ = shown
