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
    r"""The stabilising solution $X$ of the discrete-time algebraic Riccati equation.

    $$A^\top X A - E^\top X E - (A^\top X B + S) (R + B^\top X B)^{-1}
    (B^\top X A + S^\top) + Q = 0$$

    The gain $K = (R + B^\top X B)^{-1} (B^\top X A + S^\top)$ gives the optimal control
    $u_k = -K x_k$ of $E x_{k+1} = A x_k + B u_k$ over an infinite horizon. This control
    minimises

    $$\sum_{k=0}^\infty \left( x_k^\top Q x_k + 2 x_k^\top S u_k + u_k^\top R u_k
    \right),$$

    and the minimal cost from $x_0$ is $(E x_0)^\top X (E x_0)$.

    The solver uses the structure-preserving doubling algorithm, which starts from a
    positive final cost and doubles the horizon of the Riccati recursion in each
    iteration. If the residual is still large at the end, Newton steps reduce the
    residual. Doubling and Newton steps need only products and linear solves, no
    eigenvalues, so they run well on accelerators and under `jax.vmap`. In a batch, an
    equation that fails does not affect the other equations. The solution is
    differentiable to any order, in forward and reverse mode, by the implicit function
    theorem.

    If $(A, Q)$ is not detectable, a control that lets the state grow can cost less than
    the stabilising control. The stabilising solution is then not the smallest solution
    of the equation.

    **Arguments:**

    - `A`: shape `(n, n)`. All matrices may be complex. Then $^\top$ is the conjugate
        transpose.
    - `B`: shape `(n, m)`.
    - `Q`: state weight, shape `(n, n)`, symmetric. It may be indefinite.
    - `R`: control weight, shape `(m, m)`, symmetric, positive semidefinite. It may be
        singular, even zero.
    - `S`: cross weight, shape `(n, m)`; zero by default.
    - `E`: descriptor matrix, shape `(n, n)`, invertible; the identity by default.
    - `throw`: raise an error if the solver finds no stabilising solution (default). If
        false, check `result`.

    **Returns:** a [`delucax.riccati.RiccatiSolution`][]. The solve is successful if the
    closed loop is stable and the relative residual, after diagonal balancing of the
    states, is at most 1e-12 (1e-5 in single precision). The function also accepts a
    residual of up to a hundred times this limit if the rounding errors of $X$ alone can
    cause such a residual. Otherwise `result` is one of `RESULTS.not_stabilisable`,
    `not_stabilising` (there is no stabilising solution), `on_boundary`, `not_converged`
    and `ill_posed`. The status `on_boundary` means that eigenvalues are on the unit
    circle, or so close to it that rounding of the data removes the stabilising
    solution.

    **Raises:** `ValueError` if a matrix has the wrong shape or is not finite, if `Q` or
    `R` is not symmetric, or if `R` is not semidefinite. With `throw`, an error at run
    time if the solve fails.

    Source: Chu, Fan, Lin and Wang, 2004 (doubling); Benner, 2001 (balancing).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[1.0, 1.0], [0.0, 1.0]])
        B = jnp.array([[0.0], [1.0]])
        dlx.riccati.dare(A, B, jnp.eye(2), jnp.eye(1)).K
        ```

        ```text
        Array([[0.422, 1.244]], dtype=float32)
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
    r"""The stabilising solution $X$ of the continuous-time algebraic Riccati equation.

    $$A^\top X E + E^\top X A - (E^\top X B + S) R^{-1} (B^\top X E + S^\top) + Q = 0$$

    The gain $K = R^{-1} (B^\top X E + S^\top)$ gives the optimal control $u = -K x$ of
    $E \dot{x} = A x + B u$ over an infinite horizon. This control minimises

    $$\int_0^\infty \left( x^\top Q x + 2 x^\top S u + u^\top R u \right)
    \mathrm{d}t,$$

    and the minimal cost from $x_0$ is $(E x_0)^\top X (E x_0)$.

    The solver uses the scaled sign iteration of the Hamiltonian matrix. If the sign
    iteration fails, the solver tries again with $X$ in another unit, which is better if
    the controls have a weak effect. The remarks in [`delucax.riccati.dare`][] about
    Newton steps, accelerators, batches, derivatives and undetectable modes also hold
    for this function.

    **Arguments:** `A`, `B`, `Q`, `S`, `E` and `throw`: as in
    [`delucax.riccati.dare`][].

    - `R`: control weight, shape `(m, m)`, symmetric, positive definite. If `R` is
        singular, the optimal control may contain an impulse, and no feedback gain can
        produce an impulse.

    **Returns:** a [`delucax.riccati.RiccatiSolution`][] with a `spectral_abscissa`
    instead of a spectral radius. The criteria for success and the values of `result`
    are the same as in [`delucax.riccati.dare`][], but the boundary of stability is the
    imaginary axis instead of the unit circle.

    **Raises:** as in [`delucax.riccati.dare`][], and `ValueError` if `R` is not
    positive definite.

    Source: Roberts, 1971 (sign); Byers, 1987 (scaling); Kleinman, 1968 (Newton);
    Benner, 2001 (balancing).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[0.0, 1.0], [0.0, 0.0]])
        B = jnp.array([[0.0], [1.0]])
        solution = dlx.riccati.care(A, B, jnp.eye(2), jnp.eye(1))
        solution.K, solution.spectral_abscissa
        ```

        ```text
        (Array([[1.   , 1.732]], dtype=float32), Array(-0.866, dtype=float32))
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
    r"""The stationary covariance and gain of the one-step Kalman predictor.

    $$A X A^\top - X - (A X C^\top + S) (V + C X C^\top)^{-1} (C X A^\top + S^\top)
    + W = 0$$

    The system is $x_{k+1} = A x_k + w_k$, $y_k = C x_k + v_k$. The noises $w$ and $v$
    are white, with covariances $W$ and $V$ and cross-covariance
    $S = \mathrm{E}[w_k v_k^\top]$. The predictor is

    $$\hat{x}_{k+1} = A \hat{x}_k + K (y_k - C \hat{x}_k), \qquad
    K = (A X C^\top + S) (V + C X C^\top)^{-1}.$$

    $X$ is the covariance of the prediction error, which is the covariance of $x_k$
    given all measurements before time $k$. The gain of the measurement update of a
    Kalman filter is $X C^\top (V + C X C^\top)^{-1}$. The equation is that of
    [`delucax.riccati.dare`][] for the transposed system, in which $A^\top$ and $C^\top$
    take the place of $A$ and $B$.

    **Arguments:**

    - `A`: shape `(n, n)`.
    - `C`: output matrix, shape `(p, n)`.
    - `W`: covariance of the process noise, shape `(n, n)`, symmetric.
    - `V`: covariance of the measurement noise, shape `(p, p)`, symmetric, positive
        semidefinite.
    - `S`: cross-covariance of the two noises, shape `(n, p)`; zero by default.
    - `throw`: raise an error if the solver finds no stabilising solution (default). If
        false, check `result`.

    **Returns:** a [`delucax.riccati.RiccatiSolution`][]. `K` has the shape `(n, p)`.
    `closed_loop` is $A - K C$, the system matrix of the prediction error. `result` is
    the status of the Riccati equation of the transposed system, so
    `RESULTS.not_stabilisable` means that $(A, C)$ is not detectable.

    **Raises:** `ValueError` if a matrix has the wrong shape or is not finite, if `W` or
    `V` is not symmetric, or if `V` is not semidefinite. With `throw`, an error at run
    time if the solve fails.

    Source: Kalman, 1960.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[1.0, 0.1], [0.0, 1.0]])
        C = jnp.array([[1.0, 0.0]])
        dlx.riccati.filter_dare(A, C, 0.01 * jnp.eye(2), jnp.eye(1)).K
        ```

        ```text
        Array([[0.168],
               [0.092]], dtype=float32)
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
    r"""The stationary covariance and gain of the Kalman-Bucy filter.

    $$A X + X A^\top - (X C^\top + S) V^{-1} (C X + S^\top) + W = 0$$

    The system is $\dot{x} = A x + w$, $y = C x + v$. The noises $w$ and $v$ are white,
    with intensities $W$ and $V$ and cross-intensity $S$. $X$ is the covariance of the
    estimation error. The filter is

    $$\dot{\hat{x}} = A \hat{x} + K (y - C \hat{x}), \qquad
    K = (X C^\top + S) V^{-1}.$$

    The equation is that of [`delucax.riccati.care`][] for the transposed system, in
    which $A^\top$ and $C^\top$ take the place of $A$ and $B$.

    **Arguments:** `A`, `C`, `S` and `throw`: as in [`delucax.riccati.filter_dare`][],
    with intensities instead of covariances.

    - `W`: intensity of the process noise, shape `(n, n)`, symmetric.
    - `V`: intensity of the measurement noise, shape `(p, p)`, symmetric, positive
        definite.

    **Returns:** as in [`delucax.riccati.filter_dare`][], but with a `spectral_abscissa`
    instead of a spectral radius. `closed_loop` is the system matrix of the estimation
    error.

    **Raises:** as in [`delucax.riccati.filter_dare`][], and `ValueError` if `V` is not
    positive definite.

    Source: Kalman and Bucy, 1961.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[0.0, 1.0], [0.0, 0.0]])
        C = jnp.array([[1.0, 0.0]])
        dlx.riccati.filter_care(A, C, 0.01 * jnp.eye(2), jnp.eye(1)).K
        ```

        ```text
        Array([[0.458],
               [0.1  ]], dtype=float32)
        ```
    """
    return _filter(False, "filter_care", A, C, W, V, S, throw)


def _filter(discrete, where, A, C, W, V, S, throw) -> RiccatiSolution:
    """Solve a filter equation as the control equation of the transposed system."""
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
