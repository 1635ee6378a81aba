"""Operations that call a routine of C for each matrix, row or entry: factors of
matrices, triangular systems, sorting and random bits."""

from typing import Any

import numpy as np

from ._elementwise import operation
from ._expressions import Expr, index_of, known, literal, NOTHING, union
from ._values import broadcast, Scalars


def _call(e, name, dtype, writes, *arguments, cost):
    """Write a call of a routine. Arguments are numbers or pairs `(view, offset)`."""
    words, reads = [], NOTHING
    for argument in arguments:
        if isinstance(argument, tuple):
            view, offset = argument
            reads |= offset.reads | view.start.reads | {view.buffer.name}
            words.append(_address(view, offset))
        else:
            words.append(str(argument))
    text = f"{e.shared.routine(name, dtype)}({', '.join(words)});"
    e.line(text, reads, writes[0].buffer.name, cost)
    for other in writes[1:]:
        e.line("", frozenset([writes[0].buffer.name]) | reads, other.buffer.name)


def _address(view, offset):
    start = view.start.plus(offset)
    if start.is_known and start.const == 0:
        return view.buffer.name
    return f"{view.buffer.name} + {start.text}"


def _offset(indices, shape):
    size, offset = int(np.prod(shape[len(indices) :], dtype=int)), known(0)
    pairs = [*zip(indices, shape, strict=False)]
    for index, extent in reversed(pairs):
        offset = offset.plus(index, size)
        size *= extent
    return offset


def cholesky(e, node, x):
    out, x = node.outs[0], e.packed(x)
    place, n = e.new_view(out.shape, out.dtype), x.shape[-1]
    with e.over(x.shape[:-2]) as batch:
        at = _offset(batch, x.shape)
        _call(
            e, "cholesky", x.dtype, [place], n, (x, at), (place, at), cost=n**3 // 3 + n
        )
    return place


def triangular_solve(e, node, a, b):
    p, out = node.params, node.outs[0]
    n = a.shape[-1]
    a, place = e.packed(a), e.copied(b)
    rows, columns = place.shape[-2:]
    left, lower = p["left_side"], p["lower"]
    # X A = B is A' X' = B'. To read A', swap the strides of A.
    turned = p["transpose_a"] == left
    strides = (1, n) if turned else (n, 1)
    lower = lower != turned
    m, of = (columns, (columns, 1)) if left else (rows, (1, columns))
    flags = int(lower), int(p["unit_diagonal"])
    with e.over(out.shape[:-2]) as batch:
        given = (a, _offset(batch, a.shape)), *strides, *flags
        into = (place, _offset(batch, out.shape)), *of
        _call(e, "triangular", a.dtype, [place], n, m, *given, *into, cost=n * n * m)
    return place


def lu(e, node, x):
    factors, pivots, order = node.outs
    place = e.copied(x)
    m, n = x.shape[-2:]
    first, second = (e.new_view(o.shape, o.dtype) for o in (pivots, order))
    with e.over(x.shape[:-2]) as batch:
        parts = [(view, _offset(batch, view.shape)) for view in (place, first, second)]
        cost = m * n * min(m, n)
        _call(e, "lu", x.dtype, [place, first, second], m, n, *parts, cost=cost)
    del factors
    return [place, first, second]


def permutation(e, node, pivots):
    out, pivots = node.outs[0], e.packed(pivots)
    place, (n, k) = e.new_view(out.shape, out.dtype), (out.shape[-1], pivots.shape[-1])
    with e.over(out.shape[:-1]) as batch:
        parts = [(v, _offset(batch, v.shape)) for v in (pivots, place)]
        _call(e, "permutation", out.dtype, [place], n, k, *parts, cost=3 * k)
    return place


def qr(e, node, x):
    q, r = node.outs
    (m, n), k = x.shape[-2:], min(x.shape[-2:])
    a, tau = _reflections(e, x)
    columns = q.shape[-1]
    basis = _orthogonal(e, a, tau, columns, k)
    entry = lambda i: a.at(i)

    def upper(i):
        test = operation("le", {}, [np.dtype("int32")], bool, e.shared)[0]
        inside = test([i[-2].expr(np.int32), i[-1].expr(np.int32)])
        make = operation("select_n", {}, [np.dtype(bool)], r.dtype, e.shared)[0]
        return make([inside, literal(0, r.dtype), entry(i)])

    del m, n
    return [basis, e.stored(e.formula(r.shape, r.dtype, upper, (a,), 1))]


def _reflections(e, x):
    (m, n), k = x.shape[-2:], min(x.shape[-2:])
    a = e.copied(x)
    tau = e.new_view((*x.shape[:-2], k), x.dtype)
    with e.over(x.shape[:-2]) as batch:
        parts = (a, _offset(batch, a.shape)), (tau, _offset(batch, tau.shape))
        cost = 4 * m * n * k
        _call(e, "reflections", x.dtype, [a, tau], m, n, *parts, cost=cost)
    return a, tau


def _orthogonal(e, a, tau, columns, k):
    a, tau = e.packed(a), e.packed(tau)
    m, n = a.shape[-2:]
    place = e.new_view((*a.shape[:-2], m, columns), a.dtype)
    with e.over(a.shape[:-2]) as batch:
        parts = [(v, _offset(batch, v.shape)) for v in (a, tau, place)]
        cost = 4 * m * columns * k
        _call(e, "orthogonal", a.dtype, [place], m, columns, n, k, *parts, cost=cost)
    return place


def geqrf(e, node, x):
    return list(_reflections(e, x))


def householder_product(e, node, a, tau):
    return _orthogonal(e, a, tau, a.shape[-1], tau.shape[-1])


def sort(e, node, *xs):
    axis, keys, out = node.params["dimension"], node.params["num_keys"], node.outs[0]
    n = out.shape[axis]
    xs = [e.packed(x) for x in xs]
    places = [e.new_view(o.shape, o.dtype) for o in node.outs]
    order = e.new_view((n,), np.dtype(np.int32))
    stride = int(np.prod(out.shape[axis + 1 :], dtype=int))
    others = [1 if a == axis else k for a, k in enumerate(out.shape)]
    with e.over(others) as rest:

        def at(k):
            return (*rest[:axis], k, *rest[axis + 1 :])

        with e.loop(n) as k:
            e.store(order, (k,), k.expr(np.int32))
        for key in reversed(xs[:keys]):
            begin = _offset(at(known(0)), key.shape)
            arguments = n, (key, begin), stride, (order, known(0))
            _call(e, "order", key.dtype, [order], *arguments, cost=n * n // 2)
        with e.loop(n) as k:
            from_ = e.define(order.at((k,)))
            index = index_of(from_)
            for place, x in zip(places, xs, strict=True):
                e.store(place, at(k), x.at(at(index)))
    return places


def threefry(e, node, *ins):
    """Two random words for each entry. The routine returns both in one integer."""
    shape, word = node.outs[0].shape, node.outs[0].dtype
    ins = [e.indexable(e.cheap(x)) if not e.is_few(node.outs[0]) else x for x in ins]
    name, long = e.shared.routine("threefry", word), np.dtype(np.uint64)

    def pair(i):
        given = [x.at(broadcast(i, x.shape)) for x in ins]
        text = f"{name}({', '.join(x.text for x in given)})"
        both = e.define(Expr(text, long, union(x.reads for x in given), 120))
        texts = f"((uint32_t)({both.text} >> 32))", f"((uint32_t){both.text})"
        return [Expr(text, word, both.reads) for text in texts]

    if e.is_few(node.outs[0]):
        pairs = [pair(tuple(map(known, i))) for i in np.ndindex(*shape)]
        parts = zip(*pairs, strict=True)
        return [Scalars(shape, word, list(part), frozenset()) for part in parts]
    places = [e.new_view(shape, word) for _ in node.outs]
    with e.over(shape) as indices:
        for place, half in zip(places, pair(indices), strict=True):
            e.store(place, indices, half)
    return places


RULES: dict[str, Any] = {
    "cholesky": cholesky,
    "triangular_solve": triangular_solve,
    "lu": lu,
    "lu_pivots_to_permutation": permutation,
    "qr": qr,
    "geqrf": geqrf,
    "householder_product": householder_product,
    "sort": sort,
    "threefry2x32": threefry,
}
