"""The small networks of learned lungs and of controllers."""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp

from .._module import as_module
from .._typing import PRNGKey


def tanh_network(
    inputs: int | Literal["scalar"],
    outputs: int | Literal["scalar"],
    width: int,
    depth: int,
    *,
    key: PRNGKey,
) -> eqx.nn.MLP:
    """A fully connected network whose hidden layers are tanh."""
    tanh, identity = as_module(jnp.tanh), as_module(jax.nn.identity)
    return eqx.nn.MLP(inputs, outputs, width, depth, tanh, identity, key=key)
