"""What leans on the insides of JAX."""

from ._components import by_components as by_components, LARGEST as COMPONENTS_UP_TO
from ._fence import fence as fence
from ._jacobian import jacobian as jacobian
from ._lanes import by_lanes as by_lanes
from ._nan_tangent import poison as poison
from ._normal import normal as normal
from ._state_parts import (
    join_state as join_state,
    split_state as split_state,
    stack_steps as stack_steps,
)
