"""Operating points."""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from .._check import check_bool, check_number
from .._message import shortened
from .._results import choose, Result, RESULTS
from .._typing import RealScalar
from ..systems import AbstractSystem
from ._base import AbstractDynamics
from ._discretized import Discretized, evaluate_field
from ._linear import LinearDynamics
from ._linearize import point_of


_MAX_STEPS = 256


class OperatingPoint(eqx.Module):
    """A state and a control at which a system or dynamics rest.

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


def trim(
    model: AbstractSystem | AbstractDynamics,
    t: RealScalar = 0.0,
    x: Any = None,
    u: Any = None,
    *,
    fix: Any = (),
    throw: bool = True,
) -> OperatingPoint:
    r"""An operating point: a state and a control with

    `f(t, x, u) = 0` for a system, `F(t, x, u) = x` for dynamics.

    Of all such points it is the one nearest to the guess, in units of `|guess| + 1` for
    each state and control; so where there are as many free unknowns as equations it is
    the root, and where there are more it is the least change. Where there is no such
    point it is the one with the least residual, each equation in units of the size of
    its terms, and the result says so.

    Levenberg and Marquardt's method, then Newton's on the conditions of the nearest
    point. Differentiable in forward and reverse mode with respect to all arrays in
    `model`, the guess and what is fixed, by the implicit function theorem. Disturbances
    are zero.

    **Arguments:**

    - `model`: an [`delucax.AbstractSystem`][] or [`delucax.AbstractDynamics`][].
        [`delucax.Discretized`][] dynamics rest where their system does.
    - `t`: time, 0 by default.
    - `x`, `u`: the guess, shapes `(n,)` and `(m,)`; by default the `equilibrium` that
        the model names.
    - `fix`: the states and controls that stay at the guess, by name: one, several, or a
        dictionary from name to value, which replaces that of the guess. None by
        default.
    - `throw`: raise if there is no operating point (default); if false, look at
        `result`.

    **Returns:** [`delucax.dynamics.OperatingPoint`][].

    **Raises:** `ValueError` on a wrong shape or an unknown name, if all is fixed, or if
    no guess is given and the model names no equilibrium; an error at run time as
    `throw` says.

    Source: Nocedal and Wright, 2006.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        tanks = dlx.systems.TwoTank()
        point = dlx.trim(tanks, x=[8.0, 8.0], u=[5.0], fix={"lower": 12.0})
        point.x, point.u
        dlx.linearize(tanks, x=point.x, u=point.u).A
        ```
    """
    where = "trim"
    if not isinstance(model, AbstractSystem | AbstractDynamics):
        raise ValueError(
            f"{where}: model must be an AbstractSystem or AbstractDynamics (for an "
            f"environment, its `dynamics`), got {type(model).__name__}."
        )
    check_bool(throw, "throw", where)
    if isinstance(model, LinearDynamics):
        model = model.at(t)
    x, u = point_of(model, x, u, where)
    guess = jnp.concatenate([x, u])
    values = _fixed(model, fix, where)
    for index, value in values.items():
        if value is not None:
            guess = guess.at[index].set(value)
    free = tuple(i for i in range(guess.size) if i not in values)
    if not free:
        raise ValueError(f"{where}: fix must leave a state or a control free.")
    if isinstance(model, Discretized):
        # Where the field is zero the state stays, by any method that integrates it.
        model = model.system
    point = _solve(model, jnp.asarray(t, guess.dtype), guess, free)
    if not throw:
        return point
    return point.result.error_if(point, point.result != RESULTS.successful)


def relative_drift(drift: Array, jacobian: Array, x: Array, u: Array) -> Array:
    """How far from rest a point is: the largest entry of `drift` over its terms,

    `|drift_i| / sum_j |jacobian_ij| (|z_j| + 1)`, with `z = (x, u)`; what rounding may
    leave of `x - x` counts as a term too.
    """
    size = jnp.abs(jnp.concatenate([x, u])) + 1
    terms = jnp.abs(jacobian) @ size
    terms = terms + 10 * jnp.finfo(x.dtype).eps * jnp.max(size[: x.shape[0]])
    return jnp.max(jnp.abs(drift) / terms)


def _fixed(model: Any, fix: Any, where: str) -> dict[int, Any]:
    """From the index of each state and control that is held to its value, if given."""
    if isinstance(fix, str):
        fix = (fix,)
    names = (*model.state_names, *model.control_names)
    known = isinstance(fix, Mapping | tuple | list | set | frozenset)
    if not known or not all(isinstance(name, str) for name in fix):
        raise ValueError(
            f"{where}: fix must be a name, names or a dictionary from name to value, "
            f"got {shortened(fix)}."
        )
    values = {}
    for name in fix:
        if names.count(name) != 1:
            some = "none" if name not in names else "more than one"
            raise ValueError(
                f"{where}: fix must name states and controls, which are "
                f"{', '.join(names)}; {some} is named {name!r}."
            )
        value = fix[name] if isinstance(fix, Mapping) else None
        if value is not None:
            check_number(value, f"fix[{name!r}]", where)
        values[names.index(name)] = value
    return values


def _drift(model: Any, t: Array, y: Array) -> Array:
    """How fast, or in a step how far, the state moves."""
    n = model.state_size
    x, u = y[:n], y[n:]
    if isinstance(model, AbstractSystem):
        w = jnp.zeros(model.disturbance_size, x.dtype)
        held = w if model.disturbance_names else None
        return evaluate_field(model, t, model.project(x), u, held)
    return model.difference(model.advance(t, x, u, None)[0], x)


@eqx.filter_jit
def _solve(model: Any, t: Array, guess: Array, free: tuple[int, ...]):
    """The point nearest to the guess.

    Unknowns are relative to the guess and residuals to their terms, so that units do
    not matter. With the residual r and its Jacobian J, the nearest point z is that of
    its own linear model, `z = J^+ (J z - r)`: then `J' r = 0`, and z has no part in the
    null space of J. That holds for as many equations as unknowns, for fewer, for more,
    and where J has not full rank.
    """
    n = model.state_size
    moves = jnp.array(free)
    eps = jnp.finfo(guess.dtype).eps
    terms = jnp.abs(jax.jacfwd(_drift, 2)(model, t, guess)) @ (jnp.abs(guess) + 1)
    terms = jnp.where(terms > 0, terms, 1)
    args = model, t, guess, terms

    def at(z, guess):
        return guess.at[moves].add((jnp.abs(guess[moves]) + 1) * z)

    def residual(z, args):
        model, t, guess, terms = args
        return _drift(model, t, at(z, guess)) / terms

    def nearest(z, args):
        J, r = jax.jacfwd(residual)(z, args), residual(z, args)
        # Not by Lineax, whose solves raise in their derivative where there is NaN.
        inverse = jnp.linalg.pinv(J, rtol=float(100 * max(J.shape) * eps))
        return z - inverse @ (J @ z - r)

    arrays, rest = eqx.partition(args, eqx.is_array)
    tol = float(1e3 * eps)
    start = jnp.zeros(len(free), guess.dtype)
    near = optx.least_squares(
        residual,
        optx.LevenbergMarquardt(tol, tol),
        start,
        eqx.combine(lax.stop_gradient(arrays), rest),
        max_steps=_MAX_STEPS,
        throw=False,
    ).value
    z = optx.root_find(
        nearest,
        optx.Newton(tol, tol),
        lax.stop_gradient(near),
        args,
        max_steps=_MAX_STEPS,
        throw=False,
    ).value
    y = at(z, guess)
    drift = _drift(model, t, y)
    J = jax.jacfwd(_drift, 2)(model, t, y)
    rests = relative_drift(drift, J, y[:n], y[n:]) <= eps**0.5
    off = jnp.max(jnp.abs(nearest(z, args)))
    settled = off <= eps ** (1 / 3) * (1 + jnp.max(jnp.abs(z)))
    failure = choose(settled, RESULTS.no_equilibrium, RESULTS.not_converged)
    failure = choose(jnp.all(jnp.isfinite(drift)), failure, RESULTS.diverged)
    x = model.project(y[:n]) if isinstance(model, AbstractSystem) else y[:n]
    result = choose(rests & settled, RESULTS.successful, failure)
    return OperatingPoint(x, y[n:], drift, result)
