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
from .._results import Result, RESULTS
from .._typing import Control, Difference, Observation, PRNGKey, RealScalar
from ..costs import AbstractCost
from ..dynamics import AbstractDynamics
from ..math import matvec
from ..planning import AbstractPlanner, Constraints, ILQR, Plan, Problem, SQP, Start
from ._operating_point import check_state, deviation


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
    """Model predictive control (receding horizon): plan from the current state, apply
    the first control, and plan again.

    `u_k` is the first control of the plan over `T` steps from `y_k` at `t_k`. It works
    with every [`delucax.planning.AbstractPlanner`][], and with a cost
    that depends on time, such as a reference to follow.

    Each plan starts from the cheapest of a few trajectories from `y_k`, which are
    computed together between the bounds:

    1. the last plan a step later, under its gains, its last control held,
    2. the LQR about an operating point,
    3. the control of that point, held.

    The second one keeps an unstable plant near the point of linearisation, and a plan
    of [`delucax.planning.ILQR`][] without constraints costs at most as much as each of
    them. It is computed when the controller is made, about the point that
    [`delucax.planning.Start.default`][] chooses: the targets of the cost, or the
    equilibrium of the dynamics, or zero where neither defines one, as with
    [`delucax.costs.Function`][] or [`delucax.costs.Tracking`][] over dynamics of your
    own. An unstable plant needs a `start` where it is to be held far from that point,
    and where there is no LQR: the second derivative of the cost with respect to the
    control is not positive definite there, no gain stabilises the plant, or the
    dynamics cannot be differentiated.

    The status of a plan is in the controller's state: `result`, that of the last plan;
    `iterations`, how many it took; and how often it was no success, `failures`, which
    are `incidents["failed_plan"]` of a rollout. There too is `last`, a
    [`delucax.planning.Start`][], the last plan a step later, from which the next one
    starts. A plan that ran out of iterations or found no descent is used as it is, the
    best so far. Where there is none to use, since every start diverges or the
    constraints cannot hold, `throw` and `fallback` say what happens.

    With `real_time` there is no search: each step solves one quadratic program of
    [`delucax.planning.SQP`][] about the last plan a step later, and takes its full
    step. `prepare` sets the program up before the state is measured, and `feedback`
    solves it with at most `max_qp_steps` linear systems, `state.iterations` of them:

        state = mpc.init()
        while True:
            state = mpc.prepare(t, state)
            y = measure()
            u, state = mpc.feedback(t, y, state)

    A call of the controller does both. The first plan is about the first of `start`,
    which a converged plan may give. Where a program cannot be solved, the next one is
    about the same plan, a step later.

    Derivatives are those of the planner: of [`delucax.planning.ILQR`][] by the implicit
    function theorem, NaN where a plan did not converge. For a planner that samples they
    go through the chosen start; the choice itself has none.

    **Arguments:**

    - `dynamics`: the model, which observes its state; around an estimator see
        [`delucax.controllers.OutputFeedback`][].
    - `cost`: the stage and final cost. A final cost that bounds what comes after the
        horizon lets this be short.
    - `horizon`: the steps `T` of a plan.
    - `planner`: any [`delucax.planning.AbstractPlanner`][], with its options;
        [`delucax.planning.ILQR`][] by default. Floating-point numbers among the options
        can be differentiated and changed without compiling again. With `states` each
        plan starts from these, and from the controls of the last plan, alone.
    - `bounds`: `(low, high)` of the controls, each a number or of shape `(m,)`; none by
        default.
    - `start`: what each plan may start from besides the last one:
        [`delucax.planning.Start.default`][] by default, the second and third above;
        controls in place of the third, shape `(T, m)`; or a
        [`delucax.planning.Start`][] in place of both, such as another stabilising law,
        or controls alone.
    - `throw`: raise at run time where there is no plan to use (default). If false, the
        last plan is used for one more step, under its gains, and then discarded; if
        there is no plan in the next step either, the first one of `start`, by default
        the LQR, is applied. With `real_time` the last plan is followed on.
    - `fallback`: a controller to use in a step without a plan, which then does not
        raise. Its state advances in every step. None by default.
    - `real_time`: one quadratic program for each step, by
        [`delucax.planning.SQP`][], the default planner then; false by default.
    - `max_qp_steps`: the most linear systems of such a program, 50 by default.
    - `constraints`: [`delucax.planning.Constraints`][] on states and controls, for
        planners that take them; none by default.
    - `difference`: `(x, x_ref) -> deviation`, as for the planner; subtraction by
        default.

    **Raises:** `ValueError` on arguments of the wrong kind or shape; an error at run
    time as `throw` says.

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
        run.total_cost
        ```
    """

    dynamics: AbstractDynamics
    cost: AbstractCost
    start: Start
    bounds: tuple[Array, Array] | None = bounds_field("MPC")
    planner: AbstractPlanner
    constraints: Constraints | None
    difference: Difference | None = function_field()
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
        if isinstance(start, Start):
            start = start.checked(dynamics.state_size, m, "start", where)
            if start.horizon != horizon:
                raise ValueError(
                    f"{where}: start must have {horizon} steps, as the horizon, got "
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
        """The first start, with multipliers of zero."""
        first, n = _first(self.start), self.dynamics.state_size
        x0: Any = np.zeros(n, first.controls.dtype)
        problem = self._problem(0.0, x0, x0.dtype)
        y = self.planner.first_multipliers(problem, first.horizon)
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
        """With `real_time`: set up the program of a step, before its state is known.

        **Arguments:**

        - `t`: the time of the step.
        - `state`: as `init`, `feedback` or a call returns it.

        **Returns:** the state for `feedback`.
        """
        _check_real_time(self.real_time, "prepare")
        return _prepared(self, as_float_array(t), state)

    def feedback(
        self, t: RealScalar, y: Observation, state: MPCState
    ) -> tuple[Control, MPCState]:
        """With `real_time`: solve the program for the state.

        **Arguments:**

        - `t`: the time of the step, as for `prepare`.
        - `y`: the state of the plant.
        - `state`: as `prepare` returns it.

        **Returns:** `(u, state)`.

        **Raises:** `ValueError` without `prepare`; an error at run time as `throw`
        says.
        """
        _check_real_time(self.real_time, "feedback")
        check_state(self, y, self.dynamics.state_size)
        if state.prepared is None:
            raise ValueError("MPC.feedback: state must come from prepare.")
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

    @eqx.filter_jit
    def _moved_on(
        self, t: RealScalar, y: Observation, plan: Plan, state: MPCState
    ) -> Any:
        """The control, whether there is no plan to use, and the next state."""
        # Usable plans include those that ran out of iterations: the best so far beats
        # the last one, which is a step older.
        lost, u = ~plan.is_usable, plan.controls[0]
        spare, fallback = self._followed(y, state.last), None
        if self.fallback is not None:
            spare, fallback = self.fallback(t, y, state.fallback)
        u = jnp.where(lost, spare, u)
        # The warm start is the plan a step later, its last step held for the new one. A
        # lost plan is forgotten, or the next one would start from what had failed. One
        # program that has no solution says nothing against the plan it is about.
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
        # The gains of a plan that diverged may not be finite: then its controls alone.
        tried = u - matvec(last.gains[0], deviation(y, x, self.difference))
        u = jnp.where(jnp.isfinite(tried), tried, u)
        if self.bounds is None:
            return u
        low, high = self.bounds
        return jnp.minimum(jnp.maximum(u, low), high)


# Functions, as a call of a module's method takes a tenth of a millisecond each.
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
        # Attached to the control, which every caller uses: attached to the state it
        # would be removed as dead code where the state is not read.
        return result.error_if(u, lost)
    return u


@host_unless_traced
def _first(starts: Start) -> Start:
    """The first of several starts."""
    return jax.tree.map(lambda a: a[0], starts)


@host_unless_traced
def _joined(last: Start, starts: Start) -> Start:
    """All starts as one batch, of which the planner refines the cheapest."""
    # The last plan comes first: of starts of equal cost the first is taken.
    join = lambda a, b: xp.concatenate([a[None], b])
    joined = jax.tree.map(join, last.trajectories, starts.trajectories)
    return dataclasses.replace(joined, multipliers=last.multipliers)
