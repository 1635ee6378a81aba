"""Sequential quadratic programming with hard constraints."""

import dataclasses
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._check import (
    check_bool,
    check_count,
    check_range,
    finite_rows,
    is_concrete,
)
from .._jax import quickly_compiled
from .._module import parameter
from .._typing import PRNGKey
from ..qp import Soft
from ..qp._solve import as_scalar
from ._carried import with_carried
from ._multipliers import Multipliers, zeros_like_result
from ._plan import Plan
from ._planner import AbstractPlanner
from ._problem import Problem
from ._real_time import fed_back, prepared
from ._sqp_derivatives import solution
from ._sqp_iteration import Options
from ._start import Start
from ._transcription import Iterate, limits_of, multipliers_of
from ._unknowns import check_unknowns


class SQP(AbstractPlanner):
    r"""Controls that locally minimise the cost under hard constraints, by sequential
    quadratic programming:

    `minimise sum over k < T of c(t_k, x_k, u_k) + final(t_T, x_T)`, along
    `x_{k+1} = F(t_k, x_k, u_k, w_k)`, under [`delucax.planning.Constraints`][].

    The unknowns are the states and the controls (multiple shooting), so that an
    unstable plant may start from a guess that does not follow the dynamics. Each
    iteration solves the quadratic program about the current trajectory, as
    [`delucax.qp.solve`][] does, first by guesses of the active sides. Its Hessian is
    that of the cost far from a solution, and that of the Lagrangian from a relative
    error of 0.01 on, or always if the Hessian of the cost alone has no unique minimum
    along the dynamics. Where it is not convex along the dynamics, the squares of the
    constraints that hold with equality are added, and then a multiple of the identity.

    A step `1, 1/2, ..., 1/2048` is accepted by a funnel: the sum of all violations
    stays below its width, and either the cost falls by 1e-4 of the predicted decrease,
    or the violations fall below 0.9 of the width, which then narrows.
    Where the linearised constraints have no feasible point, the squares of their
    violations are added to the cost instead, at a price. Near a stationary point the
    constraints are tried again and the price rises; if no price makes them hold, the
    result is `no_feasible_point`.

    It has converged if the gradient of the Lagrangian and the complementarity are at
    most `tolerance` times one plus the size of the terms that cancel in them, the
    steps meet to that tolerance, and no constraint is violated by more than
    `constraint_tolerance`.

    The states start from those that follow from the controls. If these violate the
    constraints more than the first state held at every stage violates the dynamics, in
    sum, they start from that instead. An earlier plan gives its multipliers too.

    `plan.multipliers` are those of the solution. `plan.cost` leaves out the penalty of
    violated soft constraints; `plan.trace` includes it.

    The plan is differentiable in both modes with respect to every array in `dynamics`,
    `cost`, `constraints`, `x0`, `w`, `t0` and `bounds`, by the implicit function
    theorem: one quadratic program at the solution, with exact second derivatives.
    Derivatives are NaN unless the solution is a converged strict minimum whose active
    constraints have positive multipliers and are independent. They are zero with
    respect to `controls` and `states`, from which the iteration only starts.

    Events of a hybrid plant are not followed from one iterate to the next: a plan at a
    kink, where they change, does not converge, and is `not_converged` or `no_descent`.

    Under `jax.vmap` on CPU the plans of a batch are made one after the other, as by
    [`delucax.planning.ILQR`][].

    **Arguments:**

    - `max_iterations`: 200 by default.
    - `tolerance`: the square root of the precision by default (1.5e-8 in float64).
    - `constraint_tolerance`: a tenth of that by default.
    - `second_order`: if true (default), with the Hessian of the Lagrangian near a
        solution; if false, with that of the cost throughout (Gauss-Newton).
    - `states`: states to start from, shape `(T+1, n)`. `controls` must then be an
        array, or the number of steps for the controls of the equilibrium.

    **Raises:** `ValueError` on an option of the wrong kind or out of its range.

    Source: Nocedal and Wright, 2006, chapter 18; Kiessling, Leyffer and Vanaret, 2024
    (the funnel); Verschueren et al., 2017, and Waechter and Biegler, 2006 (convexity).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dynamics = dlx.Discretized(dlx.systems.Pendulum(), dt=0.1)
        cost = dlx.costs.Quadratic([1.0, 0.1], [0.1], final=[20.0, 2.0])
        constraints = dlx.planning.Constraints(states=([-4.0, -1.5], [4.0, 1.5]))
        plan = dlx.planning.SQP()(
            dynamics,
            cost,
            jnp.array([1.0, 0.0]),
            jnp.zeros((20, 1)),
            bounds=(-8.0, 8.0),
            constraints=constraints,
        )
        jnp.min(plan.states[:, 1]), plan.iterations
        ```
    """

    takes_unknowns: ClassVar[bool] = True

    max_iterations: int = eqx.field(default=200, static=True)
    tolerance: Array | None = parameter(None)
    constraint_tolerance: Array | None = parameter(None)
    second_order: bool = eqx.field(default=True, static=True)
    states: Float[Array, "steps n"] | None = parameter(None)

    def __check_init__(self):
        where = "SQP"
        check_count(self.max_iterations, "max_iterations", where)
        for name in ("tolerance", "constraint_tolerance"):
            if getattr(self, name) is not None:
                check_range(getattr(self, name), name, where)
        check_bool(self.second_order, "second_order", where)

    @property
    def starts_from_states(self) -> bool:
        return self.states is not None

    def first_multipliers(self, problem: Problem, horizon: int) -> Multipliers:
        return zeros_like_result(_zero_multipliers, problem, horizon)

    def solve(self, problem: Problem, start: Start, key: PRNGKey | None) -> Plan:
        del key
        dtype, states = start.controls.dtype, self.states
        check_unknowns(problem, start.horizon)
        _check_controls(problem, start.horizon)
        if states is not None:
            n, points = problem.dynamics.state_size, start.horizon + 1
            states = finite_rows(states, n, "states", "SQP", points).astype(dtype)
        usual = float(jnp.finfo(dtype).eps) ** 0.5
        defaults = usual, usual / 10
        given = self.tolerance, self.constraint_tolerance
        tolerances = (
            as_scalar(default if value is None else value, dtype)
            for default, value in zip(defaults, given, strict=True)
        )
        options = Options(
            *tolerances,
            states=states,
            second_order=self.second_order,
            max_iterations=self.max_iterations,
        )
        return _solve(problem, start, options)

    def prepare(self, problem: Problem, start: Start) -> PyTree:
        """The first half of a real-time iteration: the quadratic program about the
        states and controls of `start`, which need not follow the dynamics. It does not
        depend on `problem.x0`.

        **Arguments:**

        - `problem`: a [`delucax.planning.Problem`][].
        - `start`: one start, with states.

        **Returns:** what `feedback` takes, a pytree.

        Source: Diehl, Bock, Schloeder, Findeisen, Nagy and Allgoewer, 2002.
        """
        if start.states is None or start.controls.ndim != 2:
            raise ValueError("SQP.prepare: start must be one start, with states.")
        if problem.unknowns is not None:
            raise ValueError("SQP.prepare: problem must have no unknowns.")
        return prepared(problem, start, self.second_order)

    def feedback(self, problem: Problem, ready: PyTree, max_steps: int = 50) -> Plan:
        """The second half: the plan from `problem.x0` after one full step.

        **Arguments:**

        - `problem`: a [`delucax.planning.Problem`][].
        - `ready`: what `prepare` returns.
        - `max_steps`: the most linear systems to solve, 50 by default.

        **Returns:** a [`delucax.planning.Plan`][], which is `successful` if the
        quadratic program was solved. `residual`, `violation` and `iterations` are those
        of the program.
        """
        return fed_back(problem, ready, max_steps)


def _check_controls(problem: Problem, horizon: int) -> None:
    """Raise if no control is between the bounds and those of the constraints."""
    own = None if problem.constraints is None else problem.constraints.controls
    if own is None or problem.bounds is None or isinstance(own, Soft):
        return
    if not all(map(is_concrete, (*own, *problem.bounds))):
        return
    shape = horizon, problem.dynamics.control_size
    # Shapes that do not fit are refused where the limits are made.
    if any(np.shape(end) not in ((), shape[1:], shape) for end in own):
        return
    low, high = (
        np.broadcast_to(pick(np.asarray(a), np.asarray(b)), shape)
        for pick, a, b in zip(
            (np.maximum, np.minimum), own, problem.bounds, strict=True
        )
    )
    if (low > high).any():
        k, i = np.argwhere(low > high)[0]
        raise ValueError(
            "SQP: bounds and the bounds `controls` of the constraints must have a "
            f"number between them, but those of entry {i} at stage {k} are at least "
            f"{low[k, i]} and at most {high[k, i]}."
        )


@quickly_compiled
def _solve(problem: Problem, start: Start, options: Options) -> Plan:
    n, whole, carried = problem.x0.shape[0], problem, None
    if problem.unknowns is not None:
        whole, start, states, carried = with_carried(problem, start, options.states)
        options = dataclasses.replace(options, states=states)
    out = solution(whole, start, options)
    fields = out._asdict()
    at, gains = fields.pop("at"), fields.pop("gains")
    limits = limits_of(whole, start.horizon)
    fields["multipliers"] = multipliers_of(whole, limits, at)
    cost = whole.total(at.states, at.controls)
    if carried is not None:
        values = carried.values(at.states[0, n:])
        parts, *_ = carried.opened(0, at.states[0])
        fields |= dict(dt=parts["dynamics"].dt, parameters=values)
    states, gains = at.states[:, :n], gains[:, :, :n]
    return problem.plan(states, at.controls, cost, gains=gains, **fields)


def _zero_multipliers(problem: Problem, horizon: int) -> Multipliers:
    limits, x0 = limits_of(problem, horizon), problem.x0
    states = jnp.zeros((horizon + 1, *x0.shape), x0.dtype)
    controls = jnp.zeros((horizon, problem.dynamics.control_size), x0.dtype)
    sides = jnp.zeros((2, *limits.low.shape), x0.dtype)
    return multipliers_of(problem, limits, Iterate(states, controls, states, sides))
