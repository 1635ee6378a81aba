"""Operations whose indices are computed at run time."""

from typing import Any

import numpy as np

from ._elementwise import operation
from ._expressions import Expr, Index, index_of, known, literal
from ._structural import mapped, scalars
from ._values import remapped


def clamped(e: Any, expr: Expr, most: int) -> Index:
    """A computed index, clamped to the interval from 0 to `most`."""
    if expr.value is not None:
        return known(min(max(int(expr.value), 0), most))
    if expr.low >= 0 and expr.high <= most:
        return index_of(e.define(expr))
    params: Any = {}
    # A small type of integers may not reach the last index.
    most = min(most, np.iinfo(expr.dtype).max)
    make, _ = operation("clamp", params, [expr.dtype], expr.dtype, e.shared)
    ends = literal(0, expr.dtype), literal(most, expr.dtype)
    return index_of(e.define(make([ends[0], expr, ends[1]])))


def dynamic_slice(e, node, x, *starts):
    sizes = node.params["slice_sizes"]
    begin = [
        clamped(e, start.at(()), n - k)
        for start, n, k in zip(starts, x.shape, sizes, strict=True)
    ]
    if not all(b.is_known for b in begin):
        x = e.indexable(x)
    index = lambda i: tuple(b.plus(k) for b, k in zip(begin, i, strict=True))
    return mapped(e, x, sizes, index)


def dynamic_update_slice(e, node, x, update, *starts):
    begin = [
        clamped(e, start.at(()), n - k)
        for start, n, k in zip(starts, x.shape, update.shape, strict=True)
    ]
    out = node.outs[0]
    if e.is_few(out) and all(b.is_known for b in begin):
        grid = np.empty(out.shape, object)
        for flat, expr in enumerate(x.entries()):
            grid.flat[flat] = expr
        for at, expr in zip(np.ndindex(*update.shape), update.entries(), strict=True):
            grid[tuple(b.const + k for b, k in zip(begin, at, strict=True))] = expr
        return scalars(out, grid, (x, update))
    place = e.owned(node.ins[0], x)
    index = lambda i: tuple(b.plus(k) for b, k in zip(begin, i, strict=True))
    part = remapped(place, update.shape, index)
    update = e.indexable(update)
    if place.buffers & update.buffers:
        update = e.copied(update)
    e.fill(part, update)
    return place


def _is_clipped(mode: Any) -> bool:
    return "CLIP" in str(mode)


def _is_promised(mode: Any) -> bool:
    return "PROMISE" in str(mode)


def gather(e, node, x, indices):
    params = node.params
    numbers, sizes, mode = (
        params["dimension_numbers"],
        params["slice_sizes"],
        params["mode"],
    )
    out, x = node.outs[0], e.indexable(x)
    indices = e.indexable(indices)
    offset_axes = numbers.offset_dims
    batch_axes = [a for a in range(len(out.shape)) if a not in offset_axes]
    hidden = {*numbers.collapsed_slice_dims, *numbers.operand_batching_dims}
    shown = [a for a in range(len(x.shape)) if a not in hidden]
    drops = not _is_clipped(mode) and not _is_promised(mode)

    def at(i):
        batch = [i[a] for a in batch_axes]
        place, inside = _starts(e, numbers, x.shape, sizes, indices, batch, drops)
        for operand_axis, a in zip(shown, offset_axes, strict=True):
            place[operand_axis] = place[operand_axis].plus(i[a])
        entry = x.at(tuple(place))
        if inside is None:
            return entry
        fill = literal(_fill_of(params, out.dtype), out.dtype)
        return _chosen(e, inside, entry, fill)

    return e.formula(out.shape, out.dtype, at, (x, indices), 1)


def _fill_of(params, dtype):
    if params["fill_value"] is not None:
        return params["fill_value"]
    kind = np.dtype(dtype).kind
    if kind == "f":
        return np.nan
    if kind == "b":
        return True
    return np.iinfo(dtype).min if kind == "i" else np.iinfo(dtype).max


def _chosen(e, inside, yes, no):
    make, _ = operation("select_n", {}, [np.dtype(bool)], yes.dtype, e.shared)
    return make([inside, no, yes])


def _starts(e, numbers, shape, sizes, indices, batch, drops):
    """The clamped start of a window, and whether it lay inside, if that matters."""
    is_gather = hasattr(numbers, "start_index_map")
    axes = (
        numbers.start_index_map if is_gather else numbers.scatter_dims_to_operand_dims
    )
    pairs = zip(
        numbers.operand_batching_dims,
        numbers.start_indices_batching_dims
        if is_gather
        else numbers.scatter_indices_batching_dims,
        strict=True,
    )
    place = [known(0) for _ in shape]
    for axis, from_axis in pairs:
        place[axis] = batch[from_axis]
    inside = None
    for k, axis in enumerate(axes):
        expr = indices.at((*batch, known(k)))
        most = min(shape[axis] - sizes[axis], np.iinfo(expr.dtype).max)
        if drops and not (expr.low >= 0 and expr.high <= most):
            expr = e.define(expr)
            for op, end in (("ge", 0), ("le", most)):
                make, _ = operation(op, {}, [expr.dtype], bool, e.shared)
                test = make([expr, literal(end, expr.dtype)])
                if inside is None:
                    inside = test
                else:
                    both, _ = operation("and", {}, [np.dtype(bool)], bool, e.shared)
                    inside = both([inside, test])
        place[axis] = clamped(e, expr, most)
    if inside is not None and inside.value is None:
        inside = e.define(inside)
    return place, inside


_COMBINED = {
    "scatter": None,
    "scatter-add": "add",
    "scatter-mul": "mul",
    "scatter-min": "min",
    "scatter-max": "max",
    "scatter-sub": "sub",
}


def scatter(e, node, x, indices, updates):
    params = node.params
    numbers, mode = params["dimension_numbers"], params["mode"]
    combine = _COMBINED[node.op]
    place = e.owned(node.ins[0], x)
    updates, indices = e.indexable(updates), e.indexable(indices)
    if place.buffers & (updates.buffers | indices.buffers):
        updates, indices = e.copied(updates), e.copied(indices)
    hidden = {*numbers.inserted_window_dims, *numbers.operand_batching_dims}
    shown = [a for a in range(len(x.shape)) if a not in hidden]
    windows = numbers.update_window_dims
    batch_axes = [a for a in range(len(updates.shape)) if a not in windows]
    sizes = [1] * len(x.shape)
    for operand_axis, a in zip(shown, windows, strict=True):
        sizes[operand_axis] = updates.shape[a]
    drops = not _is_clipped(mode) and not _is_promised(mode)
    with e.over([updates.shape[a] for a in batch_axes]) as batch:
        begin, inside = _starts(e, numbers, x.shape, sizes, indices, batch, drops)

        def write(_=None):
            with e.over([updates.shape[a] for a in windows]) as window:
                at: list[Any] = [None] * len(updates.shape)
                into = list(begin)
                for a, index in zip(batch_axes, batch, strict=True):
                    at[a] = index
                for a, b, index in zip(windows, shown, window, strict=True):
                    at[a], into[b] = index, into[b].plus(index)
                entry = updates.at(tuple(at))
                if combine is not None:
                    kind = [place.dtype] * 2
                    make, _ = operation(combine, {}, kind, place.dtype, e.shared)
                    entry = make([place.at(tuple(into)), entry])
                e.store(place, into, entry)

        if inside is None or inside.value:
            write()
        elif inside.value is None:
            e.choose(inside, 2, lambda k: write() if k else None)
    return place


RULES: dict[str, Any] = {
    "dynamic_slice": dynamic_slice,
    "dynamic_update_slice": dynamic_update_slice,
    "gather": gather,
    **dict.fromkeys(_COMBINED, scatter),
}
