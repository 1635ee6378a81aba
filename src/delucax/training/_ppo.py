"""Proximal policy optimisation."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array

from .._check import check_bool, check_count, check_positive, check_range
from .._module import as_float_array, parameter
from ..environments import Environment
from ..simulation._answer import begun
from ._actor_critic import (
    ActorCritic,
    advantages,
    as_seen,
    check_environment,
    check_model,
    episode,
    Episodes,
    more_seen,
    nothing_seen,
    Seen,
)
from ._surrogate import AbstractSurrogate


class _Rows(NamedTuple):
    """What is learned from: stretches of episodes, each `(rows, length, ...)`."""

    times: Array
    observations: Array
    controls: Array
    costs: Array
    valid: Array
    log_prob: Array
    advantages: Array
    targets: Array


class _Memory(NamedTuple):
    rows: _Rows
    order: Array
    part: Array
    seen: Seen
    total_cost: Array


class PPO(AbstractSurrogate):
    r"""Proximal policy optimisation: the clipped surrogate of the likelihood ratio.

    Every `epochs * minibatches` steps of [`delucax.training.fit`][] the policy runs
    `batch` fresh episodes. In between each step takes the next minibatch of

    `mean max(r A, clip(r, 1 - clip, 1 + clip) A)
    + value_weight (V - target)^2 / scale^2 - entropy_weight H`

    with `r = p(u; theta) / p(u; theta_old)` the likelihood ratio of what was drawn, `A`
    the generalised advantage estimate in cost (standardised over the batch),
    `target = A + V`, and H the entropy. The plant is not differentiated. It is trained
    as any loss is, with any optimiser; the model is a
    [`delucax.training.ActorCritic`][] whose policy draws, and the trained controller is
    `fitted.model.policy` (or `.policy.base`, without the noise).

    An episode that its horizon cuts off is no end: the estimated cost to go stands for
    what would follow. On termination nothing follows but the final cost. Each
    [`delucax.controllers.Standardise`][] of the model, and the scale of the critic, are
    set by what was seen before the batch, so that the ratio begins at 1; one batch is
    run before the first step for them. A policy with a memory is trained on whole
    episodes, through its memory; one without on single steps in random order.

    `steps` of `fit` thus take
    `batch * horizon * (1 + steps / (epochs * minibatches))` steps of the environment.
    Metrics: `total_cost`, of the last batch, `entropy`, `kl`, `clipped` (the share of
    ratios beyond the clip) and `value_loss`.

    **Arguments:**

    - `environment`: the environment.
    - `batch`: episodes in a batch.
    - `horizon`: steps an episode; the environment's own by default.
    - `discount`: of the cost to go, 0.99 by default.
    - `decay`: lambda of the advantage estimate, 0.95 by default.
    - `clip`: 0.2 by default.
    - `epochs`: passes over a batch, 4 by default.
    - `minibatches`: in one pass, 8 by default; what does not fill the last is left out.
    - `value_weight`: 0.5 by default.
    - `entropy_weight`: 0 by default.
    - `bootstrap`: whether the horizon is a cut (default); if false it is the end, and
        the final cost is charged there.

    **Raises:** `ValueError` on an argument of the wrong kind or range; when it is
    trained, if the model is not an `ActorCritic`, its policy does not draw, or a
    Gaussian policy lacks the bounds of the environment.

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
    horizon: int = eqx.field(static=True)
    discount: Array = parameter()
    decay: Array = parameter()
    clip: Array = parameter()
    epochs: int = eqx.field(static=True)
    minibatches: int = eqx.field(static=True)
    value_weight: Array = parameter()
    entropy_weight: Array = parameter()
    bootstrap: bool = eqx.field(static=True)

    def __init__(
        self,
        environment: Environment,
        batch: int,
        horizon: int | None = None,
        *,
        discount: Any = 0.99,
        decay: Any = 0.95,
        clip: Any = 0.2,
        epochs: int = 4,
        minibatches: int = 8,
        value_weight: Any = 0.5,
        entropy_weight: Any = 0.0,
        bootstrap: bool = True,
    ):
        where = "PPO"
        check_environment(environment, where)
        self.environment = environment
        self.batch = check_count(batch, "batch", where)
        horizon = environment.horizon if horizon is None else horizon
        self.horizon = check_count(horizon, "horizon", where)
        self.discount, self.decay = as_float_array(discount), as_float_array(decay)
        self.clip = as_float_array(clip)
        self.epochs = check_count(epochs, "epochs", where)
        self.minibatches = check_count(minibatches, "minibatches", where)
        self.value_weight = as_float_array(value_weight)
        self.entropy_weight = as_float_array(entropy_weight)
        self.bootstrap = check_bool(bootstrap, "bootstrap", where)

    def __check_init__(self):
        where = "PPO"
        check_environment(self.environment, where)
        check_range(self.discount, "discount", where, 0, 1)
        check_range(self.decay, "decay", where, 0, 1)
        check_positive(self.clip, "clip", where)
        check_range(self.value_weight, "value_weight", where)
        check_range(self.entropy_weight, "entropy_weight", where)

    def init(self, model, key):
        check_model(model, self.environment, "PPO", drawn=True)
        rows, total_cost = self._run(model, key)
        count = rows.times.shape[0]
        if count < self.minibatches:
            raise ValueError(
                f"PPO: minibatches must be at most the {count} rows of a batch, got "
                f"{self.minibatches}."
            )
        seen = more_seen(model, nothing_seen(model, rows.costs), *_flat(rows))
        order = jnp.arange(count)
        return _Memory(rows, order, jnp.zeros((), int), seen, total_cost)

    def update(self, model, memory, step, key):
        run_key, order_key = jr.split(key)
        part = (step % (self.epochs * self.minibatches)).astype(memory.part.dtype)

        def fresh():
            rows, total_cost = self._run(as_seen(model, memory.seen), run_key)
            return memory._replace(rows=rows, total_cost=total_cost)

        def learned():
            # What the last batch showed counts from the next one on.
            seen = more_seen(model, memory.seen, *_flat(memory.rows))
            return memory._replace(seen=seen)

        # The batch of `init` has been counted already.
        again = (part == 0) & (step > 0)
        memory = memory._replace(seen=lax.cond(again, learned, lambda: memory).seen)
        memory = lax.cond(part == 0, fresh, lambda: memory)
        order = lax.cond(
            part % self.minibatches == 0,
            lambda: jr.permutation(order_key, memory.order),
            lambda: memory.order,
        )
        return memory._replace(order=order, part=part)

    def __call__(self, model, memory, key):
        del key
        model = as_seen(model, memory.seen)
        size = memory.order.shape[0] // self.minibatches
        start = memory.part % self.minibatches * size
        chosen = lax.dynamic_slice(memory.order, (start,), (size,))
        rows = jax.tree.map(lambda leaf: leaf[chosen], memory.rows)
        log_prob, entropy = jax.vmap(lambda row: _scored(model.policy, row))(rows)
        raw = jax.vmap(jax.vmap(model.raw))(rows.times, rows.observations)
        weights = rows.valid / jnp.maximum(jnp.sum(rows.valid), 1)

        def mean(values):
            return jnp.sum(jnp.where(rows.valid, values, 0) * weights)

        change = jnp.where(rows.valid, log_prob - rows.log_prob, 0)
        ratio = jnp.exp(change)
        clipped = jnp.clip(ratio, 1 - self.clip, 1 + self.clip)
        surrogate = mean(
            jnp.maximum(ratio * rows.advantages, clipped * rows.advantages)
        )
        target = (rows.targets - model.shift) / model.scale
        value_loss = mean((raw - target) ** 2)
        bonus = mean(entropy)
        loss = surrogate + self.value_weight * value_loss - self.entropy_weight * bonus
        metrics = {
            "total_cost": memory.total_cost,
            "entropy": bonus,
            "kl": mean(ratio - 1 - change),
            "clipped": mean((jnp.abs(ratio - 1) > self.clip).astype(ratio.dtype)),
            "value_loss": value_loss,
        }
        return loss.astype(rows.costs.dtype), lax.stop_gradient(metrics)

    def finished(self, model, memory):
        return as_seen(model, memory.seen)

    def _run(self, model: ActorCritic, key) -> tuple[_Rows, Array]:
        """The rows of a fresh batch, and its mean cost."""

        def one(key):
            options: Any = dict(horizon=self.horizon, bootstrap=self.bootstrap)
            record, _ = episode(self.environment, model, key, **options)
            return record, advantages(record, self.discount, self.decay)

        records, gains = jax.vmap(one)(jr.split(key, self.batch))
        rows = jax.vmap(lambda *row: _row(model.policy, *row))(records, gains)
        known = jnp.maximum(jnp.sum(rows.valid), 1)
        mean = jnp.sum(jnp.where(rows.valid, gains, 0)) / known
        spread = jnp.sum(jnp.where(rows.valid, (gains - mean) ** 2, 0)) / known
        rows = rows._replace(advantages=(gains - mean) / (jnp.sqrt(spread) + 1e-8))
        if _is_plain(model.policy):
            rows = jax.tree.map(lambda leaf: leaf.reshape(-1, 1, *leaf.shape[2:]), rows)
        return jax.tree.map(lax.stop_gradient, rows), jnp.mean(records.total_cost)


def _row(policy, record: Episodes, gain) -> _Rows:
    row = _Rows(
        times=record.times,
        observations=record.observations,
        controls=record.controls,
        costs=record.costs,
        valid=record.valid,
        log_prob=record.costs,
        advantages=gain,
        targets=gain + record.values,
    )
    return row._replace(log_prob=_scored(policy, row)[0])


def _flat(rows: _Rows):
    """Observations, targets and whether they count, a row a step."""
    return tuple(
        leaf.reshape(-1, *leaf.shape[2:])
        for leaf in (rows.observations, rows.targets, rows.valid)
    )


def _is_plain(policy) -> bool:
    """Whether a policy has no memory but the key that it draws with."""
    state = jax.eval_shape(lambda: eqx.filter(_start(policy), eqx.is_array))
    return not jax.tree.leaves(getattr(state, "base", state))


def _start(policy):
    return begun(policy, jr.key(0))


def _scored(policy, row: _Rows) -> tuple[Array, Array]:
    """The log-probability and entropy at each step of a stretch from the beginning."""

    def at(t, y, u, state):
        score = policy.log_prob(t, y, state, u)
        if hasattr(policy, "entropy"):
            return score, policy.entropy(t, y, state)
        return score, -score

    first = _start(policy)
    inputs = (row.times, row.observations, row.controls)
    if _is_plain(policy):
        return jax.vmap(lambda t, y, u: at(t, y, u, first))(*inputs)
    first, static = eqx.partition(first, eqx.is_array)

    def step(memory, inputs):
        *now, cost = inputs
        t, y, u = now
        state = eqx.combine(memory, static)
        found = at(t, y, u, state)
        _, after = policy(t, y, state)
        after = policy.applied(u, cost, after)
        return eqx.filter(after, eqx.is_array), found

    return lax.scan(step, first, (*inputs, row.costs))[1]
