"""A stirred tank in which a reaction gives off heat."""

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._check import is_concrete
from .._message import shortened
from .._module import parameter, positive
from .._typing import Control, Disturbance, State, Time
from ._base import AbstractSystem


class CSTR(AbstractSystem):
    r"""The continuous stirred-tank reactor: a reactant flows in, reacts in a tank that
    is stirred, and gives off heat, which a jacket takes away,

    `dc/dt = flow (c_feed - c) - r`,
    `dT/dt = flow (T_feed - T) + heat r + cooling (T_coolant - T)`,

    with `r = rate exp(-activation / T) c`. Time is in minutes.

    The state is (concentration [mol/l], temperature [K]), the control is (coolant [K]),
    the temperature of the jacket.

    With the numbers below it can rest at half the feed's concentration, but not by
    itself: a little warmer, it reacts faster and gets warmer still. There the poles are
    2.83 and -0.45 a minute.

    **Arguments:**

    - `flow`: of the feed over the volume, q/V [1/min], 1 by default.
    - `feed_concentration`: of the reactant in the feed [mol/l], 1 by default.
    - `feed_temperature`: [K], 350 by default.
    - `rate`: k0, of the reaction at infinite temperature [1/min], 7.2e10 by default.
    - `activation`: the activation energy over the gas constant, E/R [K], 8750 by
        default.
    - `heat`: by how much the tank warms a mole that reacts in a litre [K l/mol], 209.2
        by default.
    - `cooling`: heat conducted to the jacket, over the capacity of the tank [1/min],
        2.092 by default.

    **Raises:** `ValueError` if a number is not positive.

    Source: Hicks and Ray, 1971; Henson and Seborg, 1997 (these numbers).

    !!! example

        ```python
        import delucax as dlx

        reactor = dlx.systems.CSTR()
        x, u = reactor.equilibrium(concentration=0.5)
        reactor.vector_field(0.0, x, u, None)
        ```
    """

    flow: Array = parameter(1.0, constraint=positive)
    feed_concentration: Array = parameter(1.0, constraint=positive)
    feed_temperature: Array = parameter(350.0, constraint=positive)
    rate: Array = parameter(7.2e10, constraint=positive)
    activation: Array = parameter(8750.0, constraint=positive)
    heat: Array = parameter(209.2, constraint=positive)
    cooling: Array = parameter(2.092, constraint=positive)

    state_names: ClassVar = ("concentration", "temperature")
    control_names: ClassVar = ("coolant",)
    state_units: ClassVar = ("mol/l", "K")
    time_unit: ClassVar = "min"
    control_units: ClassVar = ("K",)

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        c, T = x[0], x[1]
        # Nothing reacts near absolute zero, below which a solver's stage may be.
        reaction = self.rate * jnp.exp(-self.activation / jnp.maximum(T, 1.0)) * c
        dc = self.flow * (self.feed_concentration - c) - reaction
        warming = self.flow * (self.feed_temperature - T) + self.heat * reaction
        return jnp.stack([dc, warming + self.cooling * (u[0] - T)])

    def equilibrium(self, concentration: Any = 0.5) -> tuple[State, Control]:
        """Where the coolant holds the tank at a concentration.

        **Arguments:** `concentration`: of the reactant, between 0 and that of the feed
        [mol/l]; 0.5 by default.

        **Returns:** `(x, u)`.

        **Raises:** `ValueError` if `concentration` is not between these.
        """
        c, feed = jnp.asarray(concentration, float), self.feed_concentration
        if is_concrete(c) and is_concrete(feed):
            at, most = np.asarray(c), np.asarray(feed)
            if not np.all((at > 0) & (at < most)):
                raise ValueError(
                    "CSTR: concentration must be above 0 and below feed_concentration, "
                    f"{shortened(most)}, got {shortened(at)}."
                )
        reaction = self.flow * (feed - c)
        T = self.activation / jnp.log(self.rate * c / reaction)
        warming = self.flow * (self.feed_temperature - T) + self.heat * reaction
        return jnp.stack([c, T]), jnp.stack([T - warming / self.cooling])
