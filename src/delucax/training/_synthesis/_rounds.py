"""One round of training in the search of `synthesise`."""

from typing import Any

import jax.numpy as jnp
import optax

from ..._module import marked_leaves, path_string
from ...controllers import Residual
from ...environments import Environment
from .._costs import expected_cost
from .._evolve import evolve
from .._fit import fit
from .._gradient_estimators import ClippedSamples
from .._trainable import is_float
from ._episode_costs import TamedCost


# Steps of the gradient, and generations of evolution. A round may end after a block.
_STEPS, _GENERATIONS, _BLOCK = 300, 150, 5
_OPTIONS: Any = dict(block=_BLOCK, progress=False, throw=False)
# Gradients in a batch, and the longest rollout that is differentiated.
_BATCH, LONGEST = 32, 200
# Episodes in the cost of each model of a generation.
_EVALUATIONS = 8


def by_gradient(
    environment: Environment,
    ranges: dict[str, Any] | None,
    policy: Residual,
    time_constant: Any,
    rate: float,
    **options: Any,
) -> Residual:
    """The policy after training by the gradient, damped with a time constant."""
    adam = optax.adam(optax.cosine_decay_schedule(rate, _STEPS))
    optimiser = optax.chain(optax.clip_by_global_norm(1.0), adam)
    # An array, so that all time constants share one compiled program.
    decay = jnp.exp(-environment.dt / time_constant)
    shape: Any = dict(batch=1, horizon=min(environment.horizon, LONGEST))
    loss = expected_cost(environment, gradient_decay=decay, ranges=ranges, **shape)
    # The law stays. Of the correction the bounds and the scales of the features are
    # trained too, because with fixed ones fewer policies of quadrotors hold the plant.
    options |= _OPTIONS | dict(trainable="correction", gradient=ClippedSamples(_BATCH))
    return fit(loss, policy, optimiser, _STEPS, **options).model


def by_evolution(
    environment: Environment,
    ranges: dict[str, Any] | None,
    policy: Residual,
    sigma: float,
    usual: float,
    **options: Any,
) -> Residual:
    """The policy after training by evolution on the tamed cost."""
    episode = expected_cost(environment, batch=1, ranges=ranges)
    loss = TamedCost(episode, jnp.asarray(usual), _EVALUATIONS)
    # A standard deviation of 1 is far too much for bounds and scales.
    weights = [
        f"correction.{path_string(path)}"
        for path, leaf, role, _ in marked_leaves(policy.correction)
        if role == "weight" and is_float(leaf)
    ]
    options |= _OPTIONS | dict(sigma=sigma, trainable=weights)
    return evolve(loss, policy, _GENERATIONS, **options).model
