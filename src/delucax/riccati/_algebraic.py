"""The algebraic Riccati equations of control and of the stationary filter."""

import equinox as eqx

from .._check import as_matrix
from .._jax import host_unless_traced
from .._typing import Numbers
from ._arguments import riccati_arguments
from ._stabilising import RiccatiSolution, stabilising_solution


@host_unless_traced
def dare(
    A: Numbers,
    B: Numbers,
    Q: Numbers,
    R: Numbers,
    S: Numbers | None = None,
    E: Numbers | None = None,
    *,
    throw: bool = True,
) -> RiccatiSolution:
    r"""The stabilising solution of the discrete-time algebraic Riccati equation,

    `A'XA - E'XE - (A'XB + S) (R + B'XB)^-1 (B'XA + S') + Q = 0`,

    whose gain `K = (R + B'XB)^-1 (B'XA + S')` minimises the sum of
    `x'Qx + 2 x'Su + u'Ru` over all time along `E x_next = A x + B u`, at cost
    `(Ex)' X (Ex)` from `x`.

    Structure-preserving doubling of the Riccati recursion from a positive final cost,
    followed by Newton steps while the residual is large. It takes products and solves
    alone, no eigenvalues, which suits accelerators and `jax.vmap`; in a batch, a member
    that fails does not affect the others. It is differentiable to any order, in either
    mode, by the implicit function theorem.

    If `(A, Q)` is not detectable, the stabilising solution is not the minimal one: no
    control at all would cost less, and the state would grow.

    **Arguments:**

    - `A`: shape `(n, n)`. Real, or complex, as all others; then `'` is the conjugate
        transpose.
    - `B`: shape `(n, m)`.
    - `Q`: state weight, shape `(n, n)`, symmetric. An indefinite one is accepted.
    - `R`: control weight, shape `(m, m)`, symmetric, positive semidefinite. May be
        singular, and zero.
    - `S`: cross weight, shape `(n, m)`; zero by default.
    - `E`: descriptor matrix, shape `(n, n)`, invertible; the identity by default.
    - `throw`: raise unless there is a stabilising solution (default); if false,
        check `result`.

    **Returns:** a [`delucax.riccati.RiccatiSolution`][]. It is successful if the
    closed loop is stable, and the residual after diagonal balancing of the states is at
    most 1e-12 (1e-5 in single precision), or up to a hundred times that if rounding of
    `X` alone may cause it. Else `result` is one of `RESULTS.not_stabilisable`,
    `not_stabilising` (no such solution), `on_boundary` (eigenvalues on the unit circle,
    or so close that rounding of the data removes the stabilising solution),
    `not_converged` and `ill_posed`.

    **Raises:** `ValueError` on a matrix of the wrong shape, that is not finite, not
    symmetric or (`R`) not semidefinite; an error at run time as `throw` says.

    Source: Chu, Fan, Lin and Wang, 2004 (doubling); Benner, 2001 (balancing).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[1.0, 1.0], [0.0, 1.0]])
        B = jnp.array([[0.0], [1.0]])
        K = dlx.riccati.dare(A, B, jnp.eye(2), jnp.eye(1)).K  # [[0.4221, 1.2439]]
        ```
    """
    data = riccati_arguments("dare", A, B, Q, R, S, E, definite=False)
    return stabilising_solution(True, data, "dare", throw)


@host_unless_traced
def care(
    A: Numbers,
    B: Numbers,
    Q: Numbers,
    R: Numbers,
    S: Numbers | None = None,
    E: Numbers | None = None,
    *,
    throw: bool = True,
) -> RiccatiSolution:
    r"""The stabilising solution of the continuous-time algebraic Riccati equation,

    `A'XE + E'XA - (E'XB + S) R^-1 (B'XE + S') + Q = 0`,

    whose gain `K = R^-1 (B'XE + S')` minimises the integral of
    `x'Qx + 2 x'Su + u'Ru` over all time along `E dx/dt = A x + B u`, at cost
    `(Ex)' X (Ex)` from `x`.

    The scaled sign iteration of the Hamiltonian matrix; if that fails, once more in a
    unit of `X` for weak controls. Newton steps, accelerators, batches, derivatives and
    undetectable modes: as of [`delucax.riccati.dare`][].

    **Arguments:** `A`, `B`, `Q`, `S`, `E` and `throw`: as of
    [`delucax.riccati.dare`][];

    - `R`: control weight, shape `(m, m)`, symmetric, positive definite: with a singular
        one the control may be an impulse, and there is no such gain.

    **Returns:** a [`delucax.riccati.RiccatiSolution`][] with a `spectral_abscissa`. It
    is judged as there, with the imaginary axis for the unit circle.

    **Raises:** as there, and `ValueError` on an `R` that is only semidefinite.

    Source: Roberts, 1971 (sign); Byers, 1987 (scaling); Kleinman, 1968 (Newton);
    Benner, 2001 (balancing).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[0.0, 1.0], [0.0, 0.0]])
        B = jnp.array([[0.0], [1.0]])
        solution = dlx.riccati.care(A, B, jnp.eye(2), jnp.eye(1))
        solution.K, solution.spectral_abscissa  # [[1.0, 1.7321]], -0.866
        ```
    """
    data = riccati_arguments("care", A, B, Q, R, S, E, definite=True)
    return stabilising_solution(False, data, "care", throw)


@host_unless_traced
def filter_dare(
    A: Numbers,
    C: Numbers,
    W: Numbers,
    V: Numbers,
    S: Numbers | None = None,
    *,
    throw: bool = True,
) -> RiccatiSolution:
    r"""The stationary covariance of a one-step prediction, in discrete time,

    `A X A' - X - (A X C' + S) (V + C X C')^-1 (C X A' + S') + W = 0`,

    and the gain `K = (A X C' + S) (V + C X C')^-1` of the predictor
    `x_next = A x + K (y - C x)` of `x_next = A x + w`, `y = C x + v`, where `w` and `v`
    are white with covariances `W`, `V` and `S = E[w v']`.

    `X` is the covariance of the state given all measurements before it; the gain of the
    measurement update is `X C' (V + C X C')^-1`. This is the equation of
    [`delucax.riccati.dare`][] for the transposed system.

    **Arguments:**

    - `A`: shape `(n, n)`.
    - `C`: output matrix, shape `(p, n)`.
    - `W`: covariance of the process noise, shape `(n, n)`, symmetric.
    - `V`: covariance of the measurement noise, shape `(p, p)`, symmetric, positive
        semidefinite.
    - `S`: their cross-covariance, shape `(n, p)`; zero by default.
    - `throw`: raise unless there is a stabilising solution (default); if false,
        check `result`.

    **Returns:** a [`delucax.riccati.RiccatiSolution`][], with `K` of shape `(n, p)` and
    `closed_loop = A - K C`, the matrix of the prediction error. Its `result` is that of
    the transposed system: `RESULTS.not_stabilisable` means that `(A, C)` is not
    detectable.

    **Raises:** `ValueError` on a matrix of the wrong shape, that is not finite, not
    symmetric or (`V`) not semidefinite; an error at run time as `throw` says.

    Source: Kalman, 1960.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[1.0, 0.1], [0.0, 1.0]])
        C = jnp.array([[1.0, 0.0]])
        prediction = dlx.riccati.filter_dare(A, C, 0.01 * jnp.eye(2), jnp.eye(1))
        prediction.X, prediction.K
        ```
    """
    return _filter(True, "filter_dare", A, C, W, V, S, throw)


@host_unless_traced
def filter_care(
    A: Numbers,
    C: Numbers,
    W: Numbers,
    V: Numbers,
    S: Numbers | None = None,
    *,
    throw: bool = True,
) -> RiccatiSolution:
    r"""The stationary covariance of the estimate of the Kalman-Bucy filter,

    `A X + X A' - (X C' + S) V^-1 (C X + S') + W = 0`,

    and the gain `K = (X C' + S) V^-1` of `dx/dt = A x + K (y - C x)`, for
    `dx/dt = A x + w`, `y = C x + v`, where `w` and `v` are white with intensities `W`,
    `V` and cross-intensity `S`.

    This is the equation of [`delucax.riccati.care`][] for the transposed system.

    **Arguments:** `A`, `C`, `S` and `throw`: as of [`delucax.riccati.filter_dare`][],
    with intensities for covariances;

    - `W`: intensity of the process noise, shape `(n, n)`, symmetric.
    - `V`: intensity of the measurement noise, shape `(p, p)`, symmetric, positive
        definite.

    **Returns:** as there, with a `spectral_abscissa`; `closed_loop` is the matrix of
    the estimation error.

    **Raises:** as there, and `ValueError` on a `V` that is only semidefinite.

    Source: Kalman and Bucy, 1961.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[0.0, 1.0], [0.0, 0.0]])
        C = jnp.array([[1.0, 0.0]])
        estimate = dlx.riccati.filter_care(A, C, 0.01 * jnp.eye(2), jnp.eye(1))
        estimate.X, estimate.K
        ```
    """
    return _filter(False, "filter_care", A, C, W, V, S, throw)


def _filter(discrete, where, A, C, W, V, S, throw) -> RiccatiSolution:
    """The filter's solution, by that of control for the transposed system."""
    A, C = as_matrix(A, "A", where), as_matrix(C, "C", where)
    transposed = A.conj().T, C.conj().T, W, V, S, None
    data = riccati_arguments(
        where, *transposed, definite=not discrete, names="ACWVSE", dual=True
    )
    return eqx.tree_at(
        lambda s: (s.K, s.closed_loop),
        stabilising_solution(discrete, data, where, throw),
        replace_fn=lambda M: M.conj().T,
    )
