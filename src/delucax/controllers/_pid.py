"""Proportional-integral-derivative control."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from .._check import (
    as_bounds,
    as_entries,
    as_matrix,
    bounds_field,
    check_choice,
    check_count,
    check_range,
    check_step,
)
from .._controller import AbstractController, wrong_observation
from .._message import shortened
from .._module import as_float_array, as_module, parameter, positive, weight
from .._typing import Bounds, PRNGKey, Real, RealScalar
from ..math import clip, matvec


class _Select(eqx.Module):
    """Entries of an observation."""

    indices: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, y):
        return jnp.stack([y[i] for i in self.indices])


class _Project(eqx.Module):
    """A linear map of an observation."""

    C: Array = parameter()

    def __check_init__(self):
        as_matrix(self.C, "output", "PID")

    def __call__(self, y):
        return matvec(self.C, y)


def _as_output(output: Any) -> Any:
    """The outputs of the loops, as a function of the observation."""
    if output is None or callable(output):
        return as_module(output)
    if isinstance(output, int | np.integer) and not isinstance(output, bool):
        output = (output,)
    if isinstance(output, Sequence) and len(output) > 0:
        if all(isinstance(i, int | np.integer) and i >= 0 for i in output):
            return _Select(tuple(int(i) for i in output))
    array = as_float_array(output)
    if not eqx.is_inexact_array(array) or array.ndim != 2:
        raise ValueError(
            "PID: output must be an index from 0, a tuple of them, a matrix or a "
            f"function, got {shortened(output)}."
        )
    return _Project(array)


def _output_field() -> Any:
    return eqx.field(default=None, converter=_as_output)


def _as(after: Any, before: Any) -> Any:
    """`after` in the types of `before`, as a loop must carry it."""
    return jax.tree.map(lambda a, b: a.astype(b.dtype), after, before)


class _AbstractPID(AbstractController):
    """Independent loops, each with one output and one control."""

    kp: eqx.AbstractVar[Real]
    ki: eqx.AbstractVar[Real]
    kd: eqx.AbstractVar[Real]
    dt: eqx.AbstractVar[Real]
    reference: eqx.AbstractVar[Array | Callable[[Any], Array] | None]
    output: eqx.AbstractVar[Any]
    bounds: eqx.AbstractVar[Bounds | None]

    def __check_init__(self):
        where = type(self).__name__
        check_step(self.dt, where)
        as_bounds(self.bounds, where)
        check_count(self.loops, "loops", where)

    @property
    def loops(self) -> int:
        """The number of loops: the size that all vectors have; 1 where all are
        numbers."""
        where = type(self).__name__
        low, high = self.bounds or (None, None)
        skipped = "output", "bounds", "derivative_on"
        names = [f.name for f in dataclasses.fields(self) if f.name not in skipped]
        vectors = {name: getattr(self, name) for name in names}
        if callable(self.reference):
            del vectors["reference"]
        vectors |= {"low bounds": low, "high bounds": high}
        sizes = {}
        for name, value in vectors.items():
            if value is None:
                continue
            array = as_entries(value, None, name, where, "loop")
            if array.ndim == 1:
                sizes[name] = array.shape[0]
        if isinstance(self.output, _Select):
            sizes["output"] = len(self.output.indices)
        elif isinstance(self.output, _Project):
            sizes["output"] = self.output.C.shape[0]
        if len(set(sizes.values())) > 1 or 0 in sizes.values():
            got = ", ".join(f"{name} of size {size}" for name, size in sizes.items())
            raise ValueError(f"{where}: there must be one entry per loop; got {got}.")
        return next(iter(sizes.values()), 1)

    def _zeros(self) -> Array:
        dtype = jnp.result_type(self.kp, self.ki, self.kd, self.dt)
        return jnp.zeros(self.loops, dtype)

    def _error(self, t: RealScalar, y: Array) -> tuple[Array, Array]:
        """`(r(t) - h(y), h(y))`, checked to have an entry for each loop."""
        name, output, loops = type(self).__name__, self.output, self.loops
        if isinstance(output, _Select) and max(output.indices) >= y.shape[0]:
            raise ValueError(
                f"{name}: output selects component {max(output.indices)}, but the "
                f"observation has size {y.shape[0]}."
            )
        if isinstance(output, _Project) and y.shape != output.C.shape[1:]:
            raise wrong_observation(self, output.C.shape[1], y)
        measured = y if output is None else jnp.atleast_1d(output(y))
        if measured.shape != (loops,):
            what = "the observation has" if output is None else "output gives"
            raise ValueError(
                f"{name}: expects {loops} outputs, one per loop, but {what} shape "
                f"{measured.shape}; choose what each loop follows, such as output=0."
            )
        reference = self.reference(t) if callable(self.reference) else self.reference
        reference = jnp.asarray(0 if reference is None else reference)
        if reference.shape not in ((), (loops,)):
            raise ValueError(
                f"{name}: reference must have an entry for each of {loops} loops, got "
                f"shape {reference.shape}."
            )
        return reference - measured, measured

    def _clip(self, u: Array, y: Array) -> Array:
        return (u if self.bounds is None else clip(u, *self.bounds)).astype(y.dtype)


class _Memory(NamedTuple):
    integral: Array
    slope: Array
    previous: Array
    started: Array
    asked: Array


class PID(_AbstractPID):
    """Proportional, integral and derivative action, one loop per control.

    With the error `e = r(t) - h(y)`, over a step of `dt`:

    `v = kp e + I + kd D`, `u = clip(v, low, high)`,
    `I_next = I + dt (ki e + (u_applied - v) / T_a)`,
    `D = (T_d D_before + z - z_before) / (T_d + dt)`,

    `D` being the derivative of `z = -h(y)` (so that a jump of the reference makes no
    kick), or of `e`, through a first-order lag; it starts at 0. The integral does not
    leak. Its second term, back-calculation, keeps it from winding up: `u_applied` is
    the control that was really applied, so the environment's bounds count as the
    controller's own do. Where `ki` is 0 there is no integral.

    **Arguments:**

    - `kp`, `ki`, `kd`: the gains, each a number or a vector with an entry for each
        loop; 0 by default but for `kp`. Trainable. Units: of the control over those of
        the error, its integral and its derivative.
    - `dt`: the control interval, that of the environment.
    - `reference`: r, a function of time, a vector or a number; 0 by default.
    - `output`: h, what the loops follow: an index into the observation, a tuple of
        indices, a matrix, or a function of the observation; all of it by default.
    - `bounds`: `(low, high)`, each a number or a vector; none by default.
    - `derivative_time_constant`: T_d of the lag, `dt` by default; 0 for none.
    - `derivative_on`: `"measurement"` (default) or `"error"`.
    - `anti_windup_time`: T_a, at least `dt`. By default the integral time `kp / ki` of
        each loop, but not below `dt`.

    **Raises:** `ValueError` if sizes do not fit, or a time is out of its range; when it
    is run, if there are not as many outputs as loops.

    Source: Åström and Hägglund, 2006.

    !!! example

        ```python
        import delucax as dlx
        import jax

        env = dlx.make("pendulum")
        pid = dlx.controllers.PID(
            25.0, 5.0, 5.0, dt=env.dt, output=0, bounds=(-2.0, 2.0)
        )
        dlx.rollout(env, pid, key=jax.random.key(0), x0=[0.1, 0.0]).total_cost
        ```
    """

    kp: Real = weight()
    ki: Real = weight(0.0)
    kd: Real = weight(0.0)
    _: KW_ONLY
    dt: Real = parameter(constraint=positive)
    reference: Array | Callable[[Any], Array] | None = parameter(None)
    output: Callable[[Array], Array] | int | Sequence[int] | None = _output_field()
    bounds: tuple[Array, Array] | None = bounds_field("PID", default=None)
    derivative_time_constant: Real | None = parameter(None)
    derivative_on: Literal["measurement", "error"] = eqx.field(
        default="measurement", static=True
    )
    anti_windup_time: Real | None = parameter(None, constraint=positive)

    def __check_init__(self):
        check_choice(
            self.derivative_on, ("measurement", "error"), "derivative_on", "PID"
        )
        lag, windup, dt = self.derivative_time_constant, self.anti_windup_time, self.dt
        # Before the base's checks, because the other times are compared with it.
        check_step(dt, "PID")
        check_range(dt if lag is None else lag, "derivative_time_constant", "PID")
        check_range(dt if windup is None else windup, "anti_windup_time", "PID", dt)

    def init(self, *, key: PRNGKey | None = None) -> PyTree:
        zeros = self._zeros()
        return _Memory(zeros, zeros, zeros, jnp.zeros((), bool), zeros)

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        error, measured = self._error(t, y)
        moving = -measured if self.derivative_on == "measurement" else error
        # No derivative on the first call, which has nothing before it.
        step = jnp.where(state.started, moving - state.previous, 0)
        lag = self.derivative_time_constant
        lag = self.dt if lag is None else lag
        # Backward Euler on `T_d D' + D = dz/dt`: stable whatever T_d, and with T_d = 0
        # the plain difference `step / dt`.
        slope = (lag * state.slope + step) / (lag + self.dt)
        asked = self.kp * error + state.integral + self.kd * slope
        # The gain is inside of the sum, so that a change of it makes no jump
        # (bumpless).
        integral = state.integral + self.dt * self.ki * error
        # The integral of this step acts from the next one on, so that `applied`, which
        # comes in between, corrects what the next control is made of.
        after = _Memory(integral, slope, moving, jnp.ones((), bool), asked)
        return self._clip(asked, y), _as(after, state)

    def applied(self, u: Array, cost: Array, state: PyTree) -> PyTree:
        # Back-calculation: with the bounds of the environment included in u, because
        # this is told what was applied.
        correction = self.dt * self._windup_rate() * (u - state.asked)
        return _as(state._replace(integral=state.integral + correction), state)

    def _windup_rate(self):
        """`1 / T_a`, and 0 where there is no integral to wind up."""
        # Faster than the sample the correction would overshoot, and oscillate.
        fastest = 1 / self.dt
        if self.anti_windup_time is None:
            no_kp = self.kp == 0
            # The integral time T_i = kp / ki for T_a, a textbook's choice for PI
            # (Astrom and Hagglund, 2006). 1 in place of a kp of 0, because `where`
            # differentiates both of its sides.
            rate = jnp.abs(self.ki / jnp.where(no_kp, 1, self.kp))
            rate = jnp.where(no_kp, fastest, jnp.minimum(rate, fastest))
        else:
            rate = 1 / self.anti_windup_time
        return jnp.where(self.ki == 0, 0, rate)


class _Averages(NamedTuple):
    error: Array
    integral: Array
    derivative: Array


class LeakyPID(_AbstractPID):
    """The PID of the original Deluca, whose integral is an exponential average.

    With the error `e = r(t) - h(y)` and `a = dt / (dt + T)`:

    `I = I_before + a (e - I_before)`, `D = D_before + a (e - e_before - D_before)`,
    `u = clip(kp e + ki I + kd D, low, high)`,

    all 0 at the start. The average does not wind up, nor does it remove an offset, and
    the "derivative" is a difference that is not divided by `dt`; for those see
    [`delucax.controllers.PID`][].

    **Arguments:**

    - `kp`, `ki`, `kd`: the gains, as of [`delucax.controllers.PID`][]; 3, 4 and 0 by
        default.
    - `dt`, `reference`, `output`, `bounds`: as there.
    - `time_constant`: T, 0.5 by default.

    **Raises:** `ValueError` if sizes do not fit, or a time is not positive; when it is
    run, if there are not as many outputs as loops.

    Source: Gradu, Hallman, Suo, Yu, Agarwal, Ghai, Singh, Zhang, Majumdar and Hazan,
    2021 (Deluca).

    !!! example

        ```python
        import delucax as dlx
        import jax

        env = dlx.make("pendulum")
        pid = dlx.controllers.LeakyPID(20.0, 5.0, 50.0, dt=env.dt, output=0)
        dlx.rollout(env, pid, key=jax.random.key(0), x0=[0.1, 0.0]).total_cost
        ```
    """

    kp: Real = weight(3.0)
    ki: Real = weight(4.0)
    kd: Real = weight(0.0)
    _: KW_ONLY
    dt: Real = parameter(constraint=positive)
    time_constant: Real = parameter(0.5, constraint=positive)
    reference: Array | Callable[[Any], Array] | None = parameter(None)
    output: Callable[[Array], Array] | int | Sequence[int] | None = _output_field()
    bounds: tuple[Array, Array] | None = bounds_field("LeakyPID", default=None)

    def init(self, *, key: PRNGKey | None = None) -> PyTree:
        zeros = self._zeros()
        return _Averages(zeros, zeros, zeros)

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        error, _ = self._error(t, y)
        # The low-pass filter dI/dt = (e - I) / T by backward Euler.
        share = self.dt / (self.dt + self.time_constant)
        integral = state.integral + share * (error - state.integral)
        change = error - state.error
        derivative = state.derivative + share * (change - state.derivative)
        u = self.kp * error + self.ki * integral + self.kd * derivative
        return self._clip(u, y), _as(_Averages(error, integral, derivative), state)
