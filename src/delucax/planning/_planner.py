"""What a planner is, and the plan that it returns."""

import abc
import numbers
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._check import (
    as_bounds,
    check_control_bounds,
    check_count,
    check_instance,
    check_key,
    check_number,
    check_step,
    finite_rows,
    finite_vector,
)
from .._controller import AbstractController, wrong_observation
from .._module import as_float_array, as_module, function_field, parameter, weight
from .._results import choose, raise_on_failure, Result, RESULTS
from .._typing import PRNGKey
from ..costs import AbstractCost
from ..dynamics import AbstractDynamics
from ..math import matvec
from ..math._steps import row_at, step_at
from ._problem import Constraints, Problem
from ._start import operating_point, Start


class Plan(AbstractController):
    """A locally optimal trajectory, and a controller that follows it,

    `u = controls[k] - gains[k] (y - states[k])` with `k = round((t - t0) / dt)`,

    between the bounds that it was planned with. Outside the horizon the control is NaN,
    which a rollout reports. [`delucax.planning.ilqr`][] makes it, and so do
    [`delucax.planning.MPPI`][] and [`delucax.planning.CEM`][], without gains, and
    [`delucax.planning.ilc`][] and [`delucax.planning.igpc`][].

    **Arguments:**

    - `states`: shape `(T+1, n)`.
    - `controls`: shape `(T, m)`, trainable.
    - `gains`: shape `(T, m, n)`, trainable. The rows of controls that a bound holds are
        zero.
    - `cost`: the cost of the trajectory, with its final cost.
    - `trace`: the cost at the start and after each iteration, shape
        `(max_iterations + 1,)`; the last one repeated where there were fewer. With
        constraints, of the augmented Lagrangian.
    - `residual`: the largest entry of the gradient of the cost with respect to the
        controls, of its projection where a bound holds; of a planner that samples, the
        largest change of a control in the last iteration.
    - `violation`: by how much a constraint is violated, or is inactive although its
        multiplier is not zero; 0 without constraints.
    - `result`: success, or why not; one of `delucax.RESULTS`.
    - `iterations`: the iterations taken.
    - `rollouts`: the trajectories computed, each candidate of a line search being one.
    - `regularisation`: that of the last iteration. Above zero, the problem has no
        positive definite control Hessian at the solution, or the search was hard.
    - `t0`: the time of the first state.
    - `dt`: the control interval.
    - `low`, `high`: the bounds of the controls, shape `(m,)`; `None` if there are none.
    - `difference`: `(x, x_ref) -> deviation`; subtraction by default.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        env = dlx.make("planar_quadrotor", horizon=40)
        _, hover = env.dynamics.equilibrium()
        start = jnp.tile(hover, (40, 1))
        plan = dlx.planning.ilqr(env.dynamics, env.cost, env.initial_state, start)
        dlx.rollout(env, plan, key=jax.random.key(0)).total_cost
        ```
    """

    states: Float[Array, "*batch T+1 n"] = parameter()
    controls: Float[Array, "*batch T m"] = weight()
    gains: Float[Array, "*batch T m n"] = weight()
    cost: Array
    trace: Array
    residual: Array
    violation: Array
    result: Result
    iterations: Array
    rollouts: Array
    regularisation: Array
    t0: Array = parameter()
    dt: Array = parameter()
    low: Array | None = parameter()
    high: Array | None = parameter()
    difference: Callable[[Any, Any], Any] | None = function_field()

    def __check_init__(self):
        check_step(self.dt, "Plan")
        if self.low is not None or self.high is not None:
            bounds, size = (self.low, self.high), self.controls.shape[-1]
            as_bounds(bounds, "Plan", "low and high", size)

    @property
    def is_usable(self) -> Array:
        """Whether the planner has a plan to use: it did not diverge, and the
        constraints can hold.

        A plan of too few iterations, or whose search failed, is the best so far.
        """
        finite = jnp.all(jnp.isfinite(self.controls), axis=(-2, -1))
        lost = (self.result == RESULTS.diverged) | (self.result == RESULTS.infeasible)
        return finite & ~lost

    def __call__(self, t, y, state):
        size = self.states.shape[1]
        if y.shape != (size,):
            raise wrong_observation(self, size, y)
        step = step_at(t - self.t0, self.dt, len(self.controls), "Plan")
        rows = self.states[:-1], self.controls, self.gains
        x_ref, u_ref, K = row_at(rows, step)
        e = y - x_ref if self.difference is None else self.difference(y, x_ref)
        u = u_ref - matvec(K, e)
        if self.low is not None and self.high is not None:
            u = jnp.minimum(jnp.maximum(u, self.low), self.high)
        return u.astype(y.dtype), state


def plan_of(
    problem: Problem, states: Array, controls: Array, cost: Array, **rest: Any
) -> Plan:
    """A plan for a problem."""
    defaults = dict.fromkeys(("violation", "regularisation"), jnp.zeros_like(cost))
    low, high = problem.bounds or (None, None)
    return Plan(
        states=states,
        controls=controls,
        cost=cost,
        t0=problem.t0,
        dt=problem.dynamics.dt,
        low=low,
        high=high,
        difference=problem.difference,
        **(defaults | rest),
    )


def checked_plan(plan: Plan, where: str, throw: bool = True) -> Plan:
    """Raise if asked to, unless the plan is a solution."""
    facts = lambda: (
        f"After {int(plan.iterations)} iterations the cost is {float(plan.cost):.6g} "
        f"and the residual {float(plan.residual):.2g}."
    )
    return raise_on_failure(plan, where, throw, "the plan", facts)


class AbstractPlanner(eqx.Module):
    """A way to find a plan. Its fields are its options; a call gives it a problem:

    `plan = planner(dynamics, cost, x0, controls, t0, w, bounds)`.

    A planner of your own has the method `solve`, which gets a problem whose arguments
    are checked. It works in [`delucax.controllers.MPC`][] then.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        env = dlx.make("pendulum")
        given = env.dynamics, env.cost, jnp.array([0.5, 0.0]), 10
        for planner in (dlx.planning.ILQR(), dlx.planning.CEM(samples=64)):
            key = jax.random.key(0) if planner.is_stochastic else None
            plan = planner(*given, bounds=(-2.0, 2.0), key=key)
            plan.cost, plan.result
        ```
    """

    is_stochastic: ClassVar[bool] = False
    """Whether it draws random numbers, and so needs a key."""

    @property
    def starts_from_states(self) -> bool:
        """Whether it has states to start from, and so takes no feedback."""
        return False

    @abc.abstractmethod
    def solve(self, problem: Problem, start: Start, key: PRNGKey | None) -> Plan:
        """The plan, whatever became of it.

        **Arguments:**

        - `problem`: dynamics, cost, first state and time, known disturbances, bounds
            and constraints; with the cost of a trajectory and so on as methods.
        - `start`: one start, or several along a first axis.
        - `key`: a random key if the planner draws, else `None`.
        """

    def __call__(
        self,
        dynamics: AbstractDynamics,
        cost: AbstractCost,
        x0: Any,
        controls: Any,
        t0: Any = 0.0,
        w: Any = None,
        bounds: Any = None,
        *,
        constraints: Constraints | None = None,
        difference: Callable[[Array, Array], Array] | None = None,
        fallback: Start | Plan | None = None,
        key: PRNGKey | None = None,
        throw: bool = True,
    ) -> Plan:
        """Plan.

        **Arguments:**

        - `dynamics`: the discrete-time dynamics.
        - `cost`: the stage and final cost.
        - `x0`: the first state, shape `(n,)`.
        - `controls`: what to start from: controls, shape `(T, m)`; the number of steps
            `T`, for [`delucax.planning.Start.default`][]; feedback, or several starts
            of which the cheapest is taken, as [`delucax.planning.Start`][]; or an
            earlier plan, with its gains.
        - `t0`: the time of the first state, 0 by default.
        - `w`: disturbances known in advance, shape `(T, k)`; zero by default.
        - `bounds`: `(low, high)`, each a number or of shape `(m,)`, between which every
            control is kept; none by default.
        - `constraints`: [`delucax.planning.Constraints`][] on states and controls, for
            planners that take them; none by default.
        - `difference`: `(x, x_ref) -> deviation`, such as `system.difference`, which
            wraps angles, for dynamics that wrap them; subtraction by default.
        - `fallback`: feedback of the same horizon, with states and gains, which the
            plan holds in place of its own where that is of no use: every start
            diverges, or the constraints cannot hold. Its `result` says so. None by
            default.
        - `key`: a random key, for planners that draw.
        - `throw`: raise unless the plan is a solution (default); if false, look at
            `plan.result`.

        **Returns:** a [`delucax.planning.Plan`][].

        **Raises:** `ValueError` on an argument of the wrong kind or shape, or not
        finite; an error at run time as `throw` says.
        """
        where = type(self).__name__
        check_instance(dynamics, AbstractDynamics, "dynamics", where)
        check_instance(cost, AbstractCost, "cost", where)
        n, m = dynamics.state_size, dynamics.control_size
        x0 = finite_vector(x0, n, "x0", where)
        check_number(t0, "t0", where)
        t0 = as_float_array(t0)
        known = ()
        if isinstance(controls, Start | Plan):
            if self.starts_from_states:
                raise ValueError(
                    f"{where}: states go with an array of controls or a number of "
                    f"steps, got {type(controls).__name__}."
                )
            start = Start(controls.controls, controls.states, controls.gains)
            start = start.checked(n, m, "controls", where)
            known = (start.controls,)
        elif not isinstance(controls, numbers.Integral):
            start = Start(finite_rows(controls, m, "controls", where))
            known = (start.controls,)
        # A default start has no precision of its own.
        elif self.starts_from_states:
            T = check_count(controls, "controls (the horizon)", where)
            start = Start(jnp.tile(operating_point(dynamics, cost)[1], (T, 1)))
        else:
            T = check_count(controls, "controls (the horizon)", where)
            start = Start.default(dynamics, cost, T, t0)
        dtype = jnp.result_type(x0, *known)
        if w is not None:
            size = dynamics.disturbance_size
            w = finite_rows(w, size, "w", where, start.horizon)
        if difference is not None and not callable(difference):
            raise ValueError(
                f"{where}: difference must be a function, got {difference!r}."
            )
        if constraints is not None:
            hint = " (`delucax.planning.Constraints`)"
            check_instance(constraints, Constraints, "constraints", where, hint)
        ends: Any = check_control_bounds(bounds, m, where)
        if ends is not None:
            ends = tuple(jnp.broadcast_to(end, (m,)).astype(dtype) for end in ends)
        x0, t0, distance = x0.astype(dtype), t0.astype(dtype), as_module(difference)
        problem = Problem(dynamics, cost, x0, t0, w, ends, distance, constraints)
        start = jax.tree.map(lambda a: a.astype(dtype), start)
        if self.is_stochastic:
            check_key(key, where)
        plan = self.solve(problem, start, key)
        if fallback is not None:
            plan = _with_fallback(plan, fallback)
        return checked_plan(plan, where, throw)


@eqx.filter_jit
def _with_fallback(plan: Plan, fallback: Start | Plan) -> Plan:
    trajectory = lambda p: (p.states, p.controls, p.gains)
    usable = plan.is_usable
    # By `where`, not `cond`: under `jax.vmap` each member of a batch has its own.
    keep = lambda new, old: jnp.where(usable, new, old).astype(new.dtype)
    # Controls that are not finite are of no use either, whatever the planner says.
    result = choose(plan.result == RESULTS.successful, RESULTS.diverged, plan.result)
    result = choose(usable, plan.result, result)
    kept = jax.tree.map(keep, trajectory(plan), trajectory(fallback))
    return eqx.tree_at(lambda p: (*trajectory(p), p.result), plan, (*kept, result))
