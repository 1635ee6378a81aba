"""The lungs of the original Deluca, step by step and with its constants."""

import abc
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from delucax._module import parameter, positive
from delucax._results import RESULTS
from delucax._typing import Control, State
from delucax.dynamics import AbstractDynamics
from delucax.lung import BalloonLung


def original_valve(u_in: Any) -> Array:
    """The flow of the original's valve, `clip(tanh(0.03 (3 u_in - 130)) + 1, 0, 1.72)`.

    It has kinks where it is clipped; `delucax.lung.Valves` is smooth.

    **Arguments:** `u_in`: its opening [%].

    **Returns:** of the shape of `u_in`.
    """
    return jnp.clip(jnp.tanh(0.03 * (3 * u_in - 130)) + 1, 0, 1.72)


class _AbstractOriginalLung(AbstractDynamics):
    """A step of the original, whose state begins with a volume and a pressure."""

    control_names = ("u_in", "u_out")

    @abc.abstractmethod
    def _step(self, x: State, u: Control) -> State:
        """The state one step on."""

    def advance(self, t, x, u, w):
        after = self._step(x, u)
        return (after if w is None else after + w).astype(x.dtype), RESULTS.successful

    def observe(self, t, x):
        return x[1:2]


class OriginalBalloonLung(_AbstractOriginalLung):
    r"""The balloon lung of the original, an Euler step of `dt`:

    `flow = clip(gain valve(u_in), 0, 2)`, less `0.05 p` if `p > peep` and `u_out > 0`;
    `v_next = v + flow dt`, and with a leak `+ (v_rest - v) dt / (5 + dt)`;
    `p_next = P0 + stiffness (1 - (r0 / r)^6) / (r0^2 r)`.

    The state is (volume, pressure). Not smooth where the flow is clipped, and at
    `p = peep`. With the gain of 15 the flow is at its limit from `u_in = 28.7` on, so
    that control is nearly on and off; `delucax.lung.BalloonLung` is retuned.

    **Arguments:**

    - `gain`: of the valve, 15 by default.
    - `stiffness`: 40 by default.
    - `rest`: v_rest, the volume without pressure, 1.5 by default.
    - `offset`: P0, 0 by default.
    - `peep`: 5 by default.
    - `leak`: whether there is a leak, false by default.
    - `dt`: the step, 0.03 by default.

    **Raises:** `ValueError` if a number is not positive.

    Source: Gradu, Hallman, Suo, Yu, Agarwal, Ghai, Singh, Zhang, Majumdar and Hazan,
    2021 (Deluca).
    """

    gain: Array = parameter(15.0, constraint=positive)
    stiffness: Array = parameter(40.0, constraint=positive)
    rest: Array = parameter(1.5, constraint=positive)
    offset: Array = parameter(0.0)
    peep: Array = parameter(5.0)
    leak: bool = eqx.field(static=True, default=False)
    dt: Array = parameter(0.03, constraint=positive)

    state_names = ("volume", "pressure")

    def _step(self, x, u):
        volume, pressure = x[0], x[1]
        flow = jnp.clip(self.gain * original_valve(u[0]), 0, 2)
        out = (pressure > self.peep) & (u[1] > 0)
        flow = flow - jnp.where(out, 0.05 * pressure, 0)
        after = volume + flow * self.dt
        if self.leak:
            after = after + self.dt / (5 + self.dt) * (self.rest - after)
        balloon = BalloonLung(stiffness=self.stiffness, rest=self.rest)
        pressure = self.offset + balloon.elastic_pressure(after)
        return jnp.stack([after, pressure])


class OriginalDelayLung(_AbstractOriginalLung):
    r"""The delay lung of the original, with the delay that its code left out:

    `v_next = max(v + dt p / resistance, rest)`,
    `pipe_next = inertia pipe + gain u_in[k + 1 - delay]`, times 0.995 if
    `u_out[k + 1 - delay] > 0`,
    `p_next = max(0, pipe_next - P(v_next))`,

    with `P` of `OriginalBalloonLung`. The state is (volume, pressure,
    pipe), and the last `delay - 1` controls: the oldest of a ring of `delay`, that of
    now among them, is the one that acts. Not smooth where the maxima change sides.

    **Arguments:**

    - `resistance`: 10 by default.
    - `stiffness`: 6 by default.
    - `rest`: 1.5 by default.
    - `inertia`: 0.995 by default.
    - `gain`: 0.02 by default.
    - `delay`: in steps, 25 by default.
    - `dt`: the step, 0.03 by default.

    **Raises:** `ValueError` if a number is not positive.

    Source: Gradu, Hallman, Suo, Yu, Agarwal, Ghai, Singh, Zhang, Majumdar and Hazan,
    2021 (Deluca), whose code left the delay out.
    """

    resistance: Array = parameter(10.0, constraint=positive)
    stiffness: Array = parameter(6.0, constraint=positive)
    rest: Array = parameter(1.5, constraint=positive)
    inertia: Array = parameter(0.995, constraint=positive)
    gain: Array = parameter(0.02, constraint=positive)
    delay: int = eqx.field(static=True, default=25)
    dt: Array = parameter(0.03, constraint=positive)

    @property
    def state_names(self):
        late = range(1, self.delay)
        names = [f"{name}[-{k}]" for k in late for name in self.control_names]
        return ("volume", "pressure", "pipe", *names)

    def _step(self, x, u):
        volume, pressure, pipe, late = x[0], x[1], x[2], x[3:]
        volume = jnp.maximum(volume + pressure / self.resistance * self.dt, self.rest)
        late = jnp.concatenate([u.astype(x.dtype), late])
        pipe = self.inertia * pipe + self.gain * late[-2]
        balloon = BalloonLung(stiffness=self.stiffness, rest=self.rest)
        pressure = jnp.maximum(0, pipe - balloon.elastic_pressure(volume))
        pipe = jnp.where(late[-1] > 0, 0.995 * pipe, pipe)
        return jnp.concatenate([jnp.stack([volume, pressure, pipe]), late[:-2]])


class OriginalSingleCompartment(_AbstractOriginalLung):
    r"""The single compartment of the original, an Euler step of `dt`:

    `flow = clip(valve(u_in), 0, 2)`, `p_next = flow resistance + v / compliance + P0`,
    `v_next = v + flow dt`.

    The state is (volume, pressure). There is no expiration: the pressure never falls.
    `delucax.lung.SingleCompartment` breathes out.

    **Arguments:**

    - `resistance`: 15 by default.
    - `compliance`: 50 by default.
    - `offset`: P0, 10 by default.
    - `dt`: the step, 0.03 by default.

    **Raises:** `ValueError` if a number is not positive.

    Source: Gradu, Hallman, Suo, Yu, Agarwal, Ghai, Singh, Zhang, Majumdar and Hazan,
    2021 (Deluca).
    """

    resistance: Array = parameter(15.0, constraint=positive)
    compliance: Array = parameter(50.0, constraint=positive)
    offset: Array = parameter(10.0)
    dt: Array = parameter(0.03, constraint=positive)

    state_names = ("volume", "pressure")

    def _step(self, x, u):
        flow = jnp.clip(original_valve(u[0]), 0, 2)
        pressure = flow * self.resistance + x[0] / self.compliance + self.offset
        return jnp.stack([x[0] + flow * self.dt, pressure])
