"""The base class of planners."""

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
from ._constraints import Constraints, violations_of
from ._multipliers import Multipliers
from ._plan import Plan
from ._problem import Problem
from ._start import operating_point, Start
from ._unknowns import solved_problem, Unknowns


def checked_plan(
    plan: Plan, where: str, throw: bool = True, problem: Problem | None = None
) -> Plan:
    """Return the plan. If `throw`, raise if the plan is not a solution."""

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
                "from states (the option `states` of `ILQR` and `SQP`)."
            )
        words = (
            f"After {int(plan.iterations)} iterations the cost is "
            f"{float(plan.cost):.6g} and the residual {float(plan.residual):.2g}."
        )
        if problem is None or problem.constraints is None:
            return words
        solved = solved_problem(problem, plan)
        trajectory = plan.states, plan.controls
        violations = violations_of(problem.constraints, solved, *trajectory)
        return f"{words} {violations}".rstrip()

    return raise_on_failure(plan, where, throw, "the plan", facts)


_TRAJECTORY = "controls", "states", "gains"


class AbstractPlanner(eqx.Module):
    """Base class of trajectory optimisers.

    The fields of a planner are its options. Call it with a problem to get a
    [`delucax.planning.Plan`][]:

    `plan = planner(dynamics, cost, x0, controls, t0, w, bounds)`.

    To write your own planner, subclass this class and write
    `solve(problem, start, key)`. The `problem` is a [`delucax.planning.Problem`][]
    whose arguments are already checked. In `solve`:

    - `start` may hold several starts. `start.cheapest(problem)` picks one.
    - Keep the controls within the bounds. `problem.roll_out` and `problem.clip` do.
    - If your planner does not support constraints, raise an error if
        `problem.constraints` is not `None`.
    - Return `problem.plan(states, controls, cost)`. If the plan that `solve` returns
        has a `result` other than `successful`, the call of the planner raises an error.

    If the planner draws random numbers, set `is_stochastic = True`.

    Your planner also works in [`delucax.controllers.MPC`][]. To differentiate a plan,
    JAX differentiates your `solve`.

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

        ```text
        Array(3.353, dtype=float32)
        ```
    """

    is_stochastic: ClassVar[bool] = False
    """Whether the planner draws random numbers and therefore needs a key."""
    takes_unknowns: ClassVar[bool] = False
    """Whether the planner takes [`delucax.planning.Unknowns`][]."""

    __repr__ = shown

    @property
    def starts_from_states(self) -> bool:
        """Whether an option of the planner gives the states to start from.

        If it does, a call of the planner does not take a `Start` or a `Plan`.
        """
        return False

    def first_multipliers(self, problem: Problem, horizon: int) -> Multipliers | None:
        """Multipliers of zero, in the shapes that a plan of this planner has.

        The default is `None`, for a planner whose plans have no multipliers.

        **Arguments:**

        - `problem`: a [`delucax.planning.Problem`][].
        - `horizon`: the number of steps `T`.
        """
        del problem, horizon
        return None

    @abc.abstractmethod
    def solve(self, problem: Problem, start: Start, key: PRNGKey | None) -> Plan:
        """Solve a checked problem.

        `solve` must report a failure by the `result` of the plan, not by an error.

        **Arguments:**

        - `problem`: a [`delucax.planning.Problem`][].
        - `start`: one [`delucax.planning.Start`][], or several along a first axis.
        - `key`: a random key if the planner is stochastic, otherwise `None`.

        **Returns:** a [`delucax.planning.Plan`][].
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
        """Plan a trajectory from `x0`.

        **Arguments:**

        - `dynamics`: the discrete-time dynamics.
        - `cost`: the stage and final cost.
        - `x0`: the first state, shape `(n,)`.
        - `controls`: where to start. Give controls, shape `(T, m)`; or the number of
            steps `T`, which starts from [`delucax.planning.Start.default`][]; or a
            [`delucax.planning.Start`][], which holds feedback or several starts; or an
            earlier plan, which starts from its trajectory and gains.
        - `t0`: the time of the first state; 0 by default.
        - `w`: disturbances known in advance, shape `(T, k)`; zero by default.
        - `bounds`: the bounds `(low, high)` of the controls, each a number or an array
            of shape `(m,)`; none by default.
        - `constraints`: [`delucax.planning.Constraints`][] on states and controls, if
            the planner takes them; none by default.
        - `difference`: `(x, x_ref) -> deviation`; subtraction by default. If the
            dynamics wrap angles, give `system.difference`, which wraps them too.
        - `unknowns`: [`delucax.planning.Unknowns`][] that
            [`delucax.planning.SQP`][] chooses together with the controls; none by
            default.
        - `fallback`: a `Start` with states and gains, or a `Plan`, of the same horizon.
            It replaces the trajectory and the gains of a plan that is not usable: every
            start diverges, or the constraints cannot all hold. `result` and `cost` stay
            those of the failed plan. None by default.
        - `key`: a random key, for stochastic planners.
        - `throw`: if true (default), raise if the plan is not a solution. If false,
            check `plan.result` yourself.

        **Returns:** a [`delucax.planning.Plan`][].

        **Raises:** `ValueError` if an argument has the wrong kind or shape or is not
        finite; with `throw`, an error at run time if the plan is not successful.
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
                    f"{where}: controls must be an array or a number of steps if the "
                    f"planner has states, got {type(controls).__name__}."
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
        # The default start takes the precision of the problem.
        dtype = jnp.result_type(x0, *(() if is_count else (start.controls,)))
        if w is not None:
            size = dynamics.disturbance_size
            w = finite_rows(w, size, "w", where, start.horizon)
        if difference is not None:
            check_function(difference, "difference", where, "a, b")
        if constraints is not None:
            hint = " (`delucax.planning.Constraints`)"
            check_instance(constraints, Constraints, "constraints", where, hint)
        if unknowns is not None:
            check_instance(unknowns, Unknowns, "unknowns", where)
            if not self.takes_unknowns:
                raise ValueError(
                    f"{where}: unknowns must be None, got Unknowns. Only "
                    "`delucax.planning.SQP` takes unknowns."
                )
        ends: Any = check_control_bounds(bounds, m, where)
        if ends is not None:
            ends = tuple(_cast(end, dtype, (m,)) for end in ends)
        # All arrays get the same precision, because a compiled loop cannot change it.
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
                    f"{where}: fallback must be a Plan, or a Start with states and "
                    f"gains, of {T} steps, got {shortened(fallback)}."
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
    """Cast the array to a precision, and broadcast it to `shape` if that is given."""
    shape = np.shape(array) if shape is None else shape
    if isinstance(array, Tracer):
        return jnp.broadcast_to(array, shape).astype(dtype)
    if isinstance(array, jax.Array) and not array.weak_type:
        if array.dtype == dtype and array.shape == shape:
            return array
    # NumPy, because JAX would compile a program for each conversion.
    return jnp.asarray(np.broadcast_to(np.asarray(array, dtype), shape))


@eqx.filter_jit
def _with_fallback(plan: Plan, fallback: Start | Plan) -> Plan:
    """The plan, or, if it is not usable, the plan with the fallback's trajectory."""
    trajectory = lambda p: [getattr(p, name) for name in _TRAJECTORY]
    usable = plan.is_usable
    keep = lambda new, old: jnp.where(usable, new, old).astype(new.dtype)
    # Controls that are not finite are a failure, even if the planner reports success.
    result = choose(plan.result == RESULTS.successful, RESULTS.diverged, plan.result)
    result = choose(usable, plan.result, result)
    kept = jax.tree.map(keep, trajectory(plan), trajectory(fallback))
    return eqx.tree_at(lambda p: (*trajectory(p), p.result), plan, (*kept, result))
