"""The solution of a quadratic program."""

import equinox as eqx

from .._module import shown
from .._results import Result
from .._typing import Array, Scalar
from ._dense_problem import DenseMultipliers
from ._staged_problem import StagedMultipliers


class Solution(eqx.Module):
    r"""The solution of a quadratic program, or a certificate that it has none.

    If `result` is `RESULTS.no_feasible_point`, the multipliers are a certificate that
    no point satisfies the constraints. The multipliers of inequalities are not
    negative, their combination of the constraints, $E^\top y + G^\top
    (\mu_\mathrm{upper} - \mu_\mathrm{lower})$, is zero, and the same combination of the
    right sides is $-1$. ($G$ has a row for each bound of a variable here.) A feasible
    point would contradict this. If there is no feasible point, `x` and `u` are NaN, and
    `cost` is infinite.

    If `result` is `RESULTS.unbounded`, `x` and `u` are a direction in which the cost
    decreases without bound. A step along this direction violates no constraint. The
    quadratic cost of the direction is zero, and its linear cost is -1. For an unbounded
    program, the multipliers are NaN, and `cost` is minus infinity.

    **Attributes:**

    - `x`: the variables, shape `(n,)`; for a staged program the states, `(T+1, n)`.
    - `u`: the controls of a staged program, shape `(T, m)`; `None` for a dense program.
    - `multipliers`: a [`delucax.qp.DenseMultipliers`][] or a
        [`delucax.qp.StagedMultipliers`][].
    - `cost`: the cost of the solution, including the cost of violated soft bounds.
    - `primal_residual`: the largest violation of a constraint that is not soft.
    - `dual_residual`: the largest entry of the gradient of the Lagrangian.
    - `complementarity`: the largest product of a multiplier and the slack of its
        constraint.
    - `gap`: the absolute difference between the cost and the cost of the dual program.
    - `iterations`: the number of iterations, each with one factorisation.
    - `result`: success, or the reason for a failure; one of `delucax.RESULTS`.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        problem = dlx.qp.Dense(jnp.eye(2), jnp.ones(2), bounds=(2.0, 3.0))
        solution = dlx.qp.solve(problem)
        solution.x, solution.cost
        ```

        ```text
        (Array([2., 2.], dtype=float32), Array(8., dtype=float32))
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
