"""Iterative linear-quadratic regulator, and differential dynamic programming."""

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
    r"""Controls that locally minimise the cost over a horizon, and feedback about them:

    `minimise sum over k < T of c(t_k, x_k, u_k) + final(t_T, x_T)`, along
    `x_{k+1} = F(t_k, x_k, u_k, w_k)`, `low <= u_k <= high`, by the iterative
    linear-quadratic regulator. Each iteration solves the problem that is linear in the
    dynamics and quadratic in the cost about the present trajectory, cross terms
    included, and follows `u - a k - K (x - x_present)` through the true dynamics.

    A step `a = 1, 1/2, ..., 1/2048` is accepted if the cost falls by at least 1e-4 of
    the predicted decrease. A candidate that diverges is rejected. When none is
    accepted, or the control Hessian is not positive definite, the regularisation `mu`
    rises, and it falls after a success, by the schedule of Tassa, Erez and Todorov.
    It has converged if the (projected) gradient with respect to each control is at most
    `tolerance` times one plus the size of the terms that cancel in it, or if the
    predicted decrease is below the rounding of the cost, and of the states and controls
    that go into it.

    It is called as every [`delucax.planning.AbstractPlanner`][], and takes constraints,
    by the method of multipliers.

    The plan is differentiable, in either mode and to any order, with respect to every
    array in `dynamics`, `cost`, `x0`, `w`, `t0` and `bounds`, by the implicit function
    theorem: one linear-quadratic problem at the solution, with exact second
    derivatives, whatever the iteration used. Derivatives are NaN unless the solution is
    a converged strict minimum. They are zero with respect to `controls` and `states`,
    from which the iteration only starts.

    The minimum is a local one, and which one it is depends on the start. On an unstable
    plant controls alone lead far away, and the iteration may end in a stationary point
    far from the region of interest. If `controls` is a number of steps, it starts from
    the LQR's trajectory if that is cheaper than that of the equilibrium's control.

    Where the number of events in a step of a hybrid plant is another, the model of an
    iterate does not hold, and the cost may have a kink or a jump. If the iteration ends
    there without convergence, the result is `events_changed`, and the plan is the best
    so far. A start with the wanted events leads to a plan that has them.

    Under `jax.vmap` on CPU the plans of a batch are made one after the other, which is
    up to six times as fast as together, where each iteration would wait for the longest
    line search and the last plan; accelerators make them together.

    **Arguments:**

    - `max_iterations`: 500 by default.
    - `tolerance`: the square root of the precision by default (1.5e-8 in float64), or
        the square of `finite_difference` if that is larger. At 0 all iterations are
        taken.
    - `constraint_tolerance`: by how much a constraint may be violated; the precision
        to the power 0.4 by default (5.5e-7 in float64).
    - `second_order`: if true, with the second derivatives of dynamics and constraints
        (differential dynamic programming), except in iterations in which they would
        make the problem concave: fewer but more expensive iterations. If false, without
        them (Gauss-Newton), which is slow where multipliers are large. By default true
        if there are constraints.
    - `regularise`: `"control"` (default), which adds `mu` to the control Hessian, or
        `"state"`, which adds it to that of the cost-to-go.
    - `line_search`: `"backtracking"` (default), one step after the other; or
        `"parallel"`, all at once, for accelerators.
    - `parallel`: if true, the linear-quadratic problems are solved in parallel over
        time, for long horizons on accelerators; in sequence by default.
    - `finite_difference`: the spacing of the central differences by which the dynamics
        are linearised, two calls of them for each state and control, such as 1e-2; by
        default they are differentiated. The derivatives of the plan are exact in both
        cases, those of the cost too.
    - `states`: states to start from, shape `(T+1, n)`, which need not follow from
        `controls` (multiple shooting): the steps close the gaps. `controls` must then
        be an array, or the number of steps for the controls of the equilibrium. By
        default the states follow from `controls`.
    - `penalty`: the first weight of the square of what violates a constraint, over two;
        10 by default. It grows tenfold where the violation does not fall fast. A start
        near the solution, or a cost much larger than its constraints, wants more.

    **Raises:** `ValueError` on an option of the wrong kind or out of its range,
    `parallel` with `regularise="state"`, or `finite_difference` with `second_order`;
    when it is called also on `parallel` with `bounds`.

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
        plan.cost, plan.iterations
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
                f"{where}: constraints must be hard and given by functions; for soft "
                "ones, and for bounds of states, use `delucax.planning.SQP`."
            )
        states = self.states
        if states is not None:
            n, points = problem.dynamics.state_size, start.horizon + 1
            states = finite_rows(states, n, "states", where, points).astype(dtype)
        eps, spacing = float(jnp.finfo(dtype).eps), self.finite_difference
        # The error of central differences is of the order of the spacing squared. Below
        # it the gradient is not a descent direction of the true cost.
        defaults = max(eps**0.5, (spacing or 0.0) ** 2), eps**0.4
        given = self.tolerance, self.constraint_tolerance
        tolerance, feasible = (
            jnp.asarray(default if value is None else value, dtype)
            for default, value in zip(defaults, given, strict=True)
        )
        # Gauss-Newton drops the curvature of the constraints times their multipliers,
        # which may be large: it converges slowly there.
        second_order = self.second_order
        if second_order is None:
            second_order = problem.constraints is not None and spacing is None
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
    r"""Controls that locally minimise the cost over a horizon, and feedback about them,
    by the iterative linear-quadratic regulator: the short call of
    [`delucax.planning.ILQR`][], which says how, and has further options.

    **Arguments:**

    - `dynamics`: the discrete-time dynamics.
    - `cost`: the stage and final cost.
    - `x0`: the first state, shape `(n,)`.
    - `controls`: what to start from: controls, shape `(T, m)`; the number of steps `T`,
        for [`delucax.planning.Start.default`][]; feedback, or several starts of which
        the cheapest is taken, as [`delucax.planning.Start`][]; or an earlier plan, with
        its gains.
    - `t0`: the time of the first state, 0 by default.
    - `w`: disturbances known in advance, shape `(T, k)`; zero by default.
    - `bounds`: `(low, high)`, each a number or of shape `(m,)`, between which every
        control is kept; none by default.
    - `constraints`: [`delucax.planning.Constraints`][] on states and controls, by the
        method of multipliers; none by default.
    - `max_iterations`: 500 by default.
    - `tolerance`: the square root of the precision by default (1.5e-8 in float64). At 0
        all iterations are taken.
    - `throw`: raise unless converged (default); if false, look at `plan.result`, which
        is `not_converged`, `no_descent`, `events_changed` where the events of a hybrid
        plant are others from one iterate to the next, `no_feasible_point` if no weight
        makes the constraints hold, or `diverged` if every start diverges: the plan is
        then the best iterate.

    **Returns:** a [`delucax.planning.Plan`][]. It is stationary if it has converged.
        Where the control Hessian is not positive definite, `plan.regularisation` says
        what was added to it, and the derivatives are NaN.

    **Raises:** `ValueError` on an argument of the wrong kind or shape, or not finite, a
    horizon of 0, or a lower bound above an upper one; an error at run time as `throw`
    says.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dynamics = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05)
        cost = dlx.costs.Quadratic([1.0, 0.1], [0.1], final=[100.0, 10.0])
        hanging, start = jnp.array([jnp.pi, 0.0]), jnp.zeros((60, 1))
        plan = dlx.planning.ilqr(dynamics, cost, hanging, start, bounds=(-6.0, 6.0))
        plan.states[-1], plan.cost, plan.iterations
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
