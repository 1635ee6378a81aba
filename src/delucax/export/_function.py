"""The C of a function of arrays."""

import inspect
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._message import shortened
from . import _file
from ._blocks import Block
from ._cast import cast, precision
from ._description import Array, Description
from ._emit import Shared
from ._expressions import c_type, Expr, is_supported
from ._program import Program
from ._trace import trace
from ._values import Buffer, Scalars, Value, View


FEW = 8
"""Arrays with at most this many entries become variables."""
FEW_IN_LONG = 4
"""The same in a long program, so that its text stays short."""
_LONG = 600
"""A program with at least this many nodes is long."""


def new_program(block: Block, shared: Shared, most: int | None) -> Program:
    """A new program that can write the block."""
    return Program(block, FEW if nodes_in(block) < _LONG else FEW_IN_LONG, shared, most)


def nodes_in(block: Block) -> int:
    """The number of nodes in a block, with those of the blocks inside it."""
    return sum(1 + sum(map(nodes_in, node.blocks)) for node in block.nodes)


def argument(program: Program, name: str, shape: Sequence[int], dtype: Any) -> Value:
    """An argument of the function: an array by pointer, or a number by value."""
    if not shape:
        expr = Expr(name, np.dtype(dtype), frozenset([name]))
        return Scalars((), np.dtype(dtype), [expr], frozenset())
    return View(memory(name, shape, dtype), shape)


def memory(name: str, shape: Sequence[int], dtype: Any) -> Buffer:
    """Memory outside the function, which an argument points to."""
    return Buffer(name, dtype, int(np.prod(shape, dtype=int)), None, False)


def finite_test(program: Program, values: Sequence[Value]) -> Expr:
    """Whether all numbers are finite and no error has been raised so far."""
    parts, names = [], frozenset()
    if program.failed is not None:
        parts, names = [f"!{program.failed.text}"], program.failed.reads
    for value in values:
        if value.dtype.kind != "f":
            continue
        if value.size > program.unroll:
            sum_ = program.variable(bool, Expr("1", np.dtype(bool), value=True))
            with program.over(value.shape) as indices:
                entry = value.at(indices)
                text = f"{sum_.text} & (isfinite({entry.text}) != 0)"
                reads = sum_.reads | entry.reads
                program.assign(sum_, Expr(text, np.dtype(bool), reads, 1))
            parts.append(sum_.text)
            names |= sum_.reads
            continue
        for entry in value.entries():
            parts.append(f"isfinite({entry.text})")
            names |= entry.reads
    text = " && ".join(parts) if parts else "1"
    return Expr(f"({text})", np.dtype(bool), names, len(parts), None, 0, 1)


def ready(program: Program, value: Value) -> Value:
    """The array after its computation: in variables, or in memory."""
    if not value.size:
        return Scalars(value.shape, value.dtype, [], frozenset())
    if isinstance(value, Scalars):
        parts = [program.define(p) for p in value.parts]
        return Scalars(value.shape, value.dtype, parts, frozenset())
    return program.stored(value)


def kind_in_c(array: Array, real: str) -> str:
    """The type of the entries of an array, as the header names it."""
    return real if array.dtype.startswith("float") else c_type(array.dtype, stored=True)


def parameter(name: str, array: Array, real: str, is_output: bool = False) -> str:
    """The declaration of an argument in a signature."""
    kind = kind_in_c(array, real)
    if is_output:
        return f"{kind} *{name}"
    return f"const {kind} *{name}" if array.shape else f"{kind} {name}"


def export_function(
    function: Callable[..., Any],
    name: str,
    dtype: np.dtype,
    example: Sequence[Any],
    labels: Sequence[str] | None,
    notes: Sequence[str],
    most: int | None,
) -> Any:
    """The header and the source of a function, and the values for its report."""
    function = cast(function, dtype)
    with precision(dtype):
        given, structure = jax.tree_util.tree_flatten_with_path(tuple(example))
        shapes = [_shape(value, dtype, path) for path, value in given]
        paths: list[str] = []

        def flat(*args):
            outs = function(*jax.tree.unflatten(structure, args))
            leaves, _ = jax.tree_util.tree_flatten_with_path(outs)
            paths[:] = [_word(path) for path, _ in leaves]
            for _, leaf in leaves:
                if not hasattr(leaf, "dtype") and not isinstance(leaf, float | int):
                    raise ValueError(
                        "export.c: the function must return arrays and numbers, got "
                        f"{shortened(leaf)}."
                    )
            arrays = [jnp.asarray(leaf) for _, leaf in leaves]
            # The header has one floating-point type.
            is_real = lambda a: jnp.issubdtype(a.dtype, jnp.floating)
            return [a.astype(dtype) if is_real(a) else a for a in arrays]

        block = trace(flat, *shapes)
    heads = labels or _names_of(function, len(example))
    words = [f"{heads[path[0].idx]}_{_word(path[1:])}" for path, _ in given]
    own = [name, f"{name}_real"]
    names = _file.free_names((word.strip("_") for word in words), own)
    outs = _file.free_names([p or "out" for p in paths], [*own, *names])
    inputs = [
        Array(n, s.shape, str(s.dtype)) for n, s in zip(names, shapes, strict=True)
    ]
    outputs = [
        Array(n, a.shape, str(a.dtype), p)
        for n, a, p in zip(outs, block.outs, paths, strict=True)
    ]
    shared = Shared()
    program = new_program(block, shared, most)
    values = [argument(program, a.name, a.shape, a.dtype) for a in inputs]
    for var, value in zip(block.params, values, strict=True):
        program.bind(var, value)
    good_in = program.define(finite_test(program, values))
    results = [ready(program, v) for v in program.run(block)]
    good_out = program.define(finite_test(program, results))
    for array, value in zip(outputs, results, strict=True):
        place = View(memory(array.name, array.shape, array.dtype), array.shape)
        if not array.shape:
            place = View(memory(array.name, (1,), array.dtype), ())
        program.fill(place, value)
    macro = name.upper()
    exits = f"return {good_in.text} ? {good_out.text} ? 0 : {macro}_BAD_RESULT : "
    exits += f"{macro}_BAD_INPUT;"
    real = f"{name}_real"
    words = [parameter(a.name, a, real) for a in inputs]
    words += [parameter(a.name, a, real, True) for a in outputs]
    signature = f"int {name}({', '.join(words) or 'void'})"
    roots = {*good_in.reads, *good_out.reads, *(a.name for a in outputs)}
    made = _file.Function(signature, program, roots, exits)
    description = Description(
        name, "function", str(dtype), tuple(inputs), tuple(outputs)
    )
    comment = [
        *notes,
        *(_line(a) for a in inputs),
        *(f"{_line(a)}, output" for a in outputs),
        "",
        "Returns 0, or a flag if an input or a result is not finite. The outputs are",
        "written in every case. Their memory must not overlap the memory of inputs.",
    ]
    body = [
        f"enum {{ {macro}_BAD_INPUT = 1, {macro}_BAD_RESULT = 2 }};",
        "",
        f"{signature};",
    ]
    arguments = [a.name for a in (*inputs, *outputs)]
    text, constants = _file.source(name, [(made, arguments)], shared)
    return _file.header(description, comment, body), text, [made], constants, 0


def _line(array: Array) -> str:
    shape = "x".join(map(str, array.shape)) or "a number"
    return f"{array.name}: {shape}"


def _word(path: Any) -> str:
    return jax.tree_util.keystr(path, simple=True, separator="_")


def _shape(value: Any, dtype: np.dtype, path: Any) -> Any:
    """The shape and the type of an input of the example."""
    where = f"export.c: example{jax.tree_util.keystr(path)}"
    try:
        kind = getattr(value, "dtype", None)
        if kind is None:
            value = np.asarray(value)
            kind = value.dtype
        kind = np.dtype(kind)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"{where} must be an array, a number or a jax.ShapeDtypeStruct, got "
            f"{shortened(value)}."
        ) from error
    if kind.kind == "f":
        kind = dtype
    kind = np.dtype(jax.dtypes.canonicalize_dtype(kind))
    if not is_supported(kind):
        raise ValueError(
            f"{where} must be of real numbers, whole numbers or booleans, got {kind}."
        )
    return jax.ShapeDtypeStruct(tuple(value.shape), kind)


def _names_of(function: Any, count: int) -> list[str]:
    """The names of the arguments of a function, or `in0`, ... if they have none."""
    try:
        parameters = [*inspect.signature(function).parameters.values()]
    except (TypeError, ValueError):
        parameters = []
    fixed = inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD
    names = [p.name for p in parameters if p.kind not in fixed]
    return [names[k] if k < len(names) else f"in{k}" for k in range(count)]
