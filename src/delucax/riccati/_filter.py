"""The Riccati equations of the stationary Kalman filter."""

from typing import Any

import equinox as eqx

from .._check import as_matrix
from ._arguments import riccati_arguments
from ._solution import checked, RiccatiSolution
from ._stabilising import stabilising_solution


_NAMES = ("A", "C", "W", "V", "S", "E")


def filter_dare(
    A: Any, C: Any, W: Any, V: Any, S: Any = None, *, throw: bool = True
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
    - `C`: what is measured, shape `(p, n)`.
    - `W`: covariance of the process noise, shape `(n, n)`, symmetric.
    - `V`: covariance of the measurement noise, shape `(p, p)`, symmetric, positive
        semidefinite.
    - `S`: their cross-covariance, shape `(n, p)`; zero by default.
    - `throw`: raise unless the solution is found and stabilising (default); if false,
        look at `result`.

    **Returns:** a [`delucax.riccati.RiccatiSolution`][], with `K` of shape `(n, p)` and
    `closed_loop = A - K C`, the matrix of the prediction error. Its `result` speaks of
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
    where = "filter_dare"
    data = _transposed(where, A, C, W, V, S, definite=False)
    return checked(_dual(stabilising_solution(True, data)), where, throw)


def filter_care(
    A: Any, C: Any, W: Any, V: Any, S: Any = None, *, throw: bool = True
) -> RiccatiSolution:
    r"""The stationary covariance of the estimate of the Kalman-Bucy filter,

    `A X + X A' - (X C' + S) V^-1 (C X + S') + W = 0`,

    and the gain `K = (X C' + S) V^-1` of `dx/dt = A x + K (y - C x)`, for
    `dx/dt = A x + w`, `y = C x + v`, where `w` and `v` are white with intensities `W`,
    `V` and cross-intensity `S`.

    This is the equation of [`delucax.riccati.care`][] for the transposed system.

    **Arguments:**

    - `A`: shape `(n, n)`.
    - `C`: what is measured, shape `(p, n)`.
    - `W`: intensity of the process noise, shape `(n, n)`, symmetric.
    - `V`: intensity of the measurement noise, shape `(p, p)`, symmetric, positive
        definite.
    - `S`: their cross-intensity, shape `(n, p)`; zero by default.
    - `throw`: raise unless the solution is found and stabilising (default); if false,
        look at `result`.

    **Returns:** a [`delucax.riccati.RiccatiSolution`][], with `K` of shape `(n, p)` and
    `closed_loop = A - K C`, the matrix of the estimation error. Its `result` speaks of
    the transposed system: `RESULTS.not_stabilisable` means that `(A, C)` is not
    detectable.

    **Raises:** `ValueError` on a matrix of the wrong shape, that is not finite, not
    symmetric or (`V`) not definite; an error at run time as `throw` says.

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
    where = "filter_care"
    data = _transposed(where, A, C, W, V, S, definite=True)
    return checked(_dual(stabilising_solution(False, data)), where, throw)


def _transposed(where, A, C, W, V, S, definite):
    A, C = as_matrix(A, "A", where), as_matrix(C, "C", where)
    return riccati_arguments(
        where,
        A.conj().T,
        C.conj().T,
        W,
        V,
        S,
        None,
        definite=definite,
        names=_NAMES,
        dual=True,
    )


def _dual(solution: RiccatiSolution) -> RiccatiSolution:
    return eqx.tree_at(
        lambda s: (s.K, s.closed_loop), solution, replace_fn=lambda M: M.conj().T
    )
