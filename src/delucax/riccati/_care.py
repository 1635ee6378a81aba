"""The continuous-time algebraic Riccati equation."""

from typing import Any

from ._arguments import riccati_arguments
from ._solution import checked, RiccatiSolution
from ._stabilising import stabilising_solution


def care(
    A: Any,
    B: Any,
    Q: Any,
    R: Any,
    S: Any = None,
    E: Any = None,
    *,
    throw: bool = True,
) -> RiccatiSolution:
    r"""The stabilising solution of the continuous-time algebraic Riccati equation,

    `A'XE + E'XA - (E'XB + S) R^-1 (B'XE + S') + Q = 0`,

    whose gain `K = R^-1 (B'XE + S')` minimises the integral of
    `x'Qx + 2 x'Su + u'Ru` over all time along `E dx/dt = A x + B u`, at cost
    `(Ex)' X (Ex)` from `x`.

    The scaled sign iteration of the Hamiltonian matrix; if that fails, doubling of its
    Cayley transform. Then Newton steps on the equation itself, if its residual asks for
    them. It takes products and solves alone, no eigenvalues, which suits accelerators
    and `jax.vmap`; in a batch, a member that fails harms no other. It is differentiable
    to any order, in either mode, by the implicit function theorem.

    Where the cost does not see an unstable mode, the stabilising solution is not the
    cheapest: no control at all would cost less, and the state would grow.

    **Arguments:**

    - `A`: shape `(n, n)`. Real, or complex, as all others; then `'` is the conjugate
        transpose.
    - `B`: shape `(n, m)`.
    - `Q`: state weight, shape `(n, n)`, symmetric. An indefinite one is accepted.
    - `R`: control weight, shape `(m, m)`, symmetric, positive definite: with a singular
        one the control may be an impulse, and there is no such gain.
    - `S`: cross weight, shape `(n, m)`; zero by default.
    - `E`: descriptor matrix, shape `(n, n)`, invertible; the identity by default.
    - `throw`: raise unless the solution is found and stabilising (default); if false,
        look at `result`.

    **Returns:** a [`delucax.riccati.RiccatiSolution`][] with a `spectral_abscissa`. It
    is successful if the residual, in units of the states that balance the equation, is
    at most 1e-12 (1e-5 in single precision), or up to a hundred times that if rounding
    of `X` alone may leave it; and if the closed loop is stable: a small residual alone
    is no certificate. Else `result` is one of `RESULTS.not_stabilisable`,
    `not_stabilising` (no such solution), `on_boundary` (eigenvalues on the imaginary
    axis, or so close that data changed by rounding have no stabilising solution),
    `not_converged` and `ill_posed`.

    **Raises:** `ValueError` on a matrix of the wrong shape, that is not finite, not
    symmetric or (`R`) not definite; an error at run time as `throw` says.

    Source: Roberts, 1971 (sign); Byers, 1987 (scaling); Chu, Fan and Lin, 2005
    (doubling); Kleinman, 1968 (Newton); Benner, 2001 (balancing).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[0.0, 1.0], [0.0, 0.0]])
        B = jnp.array([[0.0], [1.0]])
        K = dlx.riccati.care(A, B, jnp.eye(2), jnp.eye(1)).K  # [[1.0, 1.7321]]
        ```
    """
    data = riccati_arguments("care", A, B, Q, R, S, E, definite=True)
    return checked(stabilising_solution(False, data), "care", throw)
