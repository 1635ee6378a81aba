"""The best fixed controller in hindsight, and regret."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, PyTree

from ..._check import check_count
from ..._check_models import check_forward_mode
from ..._controller import AbstractController
from ..._module import marked_leaves
from ..._results import choose, Result, RESULTS
from ...disturbances import FromArray
from ...environments import Environment
from ...math._linear_solve import solve
from ...simulation import rollout, Trajectory
from ._policy import FixedPolicy


class Hindsight(NamedTuple):
    """The result of `best_in_hindsight`."""

    controller: AbstractController
    trajectory: Trajectory
    decrement: Float[Array, ""]
    iterations: Int[Array, ""]
    result: Result


def best_in_hindsight(
    environment: Environment,
    controller: AbstractController,
    trajectory: Trajectory,
    *,
    iterations: int = 30,
    tolerance: float | None = None,
) -> Hindsight:
    r"""The fixed controller that would have had the lowest cost in a given run, found
    after the run when its disturbances are known.

    $$\min_\theta \; \sum_t c(t, x_t(\theta), u_t(\theta)) + c_f(x_T(\theta))$$

    Here $\theta$ are the trainable weights of `controller`. For `learner.fixed()`,
    $\theta$ are the weights of the policy, without the weights of the base controller.
    Every run of the search has the same first state, disturbances and sensor noise as
    `trajectory`.

    The search uses Newton's method with Levenberg's damping, and differentiates through
    the rollout. The search finds the global minimum if the cost is convex in $\theta$.
    The cost is convex for a disturbance-action policy on a linear plant with a convex
    cost, but in general not for a linear gain.

    - `gpc(...).fixed()`: the best disturbance-action policy.
    - `drc(...).fixed()`: the best disturbance-response policy.
    - `Linear(K)` or `LQR(...)`: the best gain, with the given gain as the start of the
        search.
    - `OpenLoop(controls)`: the best sequence of controls without feedback, for short
        horizons.

    **Arguments:**

    - `environment`: the environment.
    - `controller`: a controller whose weights are the start of the search. The search
        covers all controllers of the same structure.
    - `trajectory`: a run with its states and disturbances. The search covers its whole
        length.
    - `iterations`: the largest number of Newton steps, 30 by default.
    - `tolerance`: the search stops if the predicted decrease is below this fraction of
        the cost; by default the square root of the rounding error.

    **Returns:** a named tuple of

    - `controller`: the best controller of the class, and `trajectory`, its run;
    - `decrement`: the predicted decrease of the last Newton step, relative to the cost;
    - `iterations`: the number of steps tried;
    - `result`: successful, or `delucax.RESULTS.not_converged`.

    **Raises:** `ValueError` if the trajectory has no states or disturbances (or
    observations, if they are noisy), or the controller has no trainable weights.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        A, B = jnp.array([[1.0, 1.0], [0.0, 1.0]]), jnp.array([[0.0], [1.0]])
        wave = dlx.disturbances.Sinusoid(0.1 * jnp.ones(2), frequency=0.05)
        env = dlx.make("lds", A=A, B=B, disturbance=wave)
        lqr = dlx.controllers.LQR(env.dynamics, jnp.eye(2), jnp.eye(1))
        run = dlx.rollout(env, lqr, key=jax.random.key(0), x0=jnp.zeros(2))
        best = dlx.controllers.best_in_hindsight(env, lqr, run)
        run.total_cost / best.trajectory.total_cost
        ```
    """
    where = "best_in_hindsight"
    states, w = trajectory.states, trajectory.disturbances
    if states is None or w is None:
        raise ValueError(
            f"{where}: trajectory must have its states and disturbances, got one with "
            f"keep={trajectory.keep}."
        )
    weights, _ = _split(controller)
    if not jax.tree.leaves(weights):
        raise ValueError(
            f"{where}: controller must have trainable weights, got "
            f"{type(controller).__name__}."
        )
    iterations = check_count(iterations, "iterations", where)
    check_forward_mode(environment, where)
    rounding = float(jnp.finfo(states.dtype).eps ** 0.5)
    tolerance = rounding if tolerance is None else tolerance
    if environment.sensor_noise is not None:
        if trajectory.observations is None:
            raise ValueError(
                f"{where}: trajectory must have its observations, because environment "
                f"has sensor noise, got one with keep={trajectory.keep}."
            )
        observe = jax.vmap(environment.dynamics.observe)
        exact = observe(trajectory.times[:-1], states[:-1])
        # The recorded sensor noise, not a new draw, so that all runs are comparable.
        noise = FromArray(trajectory.observations - exact)
        environment = eqx.tree_at(lambda e: e.sensor_noise, environment, noise)
    given = states[0], w, trajectory.steps, iterations, tolerance
    return _search(environment, controller, *given)


def regret(trajectory: Trajectory, comparator: Trajectory) -> Float[Array, "... T"]:
    r"""The regret: the cost of a run minus the cost of another run, up to each step.

    $$\mathrm{regret}_k = \sum_{t \le k} (c_t - c^*_t)$$

    Here $c^*$ is the cost of the other run. Final costs do not count.

    **Arguments:**

    - `trajectory`: a run with its costs.
    - `comparator`: another run under the same disturbances, for example from
        [`delucax.controllers.best_in_hindsight`][].

    **Returns:** shape `(T,)`.

    **Raises:** `ValueError` if one of the two runs has no costs, or the runs differ in
    length.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        A, B = jnp.array([[1.0, 1.0], [0.0, 1.0]]), jnp.array([[0.0], [1.0]])
        wave = dlx.disturbances.Sinusoid(0.1 * jnp.ones(2), frequency=0.05)
        env = dlx.make("lds", A=A, B=B, disturbance=wave)
        lqr = dlx.controllers.LQR(env.dynamics, jnp.eye(2), jnp.eye(1))
        run = dlx.rollout(env, lqr, key=jax.random.key(0), x0=jnp.zeros(2))
        best = dlx.controllers.best_in_hindsight(env, lqr, run)
        dlx.controllers.regret(run, best.trajectory)[-1]
        ```
    """
    costs, others = trajectory.costs, comparator.costs
    if costs is None or others is None or costs.shape != others.shape:
        shape = lambda c: "none" if c is None else c.shape  # noqa: E731
        raise ValueError(
            "regret: trajectory and comparator must have costs of one shape, got "
            f"{shape(costs)} and {shape(others)}."
        )
    return jnp.cumsum(costs - others, axis=-1)


def _split(controller: AbstractController) -> tuple[PyTree, PyTree]:
    """The weights that the search changes, and the rest of the controller."""
    # For a policy of a learner, the base stays the same.
    inside = "policy" if isinstance(controller, FixedPolicy) else ""
    marks = [
        role == "weight"
        and eqx.is_inexact_array(leaf)
        and jax.tree_util.keystr(path, simple=True).startswith(inside)
        for path, leaf, role, _ in marked_leaves(controller)
    ]
    mask = jax.tree.unflatten(jax.tree.structure(controller), marks)
    return eqx.partition(controller, mask)


@eqx.filter_jit
def _search(environment, controller, x0, w, horizon, iterations, tolerance):
    weights, rest = _split(controller)
    start, unravel = ravel_pytree(weights)

    def run(theta, keep=(), checkpoint="step"):
        policy = eqx.combine(unravel(theta), rest)
        options: Any = dict(horizon=horizon, keep=keep, checkpoint=checkpoint)
        options |= dict(key=jax.random.key(0), throw=False)
        return policy, rollout(environment, policy, x0=x0, w=w, **options)

    def derivatives(theta):
        total = lambda theta: run(theta, checkpoint="sqrt")[1].total_cost  # noqa: E731
        # Forward over reverse: one linearisation, then a batch of Hessian products.
        (cost, gradient), jvp = jax.linearize(jax.value_and_grad(total), theta)
        _, hessian = jax.vmap(jvp)(eye)
        return cost, gradient, (hessian + hessian.T) / 2

    def step(carry):
        best, local, damping, _, k = carry
        cost, gradient, hessian = local
        size = jnp.trace(jnp.abs(hessian)) / len(start)
        # Levenberg's damping, relative to the mean curvature.
        damped = hessian + damping * jnp.where(size > 0, size, 1) * eye
        change = solve(damped, -gradient[:, None])[:, 0]
        change = jnp.where(k > 0, change, 0)
        # The decrease that the undamped quadratic model predicts.
        predicted = -(gradient @ change + change @ hessian @ change / 2)
        # Cost and derivatives in one pass, because a successful trial needs both.
        tried = derivatives(best + change)
        # A trial that diverges has a cost of NaN, which is not below, and is refused.
        pick = lambda new, old: jnp.where(tried[0] < cost, new, old)  # noqa: E731
        left = predicted / (jnp.abs(cost) + jnp.finfo(start.dtype).tiny)
        # A negative predicted decrease is rounding.
        is_known = (k > 0) & jnp.isfinite(cost)
        left = jnp.where(is_known & (predicted >= 0), left, jnp.inf)
        # With less damping, rounding would move weights without an effect on the cost.
        damping = pick(jnp.maximum(damping / 10, least), damping * 10)
        local = jax.tree.map(pick, tried, local)
        return pick(best + change, best), local, damping, left, k + 1

    def unfinished(carry):
        _, (cost, *_), _, left, k = carry
        goes_on = (k == 0) | jnp.isfinite(cost)
        return (k <= iterations) & goes_on & ~(left <= tolerance)

    eye = jnp.eye(len(start), dtype=start.dtype)
    least = jnp.finfo(start.dtype).eps ** 0.75
    # The first step does not move, and only computes the cost and derivatives.
    infinite = jnp.asarray(jnp.inf, start.dtype)
    unknown = infinite, jnp.zeros_like(start), 0 * eye
    carry = start, unknown, 100 * least, infinite, 0
    theta, (cost, *_), _, left, k = lax.while_loop(unfinished, step, carry)
    best, trajectory = run(theta, ("states", "controls", "costs", "disturbances"))
    result = choose(left <= tolerance, RESULTS.successful, RESULTS.not_converged)
    result = choose(jnp.isfinite(cost), result, RESULTS.diverged)
    return Hindsight(best, trajectory, left, jnp.asarray(k - 1), result)
