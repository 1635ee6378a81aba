"""Optax optimisers that can be compared, so that `fit` does not compile again."""

import functools
from collections.abc import Iterator
from types import CellType, CodeType, FunctionType, ModuleType
from typing import Any

import optax


class Optimiser:
    """An Optax optimiser. Two of them are equal if they were made in the same way.

    Each call of `optax.adam(1e-3)` makes new functions, for which JAX would compile
    again. This class compares the code of the functions and the values that they read,
    so an equal optimiser uses the compiled programs of the first.
    """

    def __init__(self, transformation: optax.GradientTransformation):
        self.init = transformation.init
        self.update = optax.with_extra_args_support(transformation).update
        self._content = _content(transformation, {})

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Optimiser) and self._content == other._content

    def __hash__(self) -> int:
        return hash(self._content)


class _Itself:
    """An object without a hash, which equals only itself."""

    # It holds the object, so that no other one gets the same identity.
    def __init__(self, value: Any):
        self.value = value

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Itself) and self.value is other.value

    def __hash__(self) -> int:
        return id(self.value)


def _content(value: Any, numbers: dict[int, int]) -> Any:
    """What to compare of `value`: the contents of a function or container, else the
    object itself. `numbers` numbers the functions and containers by their identity."""
    # The type is part of it, because 1 equals True and 1.0.
    kind = type(value)
    if issubclass(kind, FunctionType | tuple | list | dict):
        # Functions may call themselves and each other.
        if id(value) in numbers:
            return kind, numbers[id(value)]
        numbers[id(value)] = len(numbers)
    parts = lambda values: tuple(_content(one, numbers) for one in values)
    if kind is FunctionType:
        cells = parts(map(_held, value.__closure__ or ()))
        read = parts(_globals(value.__code__, value.__globals__))
        defaults = parts((value.__defaults__, value.__kwdefaults__))
        return value.__code__, id(value.__globals__), read, cells, defaults
    if kind is functools.partial:
        return kind, parts((value.func, value.args, value.keywords))
    if isinstance(value, tuple | list):
        return kind, parts(value)
    if isinstance(value, dict):
        return kind, tuple(value), parts(value.values())
    try:
        hash(value)
    except TypeError:
        return kind, _Itself(value)
    return kind, value


def _globals(code: CodeType, given: dict[str, Any]) -> Iterator[Any]:
    """The global values that a function may read, without modules."""
    for name in code.co_names:
        # Some of these names are of attributes. To compare too much does no harm.
        if name in given and not isinstance(given[name], ModuleType):
            yield given[name]
    for part in code.co_consts:
        if isinstance(part, CodeType):
            yield from _globals(part, given)


def _held(cell: CellType) -> Any:
    """The value in a closure cell, or the cell itself if it is still empty."""
    try:
        return cell.cell_contents
    except ValueError:
        return cell
