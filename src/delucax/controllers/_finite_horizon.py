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
    """The linear-quadratic regulator over a finite horizon,

    `u[t] = u_r[t] - K[t] difference(x[t], r[t]) - k[t]`,

    which minimises the sum over steps `t < T` of `e'Q e + 2 e'S v + v'R v`, and
    `e' final e` at the end, with `e = difference(x, r)` and `v = u - u_r`. All of the
    reference and of a known disturbance is taken into account: `k`, the feed-forward,
    is zero if the dynamics go from each `r[t]` to `r[t+1]` under `u_r[t]`, as along a
    trajectory that was planned.

    **Arguments:**

    - `dynamics`: linear dynamics that observe their state, time-invariant or
        time-varying.
    - `Q`: state weight, shape `(n, n)`, or `(T, n, n)`, symmetric.
    - `R`: control weight, shape `(m, m)`, or `(T, m, m)`, symmetric.
    - `S`: cross weight, shape `(n, m)`, or `(T, n, m)`; zero by default.
    - `final`: final weight, shape `(n, n)`, symmetric; zero by default.
    - `horizon`: the number of steps `T`; by default those of time-varying `dynamics`.
    - `reference`: the state to follow, a vector or a function of time; the operating
        points by default.
    - `control_reference`: the control from which deviations are charged, a vector or a
        function of time; that of the operating points by default.
    - `disturbance`: a disturbance known in advance, a vector or a function of time.
    - `difference`: `(x, x_ref) -> deviation`; subtraction by default.
    - `parallel`: solve the recursion in parallel over time, for accelerators.

    **Attributes:** `K`, the gains, trainable, shape `(T, m, n)`; `k`, shape `(T, m)`;
    `P`, shape `(T+1, n, n)`; `x_ref` and `u_ref`, shapes `(T, n)` and `(T, m)`. Outside
    of the horizon the control is NaN, so that a rollout fails.

    **Raises:** `ValueError` if `dynamics` is not linear or does not observe its state,
    there is no horizon, or a weight or signal does not fit; an error at run time if a
    step has no minimum.

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
    """

    K: Float[Array, "T m n"] = weight()
    k: Float[Array, "T m"] = weight()
    P: Float[Array, "T+1 n n"] = parameter()
    x_ref: Float[Array, "T n"] = parameter()
    u_ref: Float[Array, "T m"] = parameter()
    dt: Float[Array, ""] = parameter()
    difference: Difference | None = function_field()

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
                f"{where}: horizon must be given, as dynamics are time-invariant."
            )
        T = check_count(steps if horizon is None else horizon, "horizon", where)
        if steps is not None:
            check_at_most(T, steps, "horizon", where, "steps of dynamics")
        given = reference, control_reference, disturbance
        signals = as_signals(dynamics, given, where)
        self.x_ref, self.u_ref, d = _along(dynamics, signals, difference, T)
        A, B = (a if steps is None else a[:T] for a in (dynamics.A, dynamics.B))
        # With the residual d of the reference the cost to go has a linear term, whose
        # share of the control is the feed-forward k.
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
    """The references at each step of the horizon, and the residuals of the state's."""

    def at(t):
        here = KnownSignals(dynamics.at(t), *signals, difference)
        return here.state(t), here.control(t), here.next_state(t)

    x_ref, u_ref, x_next = jax.vmap(at)(jnp.arange(T) * dynamics.dt)
    end = T * dynamics.dt
    # The last step needs the reference one step beyond the horizon.
    if signals[0] is not None:
        last = signals[0](end)
    elif dynamics.is_time_varying and dynamics.A.shape[0] == T:
        last = dynamics.x_next[-1]
    else:
        last = dynamics.at(end).x_ref
    targets = jnp.concatenate([x_ref[1:], last[None]])
    # d[k], by which the dynamics miss r[k+1] from r[k]: e_next = A e + B v + d.
    d = jax.vmap(lambda a, b: deviation(a, b, difference))(x_next, targets)
    return x_ref, u_ref, d
