"""The numbers of an environment, as gymnax's protocol passes them."""

from typing import Any

import equinox as eqx

from ..._check import check_instance
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
        check_instance(environment, Environment, "environment", "GymnaxParams")
        self.arrays, self.static = eqx.partition(environment, eqx.is_array)

    @property
    def environment(self) -> Environment:
        """The environment."""
        return eqx.combine(self.arrays, self.static)

    @property
    def max_steps_in_episode(self) -> int:
        """The horizon."""
        return self.environment.horizon
