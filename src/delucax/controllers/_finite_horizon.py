"""The linear-quadratic regulator over a finite horizon."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .._check import check_at_most, check_count, check_step
from .._controller import AbstractController
from .._module import function_field, parameter, weight
from .._typing import Difference, Numbers, RealScalar
from ..dynamics import LinearDynamics
from ..math import matvec
from ..math._steps import row_at, step_at
from ..riccati import dre
from ._feed_forward import as_signals, KnownSignals
from ._operating_point import (
    check_linear_state_feedback,
    check_state,
    deviation,
)


class FiniteHorizonLQR(AbstractController):
    r"""The linear-quadratic regulator over a finite horizon.

    $$u_k = u_{r,k} - K_k\, \mathrm{difference}(x_k, r_k) - \kappa_k$$

    It minimises

    $$\sum_{k < T} \left( e_k^\top Q e_k + 2 e_k^\top S v_k + v_k^\top R v_k \right) +
    e_T^\top Q_f e_T, \qquad e = \mathrm{difference}(x, r), \quad v = u - u_r$$

    The feed-forward control $\kappa$ takes the reference and the known disturbance of
    all steps into account. If the reference is a trajectory of the dynamics, such as a
    plan, the feed-forward is zero: the control $u_{r,k}$ then takes the state from
    $r_k$ to $r_{k+1}$.

    **Arguments:**

    - `dynamics`: linear dynamics, time-invariant or time-varying, whose observation is
        the state.
    - `Q`: state weight, shape `(n, n)`, or `(T, n, n)`, symmetric.
    - `R`: control weight, shape `(m, m)`, or `(T, m, m)`, symmetric.
    - `S`: cross weight, shape `(n, m)`, or `(T, n, m)`; zero by default.
    - `final`: final weight $Q_f$, shape `(n, n)`, symmetric; zero by default.
    - `horizon`: the number of steps `T`; by default the length of time-varying
        `dynamics`.
    - `reference`: $r$, the state to follow, a vector of shape `(n,)` or a function of
        time; the operating points by default.
    - `control_reference`: $u_r$, the control at which the control cost is zero, a
        vector of shape `(m,)` or a function of time; the control of the operating
        points by default.
    - `disturbance`: a disturbance known in advance, a vector of shape `(k,)` or a
        function of time; none by default.
    - `difference`: a function `(x, x_ref) -> deviation`, for example to wrap angles;
        subtraction by default.
    - `parallel`: whether to compute all steps of the Riccati recursion in parallel,
        which is faster on accelerators; false by default.

    **Attributes:** `K`, the gains, trainable, shape `(T, m, n)`; `k`, the feed-forward
    $\kappa$, trainable, shape `(T, m)`; `P`, shape `(T+1, n, n)`; `x_ref` and `u_ref`,
    the references $r$ and $u_r$, shapes `(T, n)` and `(T, m)`. The control is NaN
    before step 0 and after the last step of the horizon, and a rollout reports this.

    **Raises:** `ValueError` if `dynamics` is not linear or does not have its state as
    the observation, the horizon is unknown, or a weight or signal has the wrong shape;
    an error at run time if the cost of a step has no minimum.

    Source: Kalman, 1960; Anderson and Moore, 1990 (tracking).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[1.0, 1.0], [0.0, 1.0]])
        B = jnp.array([[0.0], [1.0]])
        regulator = dlx.controllers.FiniteHorizonLQR(
            dlx.LinearDynamics(A, B), jnp.eye(2), jnp.eye(1), horizon=20
        )
        regulator.K[0]
        ```

        ```text
        Array([[0.422, 1.244]], dtype=float32)
        ```
    """

    K: Float[Array, "T m n"] = weight()
    k: Float[Array, "T m"] = weight()
    P: Float[Array, "T+1 n n"] = parameter()
    x_ref: Float[Array, "T n"] = parameter()
    u_ref: Float[Array, "T m"] = parameter()
    dt: Float[Array, ""] = parameter()
    difference: Difference | None = function_field(of="a, b")

    def __init__(
        self,
        dynamics: LinearDynamics,
        Q: Numbers,
        R: Numbers,
        S: Numbers | None = None,
        *,
        final: Numbers | None = None,
        horizon: int | None = None,
        reference: Any = None,
        control_reference: Any = None,
        disturbance: Any = None,
        difference: Difference | None = None,
        parallel: bool = False,
    ):
        where = "FiniteHorizonLQR"
        check_linear_state_feedback(dynamics, where)
        steps = dynamics.A.shape[0] if dynamics.is_time_varying else None
        if horizon is None and steps is None:
            raise ValueError(
                f"{where}: horizon must be given, because dynamics are time-invariant."
            )
        T = check_count(steps if horizon is None else horizon, "horizon", where)
        if steps is not None:
            check_at_most(T, steps, "horizon", where, "steps of dynamics")
        given = reference, control_reference, disturbance
        signals = as_signals(dynamics, given, where)
        self.x_ref, self.u_ref, d = _along(dynamics, signals, difference, T)
        A, B = (a if steps is None else a[:T] for a in (dynamics.A, dynamics.B))
        # The residual d of the reference gives the cost to go a linear term, and the
        # control the feed-forward k.
        options: dict[str, Any] = dict(final=final, horizon=T, d=d, parallel=parallel)
        solution: Any = dre(A, B, Q, R, S, **options)
        self.K, self.k, self.P = solution.K, solution.k, solution.X
        self.dt, self.difference = dynamics.dt, difference

    def __check_init__(self):
        check_step(self.dt, "FiniteHorizonLQR")

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        check_state(self, y, self.x_ref.shape[1])
        step = step_at(t, self.dt, len(self.K), type(self).__name__)
        x_ref, u_ref, K, k = row_at((self.x_ref, self.u_ref, self.K, self.k), step)
        u = u_ref - matvec(K, deviation(y, x_ref, self.difference)) - k
        return u.astype(y.dtype), state


@eqx.filter_jit
def _along(
    dynamics: LinearDynamics,
    signals: tuple[Any, Any, Any],
    difference: Difference | None,
    T: int,
) -> tuple[Array, Array, Array]:
    """The references at each step of the horizon, and the residual of each step."""

    def at(t):
        here = KnownSignals(dynamics.at(t), *signals, difference)
        return here.state(t), here.control(t), here.next_state(t)

    x_ref, u_ref, x_next = jax.vmap(at)(jnp.arange(T) * dynamics.dt)
    end = T * dynamics.dt
    # The residual of the last step needs the reference one step later.
    if signals[0] is not None:
        last = signals[0](end)
    elif dynamics.is_time_varying and dynamics.A.shape[0] == T:
        last = dynamics.x_next[-1]
    else:
        last = dynamics.at(end).x_ref
    targets = jnp.concatenate([x_ref[1:], last[None]])
    # d[k] is the error after a step from r[k]: e_next = A e + B v + d.
    d = jax.vmap(lambda a, b: deviation(a, b, difference))(x_next, targets)
    return x_ref, u_ref, d
