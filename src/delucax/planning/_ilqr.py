"""Iterative linear-quadratic regulator, and differential dynamic programming."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from .._check import check_count, check_positive, check_range
from .._module import as_float_array
from .._results import choose, RESULTS
from ..costs import AbstractCost
from ..dynamics import AbstractDynamics
from ._arguments import as_problem, as_sequence, at_rest
from ._constraints import Constraints
from ._descent import (
    CONVERGED,
    DIVERGED,
    INFEASIBLE,
    NO_DESCENT,
    Options,
    Tolerances,
)
from ._implicit import solution
from ._plan import checked, Plan
from ._search import SEARCHES
from ._start import Start


def ilqr(
    dynamics: AbstractDynamics,
    cost: AbstractCost,
    x0: Any,
    controls: Any,
    t0: Any = 0.0,
    w: Any = None,
    bounds: Any = None,
    *,
    states: Any = None,
    constraints: Constraints | None = None,
    second_order: bool | None = None,
    regularise: str = "control",
    line_search: str = "backtracking",
    parallel: bool = False,
    finite_difference: float | None = None,
    max_iterations: int = 500,
    tolerance: Any = None,
    constraint_tolerance: Any = None,
    difference: Callable[[Any, Any], Any] | None = None,
    throw: bool = True,
) -> Plan:
    r"""Controls that locally minimise the cost over a horizon, and feedback about them:

    `minimise sum over k < T of c(t_k, x_k, u_k) + final(t_T, x_T)`, along
    `x_{k+1} = F(t_k, x_k, u_k, w_k)`, `low <= u_k <= high`, by the iterative
    linear-quadratic regulator. Each iteration solves the problem that is linear in the
    dynamics and quadratic in the cost about the present trajectory, cross terms
    included, and follows `u - a k - K (x - x_present)` through the true dynamics.

    A step `a = 1, 1/2, ..., 1/2048` is accepted if it brings 1e-4 of the improvement
    that the model promises. A candidate that diverges is rejected. When none is
    accepted, or the control Hessian is not positive definite, the regularisation `mu`
    rises, and it falls after a success, by the schedule of Tassa, Erez and Todorov.
    Converged is: the (projected) gradient with respect to each control is at most
    `tolerance` times one plus the size of the terms that cancel in it, or what a step
    promises is below the rounding of the cost, and of the states and controls that go
    into it.

    The plan is differentiable, in either mode and to any order, with respect to every
    array in `dynamics`, `cost`, `x0`, `w`, `t0` and `bounds`, by the implicit function
    theorem: one linear-quadratic problem at the solution, with exact second
    derivatives, whatever the iteration used. Where the iteration did not converge or
    the solution is no strict minimum, each derivative of the plan is NaN (a derivative
    of nothing, such as that of a lane that a batch masks, stays zero). It does not
    depend on `controls` and `states`, from which the iteration only starts.

    The minimum is a local one, and which one it is depends on the start. On an unstable
    plant controls alone lead far away, and the iteration may end in a stationary point
    out there. With the number of steps as `controls` it starts from the LQR's
    trajectory, if that is cheaper.

    Under `jax.vmap` on CPU the plans of a batch are made one after the other, which is
    up to six times as fast as together, where each iteration would wait for the longest
    line search and the last plan; accelerators make them together.

    **Arguments:**

    - `dynamics`: the discrete-time dynamics.
    - `cost`: the stage and final cost.
    - `x0`: the first state, shape `(n,)`.
    - `controls`: what to start from: controls, shape `(T, m)`; the number of steps `T`,
        for [`delucax.planning.default_start`][]; feedback, or several starts of which
        the cheapest is taken, as [`delucax.planning.Start`][]; or an earlier plan, with
        its gains.
    - `t0`: the time of the first state, 0 by default.
    - `w`: disturbances known in advance, shape `(T, k)`; zero by default.
    - `bounds`: `(low, high)`, each a number or of shape `(m,)`, between which every
        control is kept; none by default.
    - `states`: states to start from, shape `(T+1, n)`, which need not follow from
        `controls` (multiple shooting), which are an array or the number of steps then,
        for those of the equilibrium. The steps close the gaps. By default the states
        follow from `controls`.
    - `constraints`: [`delucax.planning.Constraints`][] on states and controls, by the
        method of multipliers; none by default.
    - `second_order`: if true, with the second derivatives of dynamics and constraints
        (differential dynamic programming), except in iterations in which they would
        make the problem concave: fewer iterations, each dearer. If false, without
        them (Gauss-Newton), which is slow where multipliers are large. By default true
        if there are constraints.
    - `regularise`: `"control"` (default), which adds `mu` to the control Hessian, or
        `"state"`, which adds it to that of the cost-to-go.
    - `line_search`: `"backtracking"` (default), one step after the other;
        `"parallel"`, all at once, for accelerators; or `"deluca"`, the search of the
        original library for comparison: ten candidates `a 1.1^(1 - j^2)`, of which the
        first that is not worse is taken and is the next `a`, which may grow beyond 1,
        and no regularisation.
    - `parallel`: if true, the linear-quadratic problems are solved in parallel over
        time, for long horizons on accelerators; in sequence by default.
    - `finite_difference`: the spacing of the central differences by which the dynamics
        are linearised, two calls of them for each state and control, such as 1e-2; by
        default they are differentiated. The derivatives of the plan are exact in both
        cases, those of the cost too.
    - `max_iterations`: 500 by default.
    - `tolerance`: the square root of the precision by default (1.5e-8 in float64), or
        the square of `finite_difference` if that is larger. At 0 all iterations are
        taken.
    - `constraint_tolerance`: by how much a constraint may be violated; the precision
        to the power 0.4 by default (5.5e-7 in float64).
    - `difference`: `(x, x_ref) -> deviation`, such as `system.difference`, which wraps
        angles, for dynamics that wrap them; subtraction by default.
    - `throw`: raise unless converged (default); if false, look at `plan.result`, which
        is `not_converged`, `no_descent`, `infeasible` if no weight makes the
        constraints hold, or `diverged` if every start diverges: the plan is then
        the best iterate.

    **Returns:** a [`delucax.planning.Plan`][]. Converged is stationary: where the
        control Hessian is not positive definite, `plan.regularisation` says what was
        added to it, and its derivatives are NaN.

    **Raises:** `ValueError` on an argument of the wrong kind or shape, or not finite, a
    horizon of 0, a lower bound above an upper one, `parallel` with `bounds` or
    `regularise="state"`, or `finite_difference` with `second_order`; an error at run
    time as `throw` says.

    Source: Li and Todorov, 2004; Tassa, Erez and Todorov, 2012; Tassa, Mansard and
    Todorov, 2014 (bounds); Giftthaler et al., 2018 (multiple shooting); Howell, Jackson
    and Manchester, 2019 (constraints).

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        dynamics = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05)
        cost = dlx.costs.Quadratic([1.0, 0.1], [0.1], final=[100.0, 10.0])
        start = jnp.zeros((60, 1))
        hanging = jnp.array([jnp.pi, 0.0])
        plan = dlx.planning.ilqr(dynamics, cost, hanging, start, bounds=(-6.0, 6.0))

        def optimal(mass):
            heavier = dlx.replace(dynamics, {"system.mass": mass})
            plan = dlx.planning.ilqr(heavier, cost, jnp.array([0.5, 0.0]), start)
            return plan.cost

        plan.cost, jax.grad(optimal)(1.0)
        ```
    """
    where = "ilqr"
    if states is not None:
        controls = at_rest(dynamics, cost, controls, where)
    problem, start = as_problem(
        dynamics, cost, x0, controls, t0, w, bounds, difference, constraints, where
    )
    guess, dtype = None, start.controls.dtype
    if states is not None:
        shape = start.controls.shape[0] + 1, dynamics.state_size
        guess = as_sequence(states, *shape, "states", where).astype(dtype)
    if regularise not in ("control", "state"):
        raise ValueError(
            f"{where}: regularise must be 'control' or 'state', got {regularise!r}."
        )
    if line_search not in SEARCHES:
        raise ValueError(
            f"{where}: line_search must be one of {', '.join(map(repr, SEARCHES))}, "
            f"got {line_search!r}."
        )
    plain = guess is None and constraints is None
    if line_search == "deluca" and not plain:
        raise ValueError(
            f"{where}: line_search='deluca' goes without states and constraints; use "
            "'parallel' or 'backtracking'."
        )
    if parallel and (bounds is not None or regularise == "state"):
        raise ValueError(
            f"{where}: parallel=True goes without bounds and with "
            "regularise='control'; solve in sequence otherwise."
        )
    eps = float(jnp.finfo(dtype).eps)
    if tolerance is None:
        # What differences leave over is no descent direction of the true cost.
        tolerance = max(eps**0.5, (finite_difference or 0.0) ** 2)
    check_range(tolerance, "tolerance", where)
    feasible = eps**0.4 if constraint_tolerance is None else constraint_tolerance
    check_range(feasible, "constraint_tolerance", where)
    if finite_difference is not None:
        check_positive(finite_difference, "finite_difference", where)
        finite_difference = float(finite_difference)
    if finite_difference is not None and second_order:
        raise ValueError(
            f"{where}: finite_difference goes without second_order, got both."
        )
    if second_order is None:
        second_order = constraints is not None and finite_difference is None
    options = Options(
        second_order=bool(second_order),
        on_state=regularise == "state",
        line_search=line_search,
        parallel=bool(parallel),
        max_iterations=check_count(max_iterations, "max_iterations", where),
        spacing=finite_difference,
    )
    tolerances = (as_float_array(t).astype(dtype) for t in (tolerance, feasible))
    plan = _plan(problem, start, guess, Tolerances(*tolerances), options)
    return checked(plan, where) if throw else plan


@eqx.filter_jit
def _plan(
    problem: Any, start: Start, guess: Any, tolerances: Any, options: Options
) -> Plan:
    out = solution(problem, start, guess, tolerances, options=options)
    result = RESULTS.not_converged
    for code, kind in (
        (CONVERGED, RESULTS.successful),
        (NO_DESCENT, RESULTS.no_descent),
        (DIVERGED, RESULTS.diverged),
        (INFEASIBLE, RESULTS.infeasible),
    ):
        result = choose(out.status == code, kind, result)
    return Plan(
        states=out.states,
        controls=out.controls,
        gains=out.gains,
        cost=out.cost,
        trace=out.trace,
        residual=out.residual,
        violation=out.violation,
        result=result,
        iterations=out.iterations,
        rollouts=out.rollouts,
        regularisation=out.mu,
        t0=problem.t0,
        dt=problem.dynamics.dt,
        low=problem.low,
        high=problem.high,
        difference=problem.difference,
    )
