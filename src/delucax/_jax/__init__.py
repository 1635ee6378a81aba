"""Performance on CPU and derivatives by JAX internals: jaxprs, custom primitives."""

from ._batches import by_lanes as by_lanes, fence as fence
from ._components import (
    by_components as by_components,
    COMPONENTS_UP_TO as COMPONENTS_UP_TO,
    join_state as join_state,
    split_state as split_state,
    stack_steps as stack_steps,
)
from ._derivatives import (
    first_possible as first_possible,
    is_constant as is_constant,
    jacobian as jacobian,
    nan_tangent as nan_tangent,
    value_and_jacobians as value_and_jacobians,
)
from ._host import (
    fori_loop as fori_loop,
    host_unless_traced as host_unless_traced,
    on_host as on_host,
    scan as scan,
    stop_gradient as stop_gradient,
    vmap as vmap,
    while_loop as while_loop,
    xp as xp,
)
from ._normal import normal as normal
