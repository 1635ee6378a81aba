"""The short-horizon actor-critic (SHAC)."""

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
    r"""The short-horizon actor-critic (SHAC), as a loss for [`delucax.training.fit`][].

    Each step of `fit` runs `batch` new episodes and cuts them into windows of $m$
    steps. The loss of the policy is the mean over windows of the cost in the window
    and the estimated cost to go at its end:

    $$\frac{1}{m\, b} \Bigl(\sum_{i=0}^{m-1} \gamma^i c_i + \gamma^m V(y_m)\Bigr)$$

    The gradient of this loss passes through the plant, the controls and $V$, but stops
    at the beginning of the window. So the gradient cannot grow over more steps than a
    window has. The cost after the window is estimated by $V$. The loss of the critic is
    the mean over all steps of $(V_\phi - \hat V)^2 / b^2$. Here $V_\phi$ is the critic,
    $b$ is its `scale`, and the target $\hat V$ is the TD($\lambda$) return. The loss of
    the policy and the targets use a target network as $V$. The weights $\phi'$ of the
    target network follow the weights $\phi$ of the critic at each step:
    $\phi' \leftarrow \phi' + r\, (\phi - \phi')$.

    Pass this loss to `fit` like any other loss. In each step, one gradient trains both
    the policy and the critic. The model is a [`delucax.training.ActorCritic`][], whose
    policy may be stochastic or not. The trained controller is `fitted.model.policy`.
    Each step of `fit` takes `batch * horizon` steps of the environment. Every
    `refresh`-th step of `fit` takes another `batch * horizon` steps of the environment.
    From these steps, `fit` computes the scale of the critic and the statistics of each
    [`delucax.controllers.Standardise`][] in the model. Metrics: `total_cost` and
    `value_loss`.

    The end of an episode and `bootstrap` are handled as in [`delucax.training.PPO`][].
    In the paper, each step of training uses the next window of episodes that an older
    policy began. Here, each step uses all windows of new, whole episodes. So time,
    disturbances and the memory of the policy are consistent within an episode.

    **Arguments:**

    - `environment`: the environment.
    - `batch`: episodes in a batch.
    - `horizon`: steps per episode; the `horizon` of the environment by default.
    - `window`: $m$, steps in a window, 16 by default. The last window of an episode may
        be shorter.
    - `discount`: $\gamma$, the discount factor of the cost to go, 0.99 by default.
    - `decay`: $\lambda$ of the TD($\lambda$) return, the target of the critic; 0.95 by
        default.
    - `rate`: $r$, the rate at which the target network follows the critic, 0.2 by
        default. With a rate of 1, the target network equals the critic.
    - `value_weight`: the weight of the critic's loss, 1 by default.
    - `refresh`: steps between two updates of the scales, 10 by default.
    - `bootstrap`: whether the critic estimates the cost after the horizon; true by
        default. If false, an episode that reaches the horizon terminates there, with
        the final cost.

    **Raises:** `ValueError` if an argument has the wrong type or range. A `ValueError`
    is also raised in training, if the model is not an `ActorCritic`.

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
        # Twice, because the targets depend on the scale of the critic.
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
        # The cost to go counts once in a window: at its last step, or where the episode
        # ends.
        bonus = jnp.where(ends | ~runs.continues, runs.following, 0)
        costs = jnp.where(runs.valid, runs.costs + self.discount * bonus, 0)
        # The gradient of the critic's loss must not move the targets.
        error = self._value_errors(model, lax.stop_gradient(runs))
        # Costs are discounted from the beginning of their window, so that late windows
        # count as much as early ones.
        actor = jnp.sum(self.discount**within * costs, axis=1)
        critic = jnp.sum(jnp.where(runs.valid, error**2, 0), axis=1)
        count = jnp.sum(runs.valid)
        value_loss = jnp.sum(critic) / count
        # Divided by the scale of the critic, so that one learning rate suits both
        # losses.
        actor = jnp.sum(actor) / (count * model.scale)
        metrics = {"total_cost": jnp.mean(runs.total_cost), "value_loss": value_loss}
        return actor + self.value_weight * value_loss, lax.stop_gradient(metrics)

    def _updated(self, old: Statistics, model: ActorCritic, key: PRNGKey) -> Statistics:
        return lax.stop_gradient(old.updated(model, self._episodes(model, key)))


def _with_target(model: ActorCritic, memory: _Memory) -> ActorCritic:
    """The model with the target network as its critic, the weights held fixed."""
    # The gradient of the policy still passes through V to the observation.
    target = eqx.combine(lax.stop_gradient(memory.critic), model.critic)
    model = eqx.tree_at(lambda m: m.critic, model, target)
    return memory.statistics.applied_to(model)
