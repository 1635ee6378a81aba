"""States under given controls."""

from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array

from .._check import as_rows, as_vector, check_instance
from .._jax import by_components, join_state, split_state, stack_steps
from .._module import as_float_array
from .._results import choose, first_failure, first_of, or_none, RESULTS
from .._typing import RealScalar
from ._base import AbstractDynamics


def open_loop(
    dynamics: AbstractDynamics,
    x0: Any,
    controls: Any,
    w: Any = None,
    t0: RealScalar = 0.0,
) -> Array:
    """The states that given controls lead to, for planning and identification.

    `x_{k+1} = F(t0 + k dt, x_k, u_k, w_k)`.

    **Arguments:**

    - `dynamics`: the discrete-time dynamics.
    - `x0`: the first state, shape `(n,)`.
    - `controls`: shape `(T, m)`.
    - `w`: disturbances, shape `(T, k)`; zero by default.
    - `t0`: the time of the first state, 0 by default.

    **Returns:** the states, shape `(T + 1, n)`. Already compiled; differentiable
    with respect to every array.

    **Raises:** `ValueError` on a wrong shape, and an error at run time if the solver
    fails or a state becomes NaN or infinite.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dynamics = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05)
        states = dlx.open_loop(dynamics, jnp.zeros(2), 0.1 * jnp.ones((20, 1)))
        ```
    """
    where = "open_loop"
    check_instance(dynamics, AbstractDynamics, "dynamics", where)
    x0 = as_vector(x0, dynamics.state_size, "x0", where)
    controls = as_rows(controls, dynamics.control_size, "controls", where)
    if w is not None:
        w = as_rows(w, dynamics.disturbance_size, "w", where, controls.shape[0])
    return _open_loop(dynamics, x0, controls, w, as_float_array(t0))


@eqx.filter_jit
def _open_loop(dynamics, x0, controls, w, t0):
    size = x0.shape[0]

    @jax.checkpoint
    @by_components
    def body(parts, inputs):
        k, u, w = inputs
        t = t0 + k * dynamics.dt
        x_next, result = dynamics.advance(t, join_state(parts, size), u, w)
        return split_state(x_next.astype(x0.dtype)), (parts, or_none(result))

    steps = jnp.arange(controls.shape[0])
    last, (parts, results) = lax.scan(body, split_state(x0), (steps, controls, w))
    states = stack_steps(parts, size, last)
    finite = jnp.all(jnp.isfinite(states[-1]))
    end = choose(finite, RESULTS.successful, RESULTS.diverged)
    result = first_failure(first_of(results), end)
    return result.error_if(states, result != RESULTS.successful)
