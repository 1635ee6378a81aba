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
    """Some entries of an observation, by index."""

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
    """The map from an observation to the outputs of the loops, as a function."""
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
    """`after` in the dtypes of `before`, because a loop must not change them."""
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
        """The number of loops: the common size of all vectors, or 1 if all are
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
        """`(r(t) - h(y), h(y))`, checked to have one entry per loop."""
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
                f"{name}: the number of outputs must be {loops}, one per loop, but "
                f"{what} shape {measured.shape}. Choose what each loop follows, such "
                "as output=0."
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
    r"""Proportional-integral-derivative (PID) control, one loop per control.

    With the error $e = r(t) - h(y)$ and steps of $\Delta t$:

    $$\begin{aligned}
    v_k &= k_p e_k + I_k + k_d D_k, \qquad u_k = \operatorname{clip}(v_k, \mathrm{low},
    \mathrm{high}) \\
    I_{k+1} &= I_k + \Delta t\, (k_i e_k + (u_k^\mathrm{applied} - v_k) / T_a) \\
    D_k &= (T_d D_{k-1} + z_k - z_{k-1}) / (T_d + \Delta t)
    \end{aligned}$$

    The derivative $D$ passes through a first-order lag and starts at 0. By default $D$
    is the derivative of $z = -h(y)$, so a jump of the reference does not make $D$ jump.
    With `derivative_on="error"`, $z = e$.

    The second term of the integral is back-calculation, which prevents windup.
    Back-calculation uses the control that was applied, so it also works for the bounds
    of the environment. A loop with $k_i = 0$ has no integral.

    **Arguments:**

    - `kp`, `ki`, `kd`: the gains $k_p$, $k_i$ and $k_d$, each a number or a vector with
        an entry for each loop; trainable. `ki` and `kd` are 0 by default. The units of
        $k_p$, $k_i$ and $k_d$ are the unit of the control divided by the units of the
        error, of its integral and of its derivative, in this order.
    - `dt`: the control interval $\Delta t$, equal to the environment's `dt`.
    - `reference`: $r$, a function of time, a vector or a number; 0 by default.
    - `output`: $h$, which computes the controlled outputs from the observation: an
        index into the observation, a tuple of indices, a matrix, or a function of the
        observation. By default all entries of the observation are outputs.
    - `bounds`: `(low, high)`, each a number or a vector; none by default.
    - `derivative_time_constant`: $T_d$, the time constant of the first-order lag of the
        derivative, `dt` by default; 0 for no lag.
    - `derivative_on`: `"measurement"` (default) or `"error"`.
    - `anti_windup_time`: $T_a$, at least `dt`. The default is the integral time
        `kp / ki` of each loop, or `dt` if the integral time is shorter than `dt`.

    **Raises:** `ValueError` if the sizes of the arguments do not fit each other, or
    `dt` or a time constant is out of its range; at run time, if the number of outputs
    is not the number of loops.

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

        ```text
        Array(0.093, dtype=float32)
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
        # Before the checks of the base class, because the other times need a valid dt.
        check_step(dt, "PID")
        check_range(dt if lag is None else lag, "derivative_time_constant", "PID")
        check_range(dt if windup is None else windup, "anti_windup_time", "PID", dt)

    def init(self, *, key: PRNGKey | None = None) -> PyTree:
        zeros = self._zeros()
        return _Memory(zeros, zeros, zeros, jnp.zeros((), bool), zeros)

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        error, measured = self._error(t, y)
        moving = -measured if self.derivative_on == "measurement" else error
        # The first call has no previous value, so its derivative is zero.
        step = jnp.where(state.started, moving - state.previous, 0)
        lag = self.derivative_time_constant
        lag = self.dt if lag is None else lag
        # Backward Euler on `T_d D' + D = dz/dt`: stable for any T_d, and the plain
        # difference `step / dt` for T_d = 0.
        slope = (lag * state.slope + step) / (lag + self.dt)
        asked = self.kp * error + state.integral + self.kd * slope
        # The gain is inside the sum, so that a change of ki makes no jump (bumpless).
        integral = state.integral + self.dt * self.ki * error
        # The new integral acts from the next step on, after `applied` has corrected it.
        after = _Memory(integral, slope, moving, jnp.ones((), bool), asked)
        return self._clip(asked, y), _as(after, state)

    def applied(self, u: Array, cost: Array, state: PyTree) -> PyTree:
        # Back-calculation, from u as the environment applied it.
        correction = self.dt * self._windup_rate() * (u - state.asked)
        return _as(state._replace(integral=state.integral + correction), state)

    def _windup_rate(self):
        """`1 / T_a`, or 0 for a loop without an integral."""
        # With T_a < dt the correction would overshoot and oscillate.
        fastest = 1 / self.dt
        if self.anti_windup_time is None:
            no_kp = self.kp == 0
            # T_a is the integral time kp / ki, as textbooks suggest for PI (Åström and
            # Hägglund, 2006). The inner `where` avoids NaN gradients at kp = 0.
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
    r"""The PID of the original Deluca, whose integral is an exponential average.

    With the error $e = r(t) - h(y)$ and $a = \Delta t / (\Delta t + T)$:

    $$\begin{aligned}
    I_k &= I_{k-1} + a\, (e_k - I_{k-1}) \\
    D_k &= D_{k-1} + a\, (e_k - e_{k-1} - D_{k-1}) \\
    u_k &= \operatorname{clip}(k_p e_k + k_i I_k + k_d D_k, \mathrm{low}, \mathrm{high})
    \end{aligned}$$

    The averages $I$ and $D$ and the error $e$ are 0 before the first step. The average
    $I$ does not wind up, but it does not remove a constant error of the outputs. The
    "derivative" $D$ is an average of differences that is not divided by `dt`. For an
    exact integral and derivative, use [`delucax.controllers.PID`][].

    **Arguments:**

    - `kp`, `ki`, `kd`: the gains $k_p$, $k_i$ and $k_d$, as in
        [`delucax.controllers.PID`][]; 3, 4 and 0 by default.
    - `dt`, `reference`, `output`, `bounds`: as in [`delucax.controllers.PID`][].
    - `time_constant`: $T$, 0.5 by default.

    **Raises:** `ValueError` if the sizes of the arguments do not fit each other, or
    `dt` or `time_constant` is not positive; at run time, if the number of outputs is
    not the number of loops.

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

        ```text
        Array(7.03, dtype=float32)
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
