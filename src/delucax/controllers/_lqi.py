"""The linear-quadratic regulator with integral action."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Float

from .._check import as_matrix, check_step
from .._controller import AbstractController
from .._module import function_field, parameter, weight
from ..dynamics import LinearDynamics
from ..math import matvec
from ..riccati import dare
from ._feed_forward import as_signal
from ._operating_point import (
    check_linear_state_feedback,
    check_state,
    deviation,
    Difference,
    operating_state,
)


class _Memory(NamedTuple):
    integral: Array
    asked: Array


class LQI(AbstractController):
    """The linear-quadratic regulator with integral action,

    `u = u_ref - K difference(x, x_ref) - Ki z`,
    `z[k+1] = z[k] + dt (r(t_k) - C x[k])`,

    which brings the outputs `C x` to a constant reference under any constant
    disturbance. The gains minimise the sum of `v'Q v + 2 v'S du + du'R du`, `v` being
    the deviation of the state and the integral `z`, one under the other.

    Where the control is limited, the integral is set back to the value at which what
    was really applied would have been asked for, so that it cannot wind up.

    **Arguments:**

    - `dynamics`: time-invariant linear dynamics whose operating point is an equilibrium
        and whose state is observed.
    - `Q`: weight of state and integral, shape `(n+p, n+p)`, symmetric.
    - `R`: control weight, shape `(m, m)`, symmetric.
    - `S`: cross weight, shape `(n+p, m)`; zero by default.
    - `output`: `C`, which outputs to regulate, shape `(p, n)`; as many as there are
        controls at most.
    - `reference`: r, a vector of size `p` or a function of time that returns one; the
        outputs at the operating point by default.
    - `difference`: `(x, x_ref) -> deviation`; subtraction by default. The outputs are
        those of the operating point plus `C` times the deviation.

    **Attributes:** `K` and `Ki`, the gains, trainable, shapes `(m, n)` and `(m, p)`;
    `P`, the solution of the Riccati equation, shape `(n+p, n+p)`; `x_ref` and `u_ref`,
    the operating point.

    **Raises:** `ValueError` as for [`delucax.controllers.LQR`][], or if `output` or
    `reference` does not fit; an error at run time if there is no stabilising gain, as
    where the outputs cannot be moved one without the other.

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
    """

    K: Float[Array, "m n"] = weight()
    Ki: Float[Array, "m p"] = weight()
    P: Float[Array, "n+p n+p"] = parameter()
    output: Float[Array, "p n"] = parameter()
    x_ref: Float[Array, " n"] = parameter()
    u_ref: Float[Array, " m"] = parameter()
    dt: Float[Array, ""] = parameter()
    reference: Callable[[Any], Array] | None = function_field()
    difference: Difference | None = function_field()

    def __init__(
        self,
        dynamics: LinearDynamics,
        Q: Any,
        R: Any,
        S: Any = None,
        *,
        output: Any,
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
        self.reference = as_signal(reference, p, "reference", where)
        integrals = [-dynamics.dt * C, jnp.eye(p, dtype=C.dtype)]
        A = jnp.block([[dynamics.A, jnp.zeros((n, p), C.dtype)], integrals])
        B = jnp.concatenate([dynamics.B, jnp.zeros((p, m), C.dtype)])
        solution = dare(A, B, Q, R, S)
        self.K, self.Ki, self.P = solution.K[:, :n], solution.K[:, n:], solution.X

    def __check_init__(self):
        check_step(self.dt, "LQI")
        as_signal(self.reference, self.Ki.shape[1], "reference", "LQI")

    def init(self, *, key=None):
        dtype = jnp.result_type(self.K, self.Ki)
        m, p = self.Ki.shape
        return _Memory(jnp.zeros(p, dtype), jnp.zeros(m, dtype))

    def __call__(self, t, y, state):
        check_state(self, y, self.x_ref.shape[0])
        dx = deviation(y, self.x_ref, self.difference)
        error = -matvec(self.output, dx)
        if self.reference is not None:
            error = error + self.reference(t) - matvec(self.output, self.x_ref)
        u = self.u_ref - matvec(self.K, dx) - matvec(self.Ki, state.integral)
        integral = state.integral + self.dt * error
        dtype = state.integral.dtype
        after = _Memory(integral.astype(dtype), u.astype(dtype))
        return u.astype(y.dtype), after

    def applied(self, u, cost, state):
        # The least change of the integral that would have asked for this control.
        excess = state.asked - u.astype(state.asked.dtype)
        gain = lx.MatrixLinearOperator(self.Ki)
        solver = lx.AutoLinearSolver(well_posed=None)
        change = lx.linear_solve(gain, excess, solver, throw=False).value
        limited = jnp.any(excess != 0)
        integral = jnp.where(limited, state.integral + change, state.integral)
        return state._replace(integral=integral)
