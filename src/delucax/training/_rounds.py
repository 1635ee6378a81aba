"""One round of training in the search of `synthesise`."""

from typing import Any

import jax.numpy as jnp
import optax

from .._controller import AbstractController
from ..environments import Environment
from ._costs import expected_cost
from ._episode_costs import TamedCost
from ._evolve import evolve
from ._fit import fit
from ._gradient_estimators import ClippedSamples


# Steps of the gradient, and generations of evolution. A round may end after a block.
_STEPS, _GENERATIONS, _BLOCK = 300, 150, 5
# The law stays. Of the correction the bounds and the scales of the features are trained
# too, because with fixed ones much fewer policies of quadrotors hold the plant.
_OPTIONS: Any = dict(block=_BLOCK, trainable="correction", progress=False, throw=False)
# Gradients in a batch, and the longest rollout that is differentiated.
_BATCH, LONGEST = 32, 200
# Episodes in the cost of each model of a generation.
_EVALUATIONS = 8


def by_gradient(
    environment: Environment,
    ranges: dict[str, Any] | None,
    policy: AbstractController,
    time_constant: Any,
    rate: float,
    **options: Any,
) -> AbstractController:
    """The policy after training by the gradient, damped with a time constant."""
    adam = optax.adam(optax.cosine_decay_schedule(rate, _STEPS))
    optimiser = optax.chain(optax.clip_by_global_norm(1.0), adam)
    # An array, so that all time constants share one compiled program.
    decay = jnp.exp(-environment.dt / time_constant)
    shape: Any = dict(batch=1, horizon=min(environment.horizon, LONGEST))
    loss = expected_cost(environment, gradient_decay=decay, ranges=ranges, **shape)
    options |= _OPTIONS | dict(gradient=ClippedSamples(_BATCH))
    return fit(loss, policy, optimiser, _STEPS, **options).model


def by_evolution(
    environment: Environment,
    ranges: dict[str, Any] | None,
    policy: AbstractController,
    sigma: float,
    usual: float,
    **options: Any,
) -> AbstractController:
    """The policy after training by evolution on the tamed cost."""
    episode = expected_cost(environment, batch=1, ranges=ranges)
    loss = TamedCost(episode, jnp.asarray(usual), _EVALUATIONS)
    options |= _OPTIONS | dict(sigma=sigma)
    return evolve(loss, policy, _GENERATIONS, **options).model
