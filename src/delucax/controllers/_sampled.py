"""The sampled-data regulator, and quadratic costs in discrete time."""

from typing import Any

import numpy as np
from jaxtyping import ArrayLike

from .._check import as_matrix, check_instance, check_positive, symmetric_matrix
from .._jax import compiled_unless_on_host, host_unless_traced, xp
from .._typing import Array, Difference, Numbers
from ..dynamics import c2d, linearize, OperatingPoint
from ..math._exponential import unit_beside
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
    r"""The weights of the discrete-time cost that equals a continuous-time quadratic
    cost exactly, if the control is held over each step.

    $$x^\top Q_d x + 2 x^\top S_d u + u^\top R_d u =
    \int_0^{\Delta t} \left( x(t)^\top Q x(t) + 2 x(t)^\top S u + u^\top R u \right)
    dt$$

    In the integral, the state $x(t)$ solves $\dot x = A x + B u$ from $x(0) = x$, with
    $u$ constant.

    **Arguments:**

    - `system`: the linear system.
    - `Q`: state weight, shape `(n, n)`, symmetric.
    - `R`: control weight, shape `(m, m)`, symmetric.
    - `dt`: the step $\Delta t$, a positive number.
    - `S`: cross weight, shape `(n, m)`; zero by default.

    **Returns:** `(Qd, Rd, Sd)`, shapes `(n, n)`, `(m, m)` and `(n, m)`.

    **Raises:** `ValueError` if `system` is not linear, a weight has the wrong shape, or
    `dt` is not positive.

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
    dt = xp.asarray(dt, A.dtype)
    # The control in a unit for which a large B does not lose the digits of A.
    unit = unit_beside(B * dt, A * dt)
    B, S, R = B / unit, S / unit, R / unit**2
    # With the held control as a state, du/dt = 0, the cost of a step is a Gramian,
    # which takes one matrix exponential (Van Loan).
    zero = xp.zeros((m, n + m), A.dtype)
    field = xp.concatenate([xp.concatenate([A, B], axis=1), zero])
    charge = xp.block([[Q, S], [S.T, R]]).astype(A.dtype)
    # The integral of expm(F' s) charge expm(F s) over [0, dt] has blocks Qd, Sd, Rd.
    total = gramian_over(field.T, charge, dt)
    return total[:n, :n], total[n:, n:] * unit**2, total[:n, n:] * unit


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
    r"""The linear-quadratic regulator of a continuous system with sampled control.

    Among all controls that are constant over each step, it minimises the integral over
    all time of

    $$\delta x^\top Q\, \delta x + 2\, \delta x^\top S\, \delta u +
    \delta u^\top R\, \delta u$$

    where $\delta x$ and $\delta u$ are the deviations from the operating point. The
    minimum of this continuous-time cost from a deviation $\delta x$ is
    $\delta x^\top P\, \delta x$, where $P$ is the attribute `P` of the controller. As
    `dt` goes to 0, the gain converges to the gain of [`delucax.riccati.care`][].

    **Arguments:**

    - `system`: a linear system about an equilibrium, or any other system. A nonlinear
        system is linearised at `point` or, without a `point`, at the equilibrium that
        the system defines.
    - `Q`: state weight, shape `(n, n)`, symmetric.
    - `R`: control weight, shape `(m, m)`, symmetric.
    - `dt`: the step, a positive number.
    - `S`: cross weight, shape `(n, m)`; zero by default.
    - `difference`: a function `(x, x_ref) -> deviation`; by default subtraction if the
        system is linear, and the method `difference` of the system if it is not.
    - `point`: the [`delucax.dynamics.OperatingPoint`][] about which to linearise
        `system` at time 0, from [`delucax.trim`][].

    **Returns:** a [`delucax.controllers.LQR`][].

    **Raises:** `ValueError` if `system` is not a system or defines no equilibrium, a
    weight has the wrong shape, or `dt` is not positive; an error at run time if there
    is no stabilising gain.

    Source: Levis, Schlueter and Athans, 1971; Van Loan, 1978.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        pendulum = dlx.systems.Pendulum()
        regulator = dlx.controllers.lqrd(pendulum, jnp.eye(2), jnp.eye(1), dt=0.05)
        regulator.K
        ```

        ```text
        Array([[9.146, 2.489]], dtype=float32)
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
