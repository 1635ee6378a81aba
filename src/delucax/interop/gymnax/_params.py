"""The numbers and the state of an environment, as gymnax's protocol passes them."""

from typing import Any

import equinox as eqx
from jaxtyping import Array

from ...environments import Environment


class GymnaxParams(eqx.Module):
    """The numbers of an environment, as the `params` of gymnax's protocol.

    **Arguments:** `environment`: the environment.

    !!! example

        ```python
        import delucax as dlx
        from delucax.interop.gymnax import GymnaxParams, to_gymnax

        env = to_gymnax(dlx.make("pendulum"))
        longer = GymnaxParams(dlx.make("pendulum", length=1.2))
        env.action_space(longer)
        ```
    """

    arrays: Any
    static: Any = eqx.field(static=True)

    def __init__(self, environment: Environment):
        if not isinstance(environment, Environment):
            raise ValueError(
                "GymnaxParams: environment must be a delucax.Environment, got "
                f"{type(environment).__name__}."
            )
        self.arrays, self.static = eqx.partition(environment, eqx.is_array)

    @property
    def environment(self) -> Environment:
        """The environment."""
        return eqx.combine(self.arrays, self.static)

    @property
    def max_steps_in_episode(self) -> int:
        """The horizon."""
        return self.environment.horizon


class GymnaxState(eqx.Module):
    """The state of an episode.

    **Arguments:**

    - `state`: of the environment, shape `(state_size,)`.
    - `time`: steps since it began.
    - `keys`: what the disturbances and the noise of the episode are drawn with; none if
        nothing is drawn.

    !!! example

        ```python
        import jax.numpy as jnp
        from delucax.interop.gymnax import GymnaxState

        GymnaxState(jnp.array([0.5, 0.0]), jnp.asarray(0))
        ```
    """

    state: Array
    time: Array
    keys: Any = None
