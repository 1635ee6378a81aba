"""First-order models by automatic differentiation, and their sampled form."""

import functools
from typing import Any, overload

import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
import lineax as lx
from jaxtyping import Array

from .._check import as_vector, check_instance, check_step
from .._message import shortened
from .._typing import RealScalar
from ..systems import AbstractSystem, LinearSystem
from ._base import AbstractDynamics, zeros_if_none
from ._discretized import evaluate_field
from ._linear import LinearDynamics
from ._operating_point import OperatingPoint


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
    """The first-order model about an operating point, by automatic differentiation.

    The operating point is kept, so that a regulator designed on the result acts on
    deviations from it: `u = u_ref - K difference(x, x_ref)`.

    **Arguments:**

    - `model`: an [`delucax.AbstractDynamics`][] or [`delucax.AbstractSystem`][].
    - `t`: time, 0 by default.
    - `x`, `u`: the state and control to linearise at; by default the `equilibrium` that
        the model names. The [`delucax.dynamics.OperatingPoint`][] that
        [`delucax.trim`][] computes stands as `x` for both. Any point will do: it is the
        regulators which ask that the plant rests there, as
        [`delucax.controllers.LQR`][] says.

    **Returns:** [`delucax.LinearDynamics`][] of dynamics, with the same `dt`;
    [`delucax.systems.LinearSystem`][] of a system. `E` is the derivative with respect
    to the disturbance.

    **Raises:** `ValueError` on a wrong shape, or if no point is given and the model
    names none.

    !!! example

        ```python
        import delucax as dlx

        dynamics = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05)
        upright = dlx.linearize(dynamics)
        upright.A
        ```
    """
    if isinstance(model, LinearDynamics):
        model = model.at(t)
    is_system = isinstance(model, AbstractSystem)
    if not is_system and not isinstance(model, AbstractDynamics):
        raise ValueError(
            "linearize: model must be an AbstractSystem or AbstractDynamics (for an "
            f"environment, its `dynamics`), got {type(model).__name__}."
        )
    x, u = point_of(model, x, u, "linearize")
    t = jnp.asarray(t, x.dtype)
    C = _jacobian(lambda x: model.observe(t, x))(x)
    if is_system:
        w = jnp.zeros(model.disturbance_size, x.dtype)
        held = w if model.disturbance_names else None
        f = functools.partial(evaluate_field, model)
        A, B = _jacobian(f, (1, 2))(t, x, u, held)
        E = None
        if model.disturbance_names:
            E = _jacobian(f, 3)(t, x, u, w)
        return LinearSystem(
            A,
            B,
            C,
            E,
            x_ref=x,
            u_ref=u,
            dx_ref=f(t, x, u, held),
            state_names=model.state_names,
            control_names=model.control_names,
        )

    dynamics: Any = model

    def step(x, u, w):
        return dynamics(t, x, u, w)

    w = zeros_if_none(None, model.disturbance_size, x)
    A, B, E = _jacobian(step, (0, 1, 2))(x, u, w)
    return LinearDynamics(
        A,
        B,
        C,
        E,
        model.dt,
        x,
        u,
        step(x, u, w),
        state_names=model.state_names,
        control_names=model.control_names,
    )


def point_of(model: Any, x: Any, u: Any, where: str) -> tuple[Array, Array]:
    """The state and control that are given, or else those of the equilibrium."""
    if isinstance(x, OperatingPoint):
        if u is not None:
            raise ValueError(
                f"{where}: u must be left out where x is an OperatingPoint, which has "
                f"its own, got {shortened(u)}."
            )
        x, u = x.x, x.u
    if x is None or u is None:
        x_rest, u_rest = model.equilibrium()
        x = x_rest if x is None else x
        u = u_rest if u is None else u
    x = as_vector(x, model.state_size, "x (the state)", where)
    return x, as_vector(u, model.control_size, "u (the control)", where)


def c2d(system: LinearSystem, dt: Any, method: str = "zoh") -> LinearDynamics:
    """The sampled form of a continuous linear system.

    `"zoh"`, exact for a control held over the step, by one matrix exponential:
    `A_d = exp(A dt)`, `B_d = (integral over [0, dt] of exp(A s) ds) B`.
    `"tustin"`, the trapezoidal rule under a held control:
    `A_d = (I - A dt/2)^-1 (I + A dt/2)`, `B_d = (I - A dt/2)^-1 B dt`.

    **Arguments:**

    - `system`: the linear system (from [`delucax.linearize`][], for instance).
    - `dt`: the step, a positive number.
    - `method`: `"zoh"` (default) or `"tustin"`.

    **Returns:** [`delucax.LinearDynamics`][] about the same operating point. A
    disturbance that enters the vector field is held too.

    **Raises:** `ValueError` if `system` is not a `LinearSystem`, `dt` is not positive,
    or `method` is unknown.

    Source: Van Loan, 1978 (`"zoh"`); Tustin, 1947.

    !!! example

        ```python
        import delucax as dlx

        upright = dlx.linearize(dlx.systems.Pendulum())
        dlx.c2d(upright, dt=0.05).A
        ```
    """
    check_instance(system, LinearSystem, "system", "c2d")
    check_step(dt, "c2d")
    n = system.state_size
    inputs = [system.B, system.dx_ref[:, None]]
    if system.E is not None:
        inputs.append(system.E)
    stacked = jnp.concatenate(inputs, axis=1)
    if method == "zoh":
        k = stacked.shape[1]
        block = jnp.zeros((n + k, n + k), stacked.dtype)
        block = block.at[:n, :n].set(system.A).at[:n, n:].set(stacked)
        exponential = jsl.expm(block * dt)
        A, columns = exponential[:n, :n], exponential[:n, n:]
    elif method == "tustin":
        half = system.A * (dt / 2)
        eye = jnp.eye(n, dtype=half.dtype)
        right = jnp.concatenate([eye + half, stacked * dt], axis=1)
        solved = _solve(eye - half, right)
        A, columns = solved[:, :n], solved[:, n:]
    else:
        raise ValueError(f"c2d: method must be 'zoh' or 'tustin', got {method!r}.")
    m = system.control_size
    B, drift, E = columns[:, :m], columns[:, m], columns[:, m + 1 :]
    return LinearDynamics(
        A,
        B,
        system.C,
        None if system.E is None else E,
        dt,
        system.x_ref,
        system.u_ref,
        system.x_ref + drift,
        state_names=system.state_names,
        control_names=system.control_names,
    )


def _solve(matrix: Array, right: Array) -> Array:
    operator = lx.MatrixLinearOperator(matrix)
    solve = lambda b: lx.linear_solve(operator, b, lx.LU()).value  # noqa: E731
    return jax.vmap(solve, in_axes=1, out_axes=1)(right)


def _jacobian(f: Any, argnums: Any = 0) -> Any:
    """Forward mode; reverse where a solver inside has only that."""

    def jacobian(*args):
        try:
            return jax.jacfwd(f, argnums)(*args)
        except TypeError as error:
            if "forward-mode" not in str(error):
                raise
            return jax.jacrev(f, argnums)(*args)

    return jacobian
