"""Dynamics with delayed controls and observations."""

import abc
import math
from typing import Any

import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array

from .._check import as_vector, check_count, check_instance, check_number, is_concrete
from .._integration import evaluate_field
from .._module import parameter
from .._results import choose, first_failure, Result, RESULTS
from .._typing import Control, Numbers, Observation, Real, RealScalar, State, Time
from ._base import AbstractDiscretization, AbstractDynamics, AbstractWrapper
from ._discretized import Discretized


_SLACK = 8
"""The relative error of a delay that counts as rounding, in units of eps."""


def _eps(value: Any) -> float:
    """The relative distance of numbers in the precision of `value`."""
    return float(jnp.finfo(jnp.result_type(value, float)).eps)


class _AbstractDelay(AbstractWrapper):
    """Dynamics whose state ends with the pending controls and observations,
    `(x, u[k - 1], ..., u[k - c], y[k - 1], ..., y[k - s])`, the newest first.
    """

    @property
    @abc.abstractmethod
    def _kept(self) -> tuple[int, int]:
        """The numbers `(c, s)` of controls and observations that the state keeps."""

    @property
    def state_names(self) -> tuple[str, ...]:
        inner, (controls, sensor) = self.dynamics, self._kept
        ages = range(controls)
        late = [f"{name}[-{k + 1}]" for k in ages for name in inner.control_names]
        outputs = range(inner.observation_size if sensor else 0)
        late += [f"y{i}[-{k + 1}]" for k in range(sensor) for i in outputs]
        return (*inner.state_names, *late)

    @property
    def state_units(self) -> tuple[str, ...]:
        inner, (controls, sensor) = self.dynamics, self._kept
        units = tuple(inner.state_units) or ("",) * inner.state_size
        late = (tuple(inner.control_units) or ("",) * inner.control_size) * controls
        units += late + ("",) * (inner.observation_size * sensor)
        return units if any(units) else ()

    def _cut(self, x: Array) -> tuple[Array, Array, Array]:
        """The plant's own state, the pending controls and the pending observations."""
        n = self.dynamics.state_size
        m = n + self._kept[0] * self.dynamics.control_size
        return x[:n], x[n:m], x[m:]

    def inner(self, x: Array) -> Array:
        """The state of the plant inside.

        **Arguments:** `x`: the state of the delayed dynamics, shape `(state_size,)`.

        **Returns:** its first entries, shape `(n,)`.
        """
        return self._cut(x)[0]

    def filled(self, x: Numbers, u: Numbers | None = None) -> Array:
        """The state after a past in which nothing changed. Use it as a first state.

        **Arguments:**

        - `x`: the state of the plant inside, shape `(n,)`.
        - `u`: the control in the past, shape `(m,)`; zero by default.

        **Returns:** the state of the delayed dynamics, shape `(state_size,)`. Every
        pending control is `u`, and every pending observation is that of `x`.

        **Raises:** `ValueError` on a wrong shape.
        """
        inner, where = self.dynamics, f"{type(self).__name__}.filled"
        x = as_vector(x, inner.state_size, "x", where)
        u = [0.0] * inner.control_size if u is None else u
        u = as_vector(u, inner.control_size, "u", where)
        return self._filled(x, u)

    @eqx.filter_jit
    def _filled(self, x: Array, u: Array) -> Array:
        y, (controls, sensor) = self.dynamics.observe(0.0, x), self._kept
        late = [jnp.tile(u, controls), jnp.tile(y, sensor)]
        return jnp.concatenate([x, *late]).astype(x.dtype)

    @property
    def observes_state(self) -> bool:
        """Whether nothing is delayed and the plant inside observes its state."""
        return not any(self._kept) and self.dynamics.observes_state

    def difference(self, x: State, x_ref: State) -> State:
        # Only the plant's own state has angles to wrap.
        n = self.dynamics.state_size
        own = self.dynamics.difference(x[:n], x_ref[:n])
        return jnp.concatenate([own, x[n:] - x_ref[n:]])

    def equilibrium(self) -> tuple[State, Control]:
        x, u = self.dynamics.equilibrium()
        return self.filled(x, u), u


class Delayed(_AbstractDelay):
    r"""Dynamics with an input delay, an output delay or both, of a whole number of
    steps.

    $$x_{k+1} = F(t_k, x_k, u_{k-c}, w_k), \qquad y_k = h(t_{k-s}, x_{k-s})$$

    The state consists of the state of the plant, the controls that have not yet reached
    the plant, and the observations that have not yet been read:
    $(x_k, u_{k-1}, \dots, u_{k-c}, y_{k-1}, \dots, y_{k-s})$. The delay is an exact
    transport delay, not an approximation, and the delayed values are differentiable
    like any other state. For delays that are not a whole number of steps, use
    [`delucax.dynamics.TransportDelay`][].

    **Arguments:**

    - `dynamics`: the plant, a [`delucax.AbstractDynamics`][].
    - `controls`: $c$, the delay of the controls in steps, 0 by default.
    - `sensor`: $s$, the delay of the observations in steps, 0 by default.

    **Raises:** `ValueError` if `dynamics` is not an `AbstractDynamics`, or a delay is
    not a whole number of at least 0.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        plant = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05)
        late = dlx.dynamics.Delayed(plant, controls=2)
        x0 = late.filled(jnp.array([0.1, 0.0]))
        dlx.open_loop(late, x0, jnp.ones((3, 1)))
        ```

        ```text
        Array([[0.1  , 0.   , 0.   , 0.   ],
               [0.102, 0.075, 1.   , 0.   ],
               [0.108, 0.154, 1.   , 1.   ],
               [0.121, 0.388, 1.   , 1.   ]], dtype=float32)
        ```
    """

    dynamics: AbstractDynamics
    controls: int = eqx.field(default=0, static=True)
    sensor: int = eqx.field(default=0, static=True)

    def __check_init__(self):
        check_count(self.controls, "controls", "Delayed", least=0)
        check_count(self.sensor, "sensor", "Delayed", least=0)

    @property
    def _kept(self) -> tuple[int, int]:
        return self.controls, self.sensor

    def advance(
        self, t: RealScalar, x: Array, u: Array, w: Array | None
    ) -> tuple[Array, Result]:
        return self._advance(self.dynamics.advance, t, x, u, w)

    def advance_with_events(
        self, t: RealScalar, x: Array, u: Array, w: Array | None
    ) -> tuple[Array, Result, Any]:
        return self._advance(self.dynamics.advance_with_events, t, x, u, w)

    def _advance(self, advance, t, x, u, w):
        own, controls, observed = self._cut(x)
        acting, late = u, []
        # The newest comes first; the oldest acts, or is read. Empty slices are left
        # out, so that the state is still split into components.
        if self.controls:
            m = u.shape[0]
            acting = controls[-m:]
            late = [u.astype(x.dtype)]
            late += [controls[:-m]] if self.controls > 1 else []
        if self.sensor:
            y = self.dynamics.observe(t, own).astype(x.dtype)
            late += [y, observed[: -y.shape[0]]] if self.sensor > 1 else [y]
        after, *rest = advance(t, own, acting, w)
        return jnp.concatenate([after, *late]), *rest

    def observe(self, t: Time, x: State) -> Observation:
        own, _, observed = self._cut(x)
        if not self.sensor:
            return self.dynamics.observe(t, own)
        # The oldest observation is the last block.
        return observed[-(observed.shape[0] // self.sensor) :]


class TransportDelay(_AbstractDelay):
    r"""Dynamics with an input delay, an output delay or both, of any length. The delays
    need not be multiples of `dt`.

    $$\dot x = f(t, x, u(t - \tau_u), w), \qquad y(t) = h(t - \tau_y, x(t - \tau_y))$$

    The control is held over each control interval, so the delayed control switches once
    within an interval. Therefore the interval is integrated in two parts, before and
    after the switch, which causes no error. If the sensor is delayed, another
    integration goes from the start of the interval to the time of the delayed reading.

    The state is $(x_k, u_{k-1}, \dots, y_{k-1}, \dots)$: the state of the plant, the
    controls that have not yet reached the plant, and the earlier readings of the
    sensor, the newest first. The method `filled` makes such a state from a state of the
    plant. Disturbances act as they do without a delay; an additive disturbance is added
    at the end of the interval.

    The delays are differentiable. If a delay is a whole number of steps, the derivative
    with respect to this delay is the right-hand derivative. The number of controls and
    readings in the state is fixed at construction. If a delay is changed later, for
    example by `delucax.training.fit`, and needs more controls or readings than the
    state holds, the status of a step is `delay_beyond_memory`.

    **Arguments:**

    - `dynamics`: the plant, such as a [`delucax.Discretized`][], without a diffusion.
    - `controls`: $\tau_u$, the delay of the controls, in units of time; 0 by default.
    - `sensor`: $\tau_y$, the delay of the sensor, in units of time; 0 by default.
    - `control_memory`, `sensor_memory`: the longest delays of the controls and of the
        sensor that you may set later, in steps; by default the given delays, rounded up
        to whole steps.

    **Raises:** `ValueError` if `dynamics` is not the discretisation of a system or has
    a diffusion, or if a delay is negative, not finite, or longer than `control_memory`
    or `sensor_memory` allows.

    Source: Åström and Wittenmark, 1997, section 2.3.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        plant = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05)
        late = dlx.dynamics.TransportDelay(plant, controls=0.07, sensor=0.01)
        x0 = late.filled(jnp.array([0.1, 0.0]))
        states = dlx.open_loop(late, x0, jnp.ones((3, 1)))
        states.shape, states[-1, :2]
        ```

        ```text
        ((4, 8), Array([0.127, 0.481], dtype=float32))
        ```
    """

    dynamics: AbstractDiscretization
    controls: Real = parameter(0.0)
    sensor: Real = parameter(0.0)
    control_memory: int | None = eqx.field(default=None, static=True)
    sensor_memory: int | None = eqx.field(default=None, static=True)

    def __post_init__(self):
        where = "TransportDelay"
        check_instance(self.dynamics, AbstractDiscretization, "dynamics", where)
        for kind in ("control", "sensor"):
            name = "controls" if kind == "control" else kind
            delay, memory = getattr(self, name), getattr(self, f"{kind}_memory")
            check_number(delay, name, where)
            known = is_concrete(delay) and is_concrete(self.dynamics.dt)
            steps = float(delay) / float(self.dynamics.dt) if known else 0.0
            if steps < 0:
                raise ValueError(f"{where}: {name} must be at least 0, got {delay}.")
            slack = 1 - _SLACK * _eps(self.dynamics.dt)
            if memory is None:
                if not known:
                    raise ValueError(
                        f"{where}: {kind}_memory must be given if {name} or dt is "
                        "traced by JAX."
                    )
                memory = math.ceil(steps * slack)
            memory = check_count(memory, f"{kind}_memory", where, least=0)
            if steps * slack > memory:
                raise ValueError(
                    f"{where}: {name} must be at most {memory} steps of "
                    f"{self.dynamics.dt}, got {delay}. For a longer delay, raise "
                    f"{kind}_memory."
                )
            setattr(self, f"{kind}_memory", memory)

    def __check_init__(self):
        if self.dynamics.noise == "brownian":
            raise ValueError(
                "TransportDelay: dynamics must have no diffusion, because an interval "
                "is cut in parts, and each would need increments of its own."
            )

    @property
    def _kept(self) -> tuple[int, int]:
        assert self.control_memory is not None and self.sensor_memory is not None
        return self.control_memory, self.sensor_memory and self.sensor_memory + 1

    def _in_steps(self, delay: Array) -> tuple[Array, Array]:
        """The whole steps of a delay, and the rest as a fraction of a step."""
        steps = delay / self.dynamics.dt
        # The slack absorbs the rounding of a quotient that should be whole.
        slack = _SLACK * _eps(steps) * steps
        whole = jnp.floor(steps + slack)
        rest = steps - whole
        # A rest of zero keeps the derivative of the delay.
        return whole, jnp.where(rest < slack, rest - lax.stop_gradient(rest), rest)

    def _is_beyond(self, delay: Array, memory: int) -> Array:
        whole, rest = self._in_steps(delay)
        return (whole < 0) | (whole + (rest > 0) > memory)

    def _part(self, recorded: bool, t, x, u, w, h) -> tuple[Array, Result, Any]:
        """A step over the part `h` of an interval: the state after it, the status and
        the events."""
        part = eqx.tree_at(lambda inner: inner.dt, self.dynamics, h)
        if recorded:
            x_next, result, events = part.advance_with_events(t, x, u, w)
        else:
            (x_next, result), events = part.advance(t, x, u, w), None
        if isinstance(part, Discretized) and part.stepsize_controller is not None:
            # Diffrax takes no step in a part of length zero, so the derivative by the
            # length, which is the vector field, would be lost.
            _, held, _ = part._parts_of(x, w)
            change = h - lax.stop_gradient(h)
            rate = evaluate_field(part.system, t, x, u, held)
            x_next = x_next + jnp.where(h == 0, change, 0) * rate
        return x_next, result, events

    def advance(
        self, t: RealScalar, x: Array, u: Array, w: Array | None
    ) -> tuple[Array, Result]:
        x_next, result, _ = self._advance(False, t, x, u, w)
        return x_next, result

    def advance_with_events(
        self, t: RealScalar, x: Array, u: Array, w: Array | None
    ) -> tuple[Array, Result, Any]:
        return self._advance(True, t, x, u, w)

    def _advance(self, recorded: bool, t, x, u, w) -> tuple[Array, Result, Any]:
        own, pending, observed = self._cut(x)
        dt, m = self.dynamics.dt, u.shape[0]
        held = None if self.noise == "additive" else w
        if not self._kept[0]:
            switch, middle, first, second = 0.0, own, u, u
            after, result, events = self._part(recorded, t, own, u, w, dt)
        else:
            newest = jnp.concatenate([u.astype(x.dtype), pending])
            table, most = newest.reshape(-1, m), self._kept[0]
            whole, rest = self._in_steps(self.controls)
            # Two controls act in the interval, one after the other.
            index = whole.astype(int)
            first = table[jnp.clip(index + 1, 0, most)]
            second = table[jnp.clip(index, 0, most)]
            switch = rest * dt
            middle, early, events = self._part(recorded, t, own, first, held, switch)
            later = t + switch, middle, second, w, dt - switch
            after, late, more = self._part(recorded, *later)
            events = events if events is None else events.then(more)
            failed = self._is_beyond(self.controls, most)
            result = first_failure(early, late)
            result = choose(failed, RESULTS.delay_beyond_memory, result)
            pending = newest[:-m]
        if self._kept[1]:
            _, rest = self._in_steps(self.sensor)
            # The sensor will read the state `rest` steps before the end.
            at = (1 - rest) * dt
            before = at < switch
            start = jnp.where(before, own, middle)
            since = jnp.where(before, 0.0, switch)
            acting = jnp.where(before, first, second)
            given = t + since, start, acting, held, at - since
            read, failure, _ = self._part(False, *given)
            if self.noise == "additive" and w is not None:
                read = read + jnp.where(rest > 0, 0, w)
            y = self.dynamics.observe(t + at, read).astype(x.dtype)
            observed = jnp.concatenate([y, observed[: -y.shape[0]]])
            failed = self._is_beyond(self.sensor, self._kept[1] - 1)
            result = first_failure(result, failure)
            result = choose(failed, RESULTS.delay_beyond_memory, result)
        x_next = jnp.concatenate([after, pending, observed]).astype(x.dtype)
        return x_next, result, events

    def observe(self, t: Time, x: State) -> Observation:
        own, _, observed = self._cut(x)
        most = self._kept[1]
        if not most:
            return self.dynamics.observe(t, own)
        whole, _ = self._in_steps(self.sensor)
        return observed.reshape(most, -1)[jnp.clip(whole.astype(int), 0, most - 1)]
