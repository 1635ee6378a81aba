"""From sampled linear dynamics back to the continuous system."""

from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._check import is_concrete
from ..math._linear_solve import full_precision, solve
from ..systems import LinearSystem
from ._linear import LinearDynamics


_MAX_ROOTS = 40
_MAX_ROOT_STEPS = 60
_CLOSE = 0.25
"""How far from the identity the quadrature is exact to rounding."""
_SQUARINGS = 12
_TERMS = 9
"""Of the exponential's series: exact to rounding for norms up to 300."""
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)


def d2c(dynamics: LinearDynamics, method: str = "zoh") -> LinearSystem:
    """The continuous linear system of which `dynamics` is the sampled form.

    The inverse of [`delucax.c2d`][]: `"zoh"`, exact for a control held over the step,
    by one matrix logarithm, `A = log(A_d) / dt`,
    `B = (integral over [0, dt] of exp(A s) ds)^-1 B_d`.
    `"tustin"`, `A = (2/dt) (A_d + I)^-1 (A_d - I)`, `B = (2/dt) (A_d + I)^-1 B_d`.

    Of all systems with these samples `"zoh"` takes the one whose frequencies are below
    `pi/dt`. Differentiable to any order, in either mode.

    **Arguments:**

    - `dynamics`: time-invariant linear dynamics.
    - `method`: `"zoh"` (default) or `"tustin"`.

    **Returns:** [`delucax.systems.LinearSystem`][] about the same operating point.

    **Raises:** `ValueError` if `dynamics` is not `LinearDynamics`, is time-varying, or
    `method` is unknown. If there is no such system, `RuntimeError` (an error at run
    time under `jax.jit`): `"zoh"` cannot have eigenvalues of `A_d` that are zero or
    negative, which no sampled real system has but in pairs, `"tustin"` none that is -1.

    Source: Cheng, Higham, Kenney and Laub, 2001 (the logarithm by square roots).

    !!! example

        ```python
        import delucax as dlx

        upright = dlx.linearize(dlx.make("pendulum").dynamics)
        dlx.d2c(upright).A
        ```
    """
    if not isinstance(dynamics, LinearDynamics):
        raise ValueError(
            "d2c: dynamics must be LinearDynamics (see `delucax.linearize`), got "
            f"{type(dynamics).__name__}."
        )
    if dynamics.is_time_varying:
        raise ValueError(
            "d2c: dynamics must be time-invariant, got matrices at "
            f"{dynamics.A.shape[0]} times; `dynamics.at(t)` are those at one time."
        )
    if method == "zoh":
        convert = _from_hold
        rule = (
            "A has an eigenvalue that is zero or negative (or next to it), so that no "
            "real system has these samples under a held control"
        )
        bad = lambda values: _on_negative_axis(values)
    elif method == "tustin":
        convert = _from_trapezium
        rule = "A has the eigenvalue -1, which the trapezoidal rule never gives"
        bad = lambda values: np.abs(values + 1)
    else:
        raise ValueError(f"d2c: method must be 'zoh' or 'tustin', got {method!r}.")
    columns = [dynamics.B, (dynamics.x_next - dynamics.x_ref)[:, None]]
    if dynamics.E is not None:
        columns.append(dynamics.E)
    stacked = jnp.concatenate(columns, axis=1)
    A, inputs, failed = convert(dynamics.A, stacked, dynamics.dt)
    if not is_concrete(failed):
        A = eqx.error_if(A, failed, f"d2c: {rule}.")
    elif failed:
        values = np.linalg.eigvals(np.asarray(dynamics.A, np.float64))
        worst = values[np.argmin(bad(values))]
        shown = worst.real if worst.imag == 0 else worst
        raise RuntimeError(f"d2c: {rule}; got {shown:.6g}.")
    m = dynamics.control_size
    B, drift, E = inputs[:, :m], inputs[:, m], inputs[:, m + 1 :]
    return LinearSystem(
        A,
        B,
        dynamics.C,
        None if dynamics.E is None else E,
        x_ref=dynamics.x_ref,
        u_ref=dynamics.u_ref,
        dx_ref=drift,
        state_names=dynamics.state_names,
        control_names=dynamics.control_names,
    )


def _on_negative_axis(values):
    """The distance of each eigenvalue from the half-line of negative numbers."""
    return np.where(values.real > 0, np.abs(values), np.abs(values.imag))


@eqx.filter_jit
@full_precision
def _from_hold(A: Array, inputs: Array, dt: Any) -> tuple[Array, Array, Array]:
    n = A.shape[0]
    logarithm, failed = _logarithm(A)
    # The integral of the exponential is one block of an exponential.
    eye, zero = jnp.eye(n, dtype=A.dtype), jnp.zeros_like(A)
    block = jnp.block([[logarithm, eye], [zero, zero]])
    held = _exponential_less_one(block)[:n, n:]
    return logarithm / dt, solve(held, inputs) / dt, failed


@eqx.filter_jit
@full_precision
def _from_trapezium(A: Array, inputs: Array, dt: Any) -> tuple[Array, Array, Array]:
    n = A.shape[0]
    eye = jnp.eye(n, dtype=A.dtype)
    sizes = jnp.linalg.svd(lax.stop_gradient(A + eye), compute_uv=False)
    failed = ~(sizes[-1] > n * jnp.finfo(A.dtype).eps * sizes[0])
    matrix = jnp.where(failed, eye, A + eye)
    solved = solve(matrix, jnp.concatenate([A - eye, inputs], axis=1)) * (2 / dt)
    return solved[:, :n], solved[:, n:], failed


def _logarithm(A: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Array]:
    """The principal logarithm, and whether there is none.

    It is differentiated as the inverse of the exponential that it is: the derivative of
    the exponential is linear, and the block logarithm below solves it.
    """
    still = lax.stop_gradient(A)
    n = A.shape[0]
    eye = jnp.eye(n, dtype=A.dtype)
    value, converged = _by_roots(still)
    back = jnp.linalg.norm(_exponential_less_one(value) + eye - still)
    close = back <= jnp.finfo(A.dtype).eps ** 0.5 * jnp.linalg.norm(still)
    failed = ~(converged & close)
    # The identity in the place of what failed, so that its derivatives are finite.
    still = jnp.where(failed, eye, still)
    value = jnp.where(failed, 0, value)
    return _with_derivative(jnp.where(failed, eye, A), still, value), failed


@jax.custom_jvp
def _with_derivative(A, still, value):
    """`value`, the logarithm of `A`, with the derivative that it has."""
    del A, still
    return value


@_with_derivative.defjvp
@full_precision
def _with_derivative_jvp(primals, tangents):
    A, still, value = primals
    logarithm = _with_derivative(A, still, value)

    def derivative(L, tangent):
        return jax.jvp(_exponential_less_one, (L,), (tangent,))[1]

    def inverse(M, right):
        """The tangent of the logarithm: a block of that of a block matrix."""
        n = M.shape[0]
        size = jnp.linalg.norm(right)
        size = jnp.where(size > 0, size, 1)
        block = jnp.block([[M, right / size], [jnp.zeros_like(M), M]])
        return _by_roots(block)[0][:n, n:] * size

    tangent = lax.custom_linear_solve(
        lambda tangent: derivative(logarithm, tangent),
        tangents[0],
        solve=lambda _, right: inverse(still, right),
        transpose_solve=lambda _, right: inverse(still.T, right),
    )
    return logarithm, tangent


def _exponential_less_one(L: Array) -> Array:
    """`exp(L) - I`, by a fixed number of squarings, whose derivatives stay small
    programs. `P` becomes `(I + P)^2 - I`: nothing is lost beside the identity."""
    X = L / 2**_SQUARINGS
    eye = jnp.eye(L.shape[0], dtype=L.dtype)
    P = X / _TERMS
    for k in range(_TERMS - 1, 0, -1):
        P = X @ (eye + P) / k
    return lax.fori_loop(0, _SQUARINGS, lambda _, P: 2 * P + P @ P, P)


def _by_roots(A: Array) -> tuple[Array, Array]:
    """The logarithm of a root near the identity, times the order of the root."""
    n = A.shape[0]
    eye = jnp.eye(n, dtype=A.dtype)

    def more(carry):
        root, k, converged = carry
        far = jnp.linalg.norm(root - eye) > _CLOSE
        return far & converged & (k < _MAX_ROOTS)

    def body(carry):
        root, k, _ = carry
        root, converged = _square_root(root)
        return root, k + 1, converged

    start = (A, jnp.asarray(0), jnp.asarray(True))
    root, k, converged = lax.while_loop(more, body, start)
    X = root - eye
    converged = converged & (jnp.linalg.norm(X) <= _CLOSE)
    X = jnp.where(converged, X, 0)

    # Gauss-Legendre for the integral over [0, 1] of X (I + x X)^-1.
    def add(total, rule):
        node, weight = rule
        return total + weight / 2 * solve(eye + (1 + node) / 2 * X, X), None

    rules = jnp.asarray(_NODES, A.dtype), jnp.asarray(_WEIGHTS, A.dtype)
    total, _ = lax.scan(add, jnp.zeros_like(A), rules)
    return total * 2.0**k, converged


def _square_root(A: Array) -> tuple[Array, Array]:
    """The principal square root, by the product form of Denman and Beavers' iteration.

    `M` goes to the identity and `Y` to the root. On the negative half-line there is
    none, and `M` goes nowhere.
    """
    n, eps = A.shape[0], jnp.finfo(A.dtype).eps
    eye = jnp.eye(n, dtype=A.dtype)
    small = 10 * n * eps

    def more(carry):
        _, _, error, before, k = carry
        # It converges quadratically: once close, what no longer shrinks is rounding.
        going = (error > small) & ((error < before / 2) | (before > 0.1))
        return going & jnp.isfinite(error) & (k < _MAX_ROOT_STEPS)

    def body(carry):
        M, Y, error, _, k = carry
        inverse = solve(M, eye)
        Y = (Y + Y @ inverse) / 2
        M = eye / 2 + (M + inverse) / 4
        return M, Y, jnp.linalg.norm(M - eye), error, k + 1

    far = jnp.asarray(jnp.inf, A.dtype)
    start = (A, A, jnp.asarray(jnp.finfo(A.dtype).max, A.dtype), far, jnp.asarray(0))
    _, root, error, *_ = lax.while_loop(more, body, start)
    # A NaN compares false, and is no root.
    return root, error < eps**0.5 * n
