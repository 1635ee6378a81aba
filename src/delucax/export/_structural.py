"""Operations that move entries: as index maps if possible, else as copies in memory."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ._expressions import known
from ._values import remapped, reshaped, Scalars, Table, Value, View


Rule = Callable[..., Any]


def mapped(e: Any, value: Value, shape: Sequence[int], index: Any) -> Value:
    """As `remapped`. If the result is large, `value` is stored for loops to read."""
    size = int(np.prod(shape, dtype=int))
    if size > e.unroll:
        value = e.indexable(value)
        if size > value.size:
            value = e.cheap(value)
    return remapped(value, shape, index)


def broadcast(e, node, x):
    shape, axes = node.outs[0].shape, node.params["broadcast_dimensions"]
    if x.size < int(np.prod(shape, dtype=int)):
        x = e.cheap(x)
    own = x.shape

    def index(i):
        return tuple(
            i[axis] if extent != 1 else known(0)
            for axis, extent in zip(axes, own, strict=True)
        )

    return mapped(e, x, shape, index)


def reshape(e, node, x):
    shape = node.outs[0].shape
    if x.size <= e.unroll and not isinstance(x, Table | View):
        return Scalars(shape, x.dtype, x.entries(), x.buffers)
    same = reshaped(x, shape)
    return reshaped(e.packed(x), shape) if same is None else same


def tile(e, node, x):
    out, reps = node.outs[0], node.params["reps"]
    own = x.shape
    if e.is_few(out):
        index = lambda i: tuple(known(k.const % n) for k, n in zip(i, own, strict=True))
        return mapped(e, x, out.shape, index)
    place, x = e.new_view(out.shape, out.dtype), e.indexable(x)
    with e.over(reps) as copy:
        begin = [known(0).plus(k, n) for k, n in zip(copy, own, strict=True)]
        index = lambda i: tuple(b.plus(k) for b, k in zip(begin, i, strict=True))
        e.fill(remapped(place, own, index), x)
    return place


def transpose(e, node, x):
    order = node.params["permutation"]
    inverse = [list(order).index(axis) for axis in range(len(order))]
    index = lambda i: tuple(i[axis] for axis in inverse)
    return mapped(e, x, node.outs[0].shape, index)


def slice_(e, node, x):
    starts = node.params["start_indices"]
    steps = node.params["strides"] or (1,) * len(starts)

    def index(i):
        parts = zip(i, starts, steps, strict=True)
        return tuple(known(a).plus(k, step) for k, a, step in parts)

    return mapped(e, x, node.outs[0].shape, index)


def reverse(e, node, x):
    axes, shape = node.params["dimensions"], x.shape

    def index(i):
        return tuple(
            known(n - 1).plus(k, -1) if axis in axes else k
            for axis, (k, n) in enumerate(zip(i, shape, strict=True))
        )

    return mapped(e, x, shape, index)


def split(e, node, x):
    axis, begin, outs = node.params["axis"], 0, []
    for out in node.outs:
        outs.append(_part(e, x, out.shape, axis, begin))
        begin += out.shape[axis]
    return outs


def _part(e, x, shape, axis, begin):
    def index(i):
        return tuple(k.plus(begin) if a == axis else k for a, k in enumerate(i))

    return mapped(e, x, shape, index)


def unstack(e, node, x):
    axis = node.params["axis"]

    def entry(k, out):
        index = lambda i: (*i[:axis], known(k), *i[axis:])
        return mapped(e, x, out.shape, index)

    return [entry(k, out) for k, out in enumerate(node.outs)]


def stack(e, node, *xs):
    axis = node.params["axis"]
    parts = [
        mapped(
            e,
            x,
            (*x.shape[:axis], 1, *x.shape[axis:]),
            lambda i: (*i[:axis], *i[axis + 1 :]),
        )
        for x in xs
    ]
    return _joined(e, node.outs[0], parts, axis)


def concatenate(e, node, *xs):
    return _joined(e, node.outs[0], xs, node.params["dimension"])


def _joined(e, out, xs, axis):
    if e.is_few(out):
        grid = [np.empty(x.shape, object) for x in xs]
        for part, x in zip(grid, xs, strict=True):
            for flat, expr in enumerate(x.entries()):
                part.flat[flat] = expr
        return scalars(out, np.concatenate(grid, axis), xs)
    place, begin = e.new_view(out.shape, out.dtype), 0
    for x in xs:
        e.fill(_part(e, place, x.shape, axis, begin), e.indexable(x))
        begin += x.shape[axis]
    return place


def scalars(out, grid, of):
    buffers = frozenset().union(*(v.buffers for v in of))
    return Scalars(out.shape, out.dtype, list(grid.flat), buffers)


def pad(e, node, x, fill):
    config, out = node.params["padding_config"], node.outs[0]
    if e.is_few(out):
        grid = np.empty(out.shape, object)
        (value,) = fill.entries()
        value = e.define(value) if value.cost else value
        for flat in range(grid.size):
            grid.flat[flat] = value
        for at, expr in zip(np.ndindex(*x.shape), x.entries(), strict=True):
            into = [
                low + k * (inside + 1)
                for k, (low, _, inside) in zip(at, config, strict=True)
            ]
            if all(0 <= k < n for k, n in zip(into, out.shape, strict=True)):
                grid[tuple(into)] = expr
        return scalars(out, grid, (x, fill))
    # Copy only the entries that lie inside the result.
    ranges = []
    for n, size, (low, _, inside) in zip(x.shape, out.shape, config, strict=True):
        step = inside + 1
        first = max(0, -(low // step)) if low < 0 else 0
        last = min(n, (size - 1 - low) // step + 1)
        ranges.append((first, max(last - first, 0), low, step))
    place = e.new_view(out.shape, out.dtype)
    e.fill(place, remapped(e.cheap(fill), out.shape, lambda i: ()))
    kept = [count for _, count, *_ in ranges]
    if 0 in kept:
        return place

    def source(i):
        return tuple(k.plus(r[0]) for k, r in zip(i, ranges, strict=True))

    def target(i):
        parts = zip(i, ranges, strict=True)
        return tuple(
            known(low + first * step).plus(k, step)
            for k, (first, _, low, step) in parts
        )

    part = mapped(e, x, kept, source)
    e.fill(remapped(place, kept, target), e.indexable(part))
    return place


RULES: dict[str, Any] = {
    "broadcast_in_dim": broadcast,
    "reshape": reshape,
    "squeeze": reshape,
    "tile": tile,
    "transpose": transpose,
    "slice": slice_,
    "rev": reverse,
    "split": split,
    "unstack": unstack,
    "stack": stack,
    "concatenate": concatenate,
    "pad": pad,
}
