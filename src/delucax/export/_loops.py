"""Rules for loops, choices and errors."""

from typing import Any

import numpy as np

from ._bounds import Bound
from ._emit import Group, Scope
from ._expressions import Expr, known, literal
from ._refusal import refuse
from ._values import remapped, Scalars, Table, Value, View


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
    """A stand-in for an array that nothing reads."""
    return Scalars((), np.dtype(float), [Expr("0", np.dtype(float))], frozenset())


def _row(x, shape, index):
    return remapped(x, shape, lambda i: (index, *i))


def _places(e: Any, node: Any, ins: Any, carried: int) -> list[Value]:
    """The places of the carried values, set to the first values."""
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
    """Give the carried memory to the body of the loop, which may then change it."""
    for place in places:
        if isinstance(place, View):
            place.buffer.block = e.scope


def _hand_back(e, places):
    for place in places:
        if isinstance(place, View):
            place.buffer.block = e.scope


def while_(e, node, *starts):
    cond, body = node.blocks
    bound = Bound(cond, body, node.ins, e.definitions).rounds()
    is_sure = bound is not None
    if bound is None:
        bound = e.most
    if bound is None:
        why = (
            "the number of its rounds has no known bound. Let the loop carry a counter "
            "that starts at a constant, or give max_iterations"
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
    if is_sure:
        e.line(f"if (!{test.text}) break;", test.reads, None, test.cost)
    else:
        # If the loop needs more rounds than it may have, the step fails.
        test = e.define(test)
        over = f"({name} == {bound} && {test.text})"
        failed = e.failure()
        reads = failed.reads | test.reads
        e.assign(failed, Expr(f"{failed.text} || {over}", np.dtype(bool), reads, 2))
        e.line(f"if ({name} == {bound} || !{test.text}) break;", test.reads, None, 1)
    _adopt(e, places)
    for var, place in zip(body.params, places, strict=True):
        e.bind(var, place)
    outs = e.run(body)
    e.put_all(places, outs)
    e.scope = outside
    kind = "int" if bound < 2**31 else "int64_t"
    last = bound if is_sure else bound + 1
    header = f"for ({kind} {name} = 0; {name} < {last}; ++{name}) {{"
    outside.items.append(Group([header], [inside], frozenset()))
    outside.cost += bound * inside.cost
    _hand_back(e, places)
    return places


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


def error(e, node):
    """Record that an error was raised. The program goes on, and the flag reports it."""
    e.assign(e.failure(), literal(True, bool))
    fill = lambda out: np.nan if out.dtype.kind == "f" else 0
    return [
        Table(np.full(out.shape, fill(out), out.dtype), e.shared.table)
        for out in node.outs
    ]


RULES = {"scan": scan, "while": while_, "cond": cond, "error": error}
