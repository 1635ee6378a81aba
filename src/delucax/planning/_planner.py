"""The protocol of planners."""

import abc
import numbers
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike

from .._check import (
    check_bool,
    check_control_bounds,
    check_count,
    check_function,
    check_instance,
    check_key,
    check_number,
    finite_rows,
    finite_vector,
)
from .._message import shortened
from .._module import as_module, shown
from .._results import choose, raise_on_failure, RESULTS
from .._typing import Numbers, PRNGKey
from ..costs import AbstractCost
from ..dynamics import AbstractDynamics
from ._constraints import Constraints, worst_of
from ._multipliers import Multipliers
from ._plan import Plan
from ._problem import Problem
from ._start import operating_point, Start
from ._unknowns import solved_problem, Unknowns


def checked_plan(
    plan: Plan, where: str, throw: bool = True, problem: Problem | None = None
) -> Plan:
    """The plan; if `throw`, raise unless it is a solution."""

    def facts():
        path = np.isfinite(np.asarray(plan.states)).all(axis=-1)
        if problem is not None and problem.dynamics.event_names:
            if plan.result == RESULTS.diverged:
                steps = problem.times(plan.controls.shape[0])[:-1], plan.states[:-1]
                faulty = *steps, plan.controls, problem.w
                if fault := problem.dynamics.describe_fault(*faulty):
                    return f"A step fails with its events. {fault}"
        if not path.all():
            return (
                "The trajectory runs away: it is not finite from stage "
                f"{path.argmin()} on. Start from a number of steps, from a "
                "`delucax.planning.Start` with gains that stabilise the plant, or "
                "from `states` of `ILQR` or `SQP`."
            )
        words = (
            f"After {int(plan.iterations)} iterations the cost is "
            f"{float(plan.cost):.6g} and the residual {float(plan.residual):.2g}."
        )
        if problem is None or problem.constraints is None:
            return words
        solved = solved_problem(problem, plan)
        worst = worst_of(problem.constraints, solved, plan.states, plan.controls)
        return f"{words} {worst}".rstrip()

    return raise_on_failure(plan, where, throw, "the plan", facts)


_TRAJECTORY = "controls", "states", "gains"


class AbstractPlanner(eqx.Module):
    """Base class of trajectory optimisers. The fields of one are its options, and a
    call gives it a problem:

    `plan = planner(dynamics, cost, x0, controls, t0, w, bounds)`.

    To write a planner, subclass it and write `solve(problem, start, key)`, where
    `problem` is a [`delucax.planning.Problem`][] whose arguments are checked:

    - `start` may hold several starts. `start.cheapest(problem)` picks one.
    - Controls must respect the bounds: `problem.roll_out` and `problem.clip` do.
    - Raise an error on `problem.constraints` if the planner takes none.
    - Return `problem.plan(states, controls, cost)`. A call raises unless its `result`
        is `successful`.
    - Set `is_stochastic` if the planner draws random numbers.

    It then works in [`delucax.controllers.MPC`][], too. Derivatives of the plan are
    those of `solve`.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        class Shooting(dlx.planning.AbstractPlanner):
            def solve(self, problem, start, key):
                _, _, controls, _ = start.cheapest(problem)
                cost = lambda controls: problem.roll_out(controls)[2]
                slope = jax.jit(jax.grad(cost))
                for _ in range(20):
                    controls = controls - 0.05 * slope(controls)
                return problem.plan(*problem.roll_out(controls))

        env = dlx.make("pendulum")
        x0 = jnp.array([0.5, 0.0])
        Shooting()(env.dynamics, env.cost, x0, 10, bounds=(-2.0, 2.0)).cost
        ```
    """

    is_stochastic: ClassVar[bool] = False
    """Whether it draws random numbers, and so needs a key."""
    takes_unknowns: ClassVar[bool] = False
    """Whether it plans with [`delucax.planning.Unknowns`][]."""

    __repr__ = shown

    @property
    def starts_from_states(self) -> bool:
        """Whether it has states to start from, and so takes no feedback."""
        return False

    def first_multipliers(self, problem: Problem, horizon: int) -> Multipliers | None:
        """Multipliers of zero, of the shapes that a plan has; `None` (default) if its
        plans have none.

        **Arguments:**

        - `problem`: a [`delucax.planning.Problem`][].
        - `horizon`: T.
        """
        del problem, horizon
        return None

    @abc.abstractmethod
    def solve(self, problem: Problem, start: Start, key: PRNGKey | None) -> Plan:
        """The plan, with its `result` set; a failure does not raise here.

        **Arguments:**

        - `problem`: a [`delucax.planning.Problem`][].
        - `start`: one start, or several along a first axis.
        - `key`: a random key if the planner draws, else `None`.
        """

    def __call__(
        self,
        dynamics: AbstractDynamics,
        cost: AbstractCost,
        x0: Numbers,
        controls: Any,
        t0: ArrayLike = 0.0,
        w: Numbers | None = None,
        bounds: Sequence[Numbers] | None = None,
        *,
        constraints: Constraints | None = None,
        difference: Callable[[Array, Array], Array] | None = None,
        unknowns: Unknowns | None = None,
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
        - `unknowns`: [`delucax.planning.Unknowns`][], what is chosen besides the
            controls, by [`delucax.planning.SQP`][]; none by default.
        - `fallback`: feedback of the same horizon, with states and gains, used in place
            of the plan's own if planning fails: every start diverges, or the
            constraints cannot hold. `result` and `cost` stay those of the failed plan.
            None by default.
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
        begin: Any = t0
        is_count = isinstance(controls, numbers.Integral)
        if isinstance(controls, Start | Plan):
            if self.starts_from_states:
                raise ValueError(
                    f"{where}: states go with an array of controls or a number of "
                    f"steps, got {type(controls).__name__}."
                )
            given = (getattr(controls, name) for name in (*_TRAJECTORY, "multipliers"))
            start = Start(*given)
            start = start.checked(n, m, "controls", where)
        elif not is_count:
            start = Start(finite_rows(controls, m, "controls", where))
        else:
            T = check_count(controls, "controls (the horizon)", where)
            if self.starts_from_states:
                start = Start(jnp.tile(operating_point(dynamics, cost)[1], (T, 1)))
            else:
                start = Start.default(dynamics, cost, T, begin)
        # A default start has no precision of its own.
        dtype = jnp.result_type(x0, *(() if is_count else (start.controls,)))
        if w is not None:
            size = dynamics.disturbance_size
            w = finite_rows(w, size, "w", where, start.horizon)
        if difference is not None:
            check_function(difference, "difference", where)
        if constraints is not None:
            hint = " (`delucax.planning.Constraints`)"
            check_instance(constraints, Constraints, "constraints", where, hint)
        if unknowns is not None:
            check_instance(unknowns, Unknowns, "unknowns", where)
            if not self.takes_unknowns:
                raise ValueError(
                    f"{where}: unknowns must be left to `delucax.planning.SQP`, the "
                    "one planner that takes them."
                )
        ends: Any = check_control_bounds(bounds, m, where)
        if ends is not None:
            ends = tuple(_cast(end, dtype, (m,)) for end in ends)
        # One precision for all: the loops of the planners carry it unchanged.
        x0, begin = _cast(x0, dtype), _cast(begin, dtype)
        distance = as_module(difference)
        problem = Problem(
            dynamics, cost, x0, begin, w, ends, distance, constraints, unknowns=unknowns
        )
        start = jax.tree.map(lambda a: _cast(a, dtype), start)
        if fallback is not None:
            T = start.horizon
            spare = [getattr(fallback, name, None) for name in _TRAJECTORY]
            shapes = [getattr(array, "shape", None) for array in spare]
            if shapes != [(T, m), (T + 1, n), (T, m, n)]:
                raise ValueError(
                    f"{where}: fallback must be a plan of {T} steps, or a start with "
                    f"states and gains, got {shortened(fallback)}."
                )
        if self.is_stochastic:
            check_key(key, where)
        check_bool(throw, "throw", where)
        plan = self.solve(problem, start, key)
        check_instance(plan, Plan, "what solve returns", where)
        if fallback is not None:
            plan = _with_fallback(plan, fallback)
        return checked_plan(plan, where, throw, problem)


def _cast(array: Any, dtype: Any, shape: tuple[int, ...] | None = None) -> Array:
    """The array in another precision, and of another shape if one is given."""
    shape = np.shape(array) if shape is None else shape
    if isinstance(array, Tracer):
        return jnp.broadcast_to(array, shape).astype(dtype)
    if isinstance(array, jax.Array) and not array.weak_type:
        if array.dtype == dtype and array.shape == shape:
            return array
    # By NumPy, for each conversion would be compiled as a program of its own.
    return jnp.asarray(np.broadcast_to(np.asarray(array, dtype), shape))


@eqx.filter_jit
def _with_fallback(plan: Plan, fallback: Start | Plan) -> Plan:
    trajectory = lambda p: [getattr(p, name) for name in _TRAJECTORY]
    usable = plan.is_usable
    # By `where`, not `cond`: under `jax.vmap` each member of a batch has its own.
    keep = lambda new, old: jnp.where(usable, new, old).astype(new.dtype)
    # Controls that are not finite are a failure, whatever the planner's status.
    result = choose(plan.result == RESULTS.successful, RESULTS.diverged, plan.result)
    result = choose(usable, plan.result, result)
    kept = jax.tree.map(keep, trajectory(plan), trajectory(fallback))
    return eqx.tree_at(lambda p: (*trajectory(p), p.result), plan, (*kept, result))
