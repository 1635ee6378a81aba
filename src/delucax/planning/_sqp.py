"""Sequential quadratic programming with hard constraints."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._check import check_bool, check_count, check_range, finite_rows
from .._module import parameter
from .._typing import PRNGKey
from ._plan import Plan
from ._planner import AbstractPlanner
from ._problem import Problem
from ._sqp_derivatives import solution
from ._sqp_iteration import Options
from ._start import Start


class SQP(AbstractPlanner):
    r"""Controls that locally minimise the cost under hard constraints, by sequential
    quadratic programming:

    `minimise sum over k < T of c(t_k, x_k, u_k) + final(t_T, x_T)`, along
    `x_{k+1} = F(t_k, x_k, u_k, w_k)`, under [`delucax.planning.Constraints`][].

    The unknowns are the states and the controls (multiple shooting), so that an
    unstable plant may start from a guess that does not follow the dynamics. Each
    iteration solves the quadratic program about the present trajectory, as
    [`delucax.qp.solve`][] does, first by guesses of the active sides. Its Hessian is
    that of the Lagrangian, or of the cost (Gauss-Newton); where it is not convex along
    the dynamics, the squares of the constraints that hold with equality are added, and
    then a multiple of the identity.

    A step `1, 1/2, ..., 1/2048` is accepted by a funnel: the sum of all violations
    stays below its width, and either the cost falls by 1e-4 of the predicted decrease,
    or the violations fall below 0.9 of the width, which then narrows.
    Where the linearised constraints have no feasible point, they may be violated at a
    price, that of an exact penalty; it rises at each stationary point that is not
    feasible, and if no price makes them hold, the result is `infeasible`.

    It has converged if the gradient of the Lagrangian and the complementarity are at
    most `tolerance` times one plus the size of the terms that cancel in them, the
    steps meet to that tolerance, and no constraint is violated by more than
    `constraint_tolerance`.

    It is called as every [`delucax.planning.AbstractPlanner`][]. The states start from
    those that follow from the controls; or, if these violate the constraints by more in
    sum than the steps miss each other there, from the first state held.

    The plan is differentiable in both modes with respect to every array in `dynamics`,
    `cost`, `constraints`, `x0`, `w`, `t0` and `bounds`, by the implicit function
    theorem: one quadratic program at the solution, with exact second derivatives.
    Derivatives are NaN unless the solution is a converged strict minimum whose active
    constraints have positive multipliers and are independent. They are zero with
    respect to `controls` and `states`, from which the iteration only starts.

    Under `jax.vmap` on CPU the plans of a batch are made one after the other, as by
    [`delucax.planning.ILQR`][].

    **Arguments:**

    - `max_iterations`: 200 by default.
    - `tolerance`: the square root of the precision by default (1.5e-8 in float64).
    - `constraint_tolerance`: a tenth of that by default.
    - `second_order`: if true (default), with the Hessian of the Lagrangian; if false,
        with that of the cost alone (Gauss-Newton).
    - `states`: states to start from, shape `(T+1, n)`. `controls` must then be an
        array, or the number of steps for the controls of the equilibrium.

    **Raises:** `ValueError` on an option of the wrong kind or out of its range.

    Source: Nocedal and Wright, 2006, chapter 18; Kiessling, Leyffer and Vanaret, 2024
    (the funnel); Verschueren et al., 2017, and Waechter and Biegler, 2006 (convexity).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dynamics = dlx.Discretized(dlx.systems.Pendulum(), dt=0.1)
        cost = dlx.costs.Quadratic([1.0, 0.1], [0.1], final=[20.0, 2.0])
        constraints = dlx.planning.Constraints(states=([-4.0, -1.5], [4.0, 1.5]))
        plan = dlx.planning.SQP()(
            dynamics,
            cost,
            jnp.array([1.0, 0.0]),
            jnp.zeros((20, 1)),
            bounds=(-8.0, 8.0),
            constraints=constraints,
        )
        jnp.min(plan.states[:, 1]), plan.iterations
        ```
    """

    max_iterations: int = eqx.field(default=200, static=True)
    tolerance: Array | None = parameter(None)
    constraint_tolerance: Array | None = parameter(None)
    second_order: bool = eqx.field(default=True, static=True)
    states: Float[Array, "steps n"] | None = parameter(None)

    def __check_init__(self):
        where = "SQP"
        check_count(self.max_iterations, "max_iterations", where)
        for name in ("tolerance", "constraint_tolerance"):
            if getattr(self, name) is not None:
                check_range(getattr(self, name), name, where)
        check_bool(self.second_order, "second_order", where)

    @property
    def starts_from_states(self) -> bool:
        return self.states is not None

    def solve(self, problem: Problem, start: Start, key: PRNGKey | None) -> Plan:
        del key
        dtype, states = start.controls.dtype, self.states
        if states is not None:
            n, points = problem.dynamics.state_size, start.horizon + 1
            states = finite_rows(states, n, "states", "SQP", points).astype(dtype)
        usual = float(jnp.finfo(dtype).eps) ** 0.5
        defaults = usual, usual / 10
        given = self.tolerance, self.constraint_tolerance
        tolerances = (
            jnp.asarray(default if value is None else value, dtype)
            for default, value in zip(defaults, given, strict=True)
        )
        options = Options(
            *tolerances,
            states=states,
            second_order=self.second_order,
            max_iterations=self.max_iterations,
        )
        return _solve(problem, start, options)


@eqx.filter_jit
def _solve(problem: Problem, start: Start, options: Options) -> Plan:
    out = solution(problem, start, options)
    fields = out._asdict()
    at = fields.pop("at")
    cost = problem.total(at.states, at.controls)
    return problem.plan(at.states, at.controls, cost, **fields)
