"""An optimal control problem with its published optimum."""

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
from ..planning import (
    AbstractPlanner,
    Constraints,
    Plan,
    Problem,
    SoftConstraint,
    SQP,
    Unknowns,
)
from ..qp import Soft


class Simulated(NamedTuple):
    """The result of `OptimalControl.simulate`.

    **Attributes:**

    - `objective`: the objective of the simulated trajectory, a scalar.
    - `violation`: the largest violation of a constraint along the simulated trajectory,
        also at times between the steps of the plan.
    - `times`, `states`: the simulated trajectory, shapes `(K,)` and `(K, n)`.

    !!! example

        ```python
        import delucax as dlx
        import jax

        def check(problem):
            plan = problem.solve()
            simulated = problem.simulate(plan)
            return simulated.objective, simulated.violation

        objective, violation = jax.eval_shape(check, dlx.problems.catalyst_mixing(20))
        objective.shape
        ```

        ```text
        ()
        ```
    """

    objective: Array
    violation: Array
    times: Array
    states: Array


class OptimalControl(eqx.Module):
    """A discretised optimal control problem, with a first guess and its known optimum.

    [`delucax.planning.SQP`][] solves such problems. Use double precision
    (`JAX_ENABLE_X64=1`). In single precision the solver does not converge on some of
    the problems, and the objective of other problems has an error of about one percent.

    **Arguments:**

    - `dynamics`: the discretised dynamics. Controls are held over each step.
    - `cost`: the stage and final cost; for a maximised objective, the cost is minus the
        objective.
    - `x0`: the first state, shape `(n,)`.
    - `controls`: the first guess of the controls, shape `(T, m)`.
    - `reference`: the published objective.
    - `states`: the first guess of the states, shape `(T+1, n)`; by default the states
        that follow from the controls.
    - `bounds`: the bounds of the controls, `(low, high)`; none by default.
    - `constraints`: [`delucax.planning.Constraints`][]; none by default.
    - `unknowns`: [`delucax.planning.Unknowns`][]; none by default.
    - `is_maximised`: whether the objective is maximised; false by default.

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
        """Solve the problem, starting at its first guess.

        **Arguments:**

        - `planner`: a [`delucax.planning.AbstractPlanner`][]; by default a
            [`delucax.planning.SQP`][] that starts at `states`.
        - `throw`: raise an error if the plan is not a solution; true by default.

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
        """The objective of a plan, with the sign of `reference`.

        **Arguments:** `plan`: a plan that `solve` returned.

        **Returns:** a scalar.
        """
        return -plan.cost if self.is_maximised else plan.cost

    def simulate(self, plan: Plan, points: int = 10, rtol: float = 1e-10) -> Simulated:
        """Simulate the controls of a plan with an accurate solver, to check the plan.

        The solver is the method of Dormand and Prince of order 8 with adaptive steps.
        The unknowns of the problem keep the values of the plan.

        **Arguments:**

        - `plan`: a plan that `solve` returned for this problem.
        - `points`: the number of points in each step at which the constraints are
            checked, 10 by default.
        - `rtol`: the relative and absolute tolerance of the solver, 1e-10 by default,
            which needs double precision.

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
    """The dynamics over a fraction of a step, with adaptive steps."""
    if not isinstance(dynamics, Discretized):
        if not hasattr(dynamics, "refined"):
            raise ValueError(
                "OptimalControl.simulate: dynamics must be a delucax.Discretized, or "
                "have the method refined as delucax.problems.Sampled has, got "
                f"{type(dynamics).__name__}."
            )
        return dynamics.refined(points, lambda inner: _fine(inner, 1, rtol))
    return Discretized(
        dynamics.system,
        dynamics.dt / points,
        diffrax.Dopri8(),
        stepsize_controller=diffrax.PIDController(rtol=rtol, atol=rtol),
        max_steps=4096,
    )


_FUNCTIONS = "inequality", "equality", "final_inequality", "final_equality"


def _violation(
    solved: OptimalControl, fine: AbstractDynamics, states: Array, controls: Array
) -> Array:
    """The largest violation of a constraint along a simulation."""
    own, points = solved.constraints, (len(states) - 1) // len(controls)
    over = [jnp.zeros((), states.dtype)]
    # For each pair of bounds: the values, and how often a row of bounds is repeated.
    # The first row of the bounds of states does not count, because the start is given.
    pairs: list[Any] = [(solved.bounds, controls, 1, 0)]
    if own is not None:
        pairs += [(own.states, states, points, 1), (own.controls, controls, 1, 0)]
        is_hard = lambda f: not isinstance(f, SoftConstraint)
        hard = {
            field: {n: f for n, f in own.named(field).items() if is_hard(f)} or None
            for field in _FUNCTIONS
        }
        if any(hard.values()):
            start, t0 = states[0], jnp.zeros_like(states[0, 0])
            constraints = Constraints(**hard)
            problem = Problem(fine, solved.cost, start, t0, constraints=constraints)
            held = jnp.repeat(controls, points, axis=0)
            for c, equal in problem.constraints_along(states, held):
                over.append(jnp.max(jnp.where(equal, jnp.abs(c), c), initial=0))
    for pair, values, times, first in pairs:
        if pair is None or isinstance(pair, Soft):
            continue
        for sign, end in zip((-1, 1), map(jnp.asarray, pair), strict=True):
            varies = end.ndim == 2
            skipped = first * (times if varies else 1)
            end = jnp.repeat(end, times, 0)[skipped : len(values)] if varies else end
            over.append(jnp.max(sign * (values[skipped:] - end)))
    return jnp.max(jnp.stack(over))


class Reach(eqx.Module):
    """An equality constraint at the end: some of the states have given values."""

    values: Array = parameter()
    entries: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, t: Array, x: Array) -> Array:
        return x[np.array(self.entries)] - self.values


class FinalState(AbstractCost):
    """A final cost: a weighted sum of the last state plus an offset. Without weights it
    is the final time."""

    weights: Array | None = parameter(None)
    offset: Real = parameter(0.0)

    def __call__(self, t: Any, x: Array, u: Array) -> Array:
        return jnp.zeros((), x.dtype)

    def final(self, t: Any, x: Array) -> Array:
        if self.weights is None:
            return jnp.asarray(t, x.dtype)
        return jnp.sum(self.weights * x) + self.offset


def line(start: Any, end: Any, horizon: int) -> Array:
    """States on a straight line from one state to another."""
    share = jnp.linspace(0.0, 1.0, horizon + 1)[:, None]
    start, end = (jnp.asarray(a, float) for a in (start, end))
    return (1 - share) * start + share * end
