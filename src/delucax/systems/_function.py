"""A system from a plain function."""

from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY
from typing import Any

import equinox as eqx
from jaxtyping import Array

from .._module import function_field, names_of
from .._typing import Control, Disturbance, State, Time
from ._base import AbstractSystem


class FunctionSystem(AbstractSystem):
    """A system whose vector field is a function; made by [`delucax.system`][].

    **Arguments:**

    - `function`: `(t, x, u, w) -> dx/dt`; may itself be an `eqx.Module`, whose arrays
        are then leaves of the system.
    - `state_names`, `control_names`, `disturbance_names`: tuples of strings.

    !!! example

        ```python
        import delucax as dlx

        decay = dlx.system(lambda t, x, u, w: u - x, states=1, controls=1)
        ```
    """

    function: Callable[..., Array] = function_field()
    state_names: tuple[str, ...] = eqx.field(static=True)
    control_names: tuple[str, ...] = eqx.field(static=True)
    _: KW_ONLY
    disturbance_names: tuple[str, ...] = eqx.field(static=True, default=())

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> Any:
        return self.function(t, x, u, w)


def system(
    f: Callable[..., Array],
    *,
    states: int | Sequence[str],
    controls: int | Sequence[str],
    disturbances: int | Sequence[str] = (),
) -> FunctionSystem:
    """A system from a function `f(t, x, u, w) -> dx/dt`.

    **Arguments:**

    - `f`: the vector field. A function's own constants are fixed; pass an `eqx.Module`
        with a `__call__` to have them as differentiable leaves.
    - `states`, `controls`: their names, or how many there are.
    - `disturbances`: names or number of those that enter `f`; none by default, in which
        case `w` is added to the next state.

    **Returns:** a [`delucax.systems.FunctionSystem`][].

    **Raises:** `ValueError` if names are neither a number nor strings.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        def double_integrator(t, x, u, w):
            return jnp.stack([x[1], u[0]])

        car = dlx.system(double_integrator, states=("position", "speed"), controls=1)
        ```
    """
    if not callable(f):
        raise ValueError(f"system: f must be a function of (t, x, u, w), got {f!r}.")
    return FunctionSystem(
        f,
        names_of(states, "x", "states", "system"),
        names_of(controls, "u", "controls", "system"),
        disturbance_names=names_of(disturbances, "w", "disturbances", "system"),
    )
