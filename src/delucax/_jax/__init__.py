"""Speed on CPU and special derivatives, by transformations of jaxprs and custom
primitives."""

from .._host import (
    compiled_unless_on_host as compiled_unless_on_host,
    custom_jvp as custom_jvp,
    entry as entry,
    fori_loop as fori_loop,
    host_unless_traced as host_unless_traced,
    if_true as if_true,
    lax as lax,
    numbers as numbers,
    on_host as on_host,
    scan as scan,
    stop_gradient as stop_gradient,
    vmap as vmap,
    while_loop as while_loop,
    xp as xp,
)
from ._batches import (
    by_lanes as by_lanes,
    fence as fence,
    hoisted as hoisted,
    matmul as matmul,
)
from ._compilation import quickly_compiled as quickly_compiled
from ._components import (
    by_components as by_components,
    COMPONENTS_UP_TO as COMPONENTS_UP_TO,
    join_state as join_state,
    split_state as split_state,
    stack_steps as stack_steps,
    with_stores as with_stores,
)
from ._derivatives import (
    deferred as deferred,
    first_possible as first_possible,
    is_constant as is_constant,
    jacobian as jacobian,
    nan_tangent as nan_tangent,
    operations as operations,
    value_and_jacobians as value_and_jacobians,
    without_tangents as without_tangents,
)
from ._loops import bounded_while as bounded_while, in_parts as in_parts
from ._normal import normal as normal
