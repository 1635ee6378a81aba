"""Losses from rollouts: expected cost, score-function cost, worst case."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, Float

from .._check import (
    as_number,
    as_vector,
    check_choice,
    check_count,
    check_instance,
    check_key,
    check_positive,
)
from .._controller import (
    AbstractController,
    AbstractStochasticPolicy,
    check_controller,
    check_stochastic,
    initial_state,
    replay,
)
from .._module import as_float_array
from .._typing import Checkpoint, PRNGKey
from ..environments import Environment, randomise
from ..math import safe_norm
from ..simulation import rollout, Trajectory


class _ExpectedCost(eqx.Module):
    """A loss; a module rather than a closure, so that the plant is not a constant."""

    environment: Environment
    gradient_decay: float | Array
    ranges: dict[str, Any] | None
    batch: int = eqx.field(static=True)
    horizon: int = eqx.field(static=True)
    checkpoint: Checkpoint = eqx.field(static=True)
    truncate: int | None = eqx.field(static=True)

    def __call__(self, controller, key):
        check_key(key, "expected_cost")
        options: Any = dict(checkpoint=self.checkpoint, truncate=self.truncate)
        options |= dict(horizon=self.horizon, gradient_decay=self.gradient_decay)
        options |= dict(keep=(), throw=False)

        def total(key):
            environment = self.environment
            if self.ranges is not None:
                key, plant_key = jr.split(key)
                environment = randomise(environment, plant_key, self.ranges)
            trajectory = rollout(environment, controller, key=key, **options)
            return nan_if_failed(trajectory, trajectory.total_cost)

        if self.batch == 1:
            return total(key)
        return jnp.mean(jax.vmap(total)(jr.split(key, self.batch)))


def expected_cost(
    environment: Environment,
    *,
    batch: int,
    horizon: int | None = None,
    checkpoint: Checkpoint = "step",
    gradient_decay: Any = 1.0,
    truncate: int | None = None,
    ranges: dict[str, Any] | None = None,
) -> Any:
    """The loss of a controller: its mean total cost over fresh starts.

    `loss(controller, key) = 1/B sum_i J(controller; x0_i, w_i)`, the starts,
    disturbances and noise drawn anew with each key. A rollout that diverges, or whose
    solver fails, makes the loss NaN or infinite, which [`delucax.training.fit`][]
    reports with its step.

    **Arguments:**

    - `environment`: the environment.
    - `batch`: the number B of rollouts, all at once under `jax.vmap`.
    - `horizon`: steps per rollout; the environment's own by default.
    - `checkpoint`: what the gradient stores, as in [`delucax.rollout`][]; `"step"` by
        default.
    - `gradient_decay`: damping of the gradient through time, as in
        [`delucax.rollout`][]; 1, the true gradient, by default.
    - `truncate`: steps after which the gradient is cut, as in [`delucax.rollout`][];
        never by default.
    - `ranges`: of parameters, as in [`delucax.randomise`][]: each rollout draws a plant
        of its own. None by default.

    **Returns:** a function `loss(controller, key)` to a scalar.

    **Raises:** `ValueError` if `batch`, `horizon` or `truncate` is below 1,
    `environment` is not an environment, `checkpoint` is none of the above, or
    `gradient_decay` is not a finite number.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp
        import optax

        loss = dlx.training.expected_cost(dlx.make("pendulum"), batch=16, horizon=50)
        fitted = dlx.training.fit(
            loss,
            dlx.controllers.Linear(jnp.array([[20.0, 5.0]])),
            optax.adam(0.1),
            steps=10,
            key=jax.random.key(0),
        )
        fitted.model.K, fitted.history.loss
        ```
    """
    where = "expected_cost"
    check_instance(environment, Environment, "environment", where)
    check_choice(checkpoint, ("step", "sqrt", None), "checkpoint", where)
    decay = as_number(gradient_decay, "gradient_decay", where)
    # A number 1 is known to leave the gradient alone, and compiles nothing.
    is_one = isinstance(gradient_decay, int | float) and gradient_decay == 1
    decay = 1.0 if is_one else as_float_array(decay)
    horizon = environment.horizon if horizon is None else horizon
    batch = check_count(batch, "batch", where)
    horizon = check_count(horizon, "horizon", where)
    if truncate is not None:
        truncate = check_count(truncate, "truncate", where)
    if ranges is not None:
        randomise(environment, jr.key(0), ranges)  # for its checks
    static = batch, horizon, checkpoint, truncate
    return _ExpectedCost(environment, decay, ranges, *static)


class _ScoredCost(eqx.Module):
    environment: Environment
    horizon: int = eqx.field(static=True)

    def __call__(
        self, controller: AbstractStochasticPolicy, key: PRNGKey
    ) -> tuple[Array, dict[str, Array]]:
        check_key(key, "scored_cost")
        check_stochastic(controller, "controller", "scored_cost")
        keep = ("observations", "controls", "costs")
        options: Any = dict(horizon=self.horizon, keep=keep, throw=False)
        run: Any = rollout(self.environment, controller, key=key, **options)

        # What was drawn depends on the weights, but the score is that of the weights
        # for a draw held fixed. So the controller is run again on what it was given:
        # its memory may depend on the weights, and keeps its gradient; the
        # observations, the controls and the costs do not.
        def act(t, y, state, applied, valid):
            u, after = controller(t, y, state)
            log_prob = controller.log_prob(t, y, state, lax.stop_gradient(u))
            return jnp.where(valid, log_prob, 0), after

        record = (run.times[:-1], run.observations, run.controls, run.costs)
        valid = jnp.arange(self.horizon) < run.length
        *_, controller_key = self.environment.split_key(key)
        state = initial_state(controller, controller_key)
        scores = replay(controller, state, lax.stop_gradient((*record, valid)), act)
        return nan_if_failed(run, run.total_cost), {"log_prob": jnp.sum(scores)}


def scored_cost(environment: Environment, *, horizon: int | None = None) -> Any:
    """The loss of a controller that draws: one episode's cost, and its log-probability.

    `loss(controller, key) = (J, {"log_prob": sum_k log p(u_k | t_k, y_k, s_k)})`, with
    the observations and the drawn controls held fixed in the log-probability. The
    episode is that of `delucax.rollout(environment, controller, key=key)`. It is what
    [`delucax.training.LikelihoodRatio`][] asks for; the other estimators take it too.

    **Arguments:**

    - `environment`: the environment.
    - `horizon`: steps; the environment's own by default.

    **Returns:** a function `loss(controller, key)` to a scalar and a dictionary. The
    controller must be a [`delucax.AbstractStochasticPolicy`][].

    **Raises:** `ValueError` if `horizon` is below 1 or `environment` is not an
    environment; when it is called, if the controller does not draw its controls.

    !!! example

        ```python
        import delucax as dlx
        import equinox as eqx
        import jax
        import jax.numpy as jnp
        from jaxtyping import Array

        class Dithered(dlx.AbstractStochasticPolicy):
            gain: Array = dlx.weight(20.0)

            def init(self, *, key=None):
                return key

            def __call__(self, t, y, state):
                state, now = jax.random.split(state)
                return -self.gain * y[:1] + jax.random.normal(now, (1,), y.dtype), state

            def log_prob(self, t, y, state, u):
                return -0.5 * jnp.sum((u + self.gain * y[:1]) ** 2)

        loss = dlx.training.scored_cost(dlx.make("pendulum"), horizon=20)
        estimator = dlx.training.LikelihoodRatio(samples=32)
        key = jax.random.key(0)
        value, gradient = eqx.filter_jit(estimator)(loss, Dithered(), key)
        ```
    """
    where = "scored_cost"
    check_instance(environment, Environment, "environment", where)
    horizon = environment.horizon if horizon is None else horizon
    return _ScoredCost(environment, check_count(horizon, "horizon", where))


def nan_if_failed(trajectory: Trajectory, costs: Array) -> Array:
    """Costs of a run, NaN where it failed: those of a failed solve may look finite."""
    # Costs that are not finite show it already, and stay as they are.
    kept = ~trajectory.failed | ~jnp.isfinite(trajectory.total_cost)
    return jnp.where(kept, costs, jnp.nan)


class _Attack(NamedTuple):
    """The worst disturbances of a search, see `worst_case`."""

    w: Float[Array, "horizon disturbances"]
    total_cost: Array
    costs: Float[Array, " iterations"]


def worst_case(
    environment: Environment,
    controller: AbstractController,
    *,
    key: PRNGKey,
    bound: Any,
    x0: Any = None,
    horizon: int | None = None,
    iterations: int = 20,
    starts: int = 8,
) -> _Attack:
    r"""Worst-case bounded disturbances of a closed loop, by local search,

    `max over w of the total cost, with |w_t| <= bound for each t`.

    At each iteration the cost is taken to be linear in the disturbances,
    `w_t <- bound g_t / |g_t|`, `g_t` being the derivative of the total cost with
    respect to `w_t`. Where the cost is convex in the disturbances, as with linear
    dynamics and feedback and a convex cost, no iteration makes it less; the best one is
    returned in any case. The search starts several times at once, every other time from
    a constant push and else from noise, and the best end is returned.

    **Arguments:**

    - `environment`: the environment; its own disturbance is not used.
    - `controller`: the controller under attack. The attack accounts for the adaptation
        of a learner.
    - `key`: a random key, for the start of the search, of the rollout and of the
        controller.
    - `bound`: of the Euclidean norm of each `w_t`, a positive number.
    - `x0`: the first state; drawn by the environment by default.
    - `horizon`: steps; the environment's own by default.
    - `iterations`: 20 by default.
    - `starts`: 8 by default.

    **Returns:** a named tuple: `w`, shape `(horizon, k)`, for `rollout(..., w=w)`;
    `total_cost`, what they cost; and `costs`, the total cost at each iteration from
    the start that led to them, shape `(iterations + 1,)`.

    **Raises:** `ValueError` on an argument of the wrong kind, shape or range, or if the
    environment takes no disturbance.

    Source: Frank and Wolfe, 1956 (for a maximum of a convex function).

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        A, B = jnp.array([[1.0, 1.0], [0.0, 1.0]]), jnp.array([[0.0], [1.0]])
        env = dlx.make("lds", A=A, B=B, horizon=100)
        lqr = dlx.controllers.LQR(env.dynamics, jnp.eye(2), jnp.eye(1))
        attack = dlx.training.worst_case(env, lqr, key=jax.random.key(0), bound=1.0)
        attack.total_cost, attack.w
        ```
    """
    where = "worst_case"
    check_instance(environment, Environment, "environment", where)
    check_controller(controller, "controller", where)
    if environment.disturbance_size == 0:
        raise ValueError(f"{where}: environment must take a disturbance, got none.")
    key = check_key(key, where)
    check_positive(bound, "bound", where)
    horizon = environment.horizon if horizon is None else horizon
    horizon = check_count(horizon, "horizon", where)
    iterations = check_count(iterations, "iterations", where)
    starts = check_count(starts, "starts", where)
    if x0 is not None:
        x0 = as_vector(x0, environment.state_size, "x0", where)
    options = as_float_array(bound), x0, horizon, iterations, starts
    return _attack(environment, controller, key, *options)


@eqx.filter_jit
def _attack(environment, controller, key, bound, x0, horizon, iterations, starts):
    start, run_key = jr.split(key)

    def total(w):
        options: Any = dict(key=run_key, horizon=horizon, x0=x0, keep=(), throw=False)
        return rollout(environment, controller, w=w, **options).total_cost

    def on_sphere(g, old):
        norm = safe_norm(g, keepdims=True)
        moved = (norm > 0) & jnp.isfinite(norm)
        return jnp.where(moved, bound * g / jnp.where(moved, norm, 1), old)

    # One iteration of Frank and Wolfe: the maximum over the balls of the cost's linear
    # model lies on the spheres, along the gradient.
    def step(carry, _):
        w, best, most = carry
        cost, g = jax.value_and_grad(total)(w)
        better = cost > most
        best, most = jnp.where(better, w, best), jnp.where(better, cost, most)
        return (on_sphere(g, w).astype(w.dtype), best, most), cost

    @jax.vmap
    def search(w):
        carry = w, w, jnp.asarray(-jnp.inf, like.dtype)
        (w, best, most), costs = lax.scan(step, carry, length=iterations)
        last = total(w)
        costs = jnp.append(costs, last)
        return _Attack(jnp.where(last > most, w, best), jnp.maximum(last, most), costs)

    shape = horizon, environment.disturbance_size
    like = jax.eval_shape(total, jnp.zeros(shape))
    noise = jr.normal(start, (starts, *shape), like.dtype)
    steady = (jnp.arange(starts) % 2 == 0)[:, None, None]
    first = jnp.where(steady, noise[:, :1], noise)
    attacks = search(on_sphere(first, first).astype(like.dtype))
    worst = jnp.argmax(attacks.total_cost)
    return jax.tree.map(lambda leaf: leaf[worst], attacks)
