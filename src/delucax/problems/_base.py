"""A problem of optimal control with its published optimum."""

from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._check import check_count, check_instance, check_positive
from .._module import parameter, replace, shown
from .._typing import Real
from ..costs import AbstractCost
from ..dynamics import AbstractDynamics, Discretized, open_loop
from ..planning import AbstractPlanner, Constraints, Plan, Problem, SQP, Unknowns


class Simulated(NamedTuple):
    """What the controls of a plan do in a simulation with adaptive steps.

    **Attributes:**

    - `objective`: that of the simulated trajectory, a scalar.
    - `violation`: the largest violation of a constraint on it, also between the steps.
    - `times`, `states`: the trajectory, shapes `(K,)` and `(K, n)`.

    !!! example

        ```python
        import delucax as dlx
        import jax

        def check(problem):
            plan = problem.solve()
            simulated = problem.simulate(plan)
            return simulated.objective, simulated.violation

        jax.eval_shape(check, dlx.problems.catalyst_mixing(20))
        ```
    """

    objective: Array
    violation: Array
    times: Array
    states: Array


class OptimalControl(eqx.Module):
    """A problem of optimal control in continuous time, discretised, with a start and
    the optimum that is published. [`delucax.planning.SQP`][] solves it.

    Use double precision (`JAX_ENABLE_X64=1`). In single precision some of the problems
    do not converge, and the objective of others is off by a percent.

    **Arguments:**

    - `dynamics`: with the controls held over each step.
    - `cost`: the stage and final cost; minus the objective if that is maximised.
    - `x0`: the first state, shape `(n,)`.
    - `controls`: to start from, shape `(T, m)`.
    - `reference`: the published objective.
    - `states`: to start from, shape `(T+1, n)`; those that follow from the controls by
        default.
    - `bounds`: of the controls, `(low, high)`; none by default.
    - `constraints`: [`delucax.planning.Constraints`][]; none by default.
    - `unknowns`: [`delucax.planning.Unknowns`][]; none by default.
    - `is_maximised`: false by default.

    !!! example

        ```python
        import delucax as dlx

        problem = dlx.problems.particle_steering(20)
        plan = problem.solve()
        problem.objective(plan), problem.reference
        ```
    """

    dynamics: AbstractDynamics
    cost: AbstractCost
    x0: Float[Array, " n"] = parameter()
    controls: Float[Array, "T m"] = parameter()
    reference: float = eqx.field(static=True)
    states: Float[Array, "points n"] | None = parameter(None)
    bounds: tuple[Any, Any] | None = None
    constraints: Constraints | None = None
    unknowns: Unknowns | None = None
    is_maximised: bool = eqx.field(static=True, default=False)

    __repr__ = shown

    @property
    def horizon(self) -> int:
        """The number of steps."""
        return self.controls.shape[0]

    def solve(
        self, planner: AbstractPlanner | None = None, *, throw: bool = True
    ) -> Plan:
        """Plan from the start.

        **Arguments:**

        - `planner`: an [`delucax.planning.SQP`][] that starts from `states` by default.
        - `throw`: raise unless the plan is a solution (default).

        **Returns:** a [`delucax.planning.Plan`][], differentiable with respect to every
        array of the problem.
        """
        planner = SQP(states=self.states) if planner is None else planner
        check_instance(planner, AbstractPlanner, "planner", "OptimalControl.solve")
        return planner(
            self.dynamics,
            self.cost,
            self.x0,
            self.controls,
            bounds=self.bounds,
            constraints=self.constraints,
            unknowns=self.unknowns,
            throw=throw,
        )

    def objective(self, plan: Plan) -> Array:
        """The objective of a plan, of the sign of `reference`.

        **Arguments:** `plan`: as `solve` returns it.
        """
        return -plan.cost if self.is_maximised else plan.cost

    def simulate(self, plan: Plan, points: int = 10, rtol: float = 1e-10) -> Simulated:
        """Apply the controls of a plan, with its values of the unknowns, with adaptive
        steps (Dormand and Prince, order 8).

        **Arguments:**

        - `plan`: as `solve` of this problem returns it.
        - `points`: in each step, at which the constraints are checked; 10 by default.
        - `rtol`: of the steps, 1e-10 by default; it needs double precision.

        **Returns:** a [`delucax.problems.Simulated`][].
        """
        where = "OptimalControl.simulate"
        check_instance(plan, Plan, "plan", where)
        points = check_count(points, "points", where)
        check_positive(rtol, "rtol", where)
        solved = self if plan.parameters is None else replace(self, plan.parameters)
        fine = _fine(solved.dynamics, points, rtol)
        states = open_loop(fine, plan.states[0], jnp.repeat(plan.controls, points, 0))
        at_steps = states[::points]
        problem = Problem(
            solved.dynamics,
            solved.cost,
            plan.states[0],
            jnp.zeros_like(states[0, 0]),
            constraints=solved.constraints,
        )
        cost = problem.total(at_steps, plan.controls)
        violation = _violation(solved, fine, states, plan.controls)
        steps = jnp.arange(len(states))
        sign = -1 if self.is_maximised else 1
        return Simulated(sign * cost, violation, steps * fine.dt, states)


def _fine(dynamics: Any, points: int, rtol: float) -> Any:
    """The dynamics over a part of a step, with adaptive steps."""
    if not isinstance(dynamics, Discretized):
        return dynamics.refined(points, lambda inner: _fine(inner, 1, rtol))
    return Discretized(
        dynamics.system,
        dynamics.dt / points,
        diffrax.Dopri8(),
        stepsize_controller=diffrax.PIDController(rtol=rtol, atol=rtol),
        max_steps=4096,
    )


def _violation(
    solved: OptimalControl, fine: AbstractDynamics, states: Array, controls: Array
) -> Array:
    """The largest violation of a constraint along a simulation."""
    own, points = solved.constraints, (len(states) - 1) // len(controls)
    over = [jnp.zeros((), states.dtype)]
    pairs = [(solved.bounds, controls)]
    if own is not None:
        bounds = own.states
        if bounds is not None and jnp.ndim(bounds[0]) == 2:
            bounds = tuple(jnp.repeat(end, points, 0)[: len(states)] for end in bounds)
        pairs += [(bounds, states), (own.controls, controls)]
        problem = Problem(
            fine, solved.cost, states[0], jnp.zeros_like(states[0, 0]), constraints=own
        )
        held = jnp.repeat(controls, points, axis=0)
        for c, equal in problem.constraints_along(states, held):
            over.append(jnp.max(jnp.where(equal, jnp.abs(c), c), initial=0))
    for pair, values in pairs:
        if pair is not None:
            over += [jnp.max(pair[0] - values), jnp.max(values - pair[1])]
    return jnp.max(jnp.stack(over))


class Reach(eqx.Module):
    """An equality at the end: some of the states have given values."""

    values: Array = parameter()
    entries: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, t: Array, x: Array) -> Array:
        return x[np.array(self.entries)] - self.values


class FinalState(AbstractCost):
    """A weighted sum of the last state and an offset; without weights, the time at the
    end."""

    weights: Array | None = parameter(None)
    offset: Real = parameter(0.0)

    def __call__(self, t: Any, x: Array, u: Array) -> Array:
        return jnp.zeros((), x.dtype)

    def final(self, t: Any, x: Array) -> Array:
        if self.weights is None:
            return jnp.asarray(t, x.dtype)
        return jnp.sum(self.weights * x) + self.offset


def line(start: Any, end: Any, horizon: int) -> Array:
    """States on a line from one to another."""
    share = jnp.linspace(0.0, 1.0, horizon + 1)[:, None]
    start, end = (jnp.asarray(a, float) for a in (start, end))
    return (1 - share) * start + share * end
