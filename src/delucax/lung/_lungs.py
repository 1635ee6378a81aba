"""Lungs behind a ventilator, as differential equations."""

import abc
from typing import Any, ClassVar, TYPE_CHECKING

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .._check import is_concrete
from .._jax import host_unless_traced, xp
from .._module import bounded, parameter, positive
from .._typing import (
    Array,
    Control,
    Disturbance,
    Observation,
    Real,
    RealScalar,
    Scalar,
    State,
    Time,
)
from ..systems import AbstractSystem
from ._ventilation import Valves


PER_ML = 1e-3


class AbstractLung(AbstractSystem):
    """The base class of lungs that are ventilated through [`delucax.lung.Valves`][].

    The sensor reads the pressure of the airway [cmH2O]. The control is `(u_in, u_out)`:
    the opening of the inspiratory valve, from 0 to 100 %, and the opening of the
    expiratory valve, from 0 to 1.

    !!! example

        ```python
        import jax.numpy as jnp
        from delucax import lung

        class Rigid(lung.AbstractLung):
            state_names = ("pressure",)

            def pressure(self, x):
                return x[0]

            def resting(self, pressure):
                return jnp.reshape(pressure, (1,))

            def vector_field(self, t, x, u, w):
                return 0.1 * u[:1]

        lung.LungModel(Rigid()).resting()
        ```

        ```text
        Array([5., 5., 5.], dtype=float32)
        ```
    """

    control_names: ClassVar = ("u_in", "u_out")
    control_units: ClassVar = ("%", "")

    @abc.abstractmethod
    def pressure(self, x: State) -> Scalar:
        """The pressure of the airway.

        **Arguments:** `x`: state, shape `(n,)`.

        **Returns:** a scalar [cmH2O].
        """

    @abc.abstractmethod
    def resting(self, pressure: RealScalar) -> State:
        """The state of a lung at rest at a given pressure, with both valves closed.

        **Arguments:** `pressure`: the pressure everywhere [cmH2O].

        **Returns:** the state, shape `(n,)`.
        """

    def observe(self, t: Time, x: State) -> Observation:
        return jnp.reshape(self.pressure(x), (1,))


class _AbstractRigidPipe(AbstractLung):
    """A lung behind a rigid airway. The pressure of the airway balances the flows of
    the valves and of the lung. The state begins with the inflow and the opening."""

    if TYPE_CHECKING:  # pyright mistakes an AbstractVar for the first argument
        resistance: ClassVar[Any]
        valves: ClassVar[Any]
    else:
        resistance: eqx.AbstractVar[Array]
        valves: eqx.AbstractVar[Valves]

    @abc.abstractmethod
    def _inside(self, x: State) -> Array:
        """The pressure behind the resistance [cmH2O]."""

    def pressure(self, x: State) -> Scalar:
        inside = self._inside(x)
        return self.valves.airway_pressure(x[0], x[1], self.resistance, inside)


class _AbstractCompartment(_AbstractRigidPipe):
    r"""One elastic volume behind one resistance, $\dot V = (p - P(V)) / R$."""

    state_names: ClassVar = ("inflow", "opening", "volume")
    state_units: ClassVar = ("L/s", "", "L")

    @abc.abstractmethod
    def elastic_pressure(self, volume: Array) -> Array:
        """The pressure $P(V)$ in the lung.

        **Arguments:** `volume`: $V$ [L].

        **Returns:** the pressure [cmH2O].
        """

    @abc.abstractmethod
    def _volume(self, pressure: RealScalar) -> Scalar:
        """The volume at which the elastic pressure is `pressure`."""

    def _inside(self, x: State) -> Array:
        return self.elastic_pressure(x[2])

    @host_unless_traced
    def resting(self, pressure: RealScalar) -> State:
        volume = self._volume(pressure)
        return xp.stack([0 * volume, 0 * volume, volume])

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        inflow, opening = self.valves.derivatives(x[0], x[1], u)
        filling = (self.pressure(x) - self._inside(x)) / self.resistance
        return jnp.stack([inflow, opening, filling])


class SingleCompartment(_AbstractCompartment):
    r"""A lung of one elastic compartment behind one resistance.

    $$\dot V = \frac{p - V / C}{R}$$

    The pressure $p$ of the airway follows from the balance of the flows through the
    valves and into the lung; see [`delucax.lung.Valves.airway_pressure`][]. The state
    is (inflow [L/s], opening, volume $V$ [L]). The vector field is not smooth at an
    opening of 0.

    For constant controls, the steady pressure depends on the expiratory valve. If the
    expiratory valve is closed and there is a leak $G$, the pressure settles at
    $q(u_\mathrm{in}) / G$, where $q$ is the flow of the inspiratory valve. If the
    expiratory valve is open and there is no leak, the pressure settles at
    `peep + flow(u_in) * expiratory_resistance`.

    **Arguments:**

    - `resistance`: $R$ [cmH2O s/L], 20 by default.
    - `compliance`: $C$ [mL/cmH2O], 20 by default.
    - `valves`: a [`delucax.lung.Valves`][]; `Valves()` by default.

    **Raises:** `ValueError` if a number is not positive.

    Source: Bates, 2009 (the linear single-compartment model).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp
        from delucax.lung import SingleCompartment

        lung = SingleCompartment(resistance=50.0, compliance=10.0)
        dynamics = dlx.Discretized(lung, dt=0.03)
        dlx.open_loop(dynamics, lung.resting(5.0), jnp.array([[30.0, 0.0]] * 5))[-1]
        ```

        ```text
        Array([0.715, 0.   , 0.127], dtype=float32)
        ```
    """

    resistance: Real = parameter(20.0, constraint=positive)
    compliance: Real = parameter(20.0, constraint=positive)
    valves: Valves = Valves()

    def elastic_pressure(self, volume: Array) -> Array:
        return volume / (PER_ML * self.compliance)

    def _volume(self, pressure: RealScalar) -> Scalar:
        return PER_ML * self.compliance * pressure


class DoubleCompartment(_AbstractRigidPipe):
    r"""A lung of two elastic compartments side by side, a fast and a slow one.

    $$\dot V_i = \frac{p_c - V_i / C_i}{R_i}, \qquad
    p_c = p - R_0 (\dot V_1 + \dot V_2)$$

    The central airway has the resistance $R_0 = c R$, where $c$ is the argument
    `central`. The two branches in parallel have the rest of the resistance $R$, so
    $1 / (1 / R_1 + 1 / R_2) = (1 - c) R$, and the ratio $R_2 / R_1$ is the argument
    `imbalance`. The compliances of the compartments are $C_1 = s C$ and
    $C_2 = (1 - s) C$, where $s$ is the argument `share`. So $R$ is the resistance at
    high frequencies, and $C$ is the static compliance. The state is (inflow [L/s],
    opening, fast volume $V_1$ [L], slow volume $V_2$ [L]). The vector field is not
    smooth at an opening of 0.

    **Arguments:**

    - `resistance`: $R$, the resistance of the whole lung at high frequencies
        [cmH2O s/L], 20 by default.
    - `compliance`: $C$, the compliance of the whole lung [mL/cmH2O], 20 by default.
    - `central`: the share of the resistance $R$ that lies in the airway common to both
        compartments, 0.3 by default.
    - `share`: the share of $C$ in the fast compartment, 0.1 by default.
    - `imbalance`: $R_2 / R_1$, the ratio of the resistances of the slow and the fast
        branch, 10 by default.
    - `valves`: a [`delucax.lung.Valves`][]; `Valves()` by default.

    **Raises:** `ValueError` if a number is not positive, or a share is not between 0
    and 1.

    Source: Otis, McKerrow, Bartlett, Mead, McIlroy, Selverstone and Radford, 1956.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp
        from delucax.lung import DoubleCompartment

        lung = DoubleCompartment(resistance=50.0, compliance=10.0)
        dynamics = dlx.Discretized(lung, dt=0.03)
        dlx.open_loop(dynamics, lung.resting(5.0), jnp.array([[30.0, 0.0]] * 5))[-1]
        ```

        ```text
        Array([0.715, 0.   , 0.066, 0.061], dtype=float32)
        ```
    """

    resistance: Real = parameter(20.0, constraint=positive)
    compliance: Real = parameter(20.0, constraint=positive)
    central: Real = parameter(0.3, constraint=bounded(0, 1))
    share: Real = parameter(0.1, constraint=bounded(0, 1))
    imbalance: Real = parameter(10.0, constraint=positive)
    valves: Valves = Valves()

    state_names: ClassVar = ("inflow", "opening", "fast", "slow")
    state_units: ClassVar = ("L/s", "", "L", "L")

    def _parts(self, x: State) -> tuple[Array, Array, Array, Array, Array]:
        """The conductances of both branches, the pressures in both compartments, and
        the pressure in the equivalent single compartment."""
        # From 1 / (1 / R_1 + 1 / R_2) = parallel and R_2 = imbalance R_1.
        parallel = (1 - self.central) * self.resistance
        fast = self.imbalance / ((1 + self.imbalance) * parallel)
        slow = 1 / ((1 + self.imbalance) * parallel)
        whole = PER_ML * self.compliance
        p1, p2 = x[2] / (self.share * whole), x[3] / ((1 - self.share) * whole)
        return fast, slow, p1, p2, (fast * p1 + slow * p2) / (fast + slow)

    def _inside(self, x: State) -> Array:
        return self._parts(x)[-1]

    @host_unless_traced
    def resting(self, pressure: RealScalar) -> State:
        volume = PER_ML * self.compliance * pressure
        fast, slow = self.share * volume, (1 - self.share) * volume
        return xp.stack([0 * volume, 0 * volume, fast, slow])

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        inflow, opening = self.valves.derivatives(x[0], x[1], u)
        fast, slow, p1, p2, inside = self._parts(x)
        total = (self.pressure(x) - inside) / self.resistance
        # p_c, where the central resistance ends and the branches begin.
        centre = inside + (1 - self.central) * self.resistance * total
        return jnp.stack([inflow, opening, fast * (centre - p1), slow * (centre - p2)])


def balloon_pressure(volume: Array, rest: Array, stiffness: Array) -> Array:
    """The pressure in a balloon; see `BalloonLung`. It is constant below a tenth of the
    volume at rest."""
    # In an empty balloon the pressure and its slope would be minus infinity.
    volume = xp.maximum(volume, 0.1 * rest)
    radius = (3 * volume / (4 * np.pi)) ** (1 / 3)
    unstretched = (3 * rest / (4 * np.pi)) ** (1 / 3)
    return stiffness * (1 - (rest / volume) ** 2) / (unstretched**2 * radius)


class BalloonLung(_AbstractCompartment):
    r"""A lung that behaves like a balloon, filled through a flow resistance.

    $$\dot V = \frac{p - P(V)}{R}, \qquad
    P(V) = \frac{k}{r_0^2 r} \left(1 - \left(\frac{r_0}{r}\right)^6\right)$$

    Here $r$ is the radius of a sphere of volume $V$, and $r_0$ is the radius of a
    sphere of volume $V_0$. As the balloon fills, the pressure rises, is greatest at
    $V = 2.65 \, V_0$, and then falls. Below $V_0 / 10$ the pressure is constant. The
    state is (inflow [L/s], opening, volume $V$ [L]). The vector field is not smooth at
    an opening of 0 and at $V = V_0 / 10$.

    **Arguments:**

    - `resistance`: $R$ [cmH2O s/L], 20 by default.
    - `stiffness`: $k$ [cmH2O L], 40 by default. With the default values of `stiffness`
        and `rest`, the pressure of the balloon is at most 69 cmH2O.
    - `rest`: $V_0$, the volume at which the pressure of the balloon is zero [L], 1.5 by
        default.
    - `valves`: a [`delucax.lung.Valves`][]; `Valves()` by default.

    **Raises:** `ValueError` if a number is not positive.

    Source: Gradu, Hallman, Suo, Yu, Agarwal, Ghai, Singh, Zhang, Majumdar and Hazan,
    2021 (Deluca).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp
        from delucax.lung import BalloonLung

        lung = BalloonLung(resistance=10.0)
        dynamics = dlx.Discretized(lung, dt=0.03)
        dlx.open_loop(dynamics, lung.resting(5.0), jnp.array([[30.0, 0.0]] * 5))[-1]
        ```

        ```text
        Array([0.715, 0.   , 1.612], dtype=float32)
        ```
    """

    resistance: Real = parameter(20.0, constraint=positive)
    stiffness: Real = parameter(40.0, constraint=positive)
    rest: Real = parameter(1.5, constraint=positive)
    valves: Valves = Valves()

    def elastic_pressure(self, volume: Array) -> Array:
        return balloon_pressure(volume, self.rest, self.stiffness)

    def _volume(self, pressure: RealScalar) -> Scalar:
        return _stretched(self.rest, self.stiffness, pressure)


class DelayLung(AbstractLung):
    r"""A lung that behaves like a balloon, at the end of an elastic pipe.

    $$C_p \dot p = q_\mathrm{in} - \frac{p - P(V)}{R} - q_\mathrm{out}, \qquad
    \dot V = \frac{p - P(V)}{R}$$

    The elastic pressure $P(V)$ is the same as in [`delucax.lung.BalloonLung`][]. The
    pipe stores air, so the pressure $p$ in the pipe is one of the states. The sensor
    reads this pressure. The state is (inflow $q_\mathrm{in}$ [L/s], opening, pipe
    pressure $p$ [cmH2O], volume $V$ [L]). This system has no transport delay. The task
    `lung/delay_lung` adds the delay with [`delucax.dynamics.Delayed`][].

    **Arguments:**

    - `resistance`: $R$ [cmH2O s/L], 20 by default.
    - `stiffness`: the stiffness of the balloon [cmH2O L], 40 by default.
    - `rest`: the volume at which the pressure of the balloon is zero [L], 1.5 by
        default.
    - `pipe`: $C_p$, the compliance of the pipe [mL/cmH2O], 5 by default.
    - `valves`: a [`delucax.lung.Valves`][]; `Valves()` by default.

    **Raises:** `ValueError` if a number is not positive.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp
        from delucax.lung import DelayLung

        lung = DelayLung()
        late = dlx.dynamics.Delayed(dlx.Discretized(lung, dt=0.03), controls=5)
        x0 = late.filled(lung.resting(5.0))
        states = dlx.open_loop(late, x0, jnp.array([[30.0, 0.0]] * 8))
        states[:, 2].round(1)  # the pressure, which rises after 5 steps
        ```

        ```text
        Array([ 5. ,  5. ,  5. ,  5. ,  5. ,  5. ,  6. ,  8.1, 10.6], dtype=float32)
        ```
    """

    resistance: Real = parameter(20.0, constraint=positive)
    stiffness: Real = parameter(40.0, constraint=positive)
    rest: Real = parameter(1.5, constraint=positive)
    pipe: Real = parameter(5.0, constraint=positive)
    valves: Valves = Valves()

    state_names: ClassVar = ("inflow", "opening", "pipe", "volume")
    state_units: ClassVar = ("L/s", "", "cmH2O", "L")

    def pressure(self, x: State) -> Scalar:
        return x[2]

    @host_unless_traced
    def resting(self, pressure: RealScalar) -> State:
        volume = _stretched(self.rest, self.stiffness, pressure)
        # `0 * volume` is a zero with the dtype and shape of `volume`.
        return xp.stack([0 * volume, 0 * volume, pressure + 0 * volume, volume])

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        inflow, opening = self.valves.derivatives(x[0], x[1], u)
        inside = balloon_pressure(x[3], self.rest, self.stiffness)
        filling = (x[2] - inside) / self.resistance
        # The pressure of the pipe is a state, so no balance of flows is solved.
        outflow = self.valves.outflow(x[1], x[2])
        rise = (x[0] - filling - outflow) / (PER_ML * self.pipe)
        return jnp.stack([inflow, opening, rise, filling])


# The stretch V / V_0 at which the pressure of a balloon is greatest.
_FULLEST = 7**0.5


def _stretched(rest: Array, stiffness: Array, pressure: Any) -> Array:
    """The volume at which a balloon has a pressure, where the pressure still rises.

    **Raises:** `ValueError` if the pressure is more than the balloon can hold.
    """
    pressure = xp.asarray(pressure)
    most = balloon_pressure(_FULLEST * rest, rest, stiffness)
    if is_concrete(most) and is_concrete(pressure) and bool(xp.any(pressure > most)):
        raise ValueError(
            f"resting: pressure must be at most the {float(most):g} cmH2O that the "
            f"balloon can hold, got {pressure}."
        )
    unit = stiffness * (4 * np.pi / 3) / rest
    # p / unit = (1 - s^-2) s^(-1/3) has no closed form for the stretch s = V / V_0.
    # Newton's method from below converges, because the right side is concave. In double
    # precision, six steps are enough up to half of the greatest pressure.
    ratio = pressure / unit
    s = 1 + ratio / 2
    for _ in range(12):
        value = (1 - s**-2) * s ** (-1 / 3) - ratio
        slope = 2 * s**-3 * s ** (-1 / 3) - (1 - s**-2) * s ** (-4 / 3) / 3
        s = xp.clip(s - value / xp.maximum(slope, 1e-3), 1.0, _FULLEST)
    return rest * s
