"""The short-horizon actor-critic."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, PyTree

from .._check import check_bool, check_count, check_range
from .._module import as_float_array, parameter
from ..environments import Environment
from ._actor_critic import (
    advantages,
    as_seen,
    check_environment,
    check_model,
    episode,
    more_seen,
    nothing_seen,
    Seen,
)
from ._surrogate import AbstractSurrogate
from ._trainable import is_float


class _Memory(NamedTuple):
    critic: PyTree
    seen: Seen


class SHAC(AbstractSurrogate):
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

    It is trained as any loss is, one gradient a step for both; the model is a
    [`delucax.training.ActorCritic`][] with a policy that draws or not. The trained
    controller is `fitted.model.policy`. Each step of `fit` takes `batch * horizon`
    steps of the environment, and every `refresh`-th as many again, which set the scale
    of the critic and each [`delucax.controllers.Standardise`][] of the model. Metrics:
    `total_cost` and `value_loss`.

    Horizon, termination and `bootstrap` are as in [`delucax.training.PPO`][]. The
    windows are those of whole episodes of the present policy, rather than one window a
    step of episodes that an older one began: its clock, its disturbances and its memory
    are those of the environment.

    **Arguments:**

    - `environment`: the environment.
    - `batch`: episodes in a batch.
    - `horizon`: steps an episode; the environment's own by default.
    - `window`: steps of a window, 16 by default; the last of an episode may be shorter.
    - `discount`: of the cost to go, 0.99 by default.
    - `decay`: lambda of the target, 0.95 by default.
    - `rate`: at which the target network follows, 0.2 by default; 1 for none.
    - `value_weight`: 1 by default.
    - `refresh`: steps between what is seen anew, 10 by default.
    - `bootstrap`: whether the horizon is a cut (default); if false it is the end, and
        the final cost is charged there.

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
    horizon: int = eqx.field(static=True)
    window: int = eqx.field(static=True)
    discount: Array = parameter()
    decay: Array = parameter()
    rate: Array = parameter()
    value_weight: Array = parameter()
    refresh: int = eqx.field(static=True)
    bootstrap: bool = eqx.field(static=True)

    def __init__(
        self,
        environment: Environment,
        batch: int,
        horizon: int | None = None,
        *,
        window: int = 16,
        discount: Any = 0.99,
        decay: Any = 0.95,
        rate: Any = 0.2,
        value_weight: Any = 1.0,
        refresh: int = 10,
        bootstrap: bool = True,
    ):
        where = "SHAC"
        check_environment(environment, where)
        self.environment = environment
        self.batch = check_count(batch, "batch", where)
        horizon = environment.horizon if horizon is None else horizon
        self.horizon = check_count(horizon, "horizon", where)
        self.window = check_count(window, "window", where)
        self.discount, self.decay = as_float_array(discount), as_float_array(decay)
        self.rate = as_float_array(rate)
        self.value_weight = as_float_array(value_weight)
        self.refresh = check_count(refresh, "refresh", where)
        self.bootstrap = check_bool(bootstrap, "bootstrap", where)

    def __check_init__(self):
        where = "SHAC"
        check_environment(self.environment, where)
        for name in ("discount", "decay", "rate"):
            check_range(getattr(self, name), name, where, 0, 1)
        check_range(self.value_weight, "value_weight", where)

    def init(self, model, key):
        check_model(model, self.environment, "SHAC", drawn=False)
        like = jnp.zeros((), self.environment.dt.dtype)
        seen = nothing_seen(model, like)
        # Twice: what the targets are depends on the scale of the critic.
        for one in jr.split(key):
            seen = self._seen(as_seen(model, seen), nothing_seen(model, like), one)
        return _Memory(eqx.filter(model.critic, is_float), seen)

    def update(self, model, memory, step, key):
        new = eqx.filter(model.critic, is_float)
        critic = jax.tree.map(
            lambda old, new: (old + self.rate * (new - old)).astype(old.dtype),
            memory.critic,
            new,
        )
        again = (step > 0) & (step % self.refresh == 0)
        target = self._target(model, memory)
        seen = lax.cond(
            again, lambda: self._seen(target, memory.seen, key), lambda: memory.seen
        )
        return _Memory(lax.stop_gradient(critic), seen)

    def __call__(self, model, memory, key):
        model = as_seen(model, memory.seen)
        acting = self._target(model, memory)
        steps = jnp.arange(self.horizon)
        into = steps % self.window
        ends = (into == self.window - 1) | (steps == self.horizon - 1)

        def one(key):
            record, run = self._episode(acting, key, self.window)
            bonus = jnp.where(ends | ~record.going, record.following, 0)
            costs = jnp.where(record.valid, record.costs + self.discount * bonus, 0)
            actor = jnp.sum(self.discount**into * costs)
            gains = advantages(record, self.discount, self.decay)
            targets = lax.stop_gradient(gains + record.values)
            seen = lax.stop_gradient(record.observations)
            raw = jax.vmap(model.raw)(record.times, seen)
            error = raw - (targets - model.shift) / model.scale
            critic = jnp.sum(jnp.where(record.valid, error**2, 0))
            return actor, critic, jnp.sum(record.valid), run.total_cost

        keys = jr.split(key, self.batch)
        actor, critic, count, total_cost = jax.vmap(one)(keys)
        count = jnp.sum(count)
        value_loss = jnp.sum(critic) / count
        actor = jnp.sum(actor) / (count * model.scale)
        metrics = {"total_cost": jnp.mean(total_cost), "value_loss": value_loss}
        return actor + self.value_weight * value_loss, lax.stop_gradient(metrics)

    def finished(self, model, memory):
        return as_seen(model, memory.seen)

    def _target(self, model, memory):
        """The model with the target network for a critic, held fixed."""
        _, rest = eqx.partition(model.critic, is_float)
        held = eqx.combine(lax.stop_gradient(memory.critic), rest)
        return as_seen(eqx.tree_at(lambda m: m.critic, model, held), memory.seen)

    def _episode(self, model, key, window=None):
        options: Any = dict(horizon=self.horizon, bootstrap=self.bootstrap)
        return episode(self.environment, model, key, truncate=window, **options)

    def _seen(self, model, seen, key):
        def one(key):
            record, _ = self._episode(model, key)
            gains = advantages(record, self.discount, self.decay)
            return record.observations, gains + record.values, record.valid

        found = jax.vmap(one)(jr.split(key, self.batch))
        flat = (leaf.reshape(-1, *leaf.shape[2:]) for leaf in found)
        return lax.stop_gradient(more_seen(model, seen, *flat))
