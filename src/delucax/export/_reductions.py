"""Rules for reductions over axes, cumulative sums and products of matrices."""

import itertools
from typing import Any

import numpy as np

from ._elementwise import operation
from ._expressions import Expr, known, literal
from ._values import remapped, Scalars, Table, View


_REDUCED = {
    "reduce_sum": "add",
    "reduce_prod": "mul",
    "reduce_max": "max",
    "reduce_min": "min",
    "reduce_and": "and",
    "reduce_or": "or",
    "reduce_xor": "xor",
}
_CUMULATED = {"cumsum": "add", "cumprod": "mul", "cummax": "max", "cummin": "min"}
_FEW_TERMS = 8
_FEW_PRODUCTS = 48


def _combiner(e, op, dtype):
    make, _ = operation(op, {}, [np.dtype(dtype)] * 2, dtype, e.shared)
    return make


def _neutral(op, dtype):
    kind = np.dtype(dtype).kind
    if op in ("add", "or", "xor"):
        return 0
    if op == "and" and kind in "iu":
        return -1 if kind == "i" else np.iinfo(dtype).max
    if op in ("mul", "and"):
        return 1
    ends = {"f": (-np.inf, np.inf), "b": (False, True)}.get(kind)
    if ends is None:
        info = np.iinfo(dtype)
        ends = info.min, info.max
    return ends[op == "min"]


def _spread(shape, axes, kept, reduced):
    """The index of the operand, from the indices of its kept and reduced axes."""
    kept, reduced = iter(kept), iter(reduced)
    return tuple(next(reduced if a in axes else kept) for a in range(len(shape)))


def reduce(e, node, x):
    axes, out = tuple(node.params["axes"]), node.outs[0]
    op = _REDUCED[node.op]
    combine = _combiner(e, op, out.dtype)
    extents = [x.shape[a] for a in axes]
    count = int(np.prod(extents, dtype=int))
    if count == 0:
        fill = literal(_neutral(op, out.dtype), out.dtype)
        return e.formula(out.shape, out.dtype, lambda i: fill, (), 0)
    if count <= _FEW_TERMS and e.is_few(out):

        def total(kept):
            parts = itertools.product(*map(range, extents))
            entries = [
                x.at(_spread(x.shape, axes, kept, map(known, part))) for part in parts
            ]
            sum_ = entries[0]
            for entry in entries[1:]:
                sum_ = combine([sum_, entry])
            return sum_

        x = e.indexable(x)
        return e.formula(out.shape, out.dtype, total, (x,), count - 1)
    x = e.indexable(x)
    start = literal(_neutral(op, out.dtype), out.dtype)

    def loop(kept):
        sum_ = e.variable(out.dtype, start)
        with e.over(extents) as reduced:
            entry = x.at(_spread(x.shape, axes, kept, reduced))
            e.assign(sum_, combine([sum_, entry]))
        return sum_

    return _by_entry(e, out, loop)


def _by_entry(e, out, compute):
    """An array whose entries are computed by statements, one after another."""
    if e.is_few(out):
        corners = itertools.product(*map(range, out.shape))
        parts = [compute(tuple(map(known, i))) for i in corners]
        return Scalars(out.shape, out.dtype, parts, frozenset())
    place = e.new_view(out.shape, out.dtype)
    with e.over(out.shape) as indices:
        e.store(place, indices, compute(indices))
    return place


def extreme(e, node, x):
    """The index of the first largest or smallest entry, or of the first NaN."""
    (axis,), out, x = node.params["axes"], node.outs[0], e.indexable(e.cheap(x))
    sign = ">" if node.op == "argmax" else "<"

    def search(kept):
        at = lambda k: x.at((*kept[:axis], k, *kept[axis:]))
        best, where = (
            e.variable(x.dtype, at(known(0))),
            e.variable(out.dtype, _zero(out)),
        )
        with e.loop(x.shape[axis]) as k:
            new = at(k)
            test = f"{new.text} {sign} {best.text}"
            if x.dtype.kind == "f":
                test = f"({test} || {new.text} != {new.text})"
                test += f" && {best.text} == {best.text}"
            reads = new.reads | best.reads
            moved = e.variable(bool, Expr(f"({test})", np.dtype(bool), reads, 2))
            for kept_, entry in ((where, k.expr(out.dtype)), (best, new)):
                text = f"({moved.text} ? {entry.text} : {kept_.text})"
                all_ = moved.reads | entry.reads | kept_.reads
                e.assign(kept_, Expr(text, kept_.dtype, all_, 1))
        return where

    return _by_entry(e, out, search)


def _zero(out):
    return literal(0, out.dtype)


def cumulate(e, node, x):
    axis, back, out = node.params["axis"], node.params["reverse"], node.outs[0]
    combine = _combiner(e, _CUMULATED[node.op], out.dtype)
    place, x = e.new_view(out.shape, out.dtype), e.indexable(x)
    others = [1 if a == axis else n for a, n in enumerate(out.shape)]
    n = out.shape[axis]
    with e.over(others) as rest:

        def at(k):
            return (*rest[:axis], k, *rest[axis + 1 :])

        first = known(n - 1 if back else 0)
        sum_ = e.variable(out.dtype, x.at(at(first)))
        e.store(place, at(first), sum_)
        if n > 1:
            with e.loop(n - 1) as k:
                index = known(n - 2).plus(k, -1) if back else k.plus(1)
                e.assign(sum_, combine([sum_, x.at(at(index))]))
                e.store(place, at(index), sum_)
    return place


def dot(e, node, a, b):
    (in_a, in_b), (batch_a, batch_b) = node.params["dimension_numbers"]
    out = node.outs[0]
    if a.dtype != out.dtype or b.dtype != out.dtype:
        a, b = (_cast(e, v, out.dtype) for v in (a, b))
    free_a = [k for k in range(len(a.shape)) if k not in (*in_a, *batch_a)]
    free_b = [k for k in range(len(b.shape)) if k not in (*in_b, *batch_b)]
    extents = [a.shape[k] for k in in_a]
    size, count = int(np.prod(out.shape, dtype=int)), int(np.prod(extents, dtype=int))
    cut = len(batch_a), len(batch_a) + len(free_a)

    def index(rank, batch_axes, inner_axes, free_axes, batch, inner, free):
        at: list[Any] = [None] * rank
        for axes, values in (
            (batch_axes, batch),
            (inner_axes, inner),
            (free_axes, free),
        ):
            for axis, value in zip(axes, values, strict=True):
                at[axis] = value
        return tuple(at)

    def factors(indices, inner):
        batch, left, right = (
            indices[: cut[0]],
            indices[cut[0] : cut[1]],
            indices[cut[1] :],
        )
        return (
            a.at(index(len(a.shape), batch_a, in_a, free_a, batch, inner, left)),
            b.at(index(len(b.shape), batch_b, in_b, free_b, batch, inner, right)),
        )

    if count == 0:
        return e.zeros(out.shape, out.dtype)
    times, plus = _combiner(e, "mul", out.dtype), _combiner(e, "add", out.dtype)
    if e.is_few(out) and size * count <= _FEW_PRODUCTS:
        a, b = e.cheap(a), e.cheap(b)

        def total(indices):
            parts = itertools.product(*map(range, extents))
            terms = [
                term
                for part in parts
                if (term := _product(times, *factors(indices, tuple(map(known, part)))))
            ]
            if not terms:
                return literal(0, out.dtype)
            sum_ = terms[0]
            for term in terms[1:]:
                sum_ = plus([sum_, term])
            return sum_

        return e.formula(out.shape, out.dtype, total, (a, b), 2 * count)
    # If the last axis of the result and of the right factor is contiguous, it is the
    # innermost loop: then no sum waits for the one before it.
    a = e.indexable(e.cheap(a))
    a, b = _in_rows(e, a, free_a, free_b, in_a), e.indexable(e.cheap(b))
    b = e.stored(b) if isinstance(b, Table) else b
    if not out.shape or size == 1:
        sum_ = e.variable(out.dtype, _zero(out))
        zero = tuple(known(0) for _ in out.shape)
        with e.over(extents) as inner:
            e.assign(sum_, plus([sum_, times(list(factors(zero, inner)))]))
        return Scalars(out.shape, out.dtype, [sum_], frozenset())
    place = e.new_view(out.shape, out.dtype)
    *outer, last = out.shape
    one = tuple(known(0) for _ in extents)
    if count == 1:
        with e.over(out.shape) as at:
            e.store(place, at, times(list(factors(at, one))))
        return place
    right, axis = (b, free_b[-1]) if free_b else (a, free_a[-1] if free_a else 0)
    if not isinstance(right, View) or right.strides[axis] != 1:
        with e.over(out.shape) as at:
            sum_ = e.variable(out.dtype, _zero(out))
            with e.over(extents) as inner:
                e.assign(sum_, plus([sum_, times(list(factors(at, inner)))]))
            e.store(place, at, sum_)
        return place
    with e.over(outer) as before:
        with e.loop(last) as k:
            e.store(place, (*before, k), literal(0, out.dtype))
        with e.over(extents) as inner:
            # Read once: a compiler does not know that it stays the same in the loop.
            held, same = None, 0 if free_b else 1
            if free_a or free_b:
                held = e.define(factors((*before, known(0)), inner)[same])
            with e.loop(last) as k:
                at = (*before, k)
                pair = list(factors(at, inner))
                pair[same] = pair[same] if held is None else held
                e.store(place, at, plus([place.at(at), times(pair)]))
    return place


def _product(times, left, right):
    """The product. A factor that is the constant 1 is left out."""
    if left.value == 1:
        return right
    if right.value == 1:
        return left
    return times([left, right])


def _in_rows(e, a, free_a, free_b, in_a):
    """The left factor. A constant matrix times a vector is stored by columns."""
    if free_b or not isinstance(a, Table) or len(free_a) != 1 or len(in_a) != 1:
        return a
    if free_a[0] == len(a.shape) - 1 or len(a.shape) != 2:
        return a
    turned = Table(np.ascontiguousarray(a.array.T), a.named)
    return remapped(e.stored(turned), a.shape, lambda i: (i[1], i[0]))


def _cast(e, value, dtype):
    make, cost = operation("convert_element_type", {}, [value.dtype], dtype, e.shared)
    return e.formula(value.shape, dtype, lambda i: make([value.at(i)]), (value,), cost)


RULES: dict[str, Any] = {
    **dict.fromkeys(_REDUCED, reduce),
    **dict.fromkeys(_CUMULATED, cumulate),
    "argmax": extreme,
    "argmin": extreme,
    "dot_general": dot,
}
