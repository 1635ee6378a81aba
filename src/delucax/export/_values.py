"""The arrays of a program while its C is written.

An array may be a table of constants, a view of memory, a few scalars, or a formula,
which is written out wherever it is read.
"""

import abc
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ._expressions import (
    Expr,
    flat_index,
    Index,
    known,
    literal,
    row_major,
)


Indices = tuple[Index, ...]
_SMALL = 16


class Buffer:
    """Memory: an argument, or a part of an array on the stack.

    `home` is the scope in which it was made, `block` the scope in which it may be
    changed. `holders` counts the variables whose arrays use it.
    """

    __slots__ = ("block", "dtype", "holders", "home", "is_own", "name", "size")

    def __init__(self, name: str, dtype: Any, size: int, block: Any, is_own: bool):
        self.name, self.dtype, self.size = name, np.dtype(dtype), size
        self.block = self.home = block
        self.is_own, self.holders = is_own, 0


class Value(abc.ABC):
    """An array. Reading it reads the memory `buffers`."""

    shape: tuple[int, ...]
    dtype: Any
    buffers: frozenset[Buffer] = frozenset()

    @property
    def size(self) -> int:
        return int(np.prod(self.shape, dtype=int))

    @abc.abstractmethod
    def at(self, indices: Indices) -> Expr:
        """The entry at these indices."""

    def entries(self) -> list[Expr]:
        """All entries, in row-major order."""
        ranges = map(range, self.shape)
        return [self.at(tuple(map(known, i))) for i in itertools.product(*ranges)]


class Table(Value):
    """A known array. `named` adds it to the file and returns its name in C."""

    def __init__(self, array: np.ndarray, named: Callable[[np.ndarray], str]):
        self.array, self.named = array, named
        self.shape, self.dtype = array.shape, array.dtype

    def at(self, indices: Indices) -> Expr:
        if all(i.is_known for i in indices):
            return literal(self.array[tuple(i.const for i in indices)], self.dtype)
        if self.is_uniform:
            return literal(self.array.flat[0], self.dtype)
        least, strides = self.least()
        name = self.named(least)
        index = flat_index(indices, strides, known(0))
        reads = index.reads | {name}
        low, high = -np.inf, np.inf
        if self.dtype.kind in "iub":
            low, high = float(self.array.min()), float(self.array.max())
        return Expr(f"{name}[{index.text}]", self.dtype, reads, low=low, high=high)

    def least(self) -> tuple[np.ndarray, tuple[int, ...]]:
        """The array without the axes along which it is constant, and the strides to
        read it with."""
        least, kept = self.array, []
        for axis, extent in enumerate(self.shape):
            first = least.take([0], axis)
            same = extent > 1 and least.size > _SMALL and np.all(least == first)
            least = first if same else least
            kept.append(not same)
        strides = row_major(least.shape)
        return least, tuple(s * k for s, k in zip(strides, kept, strict=True))

    @property
    def is_uniform(self) -> bool:
        """Whether all entries are equal."""
        first = self.array.flat[:1]
        same = self.array == first
        if self.dtype.kind == "f":
            same |= np.isnan(self.array) & np.isnan(first)
        return bool(np.all(same))


class Scalars(Value):
    """An array of a few entries, with an expression for each entry."""

    def __init__(self, shape: Sequence[int], dtype: Any, parts: list[Expr], buffers):
        self.shape, self.dtype, self.parts = tuple(shape), dtype, parts
        self.buffers = buffers
        self._strides = row_major(self.shape)

    def at(self, indices: Indices) -> Expr:
        flat = flat_index(indices, self._strides, known(0))
        assert flat.is_known
        return self.parts[flat.const]

    def entries(self) -> list[Expr]:
        return self.parts


class View(Value):
    """An array in memory, with an offset and strides."""

    def __init__(
        self,
        buffer: Buffer,
        shape: Sequence[int],
        strides: Sequence[int] | None = None,
        start: Index | None = None,
    ):
        self.buffer, self.shape, self.dtype = buffer, tuple(shape), buffer.dtype
        self.strides = row_major(self.shape) if strides is None else tuple(strides)
        self.start = known(0) if start is None else start
        self.buffers = frozenset([buffer])

    def at(self, indices: Indices) -> Expr:
        flat = flat_index(indices, self.strides, self.start)
        text = f"{self.buffer.name}[{flat.text}]"
        return Expr(text, self.dtype, flat.reads | {self.buffer.name})

    @property
    def is_contiguous(self) -> bool:
        """Whether the entries lie one after another."""
        expected = row_major(self.shape)
        pairs = zip(self.shape, self.strides, expected, strict=True)
        return all(n == 1 or a == b for n, a, b in pairs)

    @property
    def pointer(self) -> str:
        """The address of the first entry, as text in C."""
        if self.start.is_known and self.start.const == 0:
            return self.buffer.name
        return f"{self.buffer.name} + {self.start.text}"


class Formula(Value):
    """An array that is a function of its indices."""

    def __init__(
        self,
        shape: Sequence[int],
        dtype: Any,
        at: Callable[[Indices], Expr],
        of: Sequence[Value],
        cost: int = 0,
    ):
        self.shape, self.dtype, self._at = tuple(shape), dtype, at
        self.buffers = frozenset().union(*(v.buffers for v in of))
        # Each read computes the formulas inside again.
        self.cost = cost + sum(v.cost for v in of if isinstance(v, Formula))

    def at(self, indices: Indices) -> Expr:
        return self._at(indices)


def broadcast(indices: Indices, shape: Sequence[int]) -> Indices:
    """The index of an operand that is broadcast along its axes of one entry."""
    if not shape:
        return ()
    pairs = zip(indices, shape, strict=True)
    return tuple(known(0) if extent == 1 else index for index, extent in pairs)


def remapped(
    value: Value, shape: Sequence[int], index: Callable[[Indices], Indices]
) -> Value:
    """The array whose entry at `i` is `value` at `index(i)`, an affine map."""
    shape = tuple(shape)
    if isinstance(value, Scalars):
        corners = itertools.product(*map(range, shape))
        if all(i.is_known for i in index(tuple(known(0) for _ in shape))):
            parts = [value.at(index(tuple(map(known, i)))) for i in corners]
            return Scalars(shape, value.dtype, parts, value.buffers)
    if isinstance(value, View):
        zero = tuple(known(0) for _ in shape)
        origin = index(zero)
        strides = []
        for axis in range(len(shape)):
            moved = list(zero)
            moved[axis] = known(1)
            steps = zip(index(tuple(moved)), origin, value.strides, strict=True)
            strides.append(sum((a.const - b.const) * s for a, b, s in steps))
        start = flat_index(origin, value.strides, value.start)
        return View(value.buffer, shape, strides, start)
    return Formula(shape, value.dtype, lambda i: value.at(index(i)), [value])


def reshaped(value: Value, shape: Sequence[int]) -> Value | None:
    """The same entries in another shape; `None` if they must be copied for it."""
    shape = tuple(shape)
    if isinstance(value, Scalars):
        return Scalars(shape, value.dtype, value.parts, value.buffers)
    if isinstance(value, Table):
        return Table(value.array.reshape(shape), value.named)
    if isinstance(value, View) and value.is_contiguous:
        return View(value.buffer, shape, None, value.start)
    # Axes of one entry may be added and removed freely.
    old = [axis for axis, n in enumerate(value.shape) if n != 1]
    new = [axis for axis, n in enumerate(shape) if n != 1]
    if [value.shape[a] for a in old] != [shape[a] for a in new]:
        return None
    rank, pairs = len(value.shape), dict(zip(old, new, strict=True))

    def index(indices):
        return tuple(indices[pairs[a]] if a in pairs else known(0) for a in range(rank))

    return remapped(value, shape, index)
