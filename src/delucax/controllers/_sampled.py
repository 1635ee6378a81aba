"""The sampled-data regulator, and the discretisation of quadratic costs."""

from typing import Any

import numpy as np
from jaxtyping import ArrayLike

from .._check import as_matrix, check_instance, check_positive, symmetric_matrix
from .._jax import compiled_unless_on_host, host_unless_traced, xp
from .._typing import Array, Difference, Numbers
from ..dynamics import c2d, linearize, OperatingPoint
from ..math._lyapunov import gramian_over
from ..systems import AbstractSystem, LinearSystem
from ._lqr import LQR
from ._operating_point import linear_at


def sampled_weights(
    system: LinearSystem,
    Q: Numbers,
    R: Numbers,
    dt: ArrayLike,
    S: Numbers | None = None,
) -> tuple[Array, Array, Array]:
    """The exact discretisation of a continuous quadratic cost under a held control,

    `x'Qd x + 2 x'Sd u + u'Rd u`
    `= integral over [0, dt] of x(t)'Q x(t) + 2 x(t)'S u + u'R u`

    along `dx/dt = A x + B u` from `x`, with `u` held.

    **Arguments:**

    - `system`: the linear system.
    - `Q`: state weight, shape `(n, n)`, symmetric.
    - `R`: control weight, shape `(m, m)`, symmetric.
    - `dt`: the step, a positive number.
    - `S`: cross weight, shape `(n, m)`; zero by default.

    **Returns:** `(Qd, Rd, Sd)`, shapes `(n, n)`, `(m, m)` and `(n, m)`.

    **Raises:** `ValueError` if `system` is not linear, a weight does not fit, or `dt`
    is not positive.

    Source: Van Loan, 1978.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        upright = dlx.linearize(dlx.systems.Pendulum())
        Q, R = jnp.eye(2), jnp.eye(1)
        Qd, Rd, Sd = dlx.controllers.sampled_weights(upright, Q, R, dt=0.05)
        ```
    """
    where = "sampled_weights"
    check_instance(system, LinearSystem, "system", where)
    check_positive(dt, "dt", where)
    A, B = system.A, system.B
    n, m = B.shape
    Q, R = symmetric_matrix(Q, "Q", where), symmetric_matrix(R, "R", where)
    S = np.zeros((n, m), A.dtype) if S is None else as_matrix(S, "S", where)
    for name, M, shape in (("Q", Q, (n, n)), ("R", R, (m, m)), ("S", S, (n, m))):
        if M.shape != shape:
            raise ValueError(
                f"{where}: {name} must have shape {shape} to fit the system, got "
                f"{M.shape}."
            )
    return _weights_over(A, B, Q, R, S, dt)


@host_unless_traced
@compiled_unless_on_host
def _weights_over(
    A: Array, B: Array, Q: Array, R: Array, S: Any, dt: ArrayLike
) -> tuple[Array, Array, Array]:
    n, m = B.shape
    # The held control as a state with du/dt = 0: the cost of a step is then a Gramian
    # of one exponential (Van Loan).
    zero = xp.zeros((m, n + m), A.dtype)
    field = xp.concatenate([xp.concatenate([A, B], axis=1), zero])
    charge = xp.block([[Q, S], [S.T, R]]).astype(A.dtype)
    # integral of expm(F' s) charge expm(F s) over [0, dt], by blocks: Qd, Sd and Rd.
    total = gramian_over(field.T, charge, xp.asarray(dt, A.dtype))
    return total[:n, :n], total[n:, n:], total[:n, n:]


def lqrd(
    system: AbstractSystem,
    Q: Numbers,
    R: Numbers,
    dt: ArrayLike,
    S: Numbers | None = None,
    *,
    difference: Difference | None = None,
    point: OperatingPoint | None = None,
) -> LQR:
    """The sampled-data regulator of a continuous problem: of all controls held over
    each `dt` it minimises the integral over all time of
    `dx'Q dx + 2 dx'S du + du'R du`.

    Its `P` is that of the continuous cost: the minimum from a deviation `dx` is
    `dx' P dx`. As `dt` goes to 0 the gain goes to that of [`delucax.riccati.care`][].

    **Arguments:**

    - `system`: a linear system about an equilibrium, or any system, which is linearised
        at the `point`, or else about the equilibrium it defines.
    - `Q`: state weight, shape `(n, n)`, symmetric.
    - `R`: control weight, shape `(m, m)`, symmetric.
    - `dt`: the step, a positive number.
    - `S`: cross weight, shape `(n, m)`; zero by default.
    - `difference`: `(x, x_ref) -> deviation`; that of a system that is not linear by
        default.
    - `point`: the [`delucax.dynamics.OperatingPoint`][] of [`delucax.trim`][] at which
        `system` is linearised, at time 0.

    **Returns:** a [`delucax.controllers.LQR`][].

    **Raises:** `ValueError` if `system` is no system or defines no equilibrium, a
    weight does not fit, or `dt` is not positive; an error at run time if there is no
    stabilising gain.

    Source: Levis, Schlueter and Athans, 1971; Van Loan, 1978.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        pendulum = dlx.systems.Pendulum()
        regulator = dlx.controllers.lqrd(pendulum, jnp.eye(2), jnp.eye(1), dt=0.05)
        regulator.K
        ```
    """
    hint = " (for dynamics in discrete time use `delucax.controllers.LQR`)"
    check_instance(system, AbstractSystem, "system", "lqrd", hint)
    linear, difference = linear_at(system, point, difference, "lqrd")
    if not isinstance(linear, LinearSystem):
        linear = linearize(system)
        difference = system.difference if difference is None else difference
    Qd, Rd, Sd = sampled_weights(linear, Q, R, dt, S)
    return LQR(c2d(linear, dt), Qd, Rd, Sd, difference=difference)
