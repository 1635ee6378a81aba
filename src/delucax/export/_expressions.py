"""Expressions of C: their text, their type, what they read, and their known bounds.

An index is an affine function of loop counters. So reads of neighbouring entries are
visible in C, and a compiler can vectorise them.
"""

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np


_LOCAL = {
    "float64": "double",
    "float32": "float",
    "int8": "int8_t",
    "int16": "int16_t",
    "int32": "int32_t",
    "int64": "int64_t",
    "uint8": "uint8_t",
    "uint16": "uint16_t",
    "uint32": "uint32_t",
    "uint64": "uint64_t",
    "bool": "int",
}

NOTHING: frozenset[str] = frozenset()


def is_supported(dtype: Any) -> bool:
    """Whether the type can be written in C."""
    return str(dtype) in _LOCAL


def c_type(dtype: Any, stored: bool = False) -> str:
    """The type in C: of a variable, or, if `stored`, of the entries of an array."""
    if stored and np.dtype(dtype).kind == "b":
        return "unsigned char"
    return _LOCAL[str(np.dtype(dtype))]


class Expr(NamedTuple):
    """An expression.

    **Attributes:**

    - `text`: its text, in parentheses if it needs them.
    - `dtype`: its type.
    - `reads`: the variables and arrays that it reads.
    - `cost`: the number of its operations.
    - `value`: its value, if it is known.
    - `low`, `high`: the bounds of an integer.
    """

    text: str
    dtype: Any
    reads: frozenset[str] = NOTHING
    cost: int = 0
    value: Any = None
    low: float | int = -math.inf
    high: float | int = math.inf


def union(sets: Iterable[frozenset[str]]) -> frozenset[str]:
    """The union of sets of names."""
    return frozenset().union(*sets)


def literal(value: Any, dtype: Any) -> Expr:
    """A known number as an expression."""
    dtype = np.dtype(dtype)
    value = dtype.type(value)
    kind = dtype.kind
    if kind == "b":
        number = int(value)
        return Expr(str(number), dtype, value=bool(value), low=number, high=number)
    if kind in "iu":
        number = int(value)
        text = str(number)
        if dtype.itemsize == 8:
            text += "LL" if kind == "i" else "ULL"
        elif kind == "u":
            text += "u"
        if number < 0:
            # C has no literal for the most negative integer.
            least = number == np.iinfo(dtype).min
            text = f"({text[1:] if least else text})" if not least else _least(dtype)
        return Expr(text, dtype, value=number, low=number, high=number)
    suffix = "f" if dtype == np.float32 else ""
    if np.isnan(value):
        text = "NAN"
    elif np.isinf(value):
        text = "INFINITY" if value > 0 else "(-INFINITY)"
    else:
        text = np.format_float_scientific(value, trim="-", unique=True)
        short = repr(float(value)) if dtype == np.float64 else str(value)
        text = short if len(short) <= len(text) else text
        if not any(mark in text for mark in ".e"):
            text += ".0"
        text += suffix
        if text.startswith("-"):
            text = f"({text})"
    return Expr(text, dtype, value=float(value))


def _least(dtype: np.dtype) -> str:
    return f"INT{8 * dtype.itemsize}_MIN"


class Index(NamedTuple):
    """An index, `const + sum of coefficient * term`, where the terms are integers in C.

    **Attributes:** `terms`: the tuple `(text, coefficient, low, high)` of each term.
    """

    const: int = 0
    terms: tuple[tuple[str, int, float, float], ...] = ()
    reads: frozenset[str] = NOTHING

    @property
    def text(self) -> str:
        words = [t if c == 1 else f"{c} * {t}" for t, c, *_ in self.terms if c > 0]
        words += [f"{-c} * {t}" if c != -1 else t for t, c, *_ in self.terms if c < 0]
        if self.const or not words:
            words.append(str(abs(self.const)))
        ups = sum(c > 0 for _, c, *_ in self.terms)
        signs = [" + "] * ups + [" - "] * (len(self.terms) - ups)
        if len(words) > len(self.terms):
            signs.append(" - " if self.const < 0 else " + ")
        text = "".join(s + w for s, w in zip(signs, words, strict=True))
        return text[3:] if text.startswith(" + ") else text[1:2] + text[3:]

    @property
    def low(self) -> float | int:
        return self.const + sum(c * (a if c > 0 else b) for _, c, a, b in self.terms)

    @property
    def high(self) -> float | int:
        return self.const + sum(c * (b if c > 0 else a) for _, c, a, b in self.terms)

    @property
    def is_known(self) -> bool:
        return not self.terms

    def plus(self, other: "Index | int", times: int = 1) -> "Index":
        """The sum of this index and `times` another."""
        if isinstance(other, int | np.integer):
            return self._replace(const=self.const + int(other) * times)
        if times == 0:
            return self
        terms = {text: (c, a, b) for text, c, a, b in self.terms}
        for text, c, a, b in other.terms:
            before = terms.get(text, (0, a, b))[0]
            terms[text] = (before + times * c, a, b)
        kept = tuple((text, *rest) for text, rest in terms.items() if rest[0])
        const = self.const + times * other.const
        return Index(const, kept, self.reads | other.reads)

    def expr(self, dtype: Any) -> Expr:
        """The index as an expression."""
        if self.is_known:
            return literal(self.const, dtype)
        text = self.text
        if len(self.terms) > 1 or self.const or self.terms[0][1] != 1:
            text = f"({text})"
        cost = len(self.terms)
        return Expr(text, np.dtype(dtype), self.reads, cost, None, self.low, self.high)


def known(number: int | np.integer) -> Index:
    """A constant index."""
    return Index(int(number))


def index_of(expr: Expr) -> Index:
    """An integer expression as an index."""
    if expr.value is not None:
        return Index(int(expr.value))
    return Index(0, ((expr.text, 1, expr.low, expr.high),), expr.reads)


def flat_index(indices: Iterable[Index], strides: Iterable[int], start: Index) -> Index:
    """`start + sum of stride * index`."""
    for index, stride in zip(indices, strides, strict=True):
        start = start.plus(index, stride)
    return start


def row_major(shape: Iterable[int]) -> tuple[int, ...]:
    """The strides of a contiguous array."""
    strides, size = [], 1
    for extent in reversed(tuple(shape)):
        strides.append(size)
        size *= extent
    return tuple(reversed(strides))
