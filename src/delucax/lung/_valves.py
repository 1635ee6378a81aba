"""What a ventilator moves air with."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._check import check_range
from .._module import check_parameters, parameter, positive


class Valves(eqx.Module):
    r"""A proportional valve that lets air in, and one that lets it out to PEEP.

    The flow that the first settles at is a smooth S-curve of its opening `u_in` [%],
    with `z(u) = sigmoid(steepness (u - midpoint))`:

    `flow(u_in) = max_flow (z(u_in) - z(0)) / (z(100) - z(0))`,

    which is 0 when closed and `max_flow` when fully open, whatever the pressure behind
    it (the supply is far above that of the airway). Both valves follow what they are
    asked for through a first-order lag:

    `lag d(inflow)/dt = flow(u_in) - inflow`,
    `expiratory_lag d(opening)/dt = u_out - opening`.

    Out goes `max(opening, 0) (p - peep) / expiratory_resistance`, and through a leak
    `leak p`. Smooth but for an opening of 0, which the lag approaches and does not
    cross.

    **Arguments:**

    - `max_flow`: [L/s], 3 by default.
    - `steepness`: of the curve [1/%], 0.06 by default.
    - `midpoint`: of the curve [%], 45 by default.
    - `lag`: of the inspiratory valve [s], 0.05 by default.
    - `expiratory_lag`: of the expiratory valve [s], 0.02 by default.
    - `expiratory_resistance`: of the valve when fully open [cmH2O s/L], 5 by default.
    - `peep`: the pressure behind the expiratory valve [cmH2O], 5 by default.
    - `leak`: conductance to the room [L/s/cmH2O], 0 by default.

    **Raises:** `ValueError` if a number is not positive, or `peep` or `leak` is
    negative.

    !!! example

        ```python
        from delucax.lung import Valves

        Valves(max_flow=2.0).flow(50.0)
        ```
    """

    max_flow: Array = parameter(3.0, constraint=positive)
    steepness: Array = parameter(0.06, constraint=positive)
    midpoint: Array = parameter(45.0)
    lag: Array = parameter(0.05, constraint=positive)
    expiratory_lag: Array = parameter(0.02, constraint=positive)
    expiratory_resistance: Array = parameter(5.0, constraint=positive)
    peep: Array = parameter(5.0)
    leak: Array = parameter(0.0)

    def __check_init__(self):
        check_parameters(self)
        check_range(self.peep, "peep", "Valves")
        check_range(self.leak, "leak", "Valves")

    def flow(self, u_in: Any) -> Array:
        """What the inspiratory valve settles at.

        **Arguments:** `u_in`: its opening [%].

        **Returns:** the flow [L/s], of the shape of `u_in`.
        """
        curve = lambda u: jax.nn.sigmoid(self.steepness * (u - self.midpoint))  # noqa: E731
        closed = curve(0.0)
        return self.max_flow * (curve(u_in) - closed) / (curve(100.0) - closed)

    def slopes(self, inflow: Array, opening: Array, u: Array) -> tuple[Array, Array]:
        """How fast both valves move.

        **Arguments:**

        - `inflow`: what flows in now [L/s].
        - `opening`: of the expiratory valve now, from 0 to 1.
        - `u`: the control `(u_in, u_out)`.

        **Returns:** the time derivatives of `inflow` and `opening`.
        """
        filling = (self.flow(u[0]) - inflow) / self.lag
        return filling, (u[1] - opening) / self.expiratory_lag

    def airway_pressure(
        self, inflow: Array, opening: Array, resistance: Array, pressure: Array
    ) -> Array:
        """The pressure between the valves and a lung, by the balance of the flows,

        `inflow = (p - pressure) / resistance + opening (p - peep) /
        expiratory_resistance + leak p`.

        **Arguments:**

        - `inflow`: [L/s].
        - `opening`: of the expiratory valve, from 0 to 1.
        - `resistance`: of the way into the lung [cmH2O s/L].
        - `pressure`: inside the lung [cmH2O].

        **Returns:** `p` [cmH2O].
        """
        out = self._conductance(opening)
        flows = inflow + pressure / resistance + out * self.peep
        return flows / (1 / resistance + out + self.leak)

    def outflow(self, opening: Array, pressure: Array) -> Array:
        """What goes out by the expiratory valve and the leak.

        **Arguments:**

        - `opening`: of the expiratory valve, from 0 to 1.
        - `pressure`: of the airway [cmH2O].

        **Returns:** the flow [L/s].
        """
        out = self._conductance(opening) * (pressure - self.peep)
        return jnp.asarray(out + self.leak * pressure)

    def _conductance(self, opening: Array) -> Array:
        """Of the expiratory valve. A solver may look at an opening below 0, where the
        balance of the flows would be singular; the slope at 0 is that to the right."""
        return jnp.where(opening < 0, 0, opening) / self.expiratory_resistance
