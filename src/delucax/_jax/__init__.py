"""What leans on the insides of JAX, and on how it differentiates."""

from ._components import by_components as by_components, LARGEST as COMPONENTS_UP_TO
from ._derivatives import (
    first_possible as first_possible,
    is_constant as is_constant,
    jacobian as jacobian,
)
from ._fence import fence as fence
from ._lanes import by_lanes as by_lanes
from ._nan_tangent import nan_tangent as nan_tangent
from ._normal import normal as normal
from ._state_parts import (
    join_state as join_state,
    split_state as split_state,
    stack_steps as stack_steps,
)
