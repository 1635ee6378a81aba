"""Periodic orbits of hybrid systems: the Poincare map and its multipliers."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array

from .._check import (
    as_vector,
    check_bool,
    check_choice,
    check_count,
    check_instance,
    is_concrete,
)
from .._check_models import check_forward_mode
from .._jax import bounded_while, first_possible, value_and_jacobians
from .._module import as_float_array, shown
from .._results import choose, promote, raise_on_failure, Result, RESULTS
from .._typing import Numbers, RealScalar
from ..dynamics import Discretized


class Return(eqx.Module):
    """The result of [`delucax.analysis.poincare_map`][].

    **Attributes:**

    - `state`: the state just after the next event, shape `(n,)`.
    - `time`: the time until the event, a scalar.
    - `result`: success; `RESULTS.not_converged` if the event did not fire within
        `max_steps`; otherwise the reason why a step failed.

    !!! example

        ```python
        import delucax as dlx

        dynamics = dlx.Discretized(dlx.systems.BouncingBall(), dt=0.1)
        after = dlx.analysis.poincare_map(dynamics, "bounce", [0.0, 3.0])
        after.state, after.time
        ```

        ```text
        (Array([0. , 2.4], dtype=float32), Array(0.612, dtype=float32))
        ```
    """

    state: Array
    time: Array
    result: Result

    __repr__ = shown


class PeriodicOrbit(eqx.Module):
    """A periodic orbit, the result of [`delucax.analysis.periodic_orbit`][].

    **Attributes:**

    - `state`: the state just after the event, shape `(n,)`.
    - `period`: the period, in units of time, a scalar.
    - `jacobian`: the Jacobian of the map from event to event, shape `(n, n)`.
    - `multipliers`: the eigenvalues of `jacobian`, shape `(n,)`, complex, the largest
        first. The orbit is stable if all multipliers are inside the unit circle. At
        least one multiplier is zero, because the state lies on the same surface at
        every event.
    - `result`: success, or the reason for a failure; one of `delucax.RESULTS`.

    !!! example

        ```python
        import delucax as dlx

        dynamics = dlx.Discretized(dlx.systems.RimlessWheel(slope=0.1), dt=0.05)
        orbit = dlx.analysis.periodic_orbit(dynamics, "step", [-0.29, 1.2])
        orbit.jacobian, orbit.result
        ```
    """

    state: Array
    period: Array
    jacobian: Array
    multipliers: Array
    result: Result

    __repr__ = shown


def poincare_map(
    dynamics: Discretized,
    event: str,
    x: Numbers,
    u: Numbers | None = None,
    *,
    t0: RealScalar = 0.0,
    max_steps: int = 1000,
    throw: bool = True,
) -> Return:
    """The Poincare map: from the state after one event to the state after the next.

    If other events fire before the next event `event`, the map applies them too. The
    system is integrated by `dynamics` in intervals of `dt`, with the same control in
    all intervals. The event may be at any time within an interval. The map is
    differentiable with respect to every array.

    **Arguments:**

    - `dynamics`: a discretised [`delucax.systems.AbstractHybridSystem`][].
    - `event`: the name of the event, one of `dynamics.event_names`.
    - `x`: the state, shape `(n,)`.
    - `u`: the control, shape `(m,)`; zero by default.
    - `t0`: the time of `x`, in units of time; 0 by default.
    - `max_steps`: the largest number of intervals until the event; 1000 by default.
    - `throw`: raise an error if the map fails (default). If false, check `result`.

    **Returns:** a [`delucax.analysis.Return`][].

    **Raises:** `ValueError` if an argument has the wrong kind or shape. With `throw`,
    an error at run time if a step fails or the event does not fire.

    Source: Guckenheimer and Holmes, 1983.

    !!! example

        ```python
        import delucax as dlx

        wheel = dlx.systems.RimlessWheel(slope=0.1)
        dynamics = dlx.Discretized(wheel, dt=0.05)
        dlx.analysis.poincare_map(dynamics, "step", [-0.29, 1.2]).time
        ```

        ```text
        Array(0.77, dtype=float32)
        ```
    """
    where = "poincare_map"
    x, u, index = _arguments(dynamics, event, x, u, where)
    max_steps = check_count(max_steps, "max_steps", where)
    check_bool(throw, "throw", where)
    after = _return(dynamics, index, x, u, as_float_array(t0), max_steps)
    return raise_on_failure(after, where, throw, "the state that was reached")


def _arguments(dynamics, event, x, u, where):
    check_instance(dynamics, Discretized, "dynamics", where)
    if not dynamics.event_names:
        raise ValueError(
            f"{where}: the system of dynamics must be an AbstractHybridSystem with "
            f"events, got {type(dynamics.system).__name__}."
        )
    check_choice(event, tuple(dynamics.event_names), "event", where)
    x = as_vector(x, dynamics.state_size, "x", where)
    u = jnp.zeros(dynamics.control_size, x.dtype) if u is None else u
    u = as_vector(u, dynamics.control_size, "u", where)
    return x, u, dynamics.event_names.index(event)


@eqx.filter_jit
def _return(dynamics, event, x, u, t0, max_steps) -> Return:
    def turn(carry):
        x, time, count, *_ = carry
        outcome = dynamics.until_event(t0 + time, x, u, None, event)
        # A product, because a sum of steps would be rounded at each step.
        after = (count * dynamics.dt + outcome.s).astype(x.dtype)
        done = outcome.stopped | (outcome.result != RESULTS.successful)
        # As in a rollout: at the end of an interval, but not at the event.
        ends = dynamics.system.project(outcome.x).astype(x.dtype)
        x_next = jnp.where(outcome.stopped, outcome.x, ends)
        new = x_next, after, count + 1, done, outcome.result
        over = carry[3]
        return jax.tree.map(lambda a, b: jnp.where(over, a, b), carry, new)

    zero = jnp.zeros((), x.dtype)
    carry = x, zero, jnp.asarray(0), jnp.asarray(False), RESULTS.successful
    # Counted, because the loop may take a few turns more.
    needed = lambda carry: ~carry[3] & (carry[2] < max_steps)
    carry = bounded_while(needed, turn, carry, max_steps)
    x, time, _, done, result = carry
    missed = ~done & (result == RESULTS.successful)
    return Return(x, time, choose(missed, RESULTS.not_converged, result))


def periodic_orbit(
    dynamics: Discretized,
    event: str,
    x0: Numbers,
    u: Numbers | None = None,
    *,
    tolerance: float = 1e-10,
    max_iterations: int = 20,
    max_steps: int = 1000,
    throw: bool = True,
) -> PeriodicOrbit:
    """A periodic orbit of a hybrid system and its multipliers, by Newton's method.

    Newton's method starts from a guess of the state and finds a state that
    [`delucax.analysis.poincare_map`][] maps to itself. The vector field must not depend
    on time. The fixed point is differentiable with respect to the dynamics, by the
    implicit function theorem.

    **Arguments:**

    - `dynamics`, `event`, `u`, `max_steps`, `throw`: as in
        [`delucax.analysis.poincare_map`][]. Dynamics with a `stepsize_controller` need
        an `adjoint` that supports forward mode, for example `diffrax.DirectAdjoint()`.
    - `x0`: the guess, a state just after the event, shape `(n,)`.
    - `tolerance`: the absolute and relative tolerance of the state; 1e-10 by default,
        and at least 8 times machine epsilon.
    - `max_iterations`: the largest number of Newton steps; 20 by default.

    **Returns:** a [`delucax.analysis.PeriodicOrbit`][].

    **Raises:** `ValueError` if an argument has the wrong kind or shape. With `throw`,
    an error at run time if there is no orbit near the guess.

    Source: McGeer, 1990; Goswami, Thuilot and Espiau, 1998.

    !!! example

        ```python
        import delucax as dlx

        wheel = dlx.systems.RimlessWheel(slope=0.1)
        dynamics = dlx.Discretized(wheel, dt=0.05)
        orbit = dlx.analysis.periodic_orbit(dynamics, "step", [-0.29, 1.2])
        orbit.period, orbit.multipliers
        ```
    """
    where = "periodic_orbit"
    x0, u, index = _arguments(dynamics, event, x0, u, where)
    max_steps = check_count(max_steps, "max_steps", where)
    iterations = check_count(max_iterations, "max_iterations", where)
    check_bool(throw, "throw", where)
    check_forward_mode(dynamics, where)
    least = 8 * float(jnp.finfo(x0.dtype).eps)
    given = index, x0, u, max(tolerance, least), iterations, max_steps
    orbit = _orbit(dynamics, *given)
    if is_concrete(x0) and is_concrete(orbit.state):
        if orbit.result != RESULTS.successful:
            # Newton's method diverges if the guess itself does not return to the event.
            # Then that failure is reported.
            zero = jnp.zeros((), x0.dtype)
            first = _return(dynamics, index, x0, u, zero, max_steps).result
            result = choose(first == RESULTS.successful, orbit.result, first)
            orbit = eqx.tree_at(lambda o: o.result, orbit, result)
    return raise_on_failure(orbit, where, throw, "the last iterate")


def _missed(x, dynamics, event, u, max_steps):
    """By how much the map misses its argument."""
    zero = jnp.zeros((), x.dtype)
    after = _return(dynamics, event, x, u, zero, max_steps).state
    return dynamics.difference(after, x)


@eqx.filter_custom_jvp
def _newton_map(x, given):
    return _missed(x, *given)


@_newton_map.def_jvp
def _newton_map_jvp(primals, tangents):
    """The Jacobian in forward mode: `jax.linearize`, which Newton's method calls, makes
    a program of twice the size from the loops of the map."""
    x, given = primals
    dx, dgiven = tangents
    by_given = lambda: eqx.filter_jvp(lambda g: _missed(x, *g), (given,), (dgiven,))
    if dx is None:
        return by_given()
    value, (J,) = value_and_jacobians(lambda x: _missed(x, *given), x)
    change = J @ dx
    if jax.tree.leaves(dgiven):
        change += by_given()[1]
    return value, change


@eqx.filter_jit
def _orbit(dynamics, event, x0, u, tolerance, iterations, max_steps) -> PeriodicOrbit:
    zero = jnp.zeros((), x0.dtype)
    solver = optx.Newton(rtol=tolerance, atol=tolerance)
    given = dynamics, event, u, max_steps
    solved = optx.root_find(
        _newton_map, solver, x0, given, max_steps=iterations, throw=False
    )
    x = solved.value

    def returned(x):
        after = _return(dynamics, event, x, u, zero, max_steps)
        return after.state, after

    # One copy of the map, which compiles slowly.
    forward = jax.jacfwd(returned, has_aux=True)
    J, again = first_possible(forward, jax.jacrev(returned, has_aux=True))(x)
    values: Any = jnp.linalg.eigvals(J)
    values = values[jnp.argsort(-jnp.abs(values))]
    result = promote(solved.result)
    failed = again.result != RESULTS.successful
    result = choose(failed, again.result, result)
    return PeriodicOrbit(x, again.time, J, values, result)
