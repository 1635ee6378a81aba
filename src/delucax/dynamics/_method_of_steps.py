"""Discrete-time dynamics of systems with delayed states."""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._check import (
    as_entries,
    as_vector,
    check_count,
    check_instance,
    check_step,
    is_concrete,
)
from .._integration import check_method, RK4, runge_kutta_step, tableau_of
from .._module import parameter
from .._results import choose, Result, RESULTS
from .._typing import Control, Numbers, Observation, Real, RealScalar, State, Time
from ..systems import AbstractDelaySystem
from ._base import Forwarding


_PARTS = "start", "slope_at_start", "end", "slope_at_end"
_SLACK = 1e-6  # relative: the rounding of a quotient that should be whole


class MethodOfSteps(Forwarding):
    r"""Discrete-time dynamics of a system with delayed states, by the method of steps,
    with the control held over each interval (zero-order hold).

    Each control interval is cut into `substeps` equal steps of an explicit Runge-Kutta
    method. No step is longer than the shortest delay, so the delayed states are always
    known. A delayed state is interpolated by a cubic polynomial, which matches the
    states and the slopes at both ends of a past step. The error of this interpolation
    is of order 4. If the system has `disturbance_names`, the disturbance `w` is held
    over the interval; otherwise `w` is added to the next state.

    The state is `(x, history)`. For each past step within `memory`, the history holds
    the state and the slope at the start and at the end of that step, the newest step
    first. `filled` makes such a state from a constant past, and `started` makes one
    from a past that is a function of time. The state with its history can be used like
    any other state. For example, you can [`delucax.linearize`][] the dynamics, and the
    eigenvalues of the matrix `A` show whether they are stable. Derivatives with respect
    to the delays are computed through the cubic interpolation.

    The slope of the state jumps when a control switches and at the start of the
    simulation, where the given history ends. One delay after such a jump of the slope,
    a higher derivative of the state jumps. The method has order 4 if the delays are
    whole numbers of substeps.

    **Arguments:**

    - `system`: the system, a [`delucax.systems.AbstractDelaySystem`][].
    - `dt`: the control interval, in units of time, a positive number.
    - `solver`: an explicit Runge-Kutta method of Diffrax; [`delucax.dynamics.RK4`][] by
        default.
    - `substeps`: the number of steps per control interval; by default the smallest
        number for which no step is longer than the shortest delay.
    - `memory`: the longest delay that you may set later, in substeps; by default the
        longest delay of the system.

    **Raises:** `ValueError` if a delay is not positive, is shorter than a substep or
    longer than `memory`, or if `solver` does not fit. If you later change a delay so
    that it is shorter than a substep or longer than `memory`, the status of a step is
    `delay_beyond_memory`.

    Source: Hairer, Nørsett and Wanner, 1993, section II.17.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp
        from jaxtyping import Array

        class Lag(dlx.systems.AbstractDelaySystem):
            state_names, control_names = ("x",), ("u",)
            delays: Array = dlx.parameter([0.4])

            def vector_field(self, t, x, u, w, late):
                return -late[0] + u

        dynamics = dlx.dynamics.MethodOfSteps(Lag(), dt=0.1)
        dlx.open_loop(dynamics, dynamics.filled([1.0]), jnp.zeros((20, 1)))[::5, 0]
        ```

        ```text
        Array([1.   , 0.505, 0.179, 0.048, 0.009], dtype=float32)
        ```
    """

    system: AbstractDelaySystem
    dt: Real = parameter()
    solver: diffrax.AbstractSolver = RK4()
    substeps: int | None = eqx.field(default=None, static=True)
    memory: int | None = eqx.field(default=None, static=True)

    def __post_init__(self):
        where = "MethodOfSteps"
        check_instance(self.system, AbstractDelaySystem, "system", where)
        check_step(self.dt, where)
        delays = as_entries(self.system.delays, None, "delays", where, "delay")
        known = is_concrete(delays) and is_concrete(self.dt)
        if not known and (self.substeps is None or self.memory is None):
            raise ValueError(
                f"{where}: substeps and memory must be given if the delays or dt are "
                "traced by JAX."
            )
        if known and not (np.size(delays) and np.all(np.asarray(delays) > 0)):
            raise ValueError(f"{where}: delays must be positive, got {delays}.")
        up = lambda ratio: max(1, int(np.ceil(float(ratio) * (1 - _SLACK))))
        if self.substeps is None:
            self.substeps = up(self.dt / np.min(delays))
        self.substeps = check_count(self.substeps, "substeps", where)
        if self.memory is None:
            self.memory = up(np.max(delays) * self.substeps / self.dt)
        self.memory = check_count(self.memory, "memory", where)

    def __check_init__(self):
        where, delays = "MethodOfSteps", jnp.asarray(self.system.delays)
        if is_concrete(delays) and is_concrete(self.dt) and self._is_beyond(delays):
            raise ValueError(
                f"{where}: delays must be at least one substep, {self._step}, and at "
                f"most memory = {self.memory} substeps, got {delays}."
            )
        check_method(self.solver, None, 1, None, where)
        if tableau_of(self.solver) is None:
            raise ValueError(
                f"{where}: solver must be an explicit Runge-Kutta method, got "
                f"{type(self.solver).__name__}."
            )
        if self.system.noise == "brownian":
            raise ValueError(f"{where}: system must have no diffusion.")

    @property
    def _inside(self):
        return self.system

    @property
    def _step(self) -> Array:
        assert self.substeps is not None
        return self.dt / self.substeps

    @property
    def state_names(self) -> tuple[str, ...]:
        names, steps = self.system.state_names, range(self.memory or 0)
        parts = [(k, part) for k in steps for part in _PARTS]
        late = [f"{name}.{part}[-{k + 1}]" for k, part in parts for name in names]
        return (*names, *late)

    @property
    def state_units(self) -> tuple[str, ...]:
        units = tuple(self.system.state_units)
        # The history mixes values and slopes, so it has no units.
        more = self.state_size - self.system.state_size
        return units + ("",) * more if units else ()

    def _cut(self, x: Array) -> tuple[Array, Array]:
        """The state of the system and the history, shape `(memory, 4, n)`."""
        n = self.system.state_size
        return x[:n], x[n:].reshape(-1, len(_PARTS), n)

    def inner(self, x: Array) -> Array:
        """The state of the system inside.

        **Arguments:** `x`: the state with its history, shape `(state_size,)`.

        **Returns:** its first entries, shape `(n,)`.
        """
        return self._cut(x)[0]

    def filled(self, x: Numbers) -> Array:
        """The state after a constant past. Use it as a first state.

        **Arguments:** `x`: the state of the system, now and in the past, shape `(n,)`.

        **Returns:** the state with its history, shape `(state_size,)`.

        **Raises:** `ValueError` on a wrong shape.
        """
        x = as_vector(x, self.system.state_size, "x", "MethodOfSteps.filled")
        rest = jnp.stack([x, jnp.zeros_like(x), x, jnp.zeros_like(x)])
        history = jnp.tile(rest[None], (self.memory or 0, 1, 1))
        return jnp.concatenate([x, history.ravel()])

    def started(self, past: Callable[[Array], Array]) -> Array:
        """The state after a given past. Use it as a first state.

        **Arguments:** `past`: the state of the system, shape `(n,)`, as a function of
            time. `past` is called at time 0, which is the present, and at negative
            times.

        **Returns:** the state with its history, shape `(state_size,)`.

        **Raises:** `ValueError` on a wrong shape.
        """
        h, zero = self._step, jnp.zeros(())
        x = as_vector(past(zero), self.system.state_size, "past", "MethodOfSteps")
        both = lambda s: jax.jvp(past, (s,), (jnp.ones_like(s),))
        ends = -h * jnp.arange((self.memory or 0) + 1, dtype=zero.dtype)
        values, slopes = jax.vmap(both)(ends)
        parts = values[1:], slopes[1:], values[:-1], slopes[:-1]
        return jnp.concatenate([x, jnp.stack(parts, axis=1).ravel()])

    def _is_beyond(self, delays: Array) -> Array:
        ratio = delays / self._step
        slack = 2 * _SLACK  # so that what the constructor chooses is within it
        beyond = ratio > (self.memory or 0) * (1 + slack)
        return jnp.any((ratio < 1 - slack) | beyond)

    def advance(
        self, t: RealScalar, x: Array, u: Array, w: Array | None
    ) -> tuple[Array, Result]:
        system, h = self.system, self._step
        own, history = self._cut(x)
        delays = jnp.atleast_1d(system.delays).astype(x.dtype)
        held = None if self.noise == "additive" else w
        if held is None and self.noise is None:
            held = jnp.zeros(self.disturbance_size, x.dtype)
        tableau: Any = tableau_of(self.solver)
        rounding = 16 * jnp.finfo(x.dtype).eps * delays / h

        def body(carry, k):
            own, history = carry
            begin = t + k * h

            def field(s, x):
                age = (delays - s) / h
                # At both ends of this step, the age may be whole, and two old steps
                # meet there. The state may jump between them, and the old step that
                # this one goes through is meant.
                index = jnp.floor(age + (2 * s / h - 1) * rounding)
                late = _at(history, age, index, h)
                return system.vector_field(begin + s, x, u, held, late)

            after = runge_kutta_step(tableau, field, jnp.zeros((), x.dtype), own, h)
            parts = own, field(0.0, own), after, field(h, after)
            newest = jnp.stack(parts).astype(x.dtype)
            return (after, jnp.concatenate([newest[None], history[:-1]])), None

        steps = jnp.arange(self.substeps or 1)
        (own, history), _ = lax.scan(body, (own, history), steps)
        if self.noise == "additive" and w is not None:
            own = own + w
        failed = self._is_beyond(delays)
        result = choose(failed, RESULTS.delay_beyond_memory, RESULTS.successful)
        return jnp.concatenate([own, history.ravel()]).astype(x.dtype), result

    def observe(self, t: Time, x: State) -> Observation:
        return self.system.observe(t, self.inner(x))

    def difference(self, x: State, x_ref: State) -> State:
        # Only the system's own state has angles to wrap.
        n = self.system.state_size
        own = self.system.difference(x[:n], x_ref[:n])
        return jnp.concatenate([own, x[n:] - x_ref[n:]])

    def equilibrium(self) -> tuple[State, Control]:
        x, u = self.system.equilibrium()
        return self.filled(x), u


def _at(history: Array, age: Array, index: Array, h: Array) -> Array:
    """The states `age` substeps ago, by Hermite's cubic of the substep `index`."""
    index = jnp.clip(index.astype(int), 0, len(history) - 1)
    start, rise, end, fall = jnp.moveaxis(history[index], 1, 0)
    s = (1 - (age - index))[:, None]
    # In the form of Hairer, Nørsett and Wanner, II.6: exact at both ends.
    change = end - start
    bend = (1 - 2 * s) * change + (s - 1) * h * rise + s * h * fall
    return (1 - s) * start + s * end + s * (s - 1) * bend
