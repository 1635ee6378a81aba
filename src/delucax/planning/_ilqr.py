"""The iterative linear-quadratic regulator and differential dynamic programming."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._check import (
    check_bool,
    check_choice,
    check_count,
    check_positive,
    check_range,
    finite_rows,
)
from .._check_models import check_forward_mode
from .._module import parameter
from .._typing import Numbers, PRNGKey
from ..costs import AbstractCost
from ..dynamics import AbstractDynamics
from ._constraints import Constraints
from ._descent import Options, SEARCHES
from ._implicit import solution
from ._multipliers import by_name, Multipliers, zeros_like_result
from ._plan import Plan
from ._planner import AbstractPlanner
from ._problem import Augmentation, Problem
from ._start import Start


class ILQR(AbstractPlanner):
    r"""The iterative linear-quadratic regulator (iLQR), a local trajectory optimiser.

    It finds a trajectory that locally solves

    $$\min \sum_{k=0}^{T-1} c(t_k, x_k, u_k) + c_T(t_T, x_T)
    \quad \text{subject to} \quad
    x_{k+1} = F(t_k, x_k, u_k, w_k), \quad \mathrm{low} \le u_k \le \mathrm{high}$$

    where $c_T$ is the final cost. ILQR also finds feedback gains about this trajectory.

    Each iteration linearises the dynamics about the current trajectory $\bar x$,
    $\bar u$, and approximates the cost to second order, including the cross terms
    between state and control. Then the iteration solves the resulting linear-quadratic
    problem. The solution gives a change $-d_k$ of the control and a gain $K_k$. With
    these, the iteration applies the control
    $u_k = \bar u_k - \alpha\, d_k - K_k\, (x_k - \bar x_k)$ to the true dynamics.

    The line search tries the steps $\alpha = 1, 1/2, \dots, 1/2048$. The line search
    accepts a step if the cost falls by at least 1e-4 times the predicted decrease. It
    rejects a step if the trajectory diverges. The regularisation $\mu$ rises if no step
    is accepted or the control Hessian is not positive definite. The regularisation
    falls after each accepted step, by the schedule of Tassa, Erez and Todorov.

    The iteration has converged if the gradient of the cost with respect to each
    control, projected to the bounds, is at most `tolerance * (1 + size)`. Here `size`
    is the size of the terms whose sum is the gradient. The iteration has also converged
    if full steps ($\alpha = 1$) no longer reduce the gradient, and the predicted
    decrease of the cost is below the rounding error of the cost.

    Call the planner like every [`delucax.planning.AbstractPlanner`][]. ILQR handles
    hard constraints by the method of multipliers.

    You can differentiate the plan, in forward and reverse mode and to any order, with
    respect to every array in `dynamics`, `cost`, `x0`, `w`, `t0` and `bounds`. The
    derivative comes from the implicit function theorem. To compute this derivative,
    ILQR solves one linear-quadratic problem at the solution. This problem has exact
    second derivatives, even if the iteration did not use second derivatives.
    Derivatives are NaN unless the plan converged to a strict minimum. The derivatives
    with respect to the initial guess (`controls` and `states`) are zero.

    ILQR finds a local minimum, so the plan depends on the initial guess. If the plant
    is unstable, controls without feedback drive the state far away. Then the iteration
    may end at a stationary point that is far from the first state. If `controls` is a
    number of steps, the iteration starts from [`delucax.planning.Start.default`][],
    which also tries the trajectory of an LQR.

    For a hybrid plant, the linear-quadratic model about a trajectory is valid only for
    trajectories with the same number of events in each step. At a trajectory where the
    number of events in a step changes, the cost may have a kink or a jump. If the
    iteration ends at such a trajectory without convergence, the result is
    `events_changed`, and the plan is the best trajectory found so far. To get a plan
    with certain events, start from a trajectory that has these events.

    Under `jax.vmap` on CPU, the plans of a batch are computed one after the other. On
    CPU, planning one after the other is up to six times as fast as computing all plans
    together, because no plan waits for the line searches of another plan. On
    accelerators the plans are computed together.

    **Arguments:**

    - `max_iterations`: the largest number of iterations; 500 by default.
    - `tolerance`: the relative tolerance of the gradient. By default the tolerance is
        the square root of the machine precision (1.5e-8 in float64). With
        `finite_difference`, the default is at least the square of this spacing. With a
        tolerance of 0, the planner takes all `max_iterations` iterations.
    - `constraint_tolerance`: the largest allowed violation of a constraint. The default
        is the machine precision to the power 0.4 (5.5e-7 in float64).
    - `second_order`: whether to use the second derivatives of dynamics and constraints
        (differential dynamic programming). With second derivatives the planner takes
        fewer but more expensive iterations. An iteration leaves the second derivatives
        out if they make the problem nonconvex. If `second_order` is false, no iteration
        uses second derivatives (Gauss-Newton). Then the convergence is slow if the
        multipliers of the constraints are large. By default `second_order` is true if
        there are constraints and `finite_difference` is not given.
    - `regularise`: `"control"` (default) adds $\mu$ to the control Hessian; `"state"`
        adds $\mu$ to the Hessian of the cost-to-go.
    - `line_search`: `"backtracking"` (default) tries one step size after the other;
        `"parallel"` tries all step sizes at once, and is meant for accelerators.
    - `parallel`: whether to solve the linear-quadratic problems in parallel over the
        time steps, false by default. True is meant for long horizons on accelerators.
    - `finite_difference`: a spacing, such as 1e-2. If `finite_difference` is given, the
        planner linearises the dynamics by central differences with this spacing. These
        need two calls of the dynamics for each state and each control. By default the
        dynamics are differentiated automatically. The derivatives of the cost and of
        the plan are exact in both cases.
    - `states`: states to start from, shape `(T+1, n)` (multiple shooting). These states
        need not satisfy the dynamics, because the iteration closes the gaps between the
        steps. If you give `states`, `controls` must be an array or a number of steps.
        For a number of steps, the iteration starts at the constant control of the
        equilibrium. By default the states are the trajectory under `controls`.
    - `penalty`: the first weight $\rho$ of the penalty $\rho\, c^2 / 2$ of a violation
        $c$; 10 by default. The weight grows by a factor of 10 when the violation falls
        too slowly. Choose a larger penalty if the start is near the solution, or if the
        cost is much larger than the violations.

    **Raises:** `ValueError` if an option is of the wrong kind or out of its range, if
    `parallel` is combined with `regularise="state"`, or if `finite_difference` is
    combined with `second_order`. A call of the planner raises a `ValueError` if
    `parallel` is combined with `bounds`.

    Source: Li and Todorov, 2004; Tassa, Erez and Todorov, 2012; Tassa, Mansard and
    Todorov, 2014 (bounds); Giftthaler et al., 2018 (multiple shooting); Howell, Jackson
    and Manchester, 2019 (constraints).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dynamics = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05)
        cost = dlx.costs.Quadratic([1.0, 0.1], [0.1], final=[100.0, 10.0])
        planner = dlx.planning.ILQR(second_order=True, tolerance=1e-4)
        plan = planner(dynamics, cost, jnp.array([0.5, 0.0]), jnp.zeros((40, 1)))
        plan.cost
        ```

        ```text
        Array(8.385, dtype=float32)
        ```
    """

    max_iterations: int = eqx.field(default=500, static=True)
    tolerance: Array | None = parameter(None)
    constraint_tolerance: Array | None = parameter(None)
    second_order: bool | None = eqx.field(default=None, static=True)
    regularise: str = eqx.field(default="control", static=True)
    line_search: str = eqx.field(default="backtracking", static=True)
    parallel: bool = eqx.field(default=False, static=True)
    finite_difference: float | None = eqx.field(default=None, static=True)
    states: Float[Array, "steps n"] | None = parameter(None)
    penalty: Array = parameter(10.0)

    def __check_init__(self):
        where = "ILQR"
        check_count(self.max_iterations, "max_iterations", where)
        for name in ("tolerance", "constraint_tolerance"):
            if getattr(self, name) is not None:
                check_range(getattr(self, name), name, where)
        check_positive(self.penalty, "penalty", where)
        check_choice(self.regularise, ("control", "state"), "regularise", where)
        check_choice(self.line_search, SEARCHES, "line_search", where)
        check_bool(self.parallel, "parallel", where)
        if self.parallel and self.regularise == "state":
            raise ValueError(f"{where}: {_IN_SEQUENCE}")
        if self.finite_difference is not None:
            check_positive(self.finite_difference, "finite_difference", where)
            if self.second_order:
                raise ValueError(
                    f"{where}: finite_difference is incompatible with second_order."
                )

    @property
    def starts_from_states(self) -> bool:
        return self.states is not None

    def first_multipliers(self, problem: Problem, horizon: int) -> Multipliers | None:
        if problem.constraints is None:
            return None
        return zeros_like_result(_zero_multipliers, problem, horizon)

    def solve(self, problem: Problem, start: Start, key: PRNGKey | None) -> Plan:
        del key
        where, dtype = "ILQR", start.controls.dtype
        if self.parallel and problem.bounds is not None:
            raise ValueError(f"{where}: {_IN_SEQUENCE}")
        if problem.constraints is not None and not problem.constraints.is_hard:
            raise ValueError(
                f"{where}: constraints must be hard and given by functions. For soft "
                "constraints, and for the bounds `states` and `controls`, use "
                "`delucax.planning.SQP`."
            )
        states = self.states
        if states is not None:
            n, points = problem.dynamics.state_size, start.horizon + 1
            states = finite_rows(states, n, "states", where, points).astype(dtype)
        eps, spacing = float(jnp.finfo(dtype).eps), self.finite_difference
        # Central differences have an error of the order of the spacing squared. A
        # gradient below this error may not be a descent direction of the true cost.
        defaults = max(eps**0.5, (spacing or 0.0) ** 2), eps**0.4
        given = self.tolerance, self.constraint_tolerance
        tolerance, feasible = (
            jnp.asarray(default if value is None else value, dtype)
            for default, value in zip(defaults, given, strict=True)
        )
        # Gauss-Newton drops the curvature of the constraints times their multipliers.
        # It converges slowly if these are large.
        second_order = self.second_order
        if second_order is None:
            second_order = problem.constraints is not None and spacing is None
        if second_order:
            check_forward_mode(problem.dynamics, f"{where}(second_order=True)")
        filled: dict[str, Any] = dict(
            tolerance=tolerance,
            constraint_tolerance=feasible,
            second_order=bool(second_order),
            finite_difference=spacing and float(spacing),
            states=states,
        )
        return _solve(problem, start, Options(**(vars(self) | filled)))


_IN_SEQUENCE = (
    "parallel=True is incompatible with bounds and requires regularise='control'."
)


def ilqr(
    dynamics: AbstractDynamics,
    cost: AbstractCost,
    x0: Numbers,
    controls: Any,
    t0: ArrayLike = 0.0,
    w: Numbers | None = None,
    bounds: Sequence[Numbers] | None = None,
    *,
    constraints: Constraints | None = None,
    max_iterations: int = 500,
    tolerance: Any = None,
    throw: bool = True,
) -> Plan:
    r"""Plan a trajectory by the iterative linear-quadratic regulator (iLQR).

    The plan is a locally optimal trajectory with feedback gains. `ilqr` calls the
    planner [`delucax.planning.ILQR`][], which has more options. The page of that
    planner describes the method.

    **Arguments:**

    - `dynamics`: the discrete-time dynamics.
    - `cost`: the stage and final cost.
    - `x0`: the first state, shape `(n,)`.
    - `controls`: where to start. Pass an array of controls, shape `(T, m)`; or the
        number of steps `T`, to start from [`delucax.planning.Start.default`][]; or a
        [`delucax.planning.Start`][], which can hold feedback gains or several starts;
        or an earlier plan, to start from the trajectory and the gains of this plan.
    - `t0`: the time of the first state; 0 by default.
    - `w`: disturbances known in advance, shape `(T, k)`; zero by default.
    - `bounds`: the bounds `(low, high)` of the controls, each a number or an array of
        shape `(m,)`; none by default.
    - `constraints`: hard [`delucax.planning.Constraints`][] on states and controls,
        which are handled by the method of multipliers; none by default.
    - `max_iterations`: the largest number of iterations; 500 by default.
    - `tolerance`: the relative tolerance of the gradient; the square root of the
        machine precision by default (1.5e-8 in float64). With a tolerance of 0, the
        planner takes all `max_iterations` iterations.
    - `throw`: if true (default), raise an error if the plan did not converge. If false,
        check `plan.result` yourself.

    **Returns:** a [`delucax.planning.Plan`][]. Its `result` is one of:

    - `successful`: the plan is stationary.
    - `not_converged`: `max_iterations` were not enough.
    - `no_descent`: no step lowered the cost.
    - `events_changed`: the events of a hybrid plant changed from one iteration to the
        next.
    - `no_feasible_point`: the constraints were violated even with the largest penalty
        weight.
    - `diverged`: every start diverges.

    If the `result` is not `successful`, the plan is the best trajectory of all
    iterations. If the control Hessian at the plan is not positive definite,
    `plan.regularisation` is the number that was added to the Hessian, and the
    derivatives are NaN.

    **Raises:** `ValueError` if an argument has the wrong kind or shape or is not
    finite, the horizon is 0, or a lower bound is above an upper one; with `throw`, an
    error at run time if the plan did not converge.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dynamics = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05)
        cost = dlx.costs.Quadratic([1.0, 0.1], [0.1], final=[100.0, 10.0])
        hanging, start = jnp.array([jnp.pi, 0.0]), jnp.zeros((60, 1))
        plan = dlx.planning.ilqr(dynamics, cost, hanging, start, bounds=(-6.0, 6.0))
        plan.cost
        ```

        ```text
        Array(129.33, dtype=float32)
        ```
    """
    planner = ILQR(max_iterations, tolerance)
    given = dynamics, cost, x0, controls, t0, w, bounds
    return planner(*given, constraints=constraints, throw=throw)


@eqx.filter_jit
def _solve(problem: Problem, start: Start, options: Options) -> Plan:
    fields = solution(problem, start, options)._asdict()
    if fields["multipliers"] is not None:
        fields["multipliers"] = _named(problem, fields["multipliers"])
    return problem.plan(**fields)


def _named(problem: Problem, y: Augmentation) -> Multipliers:
    u = jnp.zeros(problem.dynamics.control_size, problem.x0.dtype)
    args = problem.t0, problem.x0, u
    stage = by_name(problem.constraints, False, args, y.stage)
    final = by_name(problem.constraints, True, args[:2], y.final)
    return Multipliers(stage, final, penalty=y.rho)


def _zero_multipliers(problem: Problem, horizon: int) -> Multipliers:
    dtype, dynamics = problem.x0.dtype, problem.dynamics
    x = jnp.zeros((horizon + 1, dynamics.state_size), dtype)
    u = jnp.zeros((horizon, dynamics.control_size), dtype)
    (stage, _), (final, _) = problem.constraints_along(x, u)
    return _named(problem, Augmentation(stage, final, jnp.zeros((), dtype)))
