"""The C of a controller: the struct of its state, and the functions that act on it."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from .._check import check_instance, finite_vector
from .._module import parts_of
from ..systems import AbstractPlant
from . import _file
from ._blocks import Block
from ._description import Array, Description
from ._emit import Shared
from ._expressions import Expr, is_supported, literal
from ._function import (
    argument,
    finite_test,
    kind_in_c,
    memory,
    new_program,
    ready,
)
from ._program import Program
from ._refusal import Unsupported
from ._traced import TracedController
from ._values import Scalars, Table, Value, View


_LEAVE = "return"
"""A `return` alone in its branch counts as writing this name, so that it is kept."""


def export_controller(
    controller: Any,
    name: str,
    dtype: np.dtype,
    example: Any,
    fallback: Any,
    key: Any,
    plant: Any,
    most: int | None,
) -> Any:
    """The header and the source of a controller, and the values for its report."""
    if plant is not None:
        check_instance(plant, AbstractPlant, "plant", "export.c")
    size = None if plant is None else plant.observation_size
    traced = TracedController(controller, dtype, example, key, size)
    (m,) = traced.controls
    if plant is not None:
        if plant.control_size != m:
            raise ValueError(
                f"export.c: plant must have {m} controls, as many as the controller "
                f"returns, got {plant.control_size}."
            )
    if fallback is not None:
        fallback = np.asarray(finite_vector(fallback, m, "fallback", "export.c"), dtype)
    state = _members(traced)
    names = [a.name for a in state]
    last = _file.free_names(["last_control"], names)[0] if fallback is None else None
    shared, macro, real = Shared(), name.upper(), f"{name}_real"
    kept = [(a.name, a.dtype, a.shape) for a in state]
    kept += [(last, str(dtype), (m,))] if last is not None else []
    size = np.dtype(kept, align=True).itemsize if kept else 1
    description = Description(
        name,
        "controller",
        str(dtype),
        (Array("t", (), str(dtype)), Array("y", (traced.observations,), str(dtype))),
        (Array("u", (m,), str(dtype)),),
        tuple(state),
        size,
    )
    step = _step(traced, name, state, last, fallback, shared, most)
    applied = _applied(traced, name, state, shared, most)
    init = _init(traced, name, state, last, m, shared)
    members = [
        f"{kind_in_c(a, real)} {a.name}{_extent(a)}; /* {_words(a)} */" for a in state
    ]
    if last is not None:
        members.append(f"{real} {last}[{m}]; /* the last good control */")
    if not members:
        members = ["char unused;"]
    body = [
        f"#define {macro}_OBSERVATION_SIZE {traced.observations}",
        f"#define {macro}_CONTROL_SIZE {m}",
        f"enum {{ {macro}_BAD_INPUT = 1, {macro}_BAD_RESULT = 2 }};",
        "",
        "typedef struct {",
        *(f"  {member}" for member in members),
        f"}} {name}_state;",
        "",
        *(f"{f.signature};" for f, _ in (init, step, applied)),
    ]
    comment = _comment(controller, plant, traced, name, fallback)
    text, constants = _file.source(name, [init, step, applied], shared)
    functions = [init[0], step[0], applied[0]]
    return _file.header(description, comment, body), text, functions, constants, size


def _extent(array: Array) -> str:
    size = int(np.prod(array.shape, dtype=int))
    return f"[{size}]" if array.shape else ""


def _words(array: Array) -> str:
    shape = "x".join(map(str, array.shape))
    path = array.path.replace("*/", "* /") or "state"
    return f"{path}, {shape}" if shape else path


def _members(traced: TracedController) -> list[Array]:
    for array, path in zip(traced.start, traced.paths, strict=True):
        if not is_supported(array.dtype):
            raise Unsupported(
                f"export.c: state{path} cannot be exported, because C has no type "
                f"for {array.dtype}."
            )
    names = _file.free_names(p.strip(".[]") or "memory" for p in traced.paths)
    return [
        Array(name, array.shape, str(array.dtype), path)
        for name, array, path in zip(names, traced.start, traced.paths, strict=True)
    ]


def _places(state: Sequence[Array]) -> list[Value]:
    """The members of the struct `state`, as arrays."""
    places: list[Value] = []
    for array in state:
        name, dtype = f"state->{array.name}", np.dtype(array.dtype)
        if array.shape:
            places.append(View(memory(name, array.shape, dtype), array.shape))
        else:
            expr = Expr(name, dtype, frozenset([name]))
            places.append(Scalars((), dtype, [expr], frozenset()))
    return places


def _init(traced, name, state, last, m, shared):
    program = Program(Block(None, False), 1, shared, None)
    for place, array in zip(_places(state), traced.start, strict=True):
        table = Table(array, shared.table)
        if isinstance(place, View):
            program.fill(place, table)
        else:
            program.put(place, table)
    if last is not None:
        zeros = Table(np.zeros(m, traced.dtype), shared.table)
        program.fill(View(memory(f"state->{last}", (m,), traced.dtype), (m,)), zeros)
    roots = {f"state->{a.name}" for a in state} | {f"state->{last}"}
    signature = f"void {name}_init({name}_state *state)"
    return _file.Function(signature, program, roots, ""), ["state"]


def _step(traced, name, state, last, fallback, shared, most):
    program = new_program(traced.step, shared, most)
    dtype, (m,) = traced.dtype, traced.controls
    places = _places(state)
    t = argument(program, "t", (), dtype)
    y = argument(program, "y", (traced.observations,), dtype)
    answer = View(memory("u", (m,), dtype), (m,))
    kept = View(memory(f"state->{last}", (m,), dtype), (m,))
    spare = kept if last is not None else Table(fallback, shared.table)
    macro = name.upper()

    def leave_unless(good, flag):
        program.choose(good, 2, lambda k: None if k else refuse(flag))

    def refuse(flag):
        program.fill(answer, spare)
        program.line(f"return {macro}_{flag};", frozenset(), None)

    leave_unless(finite_test(program, [t, y]), "BAD_INPUT")
    for var, value in zip(traced.step.params, [t, y, *places], strict=True):
        program.bind(var, value)
    u, *after = program.run(traced.step)
    u = ready(program, u)
    changed, values, tested = _changed(program, traced, places, after)
    leave_unless(finite_test(program, [u, *tested]), "BAD_RESULT")
    if last is not None:
        program.fill(kept, u)
    # The control may be a part of the old state, so both are set at once.
    program.put_all([*changed, answer], [*values, u])
    real = f"{name}_real"
    signature = (
        f"int {name}_step({name}_state *state, {real} t, const {real} *y, {real} *u)"
    )
    roots = {"u", f"state->{last}", *(f"state->{a.name}" for a in state)}
    arguments = ["state", "t", "y", "u"]
    return _file.Function(signature, program, roots, "return 0;"), arguments


def _applied(traced, name, state, shared, most):
    program = new_program(traced.applied, shared, most)
    places, dtype = _places(state), traced.dtype
    u = argument(program, "u", traced.controls, dtype)
    cost = argument(program, "cost", (), dtype)
    for var, value in zip(traced.applied.params, [u, cost, *places], strict=True):
        program.bind(var, value)
    after = program.run(traced.applied)
    changed, values, tested = _changed(program, traced, places, after)
    if changed:
        good = finite_test(program, tested)

        def leave(k):
            if not k:
                program.line("return;", frozenset(), _LEAVE)

        program.choose(good, 2, leave)
        program.put_all(changed, values)
    real = f"{name}_real"
    signature = (
        f"void {name}_applied({name}_state *state, const {real} *u, {real} cost)"
    )
    roots = {_LEAVE, *(f"state->{a.name}" for a in state)}
    return _file.Function(signature, program, roots, ""), ["state", "u", "cost"]


def _changed(
    program: Program, traced: TracedController, places: Any, after: Any
) -> Any:
    """The members of the state that change, their new values, and those new values that
    must be finite: the ones of members that are finite at the start."""
    parts = [
        (place, ready(program, value), bool(np.all(np.isfinite(first))))
        for place, value, first in zip(places, after, traced.start, strict=True)
        if not _is_same(place, value)
    ]
    values = [value for _, value, _ in parts]
    tested = [value for _, value, is_finite in parts if is_finite]
    return [place for place, *_ in parts], values, tested


def _is_same(place: Value, value: Value) -> bool:
    """Whether the new value of a member of the state is the old one."""
    if isinstance(place, View):
        return (
            isinstance(value, View)
            and value.buffer is place.buffer
            and ((value.strides, value.start) == (place.strides, place.start))
        )
    pair = value.entries(), place.entries()
    return pair[0][0].text == pair[1][0].text


def _comment(controller, plant, traced, name, fallback) -> list[str]:
    (m,), p = traced.controls, traced.observations
    answer = "the fallback"
    if fallback is None:
        answer = "the last good one, or 0 before the first"
    lines = [
        f"{name}: a controller in C, made by delucax from a "
        f"{type(controller).__name__}.",
        "",
        f"  {name}_init(&state);",
        f"  flag = {name}_step(&state, t, y, u);",
        f"  {name}_applied(&state, u, cost);",
        "",
        f"{name}_step takes the time t and the observation y. It writes the control u.",
        f"Then pass to {name}_applied the control that was applied, and its cost.",
        "",
        f"{name}_step returns 0, or a flag if t, y or a result is not finite.",
        f"The control is then {answer}, and the state does not change.",
        f"{name}_applied does not change the state if a result is not finite.",
        *_named(controller, plant, m, p),
    ]
    if fallback is not None:
        numbers = ", ".join(literal(x, traced.dtype).text for x in fallback)
        lines.append(f"fallback: {numbers}")
    return lines


def _named(controller: Any, plant: Any, m: int, p: int) -> list[str]:
    """The names of controls and observations, if a plant is known."""
    plants = [plant] if plant is not None else parts_of(controller, AbstractPlant)
    if not plants or plants[0].control_size != m:
        return []
    plant = plants[0]
    lines = ["", f"  t [{plant.time_unit}]"]
    lines += unit_lines("u", plant.control_names, plant.control_units)
    if plant.state_size == p and plant.observes_state:
        lines += unit_lines("y", plant.state_names, plant.state_units)
    return lines


def unit_lines(letter: str, names: Sequence[str], units: Sequence[str]) -> list[str]:
    """A line for each entry of a vector."""
    return [
        f"  {letter}[{k}]: {name}" + (f" [{units[k]}]" if k < len(units) else "")
        for k, name in enumerate(names)
    ]
