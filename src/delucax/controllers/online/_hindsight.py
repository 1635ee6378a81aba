"""The best controller of a class, once the disturbances are known."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, PyTree

from ..._check import check_count
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
    """The fixed controller that would have cost least, the disturbances being known:

    `min over theta of sum_t c(t, x_t(theta), u_t(theta)) + final(x_T(theta))`,

    with theta the trainable weights of `controller` (of `learner.fixed()` those of its
    policy, not of its base), from
    the start and under the disturbances and sensor noise of `trajectory`. It is found
    by Newton's method with Levenberg's damping through the rollout, and is the global
    minimum where the cost is convex in theta: of a disturbance-action policy on a
    linear plant with a convex cost it is, of a linear gain in general not.

    - `gpc(...).fixed()`: the best disturbance-action policy.
    - `drc(...).fixed()`: the best disturbance-response policy.
    - `Linear(K)` or `LQR(...)`: the best gain, from that one on.
    - `OpenLoop(controls)`: the best open loop, for short horizons.

    **Arguments:**

    - `environment`: the environment.
    - `controller`: the class, and where the search starts.
    - `trajectory`: a run with its states and disturbances, over the whole of which the
        search goes.
    - `iterations`: Newton steps at most, 30 by default.
    - `tolerance`: stop when the predicted decrease is below this part of the cost; by
        default the square root of the rounding error.

    **Returns:** a named tuple of

    - `controller`: the best of the class, and `trajectory`, its run;
    - `decrement`: the predicted decrease of the last Newton step, relative to the cost;
    - `iterations`: steps tried;
    - `result`: success, or `delucax.RESULTS.not_converged`.

    **Raises:** `ValueError` if the trajectory has no states or disturbances (or
    observations, where they are noisy), or the controller no trainable weights.

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
            f"{where}: trajectory must have its states and disturbances, got one that "
            f"kept {trajectory.keep}."
        )
    weights, _ = _split(controller)
    if not jax.tree.leaves(weights):
        raise ValueError(
            f"{where}: controller must have trainable weights, got "
            f"{type(controller).__name__}."
        )
    iterations = check_count(iterations, "iterations", where)
    rounding = float(jnp.finfo(states.dtype).eps ** 0.5)
    tolerance = rounding if tolerance is None else tolerance
    if environment.sensor_noise is not None:
        if trajectory.observations is None:
            raise ValueError(
                f"{where}: trajectory must have its observations, in an environment "
                "with sensor noise."
            )
        observe = jax.vmap(environment.dynamics.observe)
        exact = observe(trajectory.times[:-1], states[:-1])
        # The sensor noise that there was, not a new draw: all are compared under the
        # same.
        noise = FromArray(trajectory.observations - exact)
        environment = eqx.tree_at(lambda e: e.sensor_noise, environment, noise)
    given = states[0], w, trajectory.steps, iterations, tolerance
    return _search(environment, controller, *given)


def regret(trajectory: Trajectory, comparator: Trajectory) -> Float[Array, "... T"]:
    """By how much a run has cost more than another, up to each step,

    `regret_k = sum_{t <= k} (cost_t - comparator's cost_t)`.

    The final costs are left out.

    **Arguments:**

    - `trajectory`: a run with its costs.
    - `comparator`: another under the same disturbances, such as that of
        [`delucax.controllers.best_in_hindsight`][].

    **Returns:** shape `(T,)`.

    **Raises:** `ValueError` if one has no costs, or they differ in length.

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
    """The weights that the search moves, and the rest."""
    # A policy is judged on top of the base that it was given.
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
        # One linearisation, then a batch of products with the Hessian: forward over
        # reverse.
        (cost, gradient), jvp = jax.linearize(jax.value_and_grad(total), theta)
        _, hessian = jax.vmap(jvp)(eye)
        return cost, gradient, (hessian + hessian.T) / 2

    def step(carry):
        best, local, damping, _, k = carry
        cost, gradient, hessian = local
        size = jnp.trace(jnp.abs(hessian)) / len(start)
        # Levenberg's damping, in units of the mean curvature: theta has no scale.
        damped = hessian + damping * jnp.where(size > 0, size, 1) * eye
        change = solve(damped, -gradient[:, None])[:, 0]
        change = jnp.where(k > 0, change, 0)
        # The decrease that the quadratic model predicts, of the undamped model.
        predicted = -(gradient @ change + change @ hessian @ change / 2)
        # Cost and derivatives in one pass: a trial that succeeds needs them next.
        tried = derivatives(best + change)
        # NaN is not below: a trial that diverges is refused, and the next one damped
        # more.
        pick = lambda new, old: jnp.where(tried[0] < cost, new, old)  # noqa: E731
        left = predicted / (jnp.abs(cost) + jnp.finfo(start.dtype).tiny)
        # A predicted decrease below zero is rounding.
        left = jnp.where((k > 0) & (predicted >= 0), left, jnp.inf)
        # With less damping, rounding would move what the cost does not depend on.
        damping = pick(jnp.maximum(damping / 10, least), damping * 10)
        local = jax.tree.map(pick, tried, local)
        return pick(best + change, best), local, damping, left, k + 1

    def unfinished(carry):
        *_, left, k = carry
        return (k <= iterations) & ~(left <= tolerance)

    eye = jnp.eye(len(start), dtype=start.dtype)
    least = jnp.finfo(start.dtype).eps ** 0.75
    # The first step stays where it is, and is better than this.
    infinite = jnp.asarray(jnp.inf, start.dtype)
    unknown = infinite, jnp.zeros_like(start), 0 * eye
    carry = start, unknown, 100 * least, infinite, 0
    theta, _, _, left, k = lax.while_loop(unfinished, step, carry)
    best, trajectory = run(theta, ("states", "controls", "costs", "disturbances"))
    result = choose(left <= tolerance, RESULTS.successful, RESULTS.not_converged)
    return Hindsight(best, trajectory, left, jnp.asarray(k - 1), result)
