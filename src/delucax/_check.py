"""Checks of arguments.

A function `as_...` converts and checks; a function `check_...` only checks. Both raise
a `ValueError` that names the argument, what was expected, and what was given.
"""

import functools
import inspect
import operator
from collections.abc import Callable, Iterable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from ._files import as_path as as_path
from ._message import did_you_mean, shortened
from ._module import (
    as_float_array,
    check_function as check_function,
    get_path,
)
from ._typing import Array, Bounds


Shape = tuple[int, ...]


def is_concrete(x: Any) -> bool:
    """Whether `x` has a value now, that is, whether it is not traced."""
    return not isinstance(x, Tracer)


_HOW_TO_GET = {
    "AbstractCost": " (wrap a function with `delucax.costs.Function`)",
    "AbstractPlanner": " (such as `delucax.planning.ILQR()`)",
    "AbstractDynamics": " (discretise a system with `delucax.Discretized`; for an "
    "environment pass its `dynamics`)",
    "AbstractSystem": " (wrap a function with `delucax.system`; for an environment "
    "pass its `dynamics.system`)",
    "LinearSystem": " (`delucax.linearize` makes one)",
}


def check_instance(
    value: Any, kind: type, name: str, where: str, hint: str | None = None
) -> None:
    """Raise unless `value` is an instance of `kind`. The message says how to make one,
    by `hint` if it is given."""
    if not isinstance(value, kind):
        called = kind.__name__
        article = "an" if called[0] in "AEIOU" else "a"
        hint = _HOW_TO_GET.get(called, "") if hint is None else hint
        raise ValueError(
            f"{where}: {name} must be {article} {called}{hint}, got "
            f"{type(value).__name__}."
        )


def check_key(key: Any, where: str) -> Any:
    """`key`, or an error unless it is one random key."""
    if eqx.is_array(key):
        if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) and key.shape == ():
            return key
        if key.dtype == jnp.uint32 and key.shape == (2,):
            return key
        got = f"an array of shape {key.shape} and dtype {key.dtype}"
    else:
        got = shortened(key)
    raise ValueError(
        f"{where}: key must be one random key such as jax.random.key(0), got {got}."
    )


def _error(value: Any, name: str, where: str, rule: str) -> ValueError:
    """The error for an invalid value."""
    return ValueError(f"{where}: {name} must {rule}, got {shortened(value)}.")


def _as_array(
    value: Any, name: str, where: str, rule: str, fits: Callable[[Shape], bool]
) -> Array:
    """`value` as a floating-point array, or an error unless its shape `fits`. `rule`
    describes the shape in the message."""
    array = as_float_array(value)
    if not eqx.is_inexact_array(array) or not fits(array.shape):
        if not eqx.is_array(array):
            raise _error(value, name, where, rule)
        raise ValueError(f"{where}: {name} must {rule}, got shape {array.shape}.")
    return array


def as_vector(value: Any, size: int, name: str, where: str) -> Array:
    """`value` as a real floating-point vector of `size` entries."""
    rule = f"have shape ({size},)"
    array = _as_array(value, name, where, rule, lambda shape: shape == (size,))
    check_real(array, name, where)
    return array


def as_entries(
    value: Any, size: int | None, name: str, where: str, each: str = "entry"
) -> Array:
    """`value` as a floating-point array: one number for all, or a vector with an entry
    for `each`. The vector has `size` entries, or any number of them if `size` is
    `None`."""
    rule = f"be a number or have shape ({size},)"
    if size is None:
        rule = f"be a number or a vector with an entry for each {each}"
    return _as_array(value, name, where, rule, _fits(size))


def _fits(size: int | None) -> Callable[[Shape], bool]:
    """A function that tests whether a shape is that of a number or of a vector, which
    must have the size `size` if that is given."""
    return lambda shape: len(shape) <= 1 and (size is None or shape in ((), (size,)))


def check_real(array: Array, name: str, where: str) -> None:
    """Raise if an array is complex, because its imaginary part would be lost later."""
    if jnp.iscomplexobj(array):
        raise ValueError(f"{where}: {name} must be real, got dtype {array.dtype}.")


def as_matrix(value: Any, name: str, where: str, *, ndim: int = 2) -> Array:
    """`value` as a floating-point array of `ndim` axes with finite entries."""
    fits = lambda shape: len(shape) == ndim
    array = as_float_array(value)
    if ndim == 2 and eqx.is_array(array) and array.ndim == 1:
        raise ValueError(
            f"{where}: {name} must be a matrix, got shape {array.shape}. `jnp.diag` "
            "makes a diagonal matrix of a vector."
        )
    return as_finite(value, name, where, "be a matrix", fits)


def symmetric_matrix(value: Any, name: str, where: str, *, ndim: int = 2) -> Array:
    """`value` as a symmetric matrix of finite entries, or a stack of them (`ndim=3`).

    An asymmetry by rounding is averaged out.
    """
    matrix = as_matrix(value, name, where, ndim=ndim)
    if matrix.shape[-2] != matrix.shape[-1]:
        raise ValueError(f"{where}: {name} must be square, got shape {matrix.shape}.")
    if is_concrete(matrix):
        array = np.asarray(matrix)
        largest = functools.partial(np.max, axis=(-2, -1), initial=0.0)
        slack = 100 * np.finfo(array.dtype).eps * largest(np.abs(array))
        asymmetry = largest(np.abs(array - np.swapaxes(array, -2, -1)))
        if np.any(asymmetry > slack):
            raise _error(array, name, where, "be symmetric")
        if not np.any(asymmetry):
            return matrix
    return (matrix + matrix.mT) / 2


def as_bounds(
    value: Any, where: str, name: str = "bounds", size: int | None = None
) -> Bounds | None:
    """`value` as `(low, high)`, each a number or a vector (of `size`, if that is
    given)."""
    if value is None:
        return None
    if not isinstance(value, tuple | list) or len(value) != 2:
        raise _error(value, name, where, "be a pair (low, high)")
    low, high = (as_float_array(end) for end in value)
    if size is not None:
        rule, fits = f"be numbers or have shape ({size},)", _fits(size)
        for end in (low, high):
            _as_array(end, name, where, rule, fits)
    fit = all(eqx.is_inexact_array(end) and end.ndim <= 1 for end in (low, high))
    if not fit or low.ndim == high.ndim == 1 and low.shape != high.shape:
        raise _error(value, name, where, "be numbers or vectors of the same size")
    if is_concrete(low) and is_concrete(high):
        if not np.all(np.asarray(low) <= np.asarray(high)):
            raise ValueError(
                f"{where}: {name} must have low <= high, got {low} and {high}."
            )
    return low, high


def check_control_bounds(value: Any, size: int, where: str) -> Bounds | None:
    """`value` as bounds of `size` controls."""
    bounds = as_bounds(value, where)
    for end in bounds or ():
        if end.shape not in ((), (size,)):
            raise ValueError(
                f"{where}: bounds must be numbers or have shape ({size},), with an "
                f"entry for each control, got shape {end.shape}."
            )
    return bounds


def bounds_field(where: str, name: str = "bounds", **options: Any) -> Any:
    """A field that holds `(low, high)`, converted and checked by `as_bounds`. `options`
    go to `eqx.field`."""
    converter = functools.partial(as_bounds, where=where, name=name)
    return eqx.field(converter=converter, **options)


def check_finite(array: Any, name: str, where: str) -> None:
    """Raise if a concrete `array` holds NaN or infinity."""
    if eqx.is_inexact_array(array) and is_concrete(array):
        if not np.all(np.isfinite(np.asarray(array))):
            raise _error(array, name, where, "be finite")


def number_at(tree: Any, path: str, kind: str, within: str, where: str) -> Array:
    """The finite number or array at a path; `kind` is the argument that names it."""
    try:
        value = get_path(tree, path)
    except ValueError as error:
        raise ValueError(f"{where}: {kind}: {error}") from error
    if not eqx.is_inexact_array(value):
        raise ValueError(
            f"{where}: {kind} names {path!r}, whose start value in the {within} must "
            f"be a number, got {shortened(value)}."
        )
    check_finite(value, f"{kind}[{path!r}] (the start value)", where)
    return value


def _check_entries(
    value: Any, name: str, where: str, rule: str, holds: Callable[[Any], Any]
) -> None:
    """Raise if a concrete entry violates `rule`; traced values are skipped."""
    array = as_float_array(value)
    if eqx.is_inexact_array(array):
        if not is_concrete(array) or np.all(holds(np.asarray(array))):
            return
        value = np.asarray(array)
    raise _error(value, name, where, f"be {rule}")


def check_positive(value: Any, name: str, where: str) -> None:
    """Raise unless numbers are positive and finite; traced values are skipped."""
    holds = lambda at: np.isfinite(at) & (at > 0)
    _check_entries(value, name, where, "positive and finite", holds)


def check_step(dt: Any, where: str, name: str = "dt") -> None:
    """Raise unless `dt`, called `name` in the message, is a positive scalar."""
    check_positive(dt, name, where)
    if np.shape(dt) != ():
        raise ValueError(f"{where}: {name} must be a number, got shape {np.shape(dt)}.")


def check_number(value: Any, name: str, where: str) -> None:
    """Raise unless `value` is a finite real scalar; traced values are not inspected."""
    if isinstance(value, int | float) and np.isfinite(value):
        return  # quickly, because to make a JAX array takes 0.1 ms
    array = _as_array(value, name, where, "be a number", lambda shape: shape == ())
    check_real(array, name, where)
    check_finite(array, name, where)


def as_number(value: Any, name: str, where: str) -> Any:
    """`value` as a scalar. A concrete value becomes a Python number, so that it stays
    concrete while other things are traced."""
    if isinstance(value, Tracer):
        return _as_array(value, name, where, "be a number", lambda shape: shape == ())
    number = np.asarray(value)
    if number.shape != () or number.dtype.kind not in "iuf":
        raise _error(value, name, where, "be a number")
    if not np.isfinite(number):
        raise _error(value, name, where, "be finite")
    return float(number)


def check_range(
    value: Any, name: str, where: str, low: Any = 0, high: float | int = np.inf
) -> None:
    """Raise unless numbers are in `[low, high]`; traced values are skipped."""
    least = as_float_array(low)

    def holds(at):
        if not is_concrete(least):
            return True
        return eqx.is_inexact_array(least) and (at >= np.asarray(least)) & (at <= high)

    rule = f"at least {low}" if high == np.inf else f"between {low} and {high}"
    _check_entries(value, name, where, rule, holds)


def check_choice(value: Any, choices: tuple[Any, ...], name: str, where: str) -> None:
    """Raise unless `value` is one of `choices`."""
    if value not in choices:
        words = [repr(choice) for choice in choices]
        rule = " or ".join(words) if len(words) == 2 else f"one of {', '.join(words)}"
        raise ValueError(f"{where}: {name} must be {rule}, got {value!r}.")


def check_bool(value: Any, name: str, where: str) -> bool:
    """`value` as a bool, or an error unless it is True or False."""
    if not isinstance(value, bool | np.bool_):
        raise _error(value, name, where, "be True or False")
    return bool(value)


def check_count(value: Any, name: str, where: str, least: int = 1) -> int:
    """`value` as an int of at least `least`."""
    try:
        count = least - 1 if isinstance(value, bool) else operator.index(value)
    except TypeError:  # not a whole number, or a traced one
        count = least - 1
    if count < least:
        raise _error(value, name, where, f"be a whole number of at least {least}")
    return count


def check_at_most(
    value: int, most: int, name: str, where: str, of: str | None = None
) -> None:
    """Raise if a count exceeds `most`. `of` says what `most` counts."""
    if value > most:
        limit = most if of is None else f"the {most} {of}"
        raise ValueError(f"{where}: {name} must be at most {limit}, got {value}.")


def as_rows(
    value: Any, size: int, name: str, where: str, steps: int | None = None
) -> Array:
    """`value` as a real array of shape `(steps, size)`, with any number of steps if
    `steps` is `None`."""
    rows = "steps" if steps is None else steps
    rule = f"have shape ({rows}, {size}), a row for each step"
    fits = lambda s: len(s) == 2 and s[1] == size and steps in (None, s[0])
    array = _as_array(value, name, where, rule, fits)
    if array.shape[0] == 0:
        raise ValueError(f"{where}: {name} must have at least one step.")
    check_real(array, name, where)
    return array


def keywords_of(function: Callable[..., Any]) -> tuple[str, ...]:
    """The names of the arguments that `function` takes as keywords."""
    parameters = inspect.signature(function).parameters.values()
    keyword = inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY
    return tuple(p.name for p in parameters if p.kind in keyword)


def check_keywords(
    given: Iterable[str], where: str, *functions: Callable[..., Any]
) -> None:
    """Raise unless each name of `given` is a keyword of one of `functions`."""
    names = list(dict.fromkeys(n for f in functions for n in keywords_of(f)))
    for name in given:
        if name not in names:
            raise ValueError(
                f"{where}: no argument is called {name!r}; {did_you_mean(name, names)}"
            )


FLOAT32_MAX = float(np.finfo(np.float32).max)
"""The stand-in for an infinite bound of a space, as Gymnasium advises."""


def check_vector(value: Any, name: str, where: str) -> None:
    """Raise unless `value` is an array of one axis with finite entries."""
    array = _as_array(value, name, where, "be a vector", lambda s: len(s) == 1)
    check_finite(array, name, where)


def check_definite(R: Array, name: str, where: str, definite: bool) -> None:
    """Raise unless `R`, or each matrix of a stack, is positive definite, or
    semidefinite if `definite` is false. Traced matrices are skipped."""
    if not is_concrete(R):
        return
    arrays = scaled = np.asarray(R).reshape(-1, *np.shape(R)[-2:])
    if definite:
        # In units in which the diagonal is 1, because entries have different units.
        diagonal = np.diagonal(arrays, axis1=1, axis2=2)
        by = np.sqrt(np.where(diagonal > 0, diagonal, 1))
        scaled = arrays / by[:, :, None] / by[:, None, :]
    eigenvalues = np.linalg.eigvalsh(scaled)
    # The computed eigenvalues of a symmetric matrix are off by a few eps times the
    # largest (Weyl). For a semidefinite product C'C the error grows with its rows.
    rounding = np.finfo(arrays.dtype).eps * np.max(np.abs(eigenvalues), axis=1)
    least, n = eigenvalues[:, 0], arrays.shape[-1]
    slack = -rounding if definite else 100 * n * rounding
    bad = (least < -slack) | (definite & (least <= 0))
    if np.any(bad):
        kind, array = "definite" if definite else "semidefinite", arrays[bad.argmax()]
        raise ValueError(
            f"{where}: {name} must be positive {kind}, got {array}, whose least "
            f"eigenvalue is {np.linalg.eigvalsh(array)[0]:.3g}."
        )


def as_finite(
    value: Any, name: str, where: str, rule: str, fits: Callable[[Shape], bool]
) -> Array:
    """`value` as a floating-point array of finite entries, or an error unless its shape
    `fits`. `rule` describes the shape in the message."""
    array = _as_array(value, name, where, rule, fits)
    check_finite(array, name, where)
    return array


def finite_vector(value: Any, size: int, name: str, where: str) -> Array:
    """`value` as a real vector of `size` finite entries, or an error."""
    vector = as_vector(value, size, name, where)
    check_finite(vector, name, where)
    return vector


def finite_rows(
    value: Any, size: int, name: str, where: str, steps: int | None = None
) -> Array:
    """`value` by `as_rows`, or an error unless its entries are finite."""
    rows = as_rows(value, size, name, where, steps)
    check_finite(rows, name, where)
    return rows
