"""Model predictive control."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
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
from .._jax import host_unless_traced, xp
from .._module import function_field
from .._results import Result, RESULTS
from .._typing import Control, Difference, Observation, PRNGKey, RealScalar
from ..costs import AbstractCost
from ..dynamics import AbstractDynamics
from ..math import matvec
from ..planning import AbstractPlanner, Constraints, ILQR, Plan, Start
from ._operating_point import check_state, deviation


class MPCState(NamedTuple):
    """The state of [`delucax.controllers.MPC`][]."""

    last: Start
    result: Result
    failures: Tally
    iterations: Int[Array, ""]
    key: PRNGKey | None


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
    constraints cannot hold, `throw` says what happens.

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
        the LQR, is applied.
    - `constraints`: [`delucax.planning.Constraints`][] on states and controls, for
        planners that take them; none by default.
    - `difference`: `(x, x_ref) -> deviation`, as for the planner; subtraction by
        default.

    **Raises:** `ValueError` on arguments of the wrong kind or shape; an error at run
    time as `throw` says.

    Source: Richalet, Rault, Testud and Papon, 1978; Diehl, Bock and Schloeder, 2005
    (warm start).

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
        self.planner = ILQR() if planner is None else planner
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

    def init(self, *, key: PRNGKey | None = None) -> PyTree:
        draws = self.planner.is_stochastic
        if draws:
            check_key(key, "MPC.init")
        return MPCState(
            last=_first(self.start),
            result=jax.tree.map(jnp.asarray, RESULTS.successful),
            failures=Tally("failed_plan"),
            iterations=jnp.zeros((), int),
            key=key if draws else None,
        )

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
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
        u, lost, after = self._moved_on(y, plan, state._replace(key=key))
        if self.throw and (isinstance(lost, Tracer) or lost):
            # Attached to the control, which every caller uses: attached to the state it
            # would be removed as dead code where the state is not read.
            u = plan.result.error_if(u, lost)
        return u, after

    @eqx.filter_jit
    def _moved_on(self, y: Observation, plan: Plan, state: MPCState) -> Any:
        """The control, whether there is no plan to use, and the next state."""
        # Usable plans include those that ran out of iterations: the best so far beats
        # the last one, which is a step older.
        lost, u = ~plan.is_usable, plan.controls[0]
        u = jnp.where(lost, self._followed(y, state.last), u)
        # The warm start is the plan a step later, its last step held for the new one. A
        # lost plan is forgotten, or the next one would start from what had failed.
        shift = lambda a: jnp.concatenate([a[1:], a[-1:]])
        later = Start(*(shift(a) for a in (plan.controls, plan.states, plan.gains)))
        renewed = lambda new, old: jnp.where(lost, old[0], new).astype(old.dtype)
        after = state._replace(
            last=jax.tree.map(renewed, later, self.start),
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


@host_unless_traced
def _first(starts: Start) -> Start:
    """The first of several starts."""
    return jax.tree.map(lambda a: a[0], starts)


@host_unless_traced
def _joined(last: Start, starts: Start) -> Start:
    """All starts as one batch, of which the planner refines the cheapest."""
    # The last plan comes first: of starts of equal cost the first is taken.
    join = lambda a, b: xp.concatenate([a[None], b])
    return jax.tree.map(join, last, starts)
