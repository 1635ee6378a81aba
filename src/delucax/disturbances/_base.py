"""Sequences of disturbances, drawn for a whole horizon at once."""

import abc
from typing import Any, ClassVar, TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._check import check_count
from .._message import shortened
from .._module import as_float_array, check_parameters
from .._typing import PRNGKey


class AbstractDisturbance(eqx.Module):
    """A sequence `w[0], ..., w[T - 1]`, drawn at once for the whole horizon.

    Add two with `+`; confine one to a part of the time with
    [`delucax.disturbances.Window`][].

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        noise = dlx.disturbances.Gaussian(0.1, size=2)
        push = dlx.disturbances.Shock(jnp.array([0.0, 1.0]), start=2.0, duration=0.5)
        w = (noise + push).sequence(jax.random.key(0), 0.05 * jnp.arange(100))
        ```
    """

    if TYPE_CHECKING:  # a static checker would ask for abstract fields as arguments
        size: ClassVar[Any]
    else:
        size: eqx.AbstractVar[int]

    def __check_init__(self):
        check_parameters(self)

    @property
    def recorded_steps(self) -> int | None:
        """The most steps that `sequence` gives; `None` for any number.

        By default those of the shortest disturbance among its fields.
        """
        is_part = lambda node: (
            isinstance(node, AbstractDisturbance) and node is not self
        )
        nodes = jax.tree.leaves(self, is_leaf=is_part)
        steps = [node.recorded_steps for node in nodes if is_part(node)]
        return min((n for n in steps if n is not None), default=None)

    @abc.abstractmethod
    def sequence(self, key: PRNGKey | None, times: Array) -> Array:
        """The disturbances at `times`.

        **Arguments:**

        - `key`: a random key; those that draw nothing take `None` too.
        - `times`: the start of each step, shape `(T,)`, increasing. A rollout gives
            `0, dt, ...` in the precision of the state, so a time of `k dt` is rounded:
            compare it with another to the nearest step, not exactly.

        **Returns:** shape `(T, size)`.
        """

    def __add__(self, other: "AbstractDisturbance") -> "AbstractDisturbance":
        from ._compose import Sum

        if not isinstance(other, AbstractDisturbance):
            return NotImplemented
        return Sum(self, other)

    def __radd__(self, other: Any) -> "AbstractDisturbance":
        # The built-in `sum` starts at 0.
        return self if isinstance(other, int) and other == 0 else NotImplemented


def check_disturbance(value: Any, name: str, where: str) -> None:
    """Raise unless `value` is a disturbance."""
    if not isinstance(value, AbstractDisturbance):
        raise ValueError(
            f"{where}: {name} must be an AbstractDisturbance, got {shortened(value)}."
        )


def common_size(where: str, size: int | None, **values: Any) -> tuple[int, dict]:
    """The size that arrays share, and the arrays; numbers fit any size."""
    arrays = {name: as_float_array(value) for name, value in values.items()}
    for name, array in arrays.items():
        if not eqx.is_inexact_array(array) or array.ndim > 1:
            got = array.shape if eqx.is_array(array) else shortened(array)
            raise ValueError(
                f"{where}: {name} must be a number or a vector with an entry for each "
                f"disturbance, got {got}."
            )
        if array.ndim == 1:
            if size is not None and array.shape[0] != size:
                raise ValueError(
                    f"{where}: {name} has {array.shape[0]} entries where {size} are "
                    "expected."
                )
            size = array.shape[0]
    if size is None:
        raise ValueError(
            f"{where}: size must be given when every other argument is a number, such "
            f"as {where}(..., size=2)."
        )
    return check_count(size, "size", where), arrays


def times_to_draw(disturbance: AbstractDisturbance, times: Array, steps: int) -> Array:
    """The `times` to draw `steps` steps for: two at least, which tell Brownian motion
    the step between them, unless fewer are recorded.
    """
    recorded = disturbance.recorded_steps
    least = 2 if recorded is None else min(recorded, 2)
    return times[: max(steps, least)]


def check_common_size(disturbance: Any, *names: str) -> None:
    """Raise unless the named fields are numbers, or have `disturbance.size` entries."""
    values = {name: getattr(disturbance, name) for name in names}
    common_size(type(disturbance).__name__, disturbance.size, **values)


def spread(values: Array, steps: int, size: int) -> Array:
    """`values` as shape `(steps, size)`."""
    return jnp.broadcast_to(values, (steps, size))
