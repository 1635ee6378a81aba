"""The H-infinity controller."""

from jaxtyping import Array, ArrayLike, Float, PyTree

from .._check import check_count, check_range, check_step
from .._controller import AbstractController
from .._module import function_field, parameter, weight
from .._typing import Difference, Numbers, RealScalar
from ..dynamics import LinearDynamics
from ..math import matvec
from ..math._steps import row_at, step_at
from ..riccati import hinf_dare, hinf_dre
from ._operating_point import (
    check_linear_state_feedback,
    check_state,
    deviation,
    operating_state,
)


class HInfinity(AbstractController):
    r"""The H-infinity controller about an operating point, for the worst disturbance.

    $$u = u_\mathrm{ref} - K\, \mathrm{difference}(x, x_\mathrm{ref})$$

    For every disturbance $w$ of the linear dynamics, starting at the operating point,
    it guarantees

    $$\sum_k \left( \delta x_k^\top Q\, \delta x_k + \delta u_k^\top R\, \delta u_k
    \right) \le \gamma^2 \sum_k w_k^\top w_k$$

    where $\delta x$ and $\delta u$ are the deviations from the operating point. The
    sums run over all time, or over a finite horizon. With a finite horizon the gain
    varies in time, and the left side of the inequality also contains the final cost.

    By default $\gamma$ is the smallest level that a controller can attain. A larger
    $\gamma$ improves the average performance at the expense of the worst case.

    **Arguments:**

    - `dynamics`: linear dynamics whose operating point is an equilibrium and whose
        observation is the state, for example from [`delucax.linearize`][]. The
        disturbance enters through their `E`. Time-varying dynamics have a finite
        horizon, and each of their operating points must lead to the next one.
    - `Q`: state weight, shape `(n, n)`, symmetric. With a finite horizon the shape may
        also be `(T, n, n)`.
    - `R`: control weight, shape `(m, m)`, symmetric. With a finite horizon the shape
        may also be `(T, m, m)`.
    - `gamma`: the level $\gamma$, a positive number; by default the smallest level that
        a controller can attain.
    - `horizon`: the number of steps `T`. By default the horizon is infinite if
        `dynamics` is time-invariant. If `dynamics` is time-varying, the horizon is its
        number of steps.
    - `final`: final weight, shape `(n, n)`, symmetric, allowed only with a finite
        horizon; zero by default.
    - `difference`: a function `(x, x_ref) -> deviation`, for example to wrap angles;
        subtraction by default.

    **Attributes:** `K`, the gain, trainable, shape `(m, n)`, or `(T, m, n)`; `P`, the
    solution of the game, shape `(n, n)`, or `(T+1, n, n)`; `L`, the gain of the worst
    disturbance `w = L dx`, shape `(k, n)`, or `(T, k, n)`; `gamma`, the level; `x_ref`
    and `u_ref`, the operating point. With a finite horizon the control is NaN before
    step 0 and after the last step, and a rollout reports this.

    **Raises:** `ValueError` if `dynamics` is not linear, if its operating point is not
    an equilibrium, if its observation is not the state, or if an argument has the wrong
    shape or value; an error at run time if no controller attains `gamma`.

    Source: Basar and Bernhard, 1995.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A, B = jnp.array([[1.0, 1.0], [0.0, 1.0]]), jnp.array([[0.0], [1.0]])
        dynamics, weight = dlx.LinearDynamics(A, B), jnp.eye(2)
        best = dlx.controllers.HInfinity(dynamics, weight, jnp.eye(1))
        calm = dlx.controllers.HInfinity(dynamics, weight, jnp.eye(1), gamma=10.0)
        best.gamma, best.K, calm.K
        ```

        ```text
        (Array(2.956, dtype=float32),
         Array([[0.713, 1.713]], dtype=float32),
         Array([[0.439, 1.273]], dtype=float32))
        ```
    """

    K: Float[Array, "*T m n"] = weight()
    P: Float[Array, "... n n"] = parameter()
    L: Float[Array, "*T k n"] = parameter()
    gamma: Float[Array, ""] = parameter()
    x_ref: Float[Array, "... n"] = parameter()
    u_ref: Float[Array, "... m"] = parameter()
    dt: Float[Array, ""] | None = parameter()
    difference: Difference | None = function_field(of="a, b")

    def __init__(
        self,
        dynamics: LinearDynamics,
        Q: Numbers,
        R: Numbers,
        *,
        gamma: ArrayLike | None = None,
        horizon: int | None = None,
        final: Numbers | None = None,
        difference: Difference | None = None,
    ):
        where = "HInfinity"
        check_linear_state_feedback(dynamics, where)
        varies = dynamics.is_time_varying
        is_finite = varies or horizon is not None
        if final is not None and not is_finite:
            raise ValueError(f"{where}: final must not be given without a horizon.")
        self.x_ref = operating_state(dynamics, difference, where)
        self.u_ref, self.difference = dynamics.u_ref, difference
        matrices = dynamics.A, dynamics.B, dynamics.E, Q, R
        # One Riccati equation is enough, because the state is observed. Output feedback
        # would need a second one (Doyle, Glover, Khargonekar and Francis, 1989).
        if is_finite:
            steps = dynamics.A.shape[0] if varies else None
            T = steps if horizon is None else check_count(horizon, "horizon", where)
            solution = hinf_dre(*matrices, final=final, horizon=T, gamma=gamma)
        else:
            solution = hinf_dare(*matrices, gamma=gamma)
        self.K, self.P, self.L = solution.K, solution.X, solution.L
        # The signs of the Riccati package: u = -K dx minimises, w = +L dx maximises.
        self.gamma, self.dt = solution.gamma, dynamics.dt if is_finite else None

    def __check_init__(self):
        # Zero if the disturbance has no effect.
        check_range(self.gamma, "gamma", "HInfinity")
        if self.dt is not None:
            check_step(self.dt, "HInfinity")

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        check_state(self, y, self.x_ref.shape[-1])
        K, x_ref, u_ref = self.K, self.x_ref, self.u_ref
        if self.dt is not None:
            step = step_at(t, self.dt, len(K), "HInfinity")
            K = row_at(K, step)
            # The gains vary in time, but the operating point need not.
            if x_ref.ndim == 2:
                x_ref, u_ref = row_at((x_ref, u_ref), step)
        u = u_ref - matvec(K, deviation(y, x_ref, self.difference))
        return u.astype(y.dtype), state
