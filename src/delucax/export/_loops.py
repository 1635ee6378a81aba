"""Loops and choices."""

from typing import Any

import numpy as np

from ._blocks import Block, Const
from ._emit import Group, Scope
from ._expressions import Expr, known
from ._trace import refuse
from ._values import remapped, Scalars, Value, View


def scan(e, node, *ins):
    p, (body,) = node.params, node.blocks
    carried, length = p["carried"], p["length"]
    places = _places(e, node, ins, carried)
    rows = ins[carried:]
    if length > 1:
        rows = [e.indexable(x) for x in rows]
    stacks = [
        e.new_view(out.shape, out.dtype) if out.remaining else None
        for out in node.outs[carried:]
    ]
    with e.loop(length) as k:
        index = known(length - 1).plus(k, -1) if p["reverse"] else k
        _adopt(e, places)
        for var, place in zip(body.params[:carried], places, strict=True):
            e.bind(var, place)
        for var, x in zip(body.params[carried:], rows, strict=True):
            e.bind(var, _row(x, var.shape, index))
        outs = e.run(body)
        for place, value in zip(stacks, outs[carried:], strict=True):
            if place is not None:
                e.fill(_row(place, value.shape, index), e.indexable(value))
        e.put_all(places, outs[:carried])
    _hand_back(e, places)
    return [*places, *(s if s is not None else _unread() for s in stacks)]


def _unread():
    """In place of an array that nothing reads."""
    return Scalars((), np.dtype(float), [Expr("0", np.dtype(float))], frozenset())


def _row(x, shape, index):
    return remapped(x, shape, lambda i: (index, *i))


def _places(e: Any, node: Any, ins: Any, carried: int) -> list[Value]:
    """Where the carried values are kept, with their first values."""
    places: list[Value] = []
    for k, x in enumerate(ins[:carried]):
        if int(np.prod(x.shape, dtype=int)) <= e.unroll:
            parts = [e.variable(x.dtype, entry) for entry in x.entries()]
            places.append(Scalars(x.shape, x.dtype, parts, frozenset()))
            continue
        others = [v for i, v in enumerate(ins) if i != k]
        shared = any(x.buffers & v.buffers for v in others)
        places.append(e.copied(x) if shared else e.owned(node.ins[k], x))
    return places


def _adopt(e, places):
    """Memory that is carried belongs to the body of the loop while that is written."""
    for place in places:
        if isinstance(place, View):
            place.buffer.block = e.scope


def _hand_back(e, places):
    for place in places:
        if isinstance(place, View):
            place.buffer.block = e.scope


def while_(e, node, *starts):
    cond, body = node.blocks
    bound = bound_of(cond, body, node.ins)
    if bound is None:
        bound = e.most
    if bound is None:
        why = (
            "no bound of its rounds is known: count them in what it carries, from a "
            "number that is known, or give max_iterations"
        )
        raise refuse("while_loop", why, node.where)
    e.bounds.append((node.where, bound))
    places = _places(e, node, starts, len(starts))
    name, outside = e.name("i"), e.scope
    inside = e.scope = Scope(outside, True)
    for var, place in zip(cond.params, places, strict=True):
        e.bind(var, place)
    (proceeds,) = e.run(cond)
    (test,) = proceeds.entries()
    e.line(f"if (!{test.text}) break;", test.reads, None, test.cost)
    _adopt(e, places)
    for var, place in zip(body.params, places, strict=True):
        e.bind(var, place)
    outs = e.run(body)
    e.put_all(places, outs)
    e.scope = outside
    header = f"for (int {name} = 0; {name} < {bound}; ++{name}) {{"
    outside.items.append(Group([header], [inside], frozenset()))
    outside.cost += bound * inside.cost
    _hand_back(e, places)
    return places


def bound_of(cond: Block, body: Block, starts: Any) -> int | None:
    """The most rounds of a loop that counts them: it proceeds while a number that it
    carries is on one side of another that is known."""
    made = {block: _makers(block) for block in (cond, body)}
    bounds = []
    pending: list[Any] = [(cond, cond.outs[0], True)]
    while pending:
        block, atom, value = pending.pop()
        if isinstance(atom, Const):
            continue
        if atom in block.params:
            # A flag that the round before has set.
            if block is cond:
                pending.append((body, body.outs[block.params.index(atom)], value))
            continue
        node = made[block].get(atom)
        if node is None:
            continue
        if node.op == "not":
            pending.append((block, node.ins[0], not value))
        elif node.op == ("and" if value else "or") or node.op == "convert_element_type":
            pending += [(block, a, value) for a in node.ins]
        elif node.op in _TESTS:
            bounds += _counted(node, value, block is body, block, body, starts)
    return min(bounds, default=None)


def _makers(block):
    return {out: node for node in block.nodes for out in node.outs}


_TESTS = {"lt": (1, 0), "le": (1, 1), "gt": (-1, 0), "ge": (-1, 1), "ne": (0, 0)}
_OPPOSITE = {"lt": "ge", "le": "gt", "gt": "le", "ge": "lt"}


def _counted(test, value, is_late, block, body, starts):
    """The rounds while a test has a value, if it is one of a count."""
    op = test.op if value else _OPPOSITE.get(test.op)
    left, right = test.ins
    if op is None:
        return []
    sign, reaches = _TESTS[op]
    if isinstance(left, Const):
        left, right, sign = right, left, -sign
    if not isinstance(right, Const) or right.value.ndim or isinstance(left, Const):
        return []
    # In the body the count is that before the round, or that after it.
    late = is_late and left in block.params
    if left in block.params:
        k = block.params.index(left)
    elif is_late and left in body.outs:
        k = body.outs.index(left)
    else:
        return []
    start, step = starts[k], _step_of(body, k)
    if not isinstance(start, Const) or start.value.ndim or step is None:
        return []
    distance = float(right.value) - float(start.value)
    sign = sign or (1 if step > 0 else -1)
    if sign * step <= 0 or not np.isfinite(distance):
        return []
    rounds = sign * distance / abs(step)
    exact = int(np.floor(rounds)) + 1 if reaches else int(np.ceil(rounds))
    return [max(exact + late, int(is_late))]


def _step_of(body: Block, k: int) -> Any:
    """By how much a round changes what is carried."""
    out, param = body.outs[k], body.params[k]
    node = None if isinstance(out, Const) else _makers(body).get(out)
    if node is None or node.op not in ("add", "sub"):
        return None
    a, b = node.ins
    if node.op == "add" and isinstance(a, Const):
        a, b = b, a
    if a is not param or not isinstance(b, Const) or b.value.ndim:
        return None
    return float(b.value) * (1 if node.op == "add" else -1)


def cond(e, node, which):
    branches = node.blocks
    places = [
        e.place(out.shape, out.dtype) if out.remaining else None for out in node.outs
    ]
    (index,) = which.entries()

    def branch(k):
        for place, value in zip(places, e.run(branches[k]), strict=True):
            if place is not None:
                e.put(place, e.indexable(value) if isinstance(place, View) else value)

    e.choose(index, len(branches), branch)
    return [p if p is not None else _unread() for p in places]


RULES = {"scan": scan, "while": while_, "cond": cond}
