"""Model predictive control."""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Int, PyTree

from .._check import (
    as_rows,
    bounds_field,
    check_bool,
    check_control_bounds,
    check_count,
    check_finite,
    check_instance,
    check_key,
)
from .._check_models import check_cost_sizes
from .._controller import AbstractController, Tally
from .._jax import host_unless_traced, quickly_compiled, xp
from .._module import as_float_array, function_field
from .._results import error_if, Result, RESULTS
from .._typing import Control, Difference, Observation, PRNGKey, RealScalar
from ..costs import AbstractCost
from ..dynamics import AbstractDynamics
from ..math import matvec
from ..planning import AbstractPlanner, Constraints, ILQR, Plan, Problem, SQP, Start
from ._operating_point import check_state, deviation


_REMEDY = (
    "So there is no usable plan. With MPC(..., throw=False), or with a fallback, the "
    "run goes on, and `run.incident_times['failed_plan']` is the first time without a "
    "plan. Call the planner from the state at that time: its error says what is wrong, "
    "and which constraints are violated."
)


class MPCState(NamedTuple):
    """The state of [`delucax.controllers.MPC`][]."""

    last: Start
    result: Result
    failures: Tally
    iterations: Int[Array, ""]
    key: PRNGKey | None
    fallback: PyTree
    prepared: PyTree = None


class MPC(AbstractController):
    """Model predictive control: plan at each step, and apply the first control.

    The control $u_k$ is the first control of a plan over `horizon` steps from the state
    $y_k$ at time $t_k$. Any [`delucax.planning.AbstractPlanner`][] can make the plans.
    The cost may depend on time, for example through a reference.

    **Starts.** Each plan starts from the cheapest of three trajectories from $y_k$,
    which are computed together, within the bounds:

    1. the last plan, shifted by one step, under its feedback gains,
    2. the trajectory under an LQR about an operating point,
    3. the trajectory under the constant control of the operating point.

    The LQR keeps an unstable plant near the operating point. A plan of
    [`delucax.planning.ILQR`][] without constraints costs at most as much as each of
    these three trajectories. [`delucax.planning.Start.default`][] chooses the operating
    point and computes the LQR once, when you make the controller. Give a `start` if you
    want to hold an unstable plant far from that point, or if no LQR exists about that
    point: [`delucax.planning.Start.default`][] lists the reasons why it may not exist.

    **Status.** The state of the controller has

    - `result`: the status of the last plan,
    - `iterations`: the number of iterations of the last plan,
    - `failures`: the number of plans that were not successful, which a rollout counts
        in `incidents["failed_plan"]`,
    - `last`: the last plan, shifted by one step, a [`delucax.planning.Start`][].

    After a rollout, `run.controller_state` is the state of the controller at the end of
    the run, and `run.incidents["failed_plan"]` is true at the steps whose plan was not
    successful. The rollout stores both by default; if you pass `keep` to
    [`delucax.rollout`][], it must hold `"controller_state"` and `"incidents"`. A
    rollout does not store the costs of the plans and the violations of their
    constraints. To get them, compute the plans again from the times and states of the
    run, as in the example. The new plans do not start from the plan of the step before,
    so they may end in another local minimum.

    If the planner runs out of iterations or finds no descent, the controller still uses
    its plan, because it is the best plan so far. A plan is unusable if the planner
    diverges from every start, or if no plan can satisfy the constraints. `throw` and
    `fallback` decide what the controller does without a usable plan.

    **Real time.** With `real_time` the planner does not iterate until it converges. At
    each time step, [`delucax.planning.SQP`][] solves only one quadratic program, which
    approximates the problem about the last plan, shifted by one step. The solution of
    this program is the new plan, without a line search. `prepare` sets up the program
    before the state is measured. `feedback` solves it with at most `max_qp_steps`
    linear systems; `state.iterations` is the number of systems that it solved:

        state = mpc.init()
        while True:
            state = mpc.prepare(t, state)
            y = measure()
            u, state = mpc.feedback(t, y, state)

    Calling the controller does both. If there is a `fallback`, also call
    `state = mpc.applied(u, cost, state)` at the end of each step. The first program
    approximates the problem about the first trajectory of `start`, so pass a converged
    plan as `start` if you have one. If a program cannot be solved, the next program
    approximates the problem about the same plan, shifted by one more step.

    **Derivatives.** The derivatives of the control are the derivatives of the planner.
    [`delucax.planning.ILQR`][] uses the implicit function theorem, and gives NaN if a
    plan did not converge. If the planner draws samples, the derivatives treat the
    choice of the best start as fixed.

    **Arguments:**

    - `dynamics`: the model. Its observation must be its state. If the state is not
        measured, put the MPC into a [`delucax.controllers.OutputFeedback`][].
    - `cost`: the stage and final cost. The horizon can be short if the final cost is an
        upper bound of the cost after the horizon.
    - `horizon`: the number of steps `T` of a plan.
    - `planner`: any [`delucax.planning.AbstractPlanner`][]; [`delucax.planning.ILQR`][]
        by default. You can differentiate with respect to its floating-point options,
        and change these options without compiling again. If you set the option `states`
        of the planner, each plan starts only from these states and the controls of the
        last plan, not from the other trajectories above.
    - `bounds`: `(low, high)` of the controls, each a number or of shape `(m,)`; none by
        default.
    - `start`: the trajectories from which a plan may start besides the last plan; by
        default the second and third trajectory of the list above. If you give controls
        of shape `(T, m)`, they replace the control of the third trajectory. A
        [`delucax.planning.Start`][] or a [`delucax.planning.Plan`][] replaces both
        trajectories, for example by a trajectory under another stabilising feedback.
        The first plan also starts from the multipliers of this `Start` or `Plan`.
    - `throw`: whether to raise an error at run time if there is no usable plan; true by
        default. If `throw` is false, the controller follows the last usable plan for
        one more step, with the feedback gains of this plan, and then discards this
        plan. If there is no usable plan in the next step either, the controller follows
        the first trajectory of `start`, which is by default the trajectory under the
        LQR. With `real_time`, the controller keeps following the last plan. All these
        controls are within `bounds`, but they may violate `constraints`.
    - `fallback`: a controller that computes the control in the steps without a usable
        plan, so that no error is raised. The fallback is called at every step and gets
        the control that was applied, so that the state of the fallback is always up to
        date. None by default.
    - `real_time`: whether to solve one quadratic program per step; false by default.
        With `real_time`, the planner must be a [`delucax.planning.SQP`][], which is
        also the default.
    - `max_qp_steps`: the largest number of linear systems that are solved for a
        quadratic program, 50 by default.
    - `constraints`: [`delucax.planning.Constraints`][] on states and controls, for
        planners that accept them; none by default.
    - `difference`: a function `(x, x_ref) -> deviation` that the planner uses, for
        example to wrap angles; subtraction by default.

    **Raises:** `ValueError` if an argument has the wrong type or shape; with `throw`,
    an error at run time if there is no usable plan.

    Source: Richalet, Rault, Testud and Papon, 1978; Diehl, Bock and Schloeder, 2005
    (warm start and real-time iteration).

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        env = dlx.make("pendulum", dt=0.02)
        cost = dlx.costs.Quadratic([1.0, 0.1], [0.1], final=[20.0, 5.0])
        mpc = dlx.controllers.MPC(env.dynamics, cost, 20, bounds=(-2.0, 2.0))
        x0 = jnp.array([0.3, 0.0])
        run = dlx.rollout(env, mpc, key=jax.random.key(0), x0=x0, horizon=30)
        state = run.controller_state
        print(run.total_cost, run.incident_counts["failed_plan"], state.iterations)

        @jax.jit
        @jax.vmap
        def planned(t, x):
            given = dict(bounds=mpc.bounds, constraints=mpc.constraints, throw=False)
            plan = mpc.planner(mpc.dynamics, mpc.cost, x, 20, t, **given)
            return plan.cost, plan.violation

        costs, violations = planned(run.times[:-1], run.states[:-1])
        print(costs[::10], violations.max())
        ```

        ```text
        1.973 0 1
        [6.761 3.078 1.162] 0.0
        ```
    """

    dynamics: AbstractDynamics
    cost: AbstractCost
    start: Start
    bounds: tuple[Array, Array] | None = bounds_field("MPC")
    planner: AbstractPlanner
    constraints: Constraints | None
    difference: Difference | None = function_field(of="a, b")
    throw: bool = eqx.field(static=True)
    fallback: AbstractController | None
    real_time: bool = eqx.field(static=True)
    max_qp_steps: int = eqx.field(static=True)

    def __init__(
        self,
        dynamics: AbstractDynamics,
        cost: AbstractCost,
        horizon: int,
        *,
        planner: AbstractPlanner | None = None,
        bounds: Any = None,
        start: Any = None,
        throw: bool = True,
        constraints: Constraints | None = None,
        difference: Difference | None = None,
        fallback: AbstractController | None = None,
        real_time: bool = False,
        max_qp_steps: int = 50,
    ):
        where = "MPC"
        check_instance(dynamics, AbstractDynamics, "dynamics", where)
        check_instance(cost, AbstractCost, "cost", where)
        horizon = check_count(horizon, "horizon", where)
        m = dynamics.control_size
        self.bounds = check_control_bounds(bounds, m, where)
        if isinstance(start, Plan):
            trajectory = start.controls, start.states, start.gains
            start = Start(*trajectory, multipliers=start.multipliers)
        if isinstance(start, Start):
            start = start.checked(dynamics.state_size, m, "start", where)
            if start.horizon != horizon:
                raise ValueError(
                    f"{where}: start must have {horizon} steps, the horizon, got "
                    f"{start.horizon}."
                )
        else:
            if start is not None:
                start = as_rows(start, m, "start", where, horizon)
                check_finite(start, "start", where)
            start = Start.default(dynamics, cost, horizon, controls=start)
        self.dynamics, self.cost = dynamics, cost
        self.start = start.stacked(dynamics.state_size)
        self.real_time = check_bool(real_time, "real_time", where)
        self.max_qp_steps = check_count(max_qp_steps, "max_qp_steps", where)
        if planner is None:
            planner = SQP() if real_time else ILQR()
        self.planner = planner
        self.fallback = fallback
        self.constraints, self.difference = constraints, difference
        self.throw = check_bool(throw, "throw", where)

    def __check_init__(self):
        where, dynamics = "MPC", self.dynamics
        check_instance(dynamics, AbstractDynamics, "dynamics", where)
        n, m = dynamics.state_size, dynamics.control_size
        check_instance(self.cost, AbstractCost, "cost", where)
        check_cost_sizes(self.cost, (n, m), "cost", where)
        check_instance(self.planner, AbstractPlanner, "planner", where)
        if self.constraints is not None:
            hint = " (`delucax.planning.Constraints`)"
            check_instance(self.constraints, Constraints, "constraints", where, hint)
            if isinstance(self.planner, ILQR) and not self.constraints.is_hard:
                raise ValueError(
                    f"{where}: planner must be a `delucax.planning.SQP` for bounds of "
                    "states and soft constraints, got an ILQR, the default."
                )
        check_instance(self.start, Start, "start", where)
        start = self.start.checked(n, m, "start", where)
        if start.controls.ndim != 3 or start.states is None or start.gains is None:
            raise ValueError(
                f"{where}: start.controls must have shape (c, horizon, {m}), with "
                f"states and gains, got shape {start.controls.shape}."
            )
        check_control_bounds(self.bounds, m, where)
        if self.fallback is not None:
            check_instance(self.fallback, AbstractController, "fallback", where)
        if self.real_time and not isinstance(self.planner, SQP):
            raise ValueError(
                f"{where}: planner must be a `delucax.planning.SQP` with real_time, "
                f"got {type(self.planner).__name__}."
            )

    def init(self, *, key: PRNGKey | None = None) -> PyTree:
        draws = self.planner.is_stochastic
        if draws:
            check_key(key, "MPC.init")
        fallback = None
        if self.fallback is not None:
            spare = None if key is None else jr.fold_in(key, 1)
            fallback = self.fallback.init(key=spare)
        return MPCState(
            last=self._first(),
            result=jax.tree.map(jnp.asarray, RESULTS.successful),
            failures=Tally("failed_plan"),
            iterations=jnp.zeros((), int),
            key=key if draws else None,
            fallback=fallback,
        )

    def _first(self) -> Start:
        """The first trajectory of `start`, and its multipliers if they fit, else
        zero."""
        first, n = _first(self.start.trajectories), self.dynamics.state_size
        x0: Any = np.zeros(n, first.controls.dtype)
        problem = self._problem(0.0, x0, x0.dtype)
        y = self.planner.first_multipliers(problem, first.horizon)
        given = self.start.multipliers
        sizes = lambda tree: (
            jax.tree.structure(tree),
            [*map(np.shape, jax.tree.leaves(tree))],
        )
        if sizes(given) == sizes(y):
            y = jax.tree.map(lambda a, b: jnp.asarray(a, b.dtype), given, y)
        return dataclasses.replace(first, multipliers=y)

    def _problem(self, t: RealScalar, y: Observation, dtype: Any) -> Problem:
        return Problem(
            self.dynamics,
            self.cost,
            jnp.asarray(y, dtype),
            jnp.asarray(t, dtype),
            bounds=jax.tree.map(lambda b: b.astype(dtype), self.bounds),
            difference=self.difference,
            constraints=self.constraints,
        )

    def prepare(self, t: RealScalar, state: MPCState) -> MPCState:
        """Set up the program of a step before the state is measured. Needs `real_time`.

        **Arguments:**

        - `t`: the time of the step.
        - `state`: the state from `init`, `feedback` or a call.

        **Returns:** the state for `feedback`.

        **Raises:** `ValueError` without `real_time`.
        """
        _check_real_time(self.real_time, "prepare")
        return _prepared(self, as_float_array(t), state)

    def feedback(
        self, t: RealScalar, y: Observation, state: MPCState
    ) -> tuple[Control, MPCState]:
        """Solve the prepared program for the measured state. Needs `real_time`.

        **Arguments:**

        - `t`: the time of the step, the same time as in the call of `prepare`.
        - `y`: the state of the plant, shape `(n,)`.
        - `state`: the state from `prepare`.

        **Returns:** `(u, state)`: the control, shape `(m,)`, and the new state.

        **Raises:** `ValueError` without `real_time`, or if `state` is not from
        `prepare`; with `throw`, an error at run time if there is no usable plan.
        """
        _check_real_time(self.real_time, "feedback")
        check_state(self, y, self.dynamics.state_size)
        if state.prepared is None:
            raise ValueError(
                "MPC.feedback: state must be one that MPC.prepare returned."
            )
        u, lost, result, state = _fed_back(self, as_float_array(t), y, state)
        return _checked(self, u, lost, result), state

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        if self.real_time:
            return self.feedback(t, y, self.prepare(t, state))
        check_state(self, y, self.dynamics.state_size)
        key, draw = state.key, None
        if self.planner.is_stochastic:
            key, draw = jr.split(key)
        last = state.last
        from_states = self.planner.starts_from_states
        starts = last.controls if from_states else _joined(last, self.start)
        plan = self.planner(
            self.dynamics,
            self.cost,
            y,
            starts,
            t,
            bounds=self.bounds,
            constraints=self.constraints,
            difference=self.difference,
            fallback=last,
            key=draw,
            throw=False,
        )
        u, lost, after = self._moved_on(
            as_float_array(t), y, plan, state._replace(key=key)
        )
        return _checked(self, u, lost, plan.result), after

    def applied(self, u: Array, cost: Array, state: PyTree) -> PyTree:
        if self.fallback is None:
            return state
        return state._replace(fallback=self.fallback.applied(u, cost, state.fallback))

    @eqx.filter_jit
    def _moved_on(
        self, t: RealScalar, y: Observation, plan: Plan, state: MPCState
    ) -> Any:
        """The control, whether there is no usable plan, and the next state."""
        # A plan that ran out of iterations is usable: it knows the current state, which
        # the last plan does not.
        lost, u = ~plan.is_usable, plan.controls[0]
        spare, fallback = self._followed(y, state.last), None
        if self.fallback is not None:
            spare, fallback = self.fallback(t, y, state.fallback)
        u = jnp.where(lost, spare, u)
        # After a failure the warm start is reset, so that the next plan does not start
        # from what failed. In real time it is kept, because a program without a
        # solution says nothing against the plan that it is about.
        now = Start(plan.controls, plan.states, plan.gains, plan.multipliers)
        instead = state.last.shifted() if self.real_time else self._first()
        renewed = lambda new, old: jnp.where(lost, old, new).astype(old.dtype)
        after = state._replace(
            last=jax.tree.map(renewed, now.shifted(), instead),
            fallback=fallback,
            result=plan.result,
            failures=state.failures.add(plan.result != RESULTS.successful),
            iterations=jnp.asarray(plan.iterations, state.iterations.dtype),
        )
        return u.astype(y.dtype), lost, after

    def _followed(self, y: Observation, last: Start) -> Control:
        """The first control of the last plan, under its gains."""
        assert last.states is not None and last.gains is not None
        x, u = last.states[0], last.controls[0]
        # The gains of a plan that diverged may not be finite.
        tried = u - matvec(last.gains[0], deviation(y, x, self.difference))
        u = jnp.where(jnp.isfinite(tried), tried, u)
        if self.bounds is None:
            return u
        low, high = self.bounds
        return jnp.minimum(jnp.maximum(u, low), high)


# Functions, because calling a compiled method of a module takes 0.1 ms longer.
@quickly_compiled
def _prepared(mpc: MPC, t: RealScalar, state: MPCState) -> MPCState:
    last, planner = state.last, mpc.planner
    assert last.states is not None and isinstance(planner, SQP)
    problem = mpc._problem(t, last.states[0], last.controls.dtype)
    return state._replace(prepared=planner.prepare(problem, last))


@quickly_compiled
def _fed_back(mpc: MPC, t: RealScalar, y: Observation, state: MPCState) -> Any:
    planner = mpc.planner
    assert isinstance(planner, SQP)
    problem = mpc._problem(t, y, state.last.controls.dtype)
    plan = planner.feedback(problem, state.prepared, mpc.max_qp_steps)
    u, lost, after = mpc._moved_on(t, y, plan, state)
    return u, lost, plan.result, after._replace(prepared=None)


def _check_real_time(real_time: bool, name: str) -> None:
    if not real_time:
        raise ValueError(f"MPC.{name}: real_time must be True.")


def _checked(mpc: MPC, u: Control, lost: Array, result: Result) -> Control:
    throw = mpc.throw and mpc.fallback is None
    if throw and (isinstance(lost, Tracer) or lost):
        # Attached to the control, which every caller uses. Attached to the state, JAX
        # would remove the error as dead code if the caller does not read the state.
        return error_if(result, u, lost, lambda why: f"MPC: {why} {_REMEDY}")
    return u


@host_unless_traced
def _first(starts: Start) -> Start:
    """The first of several starts."""
    return jax.tree.map(lambda a: a[0], starts)


@host_unless_traced
def _joined(last: Start, starts: Start) -> Start:
    """All starts as one batch, of which the planner refines the cheapest."""
    # The last plan comes first, because the planner takes the first of equal cost.
    join = lambda a, b: xp.concatenate([a[None], b])
    joined = jax.tree.map(join, last.trajectories, starts.trajectories)
    return dataclasses.replace(joined, multipliers=last.multipliers)
