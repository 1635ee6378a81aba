"""What a learner's own control is a function of."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..._module import parameter
from ._loop import Loop, LoopState, shift


class Features(eqx.Module):
    """Filters of the last values of a signal, side by side in one vector.

    - `filters`: shape `(f, memory)`, newest first; `None` for the values themselves.
    - `memory`: how many values are kept.
    - `signal_size`: of one value.
    - `nature`: the signal is nature's output, that of the closed loop without what the
      learner adds; otherwise it is the last disturbance.
    """

    filters: Float[Array, "f memory"] | None = parameter()
    memory: int = eqx.field(static=True)
    signal_size: int = eqx.field(static=True)
    nature: bool = eqx.field(static=True)

    @property
    def size(self) -> int:
        """Of the vector."""
        count = self.memory if self.filters is None else self.filters.shape[0]
        return count * self.signal_size

    def init(self, dtype: Any) -> Array:
        """The signal before the first step."""
        return jnp.zeros((self.memory, self.signal_size), dtype)

    def observe(self, loop: Loop, state: LoopState, history: Array) -> Array:
        """The signal with its value at this step."""
        value = loop.nature(state) if self.nature else loop.disturbance(state)
        return shift(value, history)

    def __call__(self, history: Float[Array, "memory s"]) -> Float[Array, " size"]:
        if self.filters is None:
            return history.ravel()
        return (self.filters.astype(history.dtype) @ history).ravel()
