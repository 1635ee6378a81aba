"""From a jaxpr to blocks of nodes. Calls are inlined, constants are folded, and nodes
that do not change in a loop are moved before it."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import (
    ClosedJaxpr,  # pyright: ignore[reportPrivateImportUsage]
    jaxpr_as_fun,
    Literal,
)
from jax.interpreters.partial_eval import dce_jaxpr

from ._blocks import Atom, Block, Const, count_readers, eliminate_dead_code, Node, Var
from ._expressions import is_supported
from ._fold import folded, is_all
from ._keys import as_keys, form, is_key, is_ours, on_words
from ._refusal import line_of, refuse


def trace(function: Callable[..., Any], *shapes: Any, draws: bool = False) -> Block:
    """The block of a function that takes arrays and returns a list of arrays.

    **Arguments:** `draws`: whether the function may draw random numbers.
    """
    closed: Any = jax.make_jaxpr(function)(*shapes)
    jaxpr, _ = dce_jaxpr(closed.jaxpr, [True] * len(closed.jaxpr.outvars), True)
    block = Block(None, False, draws)
    avals: Any = [v.aval for v in jaxpr.invars]
    params = [block.param(a.shape, a.dtype) for a in avals]
    block.outs = _inlined(ClosedJaxpr(jaxpr, closed.consts), params, block, "")
    eliminate_dead_code(block)
    count_readers(block)
    return block


def _inlined(closed: Any, args: Sequence[Atom], block: Block, where: str) -> list[Atom]:
    """The outputs of a jaxpr for the inputs `args`. Adds its nodes to the block."""
    jaxpr: Any = closed.jaxpr
    values: dict[Any, Atom] = dict(zip(jaxpr.invars, args, strict=True))
    for var, value in zip(jaxpr.constvars, closed.consts, strict=True):
        values[var] = Const(_array(value))

    def read(atom):
        if isinstance(atom, Literal):
            aval: Any = atom.aval
            return Const(np.asarray(atom.val, aval.dtype))
        return values[atom]

    for eqn in jaxpr.eqns:
        outs = _added(eqn, [read(a) for a in eqn.invars], block, where)
        for var, out in zip(eqn.outvars, outs, strict=True):
            values[var] = out
    return [read(a) for a in jaxpr.outvars]


def _array(value: Any) -> Any:
    return value if hasattr(value, "dtype") else np.asarray(value)


_SAME = "device_put", "stop_gradient", "optimization_barrier", "copy", "copy_p"
_SAME += ("sharding_constraint",)
_CALLS = "jaxpr", "call_jaxpr", "fun_jaxpr"


def _added(eqn: Any, ins: list[Atom], block: Block, where: str) -> Sequence[Atom]:
    """The outputs of an equation. Adds its nodes to the block."""
    op, params = eqn.primitive.name, eqn.params
    if op == "concatenate":
        ins = [a for a in ins if 0 not in a.shape] or ins
    where = line_of(eqn, where)
    if op in _SAME:
        return ins
    is_known = all(isinstance(a, Const) for a in ins) and not eqn.effects
    outs = [form(v.aval) for v in eqn.outvars]
    if is_known and op in ("scan", "while"):
        return _computed(eqn, ins, outs)
    if op in _LOOPS:
        return _LOOPS[op](eqn, ins, block, where)
    if all(0 in shape for shape, _ in outs) and outs:
        return [Const(np.zeros(shape, dtype)) for shape, dtype in outs]
    if op == "pure_callback" and _is_error(params["callback"]):
        return _failed(outs, block, where)
    inner = next((params[name] for name in _CALLS if name in params), None)
    if inner is not None:
        closed = inner if isinstance(inner, ClosedJaxpr) else ClosedJaxpr(inner, ())
        # The function of a reduction takes scalars, so a reduction is no call.
        if [form(v.aval)[0] for v in closed.jaxpr.invars] == [a.shape for a in ins]:
            return _inlined(closed, ins, block, where)
    if op == "platform_index":
        platforms = params["platforms"]
        # The branch for all platforms uses no operation that only XLA has.
        index = platforms.index(None) if None in platforms else 0
        return [Const(np.asarray(index, np.int32))]
    if "callback" in op or "debug" in op:
        raise refuse(op, "C cannot call Python", where)
    kinds = {v.aval.dtype for v in (*eqn.invars, *eqn.outvars)}
    if keys := [kind for kind in kinds if is_key(kind)]:
        return _drawn(eqn, ins, keys, outs if is_known else None, block, where)
    if is_known:
        return _computed(eqn, ins, outs)
    impl: Any = _IN_OTHERS.get(op, eqn.primitive.impl)
    if op == "call_hi_primitive":
        impl = eqn.primitive.to_lojax
        closed = jax.make_jaxpr(functools.partial(impl, **params))(*_shapes(ins))
        return _inlined(closed, ins, block, where)
    if not getattr(impl, "__module__", "functools").startswith(("jax", "functools")):
        # `impl`, here or in another library, uses other operations: trace it.
        impl = functools.partial(impl, **params)
        flat = lambda *args: jax.tree.leaves(impl(*args))
        closed = jax.make_jaxpr(flat)(*_shapes(ins))
        return _inlined(closed, ins, block, where)
    return _node(op, ins, outs, dict(params), block, where)


def _drawn(eqn: Any, ins: Any, keys: Any, known: Any, block: Block, where: str):
    """The outputs of an equation on keys. `known` holds their shapes and types if all
    inputs are known, else `None`."""
    op = eqn.primitive.name
    for kind in keys:
        if not is_ours(kind):
            why = f"C draws random numbers with threefry2x32 only, not with a {kind}"
            raise refuse(op, why, where)
    function = on_words(eqn)
    moves = op in ("random_wrap", "random_unwrap") or not op.startswith("random")
    if function is None and known:
        return _computed(eqn, ins, known)
    if not (moves or known or block.draws):
        raise refuse(op, "a function must take its random numbers as inputs", where)
    if function is None:
        raise refuse(op, "this operation is not implemented in C", where)
    flat = lambda *args: jax.tree.leaves(function(*args))
    return _inlined(jax.make_jaxpr(flat)(*_shapes(ins)), ins, block, where)


def _polynomial(x: Any, *coefficients: Any, **_: Any) -> Any:
    total = coefficients[-1]
    for number in coefficients[-2::-1]:
        total = total * x + number
    return jnp.broadcast_to(total, jnp.broadcast_shapes(x.shape, jnp.shape(total)))


_IN_OTHERS = {"polynomial": _polynomial}


def _shapes(ins: list[Atom]) -> list[Any]:
    return [jax.ShapeDtypeStruct(a.shape, a.dtype) for a in ins]


def _computed(eqn: Any, ins: list[Any], outs: Any) -> list[Atom]:
    """The outputs of an equation whose inputs are all known, computed now."""
    values = [a.value for a in ins]
    dtypes = [dtype for _, dtype in outs]
    result = folded(eqn.primitive.name, values, eqn.params, dtypes)
    if result is None:
        pairs = zip(values, eqn.invars, strict=True)
        values = [as_keys(jnp.asarray(x), v.aval.dtype) for x, v in pairs]
        result = eqn.primitive.bind(*values, **eqn.params)
        result = result if eqn.primitive.multiple_results else [result]
    return [Const(value) for value in result]


def _is_error(callback: Any) -> bool:
    """Whether a callback is the one with which Equinox raises errors."""
    function = getattr(callback, "callback_func", callback)
    return getattr(function, "__module__", "") == "equinox._errors"


def _failed(outs: Any, block: Block, where: str) -> Sequence[Atom]:
    """The outputs of a node that records an error at run time, in place of raising it.
    They are NaN, or zero if the type has no NaN."""
    kinds = tuple((shape, str(dtype)) for shape, dtype in outs)
    return _node("error", [], outs, dict(kinds=kinds), block, where)


def _node(
    op: str, ins: list[Atom], outs: Any, params: Any, block: Block, where: str
) -> Sequence[Atom]:
    """The outputs of a new node, or of an equal node that exists already."""
    same = _unchanged(op, ins, outs, params)
    if same is not None:
        return [same]
    # A node that does not depend on a loop is computed before the loop.
    depth = max((a.depth for a in ins if isinstance(a, Var)), default=0)
    while (
        "blocks" not in params
        and block.repeats
        and block.parent is not None
        and depth < block.depth
    ):
        block = block.parent
    key = _key(op, ins, params)
    around = block
    while around is not None and key is not None:
        if key in around.known:
            return around.known[key]
        around = around.parent
    for shape, dtype in outs:
        if not is_supported(dtype):
            raise refuse(op, f"C has no type for {dtype}", where)
        if not all(isinstance(extent, int) for extent in shape):
            raise refuse(op, "its shape is not known", where)
    made = [Var(shape, dtype, block.depth) for shape, dtype in outs]
    block.nodes.append(Node(op, ins, made, params, where))
    if key is not None:
        block.known[key] = made
    return made


def _key(op: str, ins: list[Atom], params: Any) -> Any:
    try:
        words = tuple(sorted((k, v) for k, v in params.items() if k != "sharding"))
        hash(words)
    except TypeError:
        return None
    return op, tuple(map(_name, ins)), words


def _name(atom: Atom) -> Any:
    if isinstance(atom, Const) and isinstance(atom.value, np.ndarray):
        if atom.value.size <= 64:
            return str(atom.dtype), atom.shape, atom.value.tobytes()
    return id(atom)


def _unchanged(op: str, ins: list[Atom], outs: Any, params: Any) -> Atom | None:
    """The input that an operation returns unchanged, or `None`."""
    (shape, dtype), *more = outs
    if more or not ins:
        return None
    first, last = ins[0], ins[-1]
    fits = lambda a: a.shape == shape and a.dtype == dtype
    alike = fits(first)
    if op in ("add", "add_any", "mul", "sub", "div") and len(ins) == 2:
        neutral = 1 if op in ("mul", "div") else 0
        if isinstance(last, Const) and alike and is_all(last.value, neutral):
            return first
        turns = op in ("add", "add_any", "mul")
        if turns and isinstance(first, Const) and is_all(first.value, neutral):
            return last if fits(last) else None
    if op in ("and", "or") and np.dtype(dtype).kind == "b":
        for one, other in ((first, last), (last, first)):
            if isinstance(one, Const) and fits(other):
                if np.all(one.value == (op == "and")):
                    return other
    if op == "select_n" and isinstance(first, Const) and first.value.size:
        which = first.value.astype(int)
        if np.all(which == which.flat[0]):
            return ins[1 + int(which.flat[0])]
    same_shape = "broadcast_in_dim", "reshape", "squeeze", "slice", "reduce_precision"
    if op in ("convert_element_type", "transpose", *same_shape, "concatenate", "pad"):
        pads = op == "pad" and any(map(any, params["padding_config"]))
        order = params.get("permutation", range(len(shape)))
        narrows = op == "reduce_precision"
        if alike and not pads and not narrows and list(order) == sorted(order):
            return first
    if op in ("reduce_sum", "reduce_max", "reduce_min") and not params["axes"]:
        return first
    return None


def _inside(closed: Any, args: Sequence[Atom], block: Block, where: str) -> None:
    block.outs = _inlined(closed, args, block, where)


def _counts(params: Any) -> tuple[int, int]:
    """The number of constants and the number of carried values of a scan."""
    if "num_consts" in params:
        return params["num_consts"], params["num_carry"]
    consts, carry, _ = params["ft_in"].unpack()
    return len(consts), len(carry)


def _scan(eqn: Any, ins: list[Atom], block: Block, where: str) -> Sequence[Atom]:
    params, length = eqn.params, eqn.params["length"]
    n, m = _counts(params)
    closed = params["jaxpr"]
    consts, carry, xs = ins[:n], ins[n : n + m], ins[n + m :]
    if length == 0:
        empty = [Const(np.zeros(*form(v.aval))) for v in eqn.outvars[m:]]
        return [*carry, *empty]
    body = Block(block, True)
    # Values that no step changes need not be carried.
    fixed = [closed.jaxpr.outvars[i] is closed.jaxpr.invars[n + i] for i in range(m)]
    given: list[Atom] = [
        a if same else body.param(a.shape, a.dtype)
        for a, same in zip(carry, fixed, strict=True)
    ]
    starts = [a for a, same in zip(carry, fixed, strict=True) if not same]
    rows: list[Atom] = [body.param(a.shape[1:], a.dtype) for a in xs]
    _inside(closed, [*consts, *given, *rows], body, where)
    body.outs = [out for i, out in enumerate(body.outs) if i >= m or not fixed[i]]
    shapes = [form(v.aval) for v in eqn.outvars]
    wanted = [s for i, s in enumerate(shapes) if i >= m or not fixed[i]]
    details = dict(
        length=length, reverse=params["reverse"], carried=len(starts), blocks=[body]
    )
    made = iter(_node("scan", [*starts, *xs], wanted, details, block, where))
    return [carry[i] if i < m and fixed[i] else next(made) for i in range(len(shapes))]


def _while(eqn: Any, ins: list[Atom], block: Block, where: str) -> Sequence[Atom]:
    params = eqn.params
    if params["cond_jaxpr"].out_avals[0].shape:
        params = params | _of_batch(params)
    n, m = params["cond_nconsts"], params["body_nconsts"]
    if params is not eqn.params:
        ins = [*ins[:n], *ins[:n], *ins[n:]]
        m += n
    in_cond, in_body, carry = ins[:n], ins[n : n + m], ins[n + m :]
    body, cond = Block(block, True), Block(block, True)
    inner = params["body_jaxpr"].jaxpr
    fixed = [inner.outvars[i] is inner.invars[m + i] for i in range(len(carry))]
    starts = [a for a, same in zip(carry, fixed, strict=True) if not same]
    for loop, closed, consts in (
        (cond, params["cond_jaxpr"], in_cond),
        (body, params["body_jaxpr"], in_body),
    ):
        given: list[Atom] = [
            a if same else loop.param(a.shape, a.dtype)
            for a, same in zip(carry, fixed, strict=True)
        ]
        _inside(closed, [*consts, *given], loop, where)
    body.outs = [o for o, same in zip(body.outs, fixed, strict=True) if not same]
    wanted = [(a.shape, a.dtype) for a in starts]
    details = dict(blocks=[cond, body])
    made = iter(_node("while", starts, wanted, details, block, where))
    return [a if same else next(made) for a, same in zip(carry, fixed, strict=True)]


def _of_batch(params: Any) -> dict[str, Any]:
    """One loop in place of a batch of loops. It goes on until all members have ended. A
    member that has ended keeps its values."""
    n, m = params["cond_nconsts"], params["body_nconsts"]
    cond, body = params["cond_jaxpr"], params["body_jaxpr"]
    tests, turn = jaxpr_as_fun(cond), jaxpr_as_fun(body)

    def proceeds(*args):
        return [jnp.any(tests(*args)[0])]

    def after(*args):
        (going,) = tests(*args[:n], *args[n + m :])
        lanes = lambda a: going.reshape(going.shape + (1,) * (a.ndim - going.ndim))
        pairs = zip(turn(*args[n:]), args[n + m :], strict=True)
        return [jnp.where(lanes(old), new, old) for new, old in pairs]

    given = [*cond.in_avals[:n], *body.in_avals]
    made = jax.make_jaxpr(proceeds)(*cond.in_avals), jax.make_jaxpr(after)(*given)
    return dict(zip(("cond_jaxpr", "body_jaxpr"), made, strict=True))


def _cond(eqn: Any, ins: list[Atom], block: Block, where: str) -> Sequence[Atom]:
    which, *args = ins
    branches = eqn.params["branches"]
    if isinstance(which, Const):
        index = min(max(int(which.value), 0), len(branches) - 1)
        return _inlined(branches[index], args, block, where)
    inside = []
    for closed in branches:
        inside.append(Block(block, False))
        _inside(closed, args, inside[-1], where)
    wanted = [form(v.aval) for v in eqn.outvars]
    return _node("cond", [which], wanted, dict(blocks=inside), block, where)


def _linear_solve(eqn: Any, ins: list[Atom], block: Block, where: str):
    lengths = eqn.params["const_lengths"]
    before = lengths.matvec + lengths.vecmat
    after = before + lengths.solve + lengths.transpose_solve
    consts = ins[before : before + lengths.solve]
    solve = eqn.params["jaxprs"].solve
    return _inlined(solve, [*consts, *ins[after:]], block, where)


_LOOPS = {
    "scan": _scan,
    "while": _while,
    "cond": _cond,
    "custom_linear_solve": _linear_solve,
}
