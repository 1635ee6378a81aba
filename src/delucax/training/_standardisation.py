"""Running means and deviations, by which a model is standardised."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array

from .._module import parts_of
from ..controllers import Standardise
from ._actor_critic import ActorCritic
from ._actor_critic_loss import Episodes


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
