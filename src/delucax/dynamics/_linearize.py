"""Linearisation, and operating points."""

from typing import Any, overload

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._check import as_vector, is_concrete
from .._integration import evaluate_field
from .._jax import jacobian, value_and_jacobians
from .._message import shortened
from .._results import Result, RESULTS
from .._typing import Control, RealScalar, State
from ..systems import AbstractSystem, LinearSystem
from ._base import AbstractDynamics
from ._linear import LinearDynamics


class OperatingPoint(eqx.Module):
    r"""An operating point: a state and a control at which a system or dynamics rest.

    [`delucax.trim`][] computes it. You can pass an operating point directly to
    [`delucax.linearize`][] or [`delucax.controllers.LQR`][]. Print it to see its
    numbers.

    **Attributes:**

    - `x`: the state, shape `(n,)`.
    - `u`: the control, shape `(m,)`.
    - `residual`: $f(t, x, u)$ of a system, or $F(t, x, u) - x$ of dynamics, shape
        `(n,)`; zero up to rounding if the result is a success.
    - `result`: one of `delucax.RESULTS`: success; `no_equilibrium` if the residual has
        a minimum that is not zero; `not_converged`; or `diverged`.

    !!! example

        ```python
        import delucax as dlx

        pendulum = dlx.systems.Pendulum()
        point = dlx.trim(pendulum, x=[0.3, 0.0], u=[1.0], fix="angle")
        point.u
        ```

        ```text
        Array([-1.478], dtype=float32)
        ```
    """

    x: Float[Array, " n"]
    u: Float[Array, " m"]
    residual: Float[Array, " r"]
    result: Result

    def __repr__(self):
        text = lambda array: str(array) if is_concrete(array) else shortened(array)
        shown = dict(x=self.x, u=self.u, residual=self.residual)
        rows = (f"    {name}={text(array)}," for name, array in shown.items())
        return "\n".join(["OperatingPoint(", *rows, f"    {self._outcome()},", ")"])

    def _outcome(self) -> str:
        good = self.result == RESULTS.successful
        if not is_concrete(good):
            return "result is traced"
        if jnp.ndim(good):
            return f"successful: {int(jnp.sum(good))} of {good.size}"
        return "successful" if good else RESULTS[self.result]


@overload
def linearize(
    model: AbstractSystem, t: RealScalar = ..., x: Any = ..., u: Any = ...
) -> LinearSystem: ...
@overload
def linearize(
    model: AbstractDynamics, t: RealScalar = ..., x: Any = ..., u: Any = ...
) -> LinearDynamics: ...
def linearize(
    model: Any, t: RealScalar = 0.0, x: Any = None, u: Any = None
) -> LinearSystem | LinearDynamics:
    r"""Linearise a system or dynamics about an operating point, by automatic
    differentiation.

    $$f(x, u) \approx f(x_\mathrm{ref}, u_\mathrm{ref})
    + A (x - x_\mathrm{ref}) + B (u - u_\mathrm{ref})$$

    The result keeps the operating point. A regulator designed for the linear model
    therefore acts on deviations from this point: `u = u_ref - K difference(x, x_ref)`.

    **Arguments:**

    - `model`: a [`delucax.AbstractDynamics`][] or [`delucax.AbstractSystem`][].
    - `t`: time, a scalar, 0 by default.
    - `x`, `u`: the state and control to linearise at, shapes `(n,)` and `(m,)`; by
        default the `equilibrium` of the model. You may pass the
        [`delucax.dynamics.OperatingPoint`][] that [`delucax.trim`][] computes as `x`:
        it holds both the state and the control. Any point works, but regulators such as
        [`delucax.controllers.LQR`][] need an equilibrium.

    **Returns:** for dynamics, [`delucax.LinearDynamics`][] with the same `dt`; for a
    system, a [`delucax.systems.LinearSystem`][]. The matrix `E` is the derivative with
    respect to the disturbance.

    **Raises:** `ValueError` on a wrong shape, or if no point is given and the model
    defines no equilibrium.

    !!! example

        ```python
        import delucax as dlx

        dynamics = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05)
        upright = dlx.linearize(dynamics)
        upright.A
        ```

        ```text
        Array([[1.019, 0.05 ],
               [0.755, 1.019]], dtype=float32)
        ```
    """
    hint = "for an environment, its `dynamics`"
    model, x, u = at_point(model, t, x, u, "linearize", hint)
    names = dict(state_names=model.state_names, control_names=model.control_names)
    C, value, (A, B, *E) = _first_order(model, jnp.asarray(t, x.dtype), x, u)
    E = E[0] if E else None
    # The value is kept, because it is not zero at a point that is no equilibrium.
    if isinstance(model, AbstractSystem):
        return LinearSystem(A, B, C, E, x_ref=x, u_ref=u, dx_ref=value, **names)
    return LinearDynamics(A, B, C, E, model.dt, x, u, value, **names)


@eqx.filter_jit
def _first_order(model: Any, t: Array, x: State, u: Control) -> Any:
    """The derivative of the sensor; the value of the field or the step; and its
    derivatives with respect to state, control and disturbance."""
    C = jacobian(lambda x: model.observe(t, x))(x)
    is_system = isinstance(model, AbstractSystem)

    def f(x, u, w=None):
        # Dynamics are called, because `advance` would not raise if the solver fails.
        return evaluate_field(model, t, x, u, w) if is_system else model(t, x, u, w)

    # Without disturbance names, or with a diffusion, w does not enter the field, and
    # there is no E.
    if is_system and model.noise is not None:
        return C, *value_and_jacobians(f, x, u, in_loop=True)
    w = jnp.zeros(model.disturbance_size, x.dtype)
    return C, *value_and_jacobians(f, x, u, w, in_loop=True)


def at_point(
    model: Any, t: RealScalar, x: Any, u: Any, where: str, hint: str
) -> tuple[Any, State, Control]:
    """`model` at time `t`, and the given state and control, or those of its
    equilibrium."""
    if not isinstance(model, AbstractSystem | AbstractDynamics):
        raise ValueError(
            f"{where}: model must be an AbstractSystem or AbstractDynamics ({hint}), "
            f"got {type(model).__name__}."
        )
    if isinstance(model, LinearDynamics):
        model = model.at(t)
    if isinstance(x, OperatingPoint):
        if u is not None:
            raise ValueError(
                f"{where}: u must be left out if x is an OperatingPoint, which has its "
                f"own control, got {shortened(u)}."
            )
        x, u = x.x, x.u
    if x is None or u is None:
        x_rest, u_rest = model.equilibrium()
        x = x_rest if x is None else x
        u = u_rest if u is None else u
    x = as_vector(x, model.state_size, "x (the state)", where)
    return model, x, as_vector(u, model.control_size, "u (the control)", where)
