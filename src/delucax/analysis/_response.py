"""What a linear model makes of sinusoids and of constants."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Complex, Float

from .._check import is_concrete
from .._module import as_float_array
from .._results import raise_if
from .._typing import BoolScalar
from ..math._linear_solve import lu_solve
from ._state_space import LinearModel, state_space, StateSpace


def frequency_response(
    model: LinearModel, omega: ArrayLike, *, inputs: str = "controls"
) -> Complex[Array, "*frequencies p m"]:
    """The complex gain `C (s I - A)^-1 B` from inputs to outputs,

    at `s = j omega`, or in discrete time at `exp(j omega dt)`.

    Differentiable with respect to the model and to `omega`. At a frequency where a pole
    is on the boundary of stability it is infinite.

    **Arguments:**

    - `model`: a [`delucax.systems.LinearSystem`][], or time-invariant
        [`delucax.LinearDynamics`][].
    - `omega`: angular frequencies, in radians per unit of time, any shape.
    - `inputs`: `"controls"` (default), or `"disturbances"`: `E` in the place of `B`.

    **Returns:** the shape of `omega` and then `(p, m)`, complex.

    **Raises:** `ValueError` if `model` is not linear or is time-varying, if `omega` is
    not finite, or `inputs` is unknown.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        upright = dlx.linearize(dlx.systems.Pendulum())
        gains = dlx.analysis.frequency_response(upright, jnp.logspace(-1, 2, 50))
        decibels = 20 * jnp.log10(jnp.abs(gains[:, 0, 0]))
        ```
    """
    where = "frequency_response"
    system = state_space(model, inputs, where)
    array = as_float_array(omega)
    real = eqx.is_inexact_array(array) and not jnp.iscomplexobj(array)
    if not real or is_concrete(array) and not bool(jnp.all(jnp.isfinite(array))):
        raise ValueError(f"{where}: omega must be real and finite, got {array}.")
    return _responses(system, array)


@eqx.filter_jit
def _responses(
    system: StateSpace, omega: Float[Array, "*frequencies"]
) -> Complex[Array, "*frequencies p m"]:
    gains = jax.vmap(system.response)(omega.astype(system.A.dtype).reshape(-1))
    gains = jnp.where(jnp.isfinite(gains), gains, jnp.inf)
    return gains.reshape(*omega.shape, *gains.shape[1:])


def dcgain(
    model: LinearModel, *, inputs: str = "controls", throw: bool = True
) -> Float[Array, "p m"]:
    """What constant inputs make of the outputs in the end,

    `-C A^-1 B`, or in discrete time `C (I - A)^-1 B`.

    **Arguments:**

    - `model`: a [`delucax.systems.LinearSystem`][], or time-invariant
        [`delucax.LinearDynamics`][]. It need not be stable.
    - `inputs`: `"controls"` (default), or `"disturbances"`: `E` in the place of `B`.
    - `throw`: raise if a pole at frequency zero, an integrator, leaves no such gain
        (default); if false, return infinity there.

    **Returns:** shape `(p, m)`.

    **Raises:** `ValueError` if `model` is not linear or is time-varying, or `inputs` is
    unknown; an error at run time as `throw` says.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[0.0, 1.0], [-2.0, -3.0]])
        B = jnp.array([[0.0], [1.0]])
        dlx.analysis.dcgain(dlx.systems.LinearSystem(A, B))  # 1/2 and 0
        ```
    """
    gain, has_integrator = _dcgain(state_space(model, inputs, "dcgain"))
    message = (
        "dcgain: a pole is at frequency zero (an integrator), so that constant inputs "
        "come to no constant outputs. Pass throw=False for infinity."
    )
    return raise_if(has_integrator, gain, message) if throw else gain


@eqx.filter_jit
def _dcgain(system: StateSpace) -> tuple[Float[Array, "p m"], BoolScalar]:
    matrix = system.eye - system.A if system.is_discrete else -system.A
    values = jnp.linalg.svd(jax.lax.stop_gradient(matrix), compute_uv=False)
    eps = jnp.finfo(values.dtype).eps
    singular = ~(values[-1] > len(values) * eps * values[0])
    invertible = jnp.where(singular, system.eye, matrix)
    gain = system.C @ lu_solve(invertible, system.B) + system.D
    return jnp.where(singular, jnp.inf, gain), singular
