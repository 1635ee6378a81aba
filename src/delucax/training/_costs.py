"""The costs of rollouts as losses, and the worst case over disturbances."""

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
    """The loss that `expected_cost` makes."""

    # A module, because a closure would compile the plant in as a constant.

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
    r"""A loss for policy training: the mean total cost over random episodes.

    $$\ell(\theta, \text{key}) = \frac{1}{B} \sum_{i=1}^{B} J(\theta; x_0^i, w^i)$$

    Initial states, disturbances and noise are drawn from the key. If a rollout diverges
    or its solver fails, the loss is NaN or infinite, and [`delucax.training.fit`][]
    reports the step at which this happens.

    **Arguments:**

    - `environment`: the environment.
    - `batch`: $B$, the number of rollouts. They run together under `jax.vmap`.
    - `horizon`: steps per rollout; the `horizon` of the environment by default.
    - `checkpoint`: what the gradient stores: `"step"` (default), `"sqrt"` or `None`, as
        in [`delucax.rollout`][].
    - `gradient_decay`: the damping factor of the gradient through time, as in
        [`delucax.rollout`][]; 1 by default, which gives the true gradient.
    - `truncate`: the number of steps between two cuts of the gradient, as in
        [`delucax.rollout`][]; by default the gradient is never cut.
    - `ranges`: ranges of parameters, as in [`delucax.randomise`][]. If you pass
        `ranges`, each rollout draws the parameters of its own plant. None by default.

    **Returns:** a function `loss(controller, key)` that returns a scalar. Compile it
    with `eqx.filter_jit(loss)`. `jax.jit(loss)` raises `unhashable type`, because the
    loss is a module that holds the arrays of the plant. You can also apply `jax.jit` to
    a function that calls the loss.

    **Raises:** `ValueError` if `batch`, `horizon` or `truncate` is below 1,
    `environment` is not an environment, `checkpoint` is none of the values above,
    `gradient_decay` is not a finite number, or `ranges` are not valid.

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
    # The Python number 1 needs no code in the compiled program; an array does.
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

        # The score is the gradient of the log-probability with the drawn controls held
        # fixed. So we run the controller again on the recorded observations, controls
        # and costs without their gradients. Its memory may depend on the weights, and
        # keeps its gradient.
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
    r"""A loss for stochastic policies: the cost and log-probability of an episode.

    `loss(controller, key)` returns `(J, {"log_prob": L})`: the total cost $J$ of
    `delucax.rollout(environment, controller, key=key)`, and

    $$L(\theta) = \sum_k \log p_\theta(u_k \mid t_k, y_k, s_k)$$

    Here $s_k$ is the memory of the controller. The derivative of $L$ treats the
    observations and the drawn controls as constants.
    [`delucax.training.LikelihoodRatio`][] needs such a loss, and the other gradient
    estimators accept such a loss too.

    **Arguments:**

    - `environment`: the environment.
    - `horizon`: steps of the episode; the `horizon` of the environment by default.

    **Returns:** a function `loss(controller, key)` that returns a scalar and a
    dictionary. The controller must be a [`delucax.AbstractStochasticPolicy`][]. Compile
    the function with `eqx.filter_jit`, as in [`delucax.training.expected_cost`][].

    **Raises:** `ValueError` if `horizon` is below 1 or `environment` is not an
    environment. A `ValueError` is also raised when the loss is called, if the
    controller is not a stochastic policy.

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
        gradient.gain
        ```
    """
    where = "scored_cost"
    check_instance(environment, Environment, "environment", where)
    horizon = environment.horizon if horizon is None else horizon
    return _ScoredCost(environment, check_count(horizon, "horizon", where))


def nan_if_failed(trajectory: Trajectory, costs: Array) -> Array:
    """The costs of a rollout, or NaN if it failed, because they may look finite."""
    # A total cost that is not finite already shows the failure, so its costs stay.
    kept = ~trajectory.failed | ~jnp.isfinite(trajectory.total_cost)
    return jnp.where(kept, costs, jnp.nan)


class _Attack(NamedTuple):
    """The worst disturbances that `worst_case` found."""

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
    r"""The bounded disturbances that give a closed loop the highest cost, found by a
    local search.

    $$\max_{w} \; J(w) \quad \text{subject to} \quad \lVert w_k \rVert \le r
    \text{ for each } k$$

    $J$ is the total cost of the rollout. Each iteration maximises the linear model of
    the cost at the present disturbances, with $g_k = \partial J / \partial w_k$:

    $$w_k \leftarrow r\, \frac{g_k}{\lVert g_k \rVert}$$

    If the cost is convex in the disturbances, an iteration never lowers the cost. The
    cost is convex in the disturbances for a linear plant, a linear feedback and a
    convex stage cost. The search starts from several guesses of the disturbances at
    once. Every second guess is constant over time, and the other guesses are noise.
    `worst_case` returns the disturbances with the highest cost among all starts and
    iterations.

    **Arguments:**

    - `environment`: the environment. Its own disturbance is not used.
    - `controller`: the controller. If the controller adapts online, the gradient
        includes the effect of the disturbances on this adaptation.
    - `key`: a random key, for the starts of the search, the rollout and the controller.
    - `bound`: $r$, the bound on the Euclidean norm of each $w_k$, a positive number.
    - `x0`: the initial state, shape `(n,)`; drawn by the environment by default.
    - `horizon`: steps of the rollout; the `horizon` of the environment by default.
    - `iterations`: the number of iterations, 20 by default.
    - `starts`: the number of starts, 8 by default.

    **Returns:** a named tuple. `w`, shape `(horizon, k)`, holds the disturbances, which
    you can pass to `rollout(..., w=w)`. `total_cost` is the total cost under these
    disturbances; it is infinite if the state diverges. `costs`, shape
    `(iterations + 1,)`, holds the total cost at each iteration, for the guess that led
    to the highest cost.

    **Raises:** `ValueError` if an argument has the wrong type, shape or range, or the
    environment takes no disturbance.

    Source: Frank and Wolfe, 1956, applied to the maximum of a convex function.

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
        cost = rollout(environment, controller, w=w, **options).total_cost
        # A plant that runs away is the worst case, and NaN would lose all comparisons.
        return jnp.where(jnp.isnan(cost), jnp.inf, cost)

    def on_sphere(g, old):
        norm = safe_norm(g, keepdims=True)
        moved = (norm > 0) & jnp.isfinite(norm)
        return jnp.where(moved, bound * g / jnp.where(moved, norm, 1), old)

    # An iteration of Frank and Wolfe: the linear model of the cost is largest on the
    # spheres, in the direction of the gradient.
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
