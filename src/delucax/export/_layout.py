"""The text of a function. Removes dead stores, and lets arrays share memory."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from ._emit import Group, Line, numbers, Scope, Shared
from ._expressions import c_type
from ._values import Buffer


def eliminate_dead_stores(top: Scope, roots: Iterable[str]) -> frozenset[str]:
    """Remove the statements that no root depends on. Returns the names that stay."""
    writers: dict[str, list[Any]] = {}

    def index(scope, around):
        for item in scope.items:
            if isinstance(item, Line):
                needs = item.reads.union(*(g.reads for g in around))
                stays = item.writes is None
                entry = item, needs, around
                writers.setdefault("" if stays else str(item.writes), []).append(entry)
            else:
                for inner in item.scopes:
                    index(inner, (*around, item))

    index(top, ())
    needed, pending = set(), [*roots]
    exits = writers.get("", [])
    kept: set[int] = set()
    groups: set[int] = set()

    def keep(item, needs, around):
        if id(item) in kept:
            return
        kept.add(id(item))
        groups.update(map(id, around))
        pending.extend(needs - needed)

    while True:
        while pending:
            name = pending.pop()
            if name not in needed:
                needed.add(name)
                for entry in writers.get(name, ()):
                    keep(*entry)
        # A loop that stays also needs the statement that leaves it.
        before = len(kept)
        for item, needs, around in exits:
            if all(id(g) in groups for g in around):
                keep(item, needs, around)
        if len(kept) == before and not pending:
            break

    def clean(scope):
        scope.items = [
            item
            for item in scope.items
            if (id(item) in kept if isinstance(item, Line) else id(item) in groups)
        ]
        for item in scope.items:
            if isinstance(item, Group):
                for inner in item.scopes:
                    clean(inner)

    clean(top)
    return frozenset(needed)


def live_ranges(top: Scope, buffers: list[Buffer]) -> dict[str, tuple[int, int]]:
    """The live range of each buffer: the numbers of its first and last statement."""
    homes = {b.name: b.home for b in buffers}
    first: dict[str, int] = {}
    last: dict[str, int] = {}
    clock = 0

    def walk(scope) -> set[str]:
        nonlocal clock
        touched = set()
        for item in scope.items:
            clock += 1
            if isinstance(item, Line):
                names = {n for n in (*item.reads, item.writes) if n in homes}
                for name in names:
                    first.setdefault(name, clock)
                    last[name] = clock
                touched |= names
                continue
            begin = clock
            inside = set().union(*map(walk, item.scopes))
            clock += 1
            touched |= inside
            for name in inside:
                # A buffer from outside a loop is live during the whole loop.
                if any(s.repeats and not homes[name].is_within(s) for s in item.scopes):
                    first[name], last[name] = min(first[name], begin), clock
        return touched

    walk(top)
    return {name: (first[name], last[name]) for name in first}


def placed(buffers: list[Buffer], top: Scope) -> tuple[list[str], int]:
    """The declarations of the buffers, and their bytes. Buffers share memory if their
    live ranges do not overlap."""
    used = live_ranges(top, buffers)
    lines, total = [], 0
    kinds: dict[Any, list[Buffer]] = {}
    for buffer in buffers:
        if buffer.name in used:
            kinds.setdefault(buffer.dtype, []).append(buffer)
    for dtype, group in kinds.items():
        kind = c_type(dtype, stored=True)
        is_only = dtype.kind == "f" and sum(d.kind == "f" for d in kinds) == 1
        arena = "work" if is_only else f"work_{dtype}"
        size, live, wheres = 0, [], []
        for buffer in sorted(group, key=lambda b: used[b.name]):
            begin, end = used[buffer.name]
            live = sorted(e for e in live if e[2] >= begin)
            offset = 0
            for start, stop, _ in live:
                if offset + buffer.size <= start:
                    break
                offset = max(offset, stop)
            live.append((offset, offset + buffer.size, end))
            size = max(size, offset + buffer.size)
            wheres.append((buffer.name, offset))
        lines.append(f"{kind} {arena}[{size}];")
        for name, offset in wheres:
            at = f"{arena} + {offset}" if offset else arena
            lines.append(f"{kind} *const {name} = {at};")
        total += size * np.dtype(dtype).itemsize
    return lines, total


def printed(scope: Scope, depth: int = 1) -> list[str]:
    """The statements of a scope, as lines of text."""
    lines, margin = [], "  " * depth
    for item in scope.items:
        if isinstance(item, Line):
            if item.text:
                lines.append(margin + item.text)
            continue
        pairs = [*zip(item.headers, item.scopes, strict=True)]
        while pairs and not pairs[-1][1].items:
            pairs.pop()
        for header, inner in pairs:
            lines.append(margin + header)
            lines += printed(inner, depth + 1)
        lines.append(margin + "}")
    return lines


def constants(shared: Shared, used: frozenset[str]) -> tuple[list[str], int]:
    """The definitions of the tables that are used, and their bytes."""
    lines, total = [], 0
    for name, array in shared.tables.values():
        if name in used:
            kind = c_type(array.dtype, stored=True)
            text = f"static const {kind} {name}[{array.size}] = {{{numbers(array)}}};"
            lines += _wrapped(text)
            total += array.nbytes
    return lines, total


def _wrapped(text: str, width: int = 88) -> list[str]:
    """A long definition, broken into lines."""
    lines = []
    while len(text) > width:
        cut = text.rfind(" ", 0, width)
        if cut <= 4:
            break
        lines.append(text[:cut])
        text = "    " + text[cut + 1 :]
    return [*lines, text]
