"""Proximal policy optimisation."""

from dataclasses import KW_ONLY
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array

from .._check import (
    check_at_most,
    check_count,
    check_instance,
    check_positive,
    check_range,
)
from .._controller import check_stochastic, initial_state, replay
from .._module import parameter
from .._typing import PRNGKey, RealScalar
from ..controllers import Gaussian
from ..environments import Environment
from ._actor_critic import AbstractActorCriticLoss, ActorCritic, Episodes, Statistics


class _Memory(NamedTuple):
    rows: Episodes
    """Whole episodes or single steps, arrays of shape `(rows, length, ...)`."""
    order: Array
    part: Array
    statistics: Statistics
    total_cost: Array


class PPO(AbstractActorCriticLoss):
    r"""Proximal policy optimisation (PPO), as a loss for [`delucax.training.fit`][].

    Every `epochs * minibatches` steps of `fit`, the policy runs `batch` new episodes.
    Each step takes the gradient of the following loss on the next minibatch of them:

    $$\operatorname{mean} \; \max\bigl(\rho A, \;
    \operatorname{clip}(\rho, 1 - \epsilon, 1 + \epsilon) A\bigr)
    + a\, \frac{(V - \hat V)^2}{b^2} - h\, H, \qquad
    \rho = \frac{p_\theta(u)}{p_{\theta_\text{old}}(u)}$$

    $\rho$ is the likelihood ratio of the controls. $A$ is the generalised advantage
    estimate of the cost, standardised over the batch. $V$ is the estimate of the
    critic, $\hat V$ its target and $b$ its `scale`. $H$ is the entropy of the policy.
    PPO does not differentiate the plant.

    Pass this loss to `fit` like any other loss, with any optimiser. The model is a
    [`delucax.training.ActorCritic`][] with a stochastic policy. The trained controller
    is `fitted.model.policy`. The same controller without random noise is
    `fitted.model.policy.base`.

    An episode that reaches the horizon is truncated, and the critic estimates the cost
    after the horizon. An episode that terminates has only the final cost after its last
    step. A policy with a memory is trained on whole episodes, with gradients through
    its memory. A policy without a memory is trained on single steps in random order.
    The scale of the critic and the statistics of each
    [`delucax.controllers.Standardise`][] in the model are computed from the previous
    batches. The scales stay fixed during a batch, so that $\rho$ starts at 1. An
    additional batch before the first step sets the first scales.

    In total, `fit` takes `batch * horizon * (1 + ceil(steps / (epochs * minibatches)))`
    steps of the environment. For example, 63 steps of `fit` with 4 epochs of 8
    minibatches run 3 batches. If an episode terminates before the horizon, this number
    also counts its remaining steps, in which the state is held. These remaining steps
    are computed, but have no effect on the loss.

    Metrics: `total_cost` of the last batch, `entropy`, `kl`, `clipped` (the fraction of
    ratios outside the clip range) and `value_loss`.

    **Arguments:**

    - `environment`: the environment.
    - `batch`: episodes in a batch.
    - `horizon`: steps per episode; the `horizon` of the environment by default.
    - `discount`: the discount factor of the cost to go, 0.99 by default.
    - `decay`: $\lambda$ of the advantage estimate, 0.95 by default.
    - `clip`: $\epsilon$, 0.2 by default.
    - `epochs`: the number of passes over each batch, 4 by default.
    - `minibatches`: minibatches in a pass, 8 by default. Rows that do not fill the last
        minibatch are skipped.
    - `value_weight`: $a$, 0.5 by default.
    - `entropy_weight`: $h$, 0 by default.
    - `bootstrap`: whether the critic estimates the cost after the horizon; true by
        default. If false, an episode that reaches the horizon terminates there, with
        the final cost.

    **Raises:** `ValueError` if an argument has the wrong type or range. A `ValueError`
    is also raised in training, if the model is not an `ActorCritic`, its policy is not
    stochastic, or a Gaussian policy has no bounds although the environment has bounds.

    Source: Schulman, Wolski, Dhariwal, Radford and Klimov, 2017; Schulman, Moritz,
    Levine, Jordan and Abbeel, 2016 (the advantage estimate); Pardo, Tavakoli, Levdik
    and Kormushev, 2018 (time limits).

    !!! example

        ```python
        import delucax as dlx
        import jax
        import optax

        env = dlx.make("pendulum")
        model = dlx.training.actor_critic(env, width=8, depth=1, key=jax.random.key(0))
        ppo = dlx.training.PPO(env, batch=4, horizon=10, epochs=2, minibatches=2)
        optimiser = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(3e-4))
        key = jax.random.key(1)
        fitted = dlx.training.fit(ppo, model, optimiser, steps=8, key=key)
        fitted.model.policy.base, fitted.history["total_cost"]
        ```
    """

    environment: Environment
    batch: int = eqx.field(static=True)
    horizon: int = eqx.field(static=True, default=None)
    _: KW_ONLY
    discount: RealScalar = parameter(0.99)
    decay: RealScalar = parameter(0.95)
    clip: RealScalar = parameter(0.2)
    epochs: int = eqx.field(static=True, default=4)
    minibatches: int = eqx.field(static=True, default=8)
    value_weight: RealScalar = parameter(0.5)
    entropy_weight: RealScalar = parameter(0.0)
    bootstrap: bool = eqx.field(static=True, default=True)

    def __check_init__(self):
        check_positive(self.clip, "clip", "PPO")
        check_count(self.epochs, "epochs", "PPO")
        check_count(self.minibatches, "minibatches", "PPO")
        check_range(self.entropy_weight, "entropy_weight", "PPO")

    def init(self, model: ActorCritic, key: PRNGKey) -> _Memory:
        check_instance(model, ActorCritic, "model", "PPO")
        policy = check_stochastic(model.policy, "policy", "PPO")
        unbounded = isinstance(policy, Gaussian) and policy.bounds is None
        if unbounded and self.environment.control_bounds is not None:
            raise ValueError(
                "PPO: the policy must have the bounds of the environment, got none. "
                "Without them, the log-probability is not that of the control that is "
                "applied. Pass Gaussian(..., bounds=env.control_bounds)."
            )
        rows, total_cost = self._rows(model, key)
        count = rows.times.shape[0]
        check_at_most(self.minibatches, count, "minibatches", "PPO", "rows of a batch")
        statistics = Statistics.empty(model, rows.costs.dtype).updated(model, rows)
        zero = jnp.zeros((), int)
        return _Memory(rows, jnp.arange(count), zero, statistics, total_cost)

    def update(
        self, model: ActorCritic, memory: _Memory, step: Array, key: PRNGKey
    ) -> _Memory:
        run_key, order_key = jr.split(key)
        part = (step % (self.epochs * self.minibatches)).astype(memory.part.dtype)

        def fresh():
            standardised = memory.statistics.applied_to(model)
            rows, total_cost = self._rows(standardised, run_key)
            return memory._replace(rows=rows, total_cost=total_cost)

        # The statistics of a batch are used from the next batch on. The memory already
        # has those of the batch that `init` ran.
        again = (part == 0) & (step > 0)
        old = memory.statistics
        updated = lambda: old.updated(model, memory.rows)
        memory = memory._replace(statistics=lax.cond(again, updated, lambda: old))
        memory = lax.cond(part == 0, fresh, lambda: memory)
        shuffled = lambda: jr.permutation(order_key, memory.order)
        is_pass = part % self.minibatches == 0
        order = lax.cond(is_pass, shuffled, lambda: memory.order)
        return memory._replace(order=order, part=part)

    def __call__(
        self, model: ActorCritic, memory: _Memory, key: PRNGKey
    ) -> tuple[Array, dict[str, Array]]:
        model = memory.statistics.applied_to(model)
        size = memory.order.shape[0] // self.minibatches
        start = memory.part % self.minibatches * size
        chosen = lax.dynamic_slice(memory.order, (start,), (size,))
        rows = jax.tree.map(lambda leaf: leaf[chosen], memory.rows)
        log_prob, entropy = _scores(model.policy, rows)
        weights = rows.valid / jnp.maximum(jnp.sum(rows.valid), 1)
        mean = lambda values: jnp.sum(jnp.where(rows.valid, values, 0) * weights)
        # The log of the ratio, but 0 for steps after the end, whose exponential could
        # overflow: then a weight of zero still gives NaN in the gradient.
        change = jnp.where(rows.valid, log_prob - rows.log_prob, 0)
        ratio, advantages = jnp.exp(change), rows.advantages
        if entropy is None:
            # One sample estimates E[-log p(u)]. The weight makes its gradient right,
            # although the controls were drawn from the old policy.
            entropy = -ratio * log_prob
        clipped = jnp.clip(ratio, 1 - self.clip, 1 + self.clip)
        # The larger of the two, because these are costs. This is a pessimistic bound:
        # its gradient is zero once the ratio left the clip range towards a lower cost.
        surrogate = mean(jnp.maximum(ratio * advantages, clipped * advantages))
        value_loss = mean(self._value_errors(model, rows) ** 2)
        bonus = mean(entropy)
        loss = surrogate + self.value_weight * value_loss - self.entropy_weight * bonus
        metrics = {
            "total_cost": memory.total_cost,
            "entropy": bonus,
            # The mean of r - 1 - log r estimates the divergence from the old policy.
            # No sample is negative (Schulman, 2020).
            "kl": mean(ratio - 1 - change),
            "clipped": mean((jnp.abs(ratio - 1) > self.clip).astype(ratio.dtype)),
            "value_loss": value_loss,
        }
        return loss.astype(rows.costs.dtype), lax.stop_gradient(metrics)

    def _rows(self, model: ActorCritic, key: PRNGKey) -> tuple[Episodes, Array]:
        """The rows of a new batch of episodes, and their mean total cost."""
        runs = self._episodes(model, key)
        policy: Any = model.policy
        log_prob, _ = _scores(policy, runs)
        count = jnp.maximum(jnp.sum(runs.valid), 1)
        mean = jnp.sum(jnp.where(runs.valid, runs.advantages, 0)) / count
        squares = jnp.where(runs.valid, (runs.advantages - mean) ** 2, 0)
        deviation = jnp.sqrt(jnp.sum(squares) / count)
        # Unit variance makes the step independent of the scale of the cost. The 1e-8
        # is for batches without variance.
        rows = runs._replace(
            advantages=(runs.advantages - mean) / (deviation + 1e-8),
            log_prob=log_prob,
            continues=None,
            following=None,
            total_cost=None,
        )
        # For a policy without a memory each step is a row: (batch * horizon, 1, ...).
        if not policy.has_memory:
            rows = jax.tree.map(lambda leaf: leaf.reshape(-1, 1, *leaf.shape[2:]), rows)
        return jax.tree.map(lax.stop_gradient, rows), jnp.mean(runs.total_cost)


def _scores(policy: Any, rows: Episodes) -> tuple[Array, Array | None]:
    """The log-probability and the entropy at each step of each row; `None` for the
    entropy if the policy has no formula for it."""

    def score(t, y, state, u):
        return policy.log_prob(t, y, state, u), policy.entropy(t, y, state)

    def act(t, y, state, u):
        return score(t, y, state, u), policy(t, y, state)[1]

    # The key does not matter, because the controls are given.
    state = initial_state(policy, jr.key(0))

    def of_row(*record):
        if policy.has_memory:
            return replay(policy, state, record, act)
        return jax.vmap(lambda t, y, u: score(t, y, state, u))(*record[:3])

    return jax.vmap(of_row)(rows.times, rows.observations, rows.controls, rows.costs)
