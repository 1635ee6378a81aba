"""A program as blocks of nodes, and the elimination of dead code.

The body of a loop is a block of its own, and so is each branch of a choice. It may read
the values of the blocks around it.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ._keys import as_words


class Const:
    """A known array. Random keys are stored as their words."""

    __slots__ = ("dtype", "shape", "value")

    def __init__(self, value: Any):
        value = np.asarray(as_words(value))
        self.value, self.shape, self.dtype = value, value.shape, value.dtype


class Var:
    """An array that is computed at run time. `weight` counts its uses, and a use in a
    loop twice. `remaining` counts the uses that are not written yet."""

    __slots__ = ("depth", "dtype", "remaining", "shape", "weight")

    def __init__(self, shape: Any, dtype: Any, depth: int):
        self.shape, self.dtype, self.depth = tuple(shape), dtype, depth
        self.weight = self.remaining = 0


Atom = Const | Var


class Node:
    """An operation. `where` names the line of Python that it comes from."""

    __slots__ = ("ins", "op", "outs", "params", "where")

    def __init__(self, op: str, ins: list[Atom], outs: list[Var], params: Any, where):
        self.op, self.ins, self.outs, self.params = op, ins, outs, params
        self.where = where

    @property
    def blocks(self) -> "list[Block]":
        """The condition and the body of a loop, or the branches of a choice."""
        return self.params.get("blocks", [])


class Block:
    """Nodes in order, with the inputs `params` and the outputs `outs`. `draws` says
    whether they may draw random numbers."""

    def __init__(self, parent: "Block | None", repeats: bool, draws: bool = False):
        self.parent, self.repeats = parent, repeats
        self.draws: bool = parent.draws if parent else draws
        self.depth: int = parent.depth + 1 if parent else 0
        self.params: list[Var] = []
        self.nodes: list[Node] = []
        self.outs: list[Atom] = []
        self.known: dict[Any, Sequence[Atom]] = {}

    def param(self, shape: Any, dtype: Any) -> Var:
        """Add an input."""
        var = Var(shape, dtype, self.depth)
        self.params.append(var)
        return var


def eliminate_dead_code(block: Block) -> None:
    """Remove the nodes that no result needs, and the unused values that loops carry."""
    _keep(block, set(), True)


def _keep(block: Block, needed: set[Var], drops: bool) -> None:
    """Add to `needed` the variables that the results of a block depend on. With
    `drops`, also remove the other nodes."""
    needed.update(a for a in block.outs if isinstance(a, Var))
    kept = []
    for node in reversed(block.nodes):
        if needed.isdisjoint(node.outs):
            continue
        if drops:
            kept.append(node)
        if node.op in ("scan", "while"):
            live = _live(node, needed)
            if drops:
                _narrow(node, live, needed)
                for inner in node.blocks:
                    _keep(inner, needed, True)
            # All that `_narrow` has left is used.
            used = range(len(node.ins)) if drops else live
            count = 0 if drops else _carried(node)
            needed.update(
                a
                for k, a in enumerate(node.ins)
                if isinstance(a, Var) and (k in used or k >= count)
            )
            continue
        for inner in node.blocks:
            _keep(inner, needed, drops)
        needed.update(a for a in node.ins if isinstance(a, Var))
    if drops:
        block.nodes = kept[::-1]


def _carried(node: Node) -> int:
    return node.params.get("carried", len(node.ins))


def _live(node: Node, needed: set[Var]) -> set[int]:
    """The indices of the carried values that are used. Adds to `needed` what the body
    reads."""
    *tests, body = node.blocks
    count = _carried(node)
    for test in tests:
        _keep(test, needed, False)
    live = {
        k
        for k in range(count)
        if node.outs[k] in needed or any(test.params[k] in needed for test in tests)
    }
    outs = body.outs
    while True:
        wanted = [
            k in live if k < count else node.outs[k] in needed for k in range(len(outs))
        ]
        body.outs = [out for out, use in zip(outs, wanted, strict=True) if use]
        _keep(body, needed, False)
        body.outs = outs
        more = {k for k in range(count) if body.params[k] in needed} | live
        if more == live:
            return live
        live = more


def _narrow(node: Node, live: set[int], needed: set[Var]) -> None:
    """Remove the unused values that a loop carries, reads or stacks."""
    body, count = node.blocks[-1], _carried(node)
    ins = [
        k
        for k in range(len(node.ins))
        if k in live or k >= count and body.params[k] in needed
    ]
    outs = [
        k
        for k, out in enumerate(node.outs)
        if k in live or k >= count and out in needed
    ]
    node.ins = [node.ins[k] for k in ins]
    for inner in node.blocks:
        inner.params = [inner.params[k] for k in ins]
    body.outs = [body.outs[k] for k in outs]
    node.outs = [node.outs[k] for k in outs]
    if "carried" in node.params:
        node.params["carried"] = len(live)


def count_readers(block: Block) -> None:
    """Count the readers of each variable: set `weight` and `remaining`."""

    def read(atom, block):
        if isinstance(atom, Var):
            atom.weight += 1 if not _repeats_within(block, atom.depth) else 2
            atom.remaining += 1

    for node in block.nodes:
        for atom in node.ins:
            read(atom, block)
        for inner in node.blocks:
            count_readers(inner)
    for atom in block.outs:
        read(atom, block)


def _repeats_within(block: Block | None, depth: int) -> bool:
    """Whether a loop lies between a block and a depth."""
    while block is not None and block.depth > depth:
        if block.repeats:
            return True
        block = block.parent
    return False
