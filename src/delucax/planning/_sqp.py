"""Sequential quadratic programming with hard constraints."""

import dataclasses
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._check import (
    check_bool,
    check_count,
    check_range,
    finite_rows,
    is_concrete,
)
from .._check_models import check_forward_mode
from .._jax import quickly_compiled
from .._module import parameter
from .._results import first_failure
from .._typing import PRNGKey
from ..qp import Soft
from ..qp._solve import as_scalar
from ._carried import with_carried
from ._multipliers import Multipliers, zeros_like_result
from ._plan import Plan
from ._planner import AbstractPlanner
from ._problem import Problem
from ._real_time import fed_back, prepared
from ._sqp_derivatives import solution
from ._sqp_iteration import Options
from ._start import Start
from ._transcription import Iterate, limits_of, multipliers_of
from ._unknowns import check_unknowns


class SQP(AbstractPlanner):
    r"""Sequential quadratic programming (SQP), a planner with hard constraints.

    It finds a trajectory that locally solves

    $$\min \sum_{k=0}^{T-1} c(t_k, x_k, u_k) + c_T(t_T, x_T)
    \quad \text{subject to} \quad x_{k+1} = F(t_k, x_k, u_k, w_k)$$

    and subject to the [`delucax.planning.Constraints`][]. Here $c_T$ is the final cost.
    SQP also finds feedback gains about this trajectory. The optimisation variables are
    the states and the controls (multiple shooting). The initial guess of the states
    need not follow the dynamics, which helps with unstable plants.

    Each iteration approximates the problem about the current trajectory by a quadratic
    program, and solves this program by the method of [`delucax.qp.solve`][]. Far from a
    solution, the quadratic program uses the Hessian of the cost. Once the relative
    error of the optimality conditions is below 0.01, the quadratic program uses the
    Hessian of the Lagrangian. If a quadratic program with the Hessian of the cost has
    no unique minimum, the planner also changes to the Hessian of the Lagrangian. The
    quadratic program may be nonconvex for changes that satisfy the linearised dynamics.
    Then the planner adds the squares of the active constraints to the cost of the
    program, and if necessary a multiple of the identity to the Hessian.

    The line search tries the steps 1, 1/2, ..., 1/2048. The line search accepts a step
    only if the sum of all constraint violations stays below a limit, the width of the
    funnel. In addition, the cost must fall by at least 1e-4 times the predicted
    decrease, or the sum of the violations must fall below 0.9 times the width of the
    funnel. If a step is accepted because the violations fall, the width of the funnel
    is reduced.

    If the linearised constraints have no feasible point, the planner adds the weighted
    squares of their violations to the cost. Near a stationary point of the new cost,
    the planner tries the linearised constraints again, and increases the weight of the
    squares. If the constraints are violated even with the largest weight, the result is
    `no_feasible_point`.

    The iteration has converged if three conditions hold. First, the gradient of the
    Lagrangian and the error of complementarity are at most `tolerance * (1 + size)`,
    where `size` is the size of the terms that are added up in them. Second, the states
    satisfy the dynamics to the same relative tolerance. Third, no constraint is
    violated by more than `constraint_tolerance`.

    There are two initial guesses of the states: the trajectory under the initial
    controls, and the first state repeated at every stage. The planner takes the guess
    with the smaller sum of all constraint violations. If the planner starts from an
    earlier plan, it also starts from the multipliers of that plan.

    `plan.multipliers` are the multipliers at the solution. `plan.cost` does not include
    the penalty of violated soft constraints; `plan.trace` does.

    You can differentiate the plan, in forward and reverse mode, with respect to every
    array in `dynamics`, `cost`, `constraints`, `x0`, `w`, `t0` and `bounds`. The
    derivative comes from the implicit function theorem. To compute this derivative, SQP
    solves one quadratic program at the solution, with exact second derivatives.
    Derivatives are NaN unless the plan converged to a strict minimum whose active
    constraints are independent and have positive multipliers. The derivatives with
    respect to the initial guess (`controls` and `states`) are zero.

    The planner does not track the events of a hybrid plant. At a trajectory where the
    events change, the cost has a kink. If the solution is at such a kink, the result is
    `not_converged` or `no_descent`.

    Under `jax.vmap` on CPU, the plans of a batch are computed one after the other, as
    for [`delucax.planning.ILQR`][].

    **Arguments:**

    - `max_iterations`: the largest number of iterations; 200 by default.
    - `tolerance`: the relative tolerance of the optimality conditions; the square root
        of the machine precision by default (1.5e-8 in float64).
    - `constraint_tolerance`: the largest allowed violation of a constraint; by default
        a tenth of the default `tolerance`.
    - `second_order`: if true (default), use the Hessian of the Lagrangian near a
        solution. If false, always use the Hessian of the cost (Gauss-Newton).
    - `states`: states to start from, shape `(T+1, n)`. If you give `states`, `controls`
        must be an array or a number of steps. For a number of steps, the iteration
        starts at the constant control of the equilibrium. By default the states are the
        trajectory under `controls`.

    **Raises:** `ValueError` if an option is of the wrong kind or out of its range.

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

    takes_unknowns: ClassVar[bool] = True

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

    def first_multipliers(self, problem: Problem, horizon: int) -> Multipliers:
        return zeros_like_result(_zero_multipliers, problem, horizon)

    def solve(self, problem: Problem, start: Start, key: PRNGKey | None) -> Plan:
        del key
        dtype, states = start.controls.dtype, self.states
        check_forward_mode(problem.dynamics, "SQP")
        check_unknowns(problem, start.horizon)
        _check_controls(problem, start.horizon)
        if states is not None:
            n, points = problem.dynamics.state_size, start.horizon + 1
            states = finite_rows(states, n, "states", "SQP", points).astype(dtype)
        usual = float(jnp.finfo(dtype).eps) ** 0.5
        defaults = usual, usual / 10
        given = self.tolerance, self.constraint_tolerance
        tolerances = (
            as_scalar(default if value is None else value, dtype)
            for default, value in zip(defaults, given, strict=True)
        )
        options = Options(
            *tolerances,
            states=states,
            second_order=self.second_order,
            max_iterations=self.max_iterations,
        )
        return _solve(problem, start, options)

    def prepare(self, problem: Problem, start: Start) -> PyTree:
        """Prepare a real-time iteration: set up its quadratic program.

        The program approximates the problem about the states and controls of `start`,
        which need not follow the dynamics. The program does not depend on `problem.x0`,
        so you can prepare it before the state is measured.

        **Arguments:**

        - `problem`: a [`delucax.planning.Problem`][], without unknowns.
        - `start`: one [`delucax.planning.Start`][], with states.

        **Returns:** a pytree, to pass to `feedback`.

        **Raises:** `ValueError` if `start` holds several starts or has no states, or
        the problem has unknowns.

        Source: Diehl, Bock, Schloeder, Findeisen, Nagy and Allgoewer, 2002.
        """
        if start.states is None or start.controls.ndim != 2:
            got = "no states" if start.states is None else f"{start.count} starts"
            raise ValueError(
                f"SQP.prepare: start must be one start with states, got {got}."
            )
        if problem.unknowns is not None:
            raise ValueError(
                "SQP.prepare: problem.unknowns must be None, because a real-time "
                "iteration takes none."
            )
        check_forward_mode(problem.dynamics, "SQP.prepare")
        return prepared(problem, start, self.second_order)

    def feedback(self, problem: Problem, ready: PyTree, max_steps: int = 50) -> Plan:
        """Finish a real-time iteration: solve the prepared quadratic program.

        The plan starts from `problem.x0` and takes the full step that solves the
        program.

        **Arguments:**

        - `problem`: the [`delucax.planning.Problem`][] with the current state as `x0`.
        - `ready`: what `prepare` returned.
        - `max_steps`: the largest number of linear systems to solve; 50 by default.

        **Returns:** a [`delucax.planning.Plan`][]. The `result` of the plan is
        `successful` if the quadratic program was solved. `residual`, `violation` and
        `iterations` are the numbers of the quadratic program.
        """
        return fed_back(problem, ready, max_steps)


def _check_controls(problem: Problem, horizon: int) -> None:
    """Raise if the bounds of the planner and of the constraints do not overlap."""
    own = None if problem.constraints is None else problem.constraints.controls
    if own is None or problem.bounds is None or isinstance(own, Soft):
        return
    if not all(map(is_concrete, (*own, *problem.bounds))):
        return
    shape = horizon, problem.dynamics.control_size
    # `limits_of` raises on shapes that do not fit.
    if any(np.shape(end) not in ((), shape[1:], shape) for end in own):
        return
    low, high = (
        np.broadcast_to(pick(np.asarray(a), np.asarray(b)), shape)
        for pick, a, b in zip(
            (np.maximum, np.minimum), own, problem.bounds, strict=True
        )
    )
    if (low > high).any():
        k, i = np.argwhere(low > high)[0]
        raise ValueError(
            "SQP: bounds and the bounds `controls` of constraints must overlap, but "
            f"the control in entry {i} at stage {k} must be at least {low[k, i]} and "
            f"at most {high[k, i]}."
        )


@quickly_compiled
def _solve(problem: Problem, start: Start, options: Options) -> Plan:
    n, whole, carried = problem.x0.shape[0], problem, None
    if problem.unknowns is not None:
        whole, start, states, carried = with_carried(problem, start, options.states)
        options = dataclasses.replace(options, states=states)
    out = solution(whole, start, options)
    fields = out._asdict()
    at, gains = fields.pop("at"), fields.pop("gains")
    limits = limits_of(whole, start.horizon)
    fields["multipliers"] = multipliers_of(whole, limits, at)
    steps = whole.failure(at.states, at.controls)
    fields["result"] = first_failure(steps, fields["result"])
    cost = whole.total(at.states, at.controls)
    if carried is not None:
        values = carried.values(at.states[0, n:])
        parts, *_ = carried.opened(0, at.states[0])
        fields |= dict(dt=parts["dynamics"].dt, parameters=values)
    states, gains = at.states[:, :n], gains[:, :, :n]
    return problem.plan(states, at.controls, cost, gains=gains, **fields)


def _zero_multipliers(problem: Problem, horizon: int) -> Multipliers:
    limits, x0 = limits_of(problem, horizon), problem.x0
    states = jnp.zeros((horizon + 1, *x0.shape), x0.dtype)
    controls = jnp.zeros((horizon, problem.dynamics.control_size), x0.dtype)
    sides = jnp.zeros((2, *limits.low.shape), x0.dtype)
    return multipliers_of(problem, limits, Iterate(states, controls, states, sides))
