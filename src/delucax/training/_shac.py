"""The short-horizon actor-critic."""

from dataclasses import KW_ONLY
from typing import NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, PyTree

from .._check import check_count, check_instance, check_range
from .._module import parameter
from .._typing import PRNGKey, RealScalar
from ..environments import Environment
from ._actor_critic import AbstractActorCriticLoss, ActorCritic, Statistics
from ._trainable import is_float


class _Memory(NamedTuple):
    critic: PyTree
    statistics: Statistics


class SHAC(AbstractActorCriticLoss):
    r"""The short-horizon actor-critic: the gradient through the plant over short
    windows, with a learned cost to go at the end of each.

    `batch` fresh episodes are cut into windows of `window` steps. The loss of the actor
    is the mean over windows of

    `(sum_i discount^i c_i + discount^window V(y_window)) / (window scale)`,

    differentiated through the plant, the controls and V, but not into the window
    before: the gradient cannot explode over more than a window, and what is cut off is
    estimated instead. The loss of the critic is the mean of `(V - target)^2 / scale^2`
    over all steps, with the target that of `TD(lambda)`. V in either is that of a
    target network, which follows the critic by `rate` at each step.

    It is trained as any loss is, one gradient per step for both; the model is a
    [`delucax.training.ActorCritic`][] with a policy that draws or not. The trained
    controller is `fitted.model.policy`. Each step of `fit` takes `batch * horizon`
    steps of the environment, and every `refresh`-th as many again, which set the scale
    of the critic and each [`delucax.controllers.Standardise`][] of the model. Metrics:
    `total_cost` and `value_loss`.

    Horizon, termination and `bootstrap` are as in [`delucax.training.PPO`][]. The
    windows are those of whole episodes of the present policy, and not one window per
    step of episodes that an older policy began, so that time, disturbances and the
    memory of the policy are consistent within an episode.

    **Arguments:**

    - `environment`: the environment.
    - `batch`: episodes in a batch.
    - `horizon`: steps per episode; the environment's own by default.
    - `window`: steps of a window, 16 by default; the last of an episode may be shorter.
    - `discount`: of the cost to go, 0.99 by default.
    - `decay`: lambda of the target, 0.95 by default.
    - `rate`: at which the target network follows, 0.2 by default; 1 for none.
    - `value_weight`: 1 by default.
    - `refresh`: steps between two batches that set the scales, 10 by default.
    - `bootstrap`: whether the horizon truncates (default); if false it terminates the
        episode, with the final cost.

    **Raises:** `ValueError` on an argument of the wrong kind or range; when it is
    trained, if the model is not an `ActorCritic`.

    Source: Xu, Makoviychuk, Narang, Ramos, Matusik, Garg and Macklin, 2022.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import optax

        env = dlx.make("pendulum")
        sizes = dict(width=8, depth=1, head="deterministic")
        model = dlx.training.actor_critic(env, **sizes, key=jax.random.key(0))
        shac = dlx.training.SHAC(env, batch=4, horizon=12, window=4)
        optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(2e-3))
        key = jax.random.key(1)
        fitted = dlx.training.fit(shac, model, optimiser, steps=5, key=key)
        fitted.model.policy, fitted.history["total_cost"]
        ```
    """

    environment: Environment
    batch: int = eqx.field(static=True)
    horizon: int = eqx.field(static=True, default=None)
    _: KW_ONLY
    window: int = eqx.field(static=True, default=16)
    discount: RealScalar = parameter(0.99)
    decay: RealScalar = parameter(0.95)
    rate: RealScalar = parameter(0.2)
    value_weight: RealScalar = parameter(1.0)
    refresh: int = eqx.field(static=True, default=10)
    bootstrap: bool = eqx.field(static=True, default=True)

    def __check_init__(self):
        check_count(self.window, "window", "SHAC")
        check_range(self.rate, "rate", "SHAC", 0, 1)
        check_count(self.refresh, "refresh", "SHAC")

    def init(self, model: ActorCritic, key: PRNGKey) -> _Memory:
        check_instance(model, ActorCritic, "model", "SHAC")
        statistics = none = Statistics.empty(model, self.environment.dt.dtype)
        # Twice: what the targets are depends on the scale of the critic.
        for one in jr.split(key):
            statistics = self._updated(none, statistics.applied_to(model), one)
        return _Memory(eqx.filter(model.critic, is_float), statistics)

    def update(
        self, model: ActorCritic, memory: _Memory, step: Array, key: PRNGKey
    ) -> _Memory:
        new = eqx.filter(model.critic, is_float)
        follow = lambda old, new: (old + self.rate * (new - old)).astype(old.dtype)
        critic = jax.tree.map(follow, memory.critic, new)
        again = (step > 0) & (step % self.refresh == 0)
        old, target = memory.statistics, _with_target(model, memory)
        updated = lambda: self._updated(old, target, key)
        statistics = lax.cond(again, updated, lambda: old)
        return _Memory(lax.stop_gradient(critic), statistics)

    def __call__(
        self, model: ActorCritic, memory: _Memory, key: PRNGKey
    ) -> tuple[Array, dict[str, Array]]:
        model = memory.statistics.applied_to(model)
        runs = self._episodes(_with_target(model, memory), key, truncate=self.window)
        steps = jnp.arange(self.horizon)
        within = steps % self.window
        ends = (within == self.window - 1) | (steps == self.horizon - 1)
        # What follows a window counts once, at its last step or at that of the episode.
        bonus = jnp.where(ends | ~runs.continues, runs.following, 0)
        costs = jnp.where(runs.valid, runs.costs + self.discount * bonus, 0)
        # The targets are data to the critic: it is not trained by moving them.
        error = self._value_errors(model, lax.stop_gradient(runs))
        # Over each episode first. Discounted from the beginning of the window, not of
        # the episode: late windows count as much as early ones.
        actor = jnp.sum(self.discount**within * costs, axis=1)
        critic = jnp.sum(jnp.where(runs.valid, error**2, 0), axis=1)
        count = jnp.sum(runs.valid)
        value_loss = jnp.sum(critic) / count
        # In the scale of the critic, so that one learning rate does for both.
        actor = jnp.sum(actor) / (count * model.scale)
        metrics = {"total_cost": jnp.mean(runs.total_cost), "value_loss": value_loss}
        return actor + self.value_weight * value_loss, lax.stop_gradient(metrics)

    def _updated(self, old: Statistics, model: ActorCritic, key: PRNGKey) -> Statistics:
        return lax.stop_gradient(old.updated(model, self._episodes(model, key)))


def _with_target(model: ActorCritic, memory: _Memory) -> ActorCritic:
    """The model with the target network for a critic, held fixed."""
    # The gradient of the actor goes through V by its observation, not into its weights.
    target = eqx.combine(lax.stop_gradient(memory.critic), model.critic)
    model = eqx.tree_at(lambda m: m.critic, model, target)
    return memory.statistics.applied_to(model)
