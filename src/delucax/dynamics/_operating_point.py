"""Where a plant rests."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._check import is_concrete
from .._message import shortened
from .._results import Result, RESULTS


class OperatingPoint(eqx.Module):
    """A state and a control at which a system or dynamics rest.

    [`delucax.linearize`][] and [`delucax.controllers.LQR`][] take it as it is. Printed,
    it shows its numbers.

    **Attributes:**

    - `x`: the state, shape `(n,)`.
    - `u`: the control, shape `(m,)`.
    - `residual`: the rate of change `f(t, x, u)` of a system, or `F(t, x, u) - x` of
        dynamics; zero up to rounding where the result is a success.
    - `result`: success; `RESULTS.no_equilibrium` if the residual has a minimum that is
        not zero; `RESULTS.not_converged` or `RESULTS.diverged`.

    !!! example

        ```python
        import delucax as dlx

        pendulum = dlx.systems.Pendulum()
        point = dlx.trim(pendulum, x=[0.3, 0.0], u=[1.0], fix="angle", throw=False)
        point.u, point.residual, dlx.RESULTS[point.result]
        ```
    """

    x: Float[Array, " n"]
    u: Float[Array, " m"]
    residual: Float[Array, " r"]
    result: Result

    def __repr__(self):
        text = lambda array: str(array) if is_concrete(array) else shortened(array)
        shown = dict(x=self.x, u=self.u, residual=self.residual)
        rows = (f"    {name}={text(array)}," for name, array in shown.items())
        return "\n".join(["OperatingPoint(", *rows, f"    {self._outcome()},", ")"])

    def _outcome(self) -> str:
        good = self.result == RESULTS.successful
        if not is_concrete(good):
            return "result is traced"
        if jnp.ndim(good):
            return f"successful: {int(jnp.sum(good))} of {good.size}"
        return "successful" if good else RESULTS[self.result]
