"""What the losses of an actor and a critic share: episodes, and their statistics."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, Bool, Float

from .._check import check_bool, check_count, check_instance, check_range
from .._module import parts_of
from .._typing import PRNGKey, RealScalar
from ..controllers import Standardise
from ..environments import Environment
from ..simulation import rollout
from ._actor_critic import ActorCritic
from ._costs import nan_if_failed
from ._loss import AbstractSurrogate


class Episodes(NamedTuple):
    """A batch of episodes; a field that a loss does not use is `None`."""

    times: Float[Array, "*batch steps"]
    observations: Float[Array, "*batch steps p"]
    controls: Float[Array, "*batch steps m"]
    costs: Float[Array, "*batch steps"]
    valid: Bool[Array, "*batch steps"]
    """Whether each step was before the end of its episode."""
    continues: Any
    """Whether something follows each step."""
    following: Any
    """The cost to go after each step: V there, or the final cost of its episode."""
    advantages: Float[Array, "*batch steps"]
    total_cost: Any
    targets: Float[Array, "*batch steps"]
    """What V should be at each observation."""
    log_prob: Any = None


class AbstractActorCriticLoss(AbstractSurrogate):
    """A loss of an [`delucax.training.ActorCritic`][] on fresh episodes."""

    environment: eqx.AbstractVar[Environment]
    batch: eqx.AbstractVar[int]
    horizon: eqx.AbstractVar[int]
    discount: eqx.AbstractVar[RealScalar]
    decay: eqx.AbstractVar[RealScalar]
    value_weight: eqx.AbstractVar[RealScalar]
    bootstrap: eqx.AbstractVar[bool]

    def __post_init__(self):
        if self.horizon is None and isinstance(self.environment, Environment):
            self.horizon = self.environment.horizon  # pyright: ignore

    def __check_init__(self):
        where = type(self).__name__
        check_instance(self.environment, Environment, "environment", where)
        check_count(self.batch, "batch", where)
        check_count(self.horizon, "horizon", where)
        check_range(self.discount, "discount", where, 0, 1)
        check_range(self.decay, "decay", where, 0, 1)
        check_range(self.value_weight, "value_weight", where)
        check_bool(self.bootstrap, "bootstrap", where)

    def finished(self, model: ActorCritic, memory: Any) -> ActorCritic:
        return memory.statistics.applied_to(model)

    def _episodes(
        self, model: ActorCritic, key: PRNGKey, truncate: int | None = None
    ) -> Episodes:
        """A batch of episodes from fresh starts.

        The gradient is cut before every `truncate`-th step.
        """
        one = lambda key: self._episode(model, key, truncate)
        return jax.vmap(one)(jr.split(key, self.batch))

    def _value_errors(
        self, model: ActorCritic, runs: Episodes
    ) -> Float[Array, "*batch steps"]:
        """How far the critic's output is from what it should be, in its own scale."""
        raw = jax.vmap(jax.vmap(model.raw))(runs.times, runs.observations)
        return raw - (runs.targets - model.shift) / model.scale

    def _episode(self, model, key, truncate) -> Episodes:
        env, horizon = self.environment, self.horizon
        keep = ("states", "observations", "controls", "costs", "terminated")
        options: Any = dict(horizon=horizon, truncate=truncate, keep=keep, throw=False)
        run: Any = rollout(env, model.policy, key=key, **options)
        costs = nan_if_failed(run, run.costs)
        # The observations recorded by a truncated rollout have lost their derivatives
        # at the cuts, where V is asked for. So the states are observed again, with the
        # noise that they had.
        observed = jax.vmap(env.dynamics.observe)(run.times, run.states)
        noise = lax.stop_gradient(run.observations - observed[:-1])
        observed = observed + jnp.concatenate([noise, jnp.zeros_like(noise[:1])])
        values = jax.vmap(model.value)(run.times, observed)
        following, values = values[1:], values[:-1]
        if not self.bootstrap:
            following = following.at[-1].set(run.final_cost)
        following = jnp.where(run.terminated, run.final_cost, following)
        steps = jnp.arange(horizon)
        continues = ~run.terminated & (self.bootstrap | (steps < horizon - 1))
        valid = steps < run.length
        errors = costs + self.discount * following - values
        errors = jnp.where(valid, errors, 0)
        advantages = _advantages(errors, continues, self.discount, self.decay)
        return Episodes(
            times=run.times[:-1],
            observations=run.observations,
            controls=run.controls,
            costs=costs,
            valid=valid,
            continues=continues,
            following=following,
            advantages=advantages,
            targets=advantages + values,
            total_cost=run.total_cost,
        )


def _advantages(
    errors: Float[Array, " steps"],
    continues: Bool[Array, " steps"],
    discount: RealScalar,
    decay: RealScalar,
) -> Float[Array, " steps"]:
    """The generalised advantage estimate of each step of one episode,

    `A_k = delta_k + g lambda A_{k+1}` with `delta_k = c_k + g V_{k+1} - V_k`, the
    temporal-difference errors.
    """

    def back(later, inputs):
        error, continues = inputs
        now = error + discount * decay * jnp.where(continues, later, 0)
        return now, now

    start = jnp.zeros((), errors.dtype)
    return lax.scan(back, start, (errors, continues), reverse=True)[1]


class Moments(NamedTuple):
    """The running mean and sum of squares of vectors."""

    count: Array
    mean: Array
    squares: Array

    @staticmethod
    def empty(like: Array) -> "Moments":
        """Of no vectors yet."""
        zero = jnp.zeros_like(like)
        return Moments(jnp.zeros((), like.dtype), zero, zero)

    def joined(self, values: Array, valid: Array) -> "Moments":
        """With more rows, of which some count."""
        known = valid.reshape(-1, *(1,) * (values.ndim - 1))
        n = jnp.sum(valid).astype(self.count.dtype)
        mean = jnp.sum(jnp.where(known, values, 0), 0) / jnp.maximum(n, 1)
        squares = jnp.sum(jnp.where(known, (values - mean) ** 2, 0), 0)
        total = jnp.maximum(self.count + n, 1)
        gap = mean - self.mean
        return Moments(
            self.count + n,
            self.mean + gap * n / total,
            self.squares + squares + gap**2 * self.count * n / total,
        )

    @property
    def std(self) -> Array:
        """The standard deviation, 1 where it is negligible."""
        variance = self.squares / jnp.maximum(self.count, 1)
        some = variance > 1e-8
        return jnp.where(some, jnp.sqrt(jnp.where(some, variance, 1)), 1)


class Statistics(NamedTuple):
    """The moments of the features of each `Standardise` of a model, and of targets."""

    features: list[Moments]
    targets: Moments

    @staticmethod
    def empty(model: ActorCritic, dtype: Any) -> "Statistics":
        """Of no observations yet."""
        features = [Moments.empty(one.mean) for one in parts_of(model, Standardise)]
        return Statistics(features, Moments.empty(jnp.zeros((), dtype)))

    def updated(self, model: ActorCritic, runs: Episodes) -> "Statistics":
        """With the valid ones of more observations and targets."""
        rows = runs.observations.reshape(-1, runs.observations.shape[-1])
        valid, targets = runs.valid.reshape(-1), runs.targets.reshape(-1)
        parts = zip(parts_of(model, Standardise), self.features, strict=True)
        features = [old.joined(jax.vmap(one.of)(rows), valid) for one, old in parts]
        return Statistics(features, self.targets.joined(targets, valid))

    def applied_to(self, model: ActorCritic) -> ActorCritic:
        """The model, standardised by these moments."""

        def places(model):
            parts = parts_of(model, Standardise)
            each = [leaf for part in parts for leaf in (part.mean, part.std)]
            return (*each, model.shift, model.scale)

        new = [v for m in (*self.features, self.targets) for v in (m.mean, m.std)]
        new = [n.astype(o.dtype) for n, o in zip(new, places(model), strict=True)]
        return eqx.tree_at(places, model, tuple(lax.stop_gradient(new)))
