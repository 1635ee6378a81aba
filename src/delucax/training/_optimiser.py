"""Optax optimisers that can be compared, so that `fit` does not compile again."""

import functools
from types import CellType, FunctionType
from typing import Any

import optax


class Optimiser:
    """An Optax optimiser. Two of them are equal if they were made in the same way.

    Each call of `optax.adam(1e-3)` makes new functions, for which JAX would compile
    again. This class compares the code of the functions and the values in their
    closures, so an equal optimiser uses the compiled programs of the first.
    """

    def __init__(self, transformation: optax.GradientTransformation):
        self.init = transformation.init
        self.update = optax.with_extra_args_support(transformation).update
        self._content = _content(transformation)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Optimiser) and self._content == other._content

    def __hash__(self) -> int:
        return hash(self._content)


def _content(value: Any, *inside: Any) -> Any:
    """What to compare of `value`: the contents of a function or container, else the
    object itself, or its identity if it has no hash."""
    # The type is part of it, because 1 equals True and 1.0.
    kind = type(value)
    if any(value is other for other in inside):
        return kind
    parts = functools.partial(_contents, inside=(*inside, value))
    if kind is FunctionType:
        cells = parts(map(_held, value.__closure__ or ()))
        defaults = parts((value.__defaults__, value.__kwdefaults__))
        return value.__code__, id(value.__globals__), cells, defaults
    if kind is functools.partial:
        return kind, parts((value.func, value.args, value.keywords))
    if isinstance(value, tuple | list):
        return kind, parts(value)
    if isinstance(value, dict):
        return kind, tuple(value), parts(value.values())
    try:
        hash(value)
    except TypeError:
        return kind, id(value)
    return kind, value


def _contents(values: Any, inside: tuple[Any, ...]) -> tuple[Any, ...]:
    return tuple(_content(value, *inside) for value in values)


def _held(cell: CellType) -> Any:
    """The value in a closure cell, or the cell itself if it is still empty."""
    try:
        return cell.cell_contents
    except ValueError:
        return cell
