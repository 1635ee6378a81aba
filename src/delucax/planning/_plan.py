"""The result of a planner: a trajectory, feedback gains about it, and its status."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .._check import as_bounds, check_step
from .._controller import AbstractController, wrong_observation
from .._module import function_field, parameter, weight
from .._results import Result, RESULTS
from .._typing import RealScalar
from ..math import matvec
from ..math._steps import row_at, step_at
from ._multipliers import Multipliers


class Plan(AbstractController):
    r"""A planned trajectory with feedback gains, and a controller that follows it.

    The control is

    $$u = u_k - K_k\, (y - x_k), \qquad k = \mathrm{round}((t - t_0) / \Delta t)$$

    where $x_k$, $u_k$ and $K_k$ are the `states`, `controls` and `gains`. The control
    is clipped to the bounds of the plan. Before the start and after the end of the
    plan, the control is NaN, and [`delucax.rollout`][] reports this.

    Every [`delucax.planning.AbstractPlanner`][] returns a plan, and so do
    [`delucax.planning.ilqr`][], [`delucax.planning.ilc`][] and
    [`delucax.planning.igpc`][]. The plans of [`delucax.planning.MPPI`][] and
    [`delucax.planning.CEM`][] have gains of zero.

    **Arguments:**

    - `states`: $x_0, \dots, x_T$, shape `(T+1, n)`.
    - `controls`: $u_0, \dots, u_{T-1}$, shape `(T, m)`, trainable.
    - `gains`: $K_0, \dots, K_{T-1}$, shape `(T, m, n)`, trainable. If a control is at
        one of its bounds at step $k$, the row of $K_k$ for this control is zero.
    - `cost`: the cost of the trajectory, with the final cost.
    - `trace`: the cost of the initial trajectory and the cost after each iteration,
        shape `(max_iterations + 1,)`. If the planner took fewer iterations, the last
        cost fills the remaining entries. With constraints, `trace` holds the augmented
        Lagrangian instead of the cost. For [`delucax.planning.SQP`][], `trace` holds
        the cost with the penalty of soft constraints.
    - `residual`: how far the plan is from a stationary point: the largest entry of the
        gradient of the cost with respect to the controls, projected to the bounds. For
        `SQP`, `residual` is the largest entry of the gradient of the Lagrangian. For a
        sampling planner, such as MPPI, `residual` is the largest change of a control in
        the last iteration.
    - `violation`: the largest violation of a constraint. For
        [`delucax.planning.ILQR`][], `violation` is also above zero if a constraint is
        inactive but its multiplier is not zero. Without constraints it is 0.
    - `multipliers`: the [`delucax.planning.Multipliers`][] of the constraints; `None`
        without constraints, or if the planner has no multipliers.
    - `result`: the status, one of `delucax.RESULTS`.
    - `iterations`: the number of iterations.
    - `rollouts`: the number of computed trajectories. Each trajectory that a line
        search tries counts as a rollout.
    - `regularisation`: the regularisation of the last iteration. A value above zero
        means that the control Hessian at the solution is not positive definite, or that
        the line search recently found no step that it could accept.
    - `t0`: the time of the first state.
    - `dt`: the control interval.
    - `low`, `high`: the bounds of the controls, shape `(m,)`; `None` without bounds.
    - `difference`: the function `(x, x_ref) -> deviation` that computes the deviation
        from the planned state; subtraction by default.
    - `parameters`: the values that the planner chose for
        [`delucax.planning.Unknowns`][], in a dictionary whose keys are the paths of the
        parameters. If the planner chose the duration, the dictionary contains the step
        `dt` of the dynamics. `None` without unknowns.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        env = dlx.make("pendulum", horizon=20)
        x0 = jnp.array([0.5, 0.0])
        plan = dlx.planning.ilqr(env.dynamics, env.cost, x0, 20)
        dlx.rollout(env, plan, key=jax.random.key(0), x0=x0 + 0.05).total_cost
        ```

        ```text
        Array(44.2, dtype=float32)
        ```
    """

    states: Float[Array, "*batch T+1 n"] = parameter()
    controls: Float[Array, "*batch T m"] = weight()
    gains: Float[Array, "*batch T m n"] = weight()
    cost: Array
    trace: Array
    residual: Array
    violation: Array
    multipliers: Multipliers | None
    result: Result
    iterations: Array
    rollouts: Array
    regularisation: Array
    t0: Array = parameter()
    dt: Array = parameter()
    low: Array | None = parameter()
    high: Array | None = parameter()
    difference: Callable[[Any, Any], Any] | None = function_field(of="a, b")
    parameters: dict[str, Array] | None = None

    def __check_init__(self):
        check_step(self.dt, "Plan")
        if self.low is not None or self.high is not None:
            bounds, size = (self.low, self.high), self.controls.shape[-1]
            as_bounds(bounds, "Plan", "low and high", size)

    @property
    def duration(self) -> Array:
        """The time from the first state to the last one."""
        return self.controls.shape[-2] * self.dt

    @property
    def is_usable(self) -> Array:
        """Whether the plan can be followed.

        The controls of a usable plan are finite, and its `result` is neither `diverged`
        nor `no_feasible_point`. A plan that did not converge is usable, because it is
        the best iterate so far.
        """
        finite = jnp.all(jnp.isfinite(self.controls), axis=(-2, -1))
        lost = self.result == RESULTS.diverged
        lost = lost | (self.result == RESULTS.no_feasible_point)
        return finite & ~lost

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        size = self.states.shape[1]
        if y.shape != (size,):
            raise wrong_observation(self, size, y)
        # Compare numbers of steps, because the time k dt is rounded.
        step = step_at(t - self.t0, self.dt, len(self.controls), "Plan")
        rows = self.states[:-1], self.controls, self.gains
        x_ref, u_ref, K = row_at(rows, step)
        e = y - x_ref if self.difference is None else self.difference(y, x_ref)
        u = u_ref - matvec(K, e)
        # The feedback may leave the bounds that the planned controls respect.
        if self.low is not None and self.high is not None:
            u = jnp.minimum(jnp.maximum(u, self.low), self.high)
        return u.astype(y.dtype), state
