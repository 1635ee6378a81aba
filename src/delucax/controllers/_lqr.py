"""Linear-quadratic regulators over an infinite horizon."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.lax as lax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Float, PyTree

from .._check import as_matrix, check_count, check_instance, check_step
from .._controller import AbstractController
from .._jax import host_unless_traced, xp
from .._module import as_float_array, function_field, parameter, weight
from .._typing import Array, Difference, Numbers, PRNGKey, RealScalar
from ..dynamics import AbstractDynamics, LinearDynamics, OperatingPoint
from ..math import matvec
from ..math._linear_solve import solve
from ..riccati import dare
from ._feed_forward import as_signal, as_signals, KnownSignals, Preview
from ._operating_point import (
    check_linear_state_feedback,
    check_state,
    deviation,
    linear_at,
    operating_state,
)


class LQR(AbstractController):
    r"""The infinite-horizon linear-quadratic regulator about an operating point.

    $$u = u_\mathrm{ref} - K\, \delta x, \qquad
    \delta x = \mathrm{difference}(x, x_\mathrm{ref})$$

    On the linear dynamics it minimises the sum over all time of

    $$\delta x^\top Q\, \delta x + 2\, \delta x^\top S\, \delta u +
    \delta u^\top R\, \delta u$$

    where $\delta x$ and $\delta u$ are the deviations from the operating point. The
    minimal cost from a deviation $\delta x$ is $\delta x^\top P\, \delta x$. Under
    white noise of unit covariance on the state, the average cost per step is
    $\operatorname{tr} P$.

    With a `reference` $r(t)$, a `control_reference` $u_r(t)$ or a known `disturbance`
    $w(t)$, the cost charges deviations from $r$ and $u_r$, and the regulator adds a
    feed-forward control:

    $$u_k = u_{r,k} - K\, \mathrm{difference}(x_k, r_k) -
    (R + B^\top P B)^{-1} B^\top \sum_{j \ge 0} ((A - B K)^\top)^j P\, d_{k+j}$$

    Here $F$ is one step of the linear dynamics. A plant that is at the reference $r_k$
    misses the next reference $r_{k+1}$ by $d_k = F(r_k, u_{r,k}, w_k) - r_{k+1}$. The
    feed-forward control is optimal if the reference and the other two signals are known
    for the next `preview` steps and are constant after these steps. The state reaches a
    constant reference $r$ exactly only if $u_r$ is the control that holds the plant at
    $r$, because the cost penalises any other control. [`delucax.controllers.LQI`][]
    reaches a constant reference without knowing $u_r$.

    **Arguments:**

    - `dynamics`: time-invariant linear dynamics whose operating point is an equilibrium
        and whose state is observed, for example from [`delucax.linearize`][]; or any
        dynamics, if you give a `point`. The change of the state in one step from this
        equilibrium must be below 1e-4 times
        $|A - I|\,|x_\mathrm{ref}| + |B|\,|u_\mathrm{ref}|$.
    - `Q`: state weight, shape `(n, n)`, symmetric.
    - `R`: control weight, shape `(m, m)`, symmetric.
    - `S`: cross weight, shape `(n, m)`; zero by default.
    - `reference`: $r$, the state to follow, a vector of shape `(n,)` or a function of
        time; the operating point by default.
    - `control_reference`: $u_r$, the control at which the control cost is zero, a
        vector of shape `(m,)` or a function of time; the control of the operating point
        by default.
    - `disturbance`: $w$, a disturbance known in advance, a vector of shape `(k,)` or a
        function of time; none by default.
    - `preview`: the number of future steps for which the controller knows `reference`,
        `control_reference` and `disturbance`, 0 by default.
    - `difference`: a function `(x, x_ref) -> deviation` that wraps angles, for example
        the `difference` of the system that you linearised. By default the deviation is
        `x - x_ref`, except if you give nonlinear `dynamics` and a `point`: then the
        default is `dynamics.difference`.
    - `point`: the [`delucax.dynamics.OperatingPoint`][] about which to linearise
        `dynamics` at time 0, from [`delucax.trim`][]. Without it, `dynamics` must be
        linear.

    **Attributes:** `K`, the gain, trainable, shape `(m, n)`; `P`, the solution of the
    Riccati equation, shape `(n, n)`; `x_ref` and `u_ref`, the operating point.

    **Raises:** `ValueError` if `dynamics` is not linear, is time-varying, does not rest
    at its operating point or does not observe its state, or if a weight or signal has
    the wrong shape; an error at run time if there is no stabilising gain.

    Source: Kalman, 1960; Anderson and Moore, 1990 (tracking).

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        env = dlx.make("pendulum")
        upright = dlx.linearize(env.dynamics)
        regulator = dlx.controllers.LQR(
            upright, jnp.eye(2), jnp.eye(1), difference=env.dynamics.difference
        )
        x0 = jnp.array([0.1, 0.0])
        dlx.rollout(env, regulator, key=jax.random.key(0), x0=x0).total_cost
        ```

        ```text
        Array(0.0881, dtype=float32)
        ```
    """

    K: Float[Array, "m n"] = weight()
    P: Float[Array, "n n"] = parameter()
    x_ref: Float[Array, " n"] = parameter()
    u_ref: Float[Array, " m"] = parameter()
    difference: Difference | None = function_field(of="a, b")
    feed_forward: Preview | None

    def __init__(
        self,
        dynamics: AbstractDynamics,
        Q: Numbers,
        R: Numbers,
        S: Numbers | None = None,
        *,
        reference: Any = None,
        control_reference: Any = None,
        disturbance: Any = None,
        preview: int = 0,
        difference: Difference | None = None,
        point: OperatingPoint | None = None,
    ):
        where = "LQR"
        if point is not None:
            hint = (
                " if point is given (sample a system with `delucax.Discretized`, or "
                "use `delucax.controllers.lqrd`)"
            )
            check_instance(dynamics, AbstractDynamics, "dynamics", where, hint)
        linear, difference = linear_at(dynamics, point, difference, where)
        check_linear_state_feedback(linear, where, time_invariant=True)
        self.x_ref = operating_state(linear, difference, where)
        self.u_ref, self.difference = linear.u_ref, difference
        given = reference, control_reference, disturbance
        given = as_signals(linear, given, where)
        is_known = any(signal is not None for signal in given)
        preview = check_count(preview, "preview", where, least=0)
        if preview and not is_known:
            raise ValueError(
                f"{where}: preview must be 0 without a reference, control_reference or "
                f"disturbance, got {preview}."
            )
        # K = (R + B'PB)^-1 (B'PA + S'), for u = -K x: the minus is not in K.
        solution = dare(linear.A, linear.B, Q, R, S)
        self.K, self.P, self.feed_forward = solution.K, solution.X, None
        if is_known:
            P = solution.X
            M = _effect(as_float_array(R), linear.B, P)
            signals = KnownSignals(linear, *given, difference)
            self.feed_forward = Preview(signals, P, M, solution.closed_loop, preview)

    def __check_init__(self):
        if self.feed_forward is None:
            return
        m, n = self.K.shape
        shapes = self.feed_forward.M.shape, self.feed_forward.signals.dynamics.B.shape
        if shapes != ((m, n), (n, m)):
            raise ValueError(
                f"LQR: feed_forward must fit K, for {n} states and {m} controls, got "
                f"feed_forward.M of shape {shapes[0]} and "
                f"feed_forward.signals.dynamics.B of shape {shapes[1]}."
            )
        known = self.feed_forward.signals
        given = known.reference, known.control_reference, known.disturbance
        as_signals(known.dynamics, given, "LQR")

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        check_state(self, y, self.x_ref.shape[0])
        x_ref, u_ref = self.x_ref, self.u_ref
        if self.feed_forward is not None:
            signals = self.feed_forward.signals
            x_ref = signals.state(t)
            # Plus: the feed-forward includes its minus.
            u_ref = signals.control(t) + self.feed_forward(t)
        u = u_ref - matvec(self.K, deviation(y, x_ref, self.difference))
        return u.astype(y.dtype), state


class _Memory(NamedTuple):
    integral: Array
    asked: Array


class LQI(AbstractController):
    r"""The linear-quadratic regulator with integral action.

    $$u_k = u_\mathrm{ref} - K\, \mathrm{difference}(x_k, x_\mathrm{ref}) - K_i z_k,
    \qquad z_{k+1} = z_k + \Delta t\, (r(t_k) - C x_k)$$

    The controller brings the outputs $C x$ to a constant reference $r$ under any
    constant disturbance. The gains minimise the sum over all time of

    $$v^\top Q v + 2\, v^\top S\, \delta u + \delta u^\top R\, \delta u$$

    where the vector $v$ consists of the deviation of the state, followed by the
    integral $z$.

    If the applied control differs from the control that the regulator computed, for
    example because of clipping, then back-calculation sets the integral to the value
    that would have given the applied control. So the integral does not wind up when the
    control is clipped.

    **Arguments:**

    - `dynamics`: time-invariant linear dynamics whose operating point is an equilibrium
        and whose state is observed.
    - `Q`: weight of state and integral, shape `(n+p, n+p)`, symmetric.
    - `R`: control weight, shape `(m, m)`, symmetric.
    - `S`: cross weight, shape `(n+p, m)`; zero by default.
    - `output`: $C$, the map from the state to the regulated outputs, shape `(p, n)`.
        The number of outputs must not exceed the number of controls.
    - `reference`: $r$, a vector of shape `(p,)` or a function of time that returns such
        a vector; the outputs at the operating point by default.
    - `difference`: a function `(x, x_ref) -> deviation`, for example to wrap angles;
        subtraction by default. The controller computes the outputs as `C x_ref` plus
        $C$ times this deviation.

    **Attributes:** `K` and `Ki`, the gains, trainable, shapes `(m, n)` and `(m, p)`;
    `P`, the solution of the Riccati equation, shape `(n+p, n+p)`; `x_ref` and `u_ref`,
    the operating point.

    **Raises:** `ValueError` for the same reasons as [`delucax.controllers.LQR`][], or
    if `output` or `reference` has the wrong shape; an error at run time if there is no
    stabilising gain, for example because the controls cannot move the outputs
    independently.

    Source: Young and Willems, 1972.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[1.0, 0.1], [0.0, 1.0]])
        B = jnp.array([[0.0], [0.1]])
        position = jnp.array([[1.0, 0.0]])
        controller = dlx.controllers.LQI(
            dlx.LinearDynamics(A, B, dt=0.1),
            jnp.eye(3),
            jnp.eye(1),
            output=position,
            reference=jnp.array([2.0]),
        )
        controller.K, controller.Ki
        ```

        ```text
        (Array([[2.275, 2.364]], dtype=float32), Array([[-0.886]], dtype=float32))
        ```
    """

    K: Float[Array, "m n"] = weight()
    Ki: Float[Array, "m p"] = weight()
    P: Float[Array, "n+p n+p"] = parameter()
    output: Float[Array, "p n"] = parameter()
    x_ref: Float[Array, " n"] = parameter()
    u_ref: Float[Array, " m"] = parameter()
    dt: Float[Array, ""] = parameter()
    reference: Callable[[Any], Array] | None = function_field(of="t")
    difference: Difference | None = function_field(of="a, b")

    def __init__(
        self,
        dynamics: LinearDynamics,
        Q: Numbers,
        R: Numbers,
        S: Numbers | None = None,
        *,
        output: Numbers,
        reference: Any = None,
        difference: Difference | None = None,
    ):
        where = "LQI"
        check_linear_state_feedback(dynamics, where, time_invariant=True)
        n, m = dynamics.B.shape
        C = as_matrix(output, "output", where)
        p = C.shape[0]
        if C.shape != (p, n) or not 1 <= p <= m:
            raise ValueError(
                f"{where}: output must have shape (p, {n}) with p from 1 to {m}, the "
                f"number of controls, got {C.shape}."
            )
        self.x_ref = operating_state(dynamics, difference, where)
        self.u_ref, self.dt, self.difference = dynamics.u_ref, dynamics.dt, difference
        self.output = C.astype(dynamics.A.dtype)
        self.reference = as_signal(where, reference, p, "reference")
        model = dynamics.A, dynamics.B, C, dynamics.dt
        self.K, self.Ki, self.P = _with_integral(*model, Q, R, S)

    def __check_init__(self):
        check_step(self.dt, "LQI")
        as_signal("LQI", self.reference, self.Ki.shape[1], "reference")

    def init(self, *, key: PRNGKey | None = None) -> PyTree:
        dtype = jnp.result_type(self.K, self.Ki)
        m, p = self.Ki.shape
        return _Memory(jnp.zeros(p, dtype), jnp.zeros(m, dtype))

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        check_state(self, y, self.x_ref.shape[0])
        dx = deviation(y, self.x_ref, self.difference)
        # r - C x with x = x_ref + dx. Without a reference, r = C x_ref, which cancels.
        error = -matvec(self.output, dx)
        if self.reference is not None:
            error = error + self.reference(t) - matvec(self.output, self.x_ref)
        u = self.u_ref - matvec(self.K, dx) - matvec(self.Ki, state.integral)
        # After u: the gains are designed for u[k] as a function of z[k].
        integral = state.integral + self.dt * error
        dtype = state.integral.dtype
        after = _Memory(integral.astype(dtype), u.astype(dtype))
        return u.astype(y.dtype), after

    def applied(self, u: Array, cost: Array, state: PyTree) -> PyTree:
        # Back-calculation in one step: the smallest change dz of the integral with
        # Ki dz = asked - applied.
        excess = state.asked - u.astype(state.asked.dtype)
        gain = lx.MatrixLinearOperator(self.Ki)
        # Ki is tall if there are fewer outputs than controls: least squares.
        solver = lx.AutoLinearSolver(well_posed=None)
        change = lx.linear_solve(gain, excess, solver, throw=False).value
        # Without an excess the change is zero, but its derivative is not.
        still = change - lax.stop_gradient(change)
        still = jnp.where(jnp.isfinite(change), still, 0)
        change = jnp.where(jnp.any(excess != 0), change, still)
        return state._replace(integral=state.integral + change)


@host_unless_traced
def _effect(R, B, P) -> Array:
    """The map `(R + B'PB)^-1 B'` from a gradient of the cost to go to a control."""
    return solve(R.astype(P.dtype) + B.T @ P @ B, B.T)


@host_unless_traced
def _with_integral(A, B, C, dt, Q, R, S) -> tuple[Array, Array, Array]:
    """The gains of state and integral, and the solution of the Riccati equation."""
    (n, m), p = B.shape, len(C)
    # The design needs no reference: it drops out of z_next = z - dt C dx.
    integrals = [-dt * C, xp.eye(p, dtype=C.dtype)]
    A = xp.block([[A, xp.zeros((n, p), C.dtype)], integrals])
    B = xp.concatenate([B, xp.zeros((p, m), C.dtype)])
    # z integrates r - C x. Textbooks that integrate C x - r (Åström and Murray, 2008)
    # have the other sign of Ki.
    solution = dare(A, B, Q, R, S)
    return solution.K[:, :n], solution.K[:, n:], solution.X
