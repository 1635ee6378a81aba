"""Conversion of linear systems from continuous to discrete time and back."""

from typing import Any, TypeAlias

import equinox as eqx
import numpy as np
from jaxtyping import ArrayLike

from .._check import check_choice, check_instance, check_step, is_concrete
from .._check_models import check_time_invariant
from .._jax import compiled_unless_on_host, host_unless_traced, stop_gradient, xp
from .._results import raise_if
from .._typing import Array, BoolScalar, Matrix, Scalar, Vector
from ..math._balancing import balanced
from ..math._exponential import exponential_of_blocks
from ..math._linear_solve import full_precision, solve
from ..systems import LinearSystem
from ._linear import LinearDynamics
from ._matrix_logarithm import exponential_less_one, logarithm


_METHODS = "zoh", "tustin"


def c2d(system: LinearSystem, dt: ArrayLike, method: str = "zoh") -> LinearDynamics:
    r"""Convert a linear system from continuous to discrete time.

    `"zoh"` is exact for a control that is held over the step (zero-order hold). It
    takes one matrix exponential:

    $$A_d = e^{A \Delta t}, \qquad
    B_d = \int_0^{\Delta t} e^{A s}\, \mathrm{d}s\; B$$

    `"tustin"` is the trapezoidal rule, also with a held control:

    $$A_d = \left(I - \tfrac{\Delta t}{2} A\right)^{-1}
    \left(I + \tfrac{\Delta t}{2} A\right), \qquad
    B_d = \left(I - \tfrac{\Delta t}{2} A\right)^{-1} B\, \Delta t$$

    If a disturbance enters the vector field, it is also held over the step, like the
    control.

    **Arguments:**

    - `system`: a [`delucax.systems.LinearSystem`][]. [`delucax.linearize`][] makes one.
    - `dt`: the step $\Delta t$, in units of time, a positive number.
    - `method`: `"zoh"` (default) or `"tustin"`.

    **Returns:** [`delucax.LinearDynamics`][] about the same operating point.

    **Raises:** `ValueError` if `system` is not a `LinearSystem`, `dt` is not positive,
    or `method` is unknown. For `"tustin"`, `RuntimeError` (an error at run time under
    `jax.jit`) if $2 / \Delta t$ is an eigenvalue of $A$.

    Source: Van Loan, 1978 (`"zoh"`); Tustin, 1947.

    !!! example

        ```python
        import delucax as dlx

        upright = dlx.linearize(dlx.systems.Pendulum())
        dlx.c2d(upright, dt=0.05).A
        ```

        ```text
        Array([[1.019, 0.05 ],
               [0.755, 1.019]], dtype=float32)
        ```
    """
    check_instance(system, LinearSystem, "system", "c2d")
    check_step(dt, "c2d")
    check_choice(method, _METHODS, "method", "c2d")
    (A, B, E, x_next), failed = _sampled(system, dt, method)
    words = "c2d: A must not have the eigenvalue 2/dt, where Tustin's rule is singular."
    A = raise_if(failed, A, words)
    about = _operating_point(system)
    return LinearDynamics(A, B, system.C, E, dt, x_next=x_next, **about)


def d2c(dynamics: LinearDynamics, method: str = "zoh") -> LinearSystem:
    r"""Convert a linear system from discrete to continuous time: the inverse of
    [`delucax.c2d`][].

    `"zoh"` is exact for a control that is held over the step. It takes one matrix
    logarithm:

    $$A = \frac{\log A_d}{\Delta t}, \qquad
    B = \left(\int_0^{\Delta t} e^{A s}\, \mathrm{d}s\right)^{-1} B_d$$

    `"tustin"` inverts the trapezoidal rule:

    $$A = \tfrac{2}{\Delta t} (A_d + I)^{-1} (A_d - I), \qquad
    B = \tfrac{2}{\Delta t} (A_d + I)^{-1} B_d$$

    Several continuous-time systems can give the same discrete-time system. Of these,
    `"zoh"` returns the one whose frequencies are below $\pi / \Delta t$. The result is
    differentiable to any order, in forward and reverse mode.

    **Arguments:**

    - `dynamics`: time-invariant [`delucax.LinearDynamics`][].
    - `method`: `"zoh"` (default) or `"tustin"`.

    **Returns:** a [`delucax.systems.LinearSystem`][] about the same operating point.

    **Raises:** `ValueError` if `dynamics` is not `LinearDynamics` or is time-varying,
    or `method` is unknown. `RuntimeError` (an error at run time under `jax.jit`) if
    there is no continuous-time system with these samples. With `"zoh"`, this is so if
    $A_d$ has an eigenvalue that is zero or negative; with `"tustin"`, if $A_d$ has the
    eigenvalue -1.

    Source: Cheng, Higham, Kenney and Laub, 2001 (the logarithm by square roots).

    !!! example

        ```python
        import delucax as dlx

        upright = dlx.linearize(dlx.make("pendulum").dynamics)
        dlx.d2c(upright).A
        ```

        ```text
        Array([[ 0.373,  0.994],
               [14.907, -0.373]], dtype=float32)
        ```
    """
    hint = " (see `delucax.linearize`)"
    check_instance(dynamics, LinearDynamics, "dynamics", "d2c", hint)
    check_time_invariant(dynamics, "dynamics", "d2c")
    check_choice(method, _METHODS, "method", "d2c")
    (A, B, E, drift), failed = _held(dynamics, method)
    _, distance, rule = _INVERSES[method]
    # The message can name the eigenvalue only if the numbers are known.
    if not is_concrete(failed):
        A = eqx.error_if(A, failed, f"d2c: {rule}.")
    elif failed:
        values = np.linalg.eigvals(np.asarray(dynamics.A, np.float64))
        worst = values[np.argmin(distance(values))]
        shown = worst.real if worst.imag == 0 else worst
        raise RuntimeError(f"d2c: {rule}, got {shown:.6g}.")
    about = _operating_point(dynamics)
    return LinearSystem(A, B, dynamics.C, E, dx_ref=drift, **about)


def _inputs(model: LinearSystem | LinearDynamics, drift: Vector) -> Matrix:
    """The input matrices of the control, of a constant and of the disturbance, side by
    side."""
    columns = [model.B, drift[:, None], *([] if model.E is None else [model.E])]
    return xp.concatenate(columns, axis=1)


def _parts(
    inputs: Matrix, model: LinearSystem | LinearDynamics
) -> tuple[Matrix, Vector, Matrix | None]:
    """The inverse of `_inputs`."""
    m = model.control_size
    E = None if model.E is None else inputs[:, m + 1 :]
    return inputs[:, :m], inputs[:, m], E


def _operating_point(model: LinearSystem | LinearDynamics) -> dict[str, Any]:
    names = "x_ref", "u_ref", "state_names", "control_names"
    return {name: getattr(model, name) for name in names}


_Matrices: TypeAlias = tuple[Matrix, Matrix, Matrix | None, Vector]


@host_unless_traced
@compiled_unless_on_host
def _sampled(
    system: LinearSystem, dt: Any, method: str
) -> tuple[_Matrices, BoolScalar]:
    """The matrices of `c2d`, with the next state at the operating point, and whether
    the conversion failed."""
    n, inputs = system.state_size, _inputs(system, system.dx_ref)
    dt = xp.asarray(dt, inputs.dtype)
    # In units of the states that balance A. Otherwise a large entry of A hides others.
    A, unit = balanced(system.A)
    unit = unit[:, None]
    inputs = inputs / unit
    if method == "zoh":
        # exp([[A, B], [0, 0]] dt) holds exp(A dt) and the integral times B, however
        # singular A is.
        zero = xp.zeros((inputs.shape[1], inputs.shape[1]), inputs.dtype)
        A, inputs, _ = exponential_of_blocks(A * dt, inputs * dt, zero)
        failed = xp.asarray(False)
    else:
        # x_next - x = dt (A (x + x_next) / 2 + B u).
        half = A * (dt / 2)
        eye = xp.eye(n, dtype=half.dtype)
        right = xp.concatenate([eye + half, inputs * dt], axis=1)
        sampled, failed = _solved(eye - half, right)
        A, inputs = sampled[:, :n], sampled[:, n:]
    A, inputs = A * unit / unit.T, inputs * unit
    B, drift, E = _parts(inputs, system)
    return (A, B, E, system.x_ref + drift), failed


@host_unless_traced
@compiled_unless_on_host
@full_precision
def _held(dynamics: LinearDynamics, method: str) -> tuple[_Matrices, BoolScalar]:
    """The matrices of `d2c`, with the rate of change at the operating point, and
    whether the conversion failed."""
    # Control, constant and disturbance are converted together, as columns of one
    # matrix.
    inputs = _inputs(dynamics, dynamics.x_next - dynamics.x_ref)
    # In units of the states that balance A. Otherwise a large entry of A hides others.
    A, unit = balanced(dynamics.A)
    unit = unit[:, None]
    A, inputs, failed = _INVERSES[method][0](A, inputs / unit, dynamics.dt)
    A, inputs = A * unit / unit.T, inputs * unit
    B, drift, E = _parts(inputs, dynamics)
    return (A, B, E, drift), failed


def _from_hold(A: Array, inputs: Array, dt: Scalar) -> tuple[Array, Array, Array]:
    n = A.shape[0]
    log, failed = logarithm(A)
    # The integral of the exponential is a block of the exponential of this matrix.
    eye, zero = xp.eye(n, dtype=A.dtype), xp.zeros_like(A)
    block = xp.block([[log, eye], [zero, zero]])
    held = exponential_less_one(block)[:n, n:]
    return log / dt, solve(held, inputs) / dt, failed


def _solved(matrix: Array, right: Array) -> tuple[Array, BoolScalar]:
    """The solution, and whether the matrix is singular up to rounding."""
    n = matrix.shape[0]
    # By the least singular value, because the eigenvalues themselves are rounded.
    sizes = xp.linalg.svd(stop_gradient(matrix), compute_uv=False)
    singular = ~(sizes[-1] > n * xp.finfo(matrix.dtype).eps * sizes[0])
    eye = xp.eye(n, dtype=matrix.dtype)
    return solve(xp.where(singular, eye, matrix), right), singular


def _from_trapezium(A: Array, inputs: Array, dt: Scalar) -> tuple[Array, Array, Array]:
    n = A.shape[0]
    eye = xp.eye(n, dtype=A.dtype)
    right = xp.concatenate([A - eye, inputs], axis=1)
    solved, failed = _solved(A + eye, right)
    return solved[:, :n] * (2 / dt), solved[:, n:] * (2 / dt), failed


_INVERSES = {
    "zoh": (
        _from_hold,
        # The distance to the half-line of negative numbers.
        lambda z: np.where(z.real > 0, np.abs(z), np.abs(z.imag)),
        "A must not have an eigenvalue that is zero or negative (up to rounding), "
        "because no real system has these samples under a held control",
    ),
    "tustin": (
        _from_trapezium,
        lambda z: np.abs(z + 1),
        "A must not have the eigenvalue -1, which the trapezoidal rule never gives",
    ),
}
"""For each method: its inverse, the distance of an eigenvalue from those that it cannot
have, and the message about these."""
