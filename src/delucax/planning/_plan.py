"""The plan: a trajectory, feedback about it, and how it was computed."""

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
    - `multipliers`: [`delucax.planning.Multipliers`][] of the constraints; `None`
        without constraints, or of a planner that has none.
    - `result`: success, or why not; one of `delucax.RESULTS`.
    - `iterations`: the iterations taken.
    - `rollouts`: the trajectories computed, each candidate of a line search being one.
    - `regularisation`: that of the last iteration. Above zero, the problem has no
        positive definite control Hessian at the solution, or the search was hard.
    - `t0`: the time of the first state.
    - `dt`: the control interval.
    - `low`, `high`: the bounds of the controls, shape `(m,)`; `None` if there are none.
    - `difference`: `(x, x_ref) -> deviation`; subtraction by default.
    - `parameters`: what [`delucax.planning.Unknowns`][] chose, by paths, with a
        duration as the step `dt` of the dynamics; `None` without.

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
    difference: Callable[[Any, Any], Any] | None = function_field()
    parameters: dict[str, Array] | None = None

    def __check_init__(self):
        check_step(self.dt, "Plan")
        if self.low is not None or self.high is not None:
            bounds, size = (self.low, self.high), self.controls.shape[-1]
            as_bounds(bounds, "Plan", "low and high", size)

    @property
    def duration(self) -> Array:
        """The time from the first state to the last."""
        return self.controls.shape[-2] * self.dt

    @property
    def is_usable(self) -> Array:
        """Whether the plan can be followed: it did not diverge, and the constraints can
        hold.

        A plan of too few iterations, or whose search failed, is the best so far.
        """
        finite = jnp.all(jnp.isfinite(self.controls), axis=(-2, -1))
        # Of other failures, such as too few iterations, the best iterate is left.
        lost = self.result == RESULTS.diverged
        lost = lost | (self.result == RESULTS.no_feasible_point)
        return finite & ~lost

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        size = self.states.shape[1]
        if y.shape != (size,):
            raise wrong_observation(self, size, y)
        # By the number of steps, because a time k dt is rounded.
        step = step_at(t - self.t0, self.dt, len(self.controls), "Plan")
        rows = self.states[:-1], self.controls, self.gains
        x_ref, u_ref, K = row_at(rows, step)
        e = y - x_ref if self.difference is None else self.difference(y, x_ref)
        u = u_ref - matvec(K, e)
        # The feedback may leave the bounds that the planned controls respect.
        if self.low is not None and self.high is not None:
            u = jnp.minimum(jnp.maximum(u, self.low), self.high)
        return u.astype(y.dtype), state
