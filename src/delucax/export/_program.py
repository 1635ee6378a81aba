"""The writer of blocks: it writes each node by the rule of its operation."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from . import _factors, _indexing, _loops, _reductions, _structural
from ._blocks import Atom, Block, Const, Node, Var
from ._bounds import Definitions
from ._elementwise import operation
from ._emit import same_memory, Writer
from ._refusal import refuse
from ._values import broadcast, Table, Value, View


_RULES: dict[str, Any] = (
    _structural.RULES
    | _indexing.RULES
    | _reductions.RULES
    | _factors.RULES
    | _loops.RULES
)


class Program(Writer):
    """Writes the nodes of blocks. `values` holds the array of each variable."""

    def __init__(self, block: Block, unroll: int, shared: Any, most: int | None):
        super().__init__(unroll, shared)
        self.definitions = Definitions(block)
        self.values: dict[Var, Value] = {}
        self.most = most
        self.bounds: list[tuple[str, int]] = []

    def is_few(self, array: Any) -> bool:
        """Whether an array is so small that it is kept in variables."""
        return int(np.prod(array.shape, dtype=int)) <= self.unroll

    def read(self, atom: Atom) -> Value:
        """The array of an atom."""
        if isinstance(atom, Const):
            return Table(atom.value, self.shared.table)
        return self.values[atom]

    def bind(self, var: Var, value: Value) -> None:
        """Set the array of a variable."""
        value = self.settled(value, var.weight)
        if not var.remaining:
            return
        self.values[var] = value
        for buffer in value.buffers:
            buffer.holders += 1

    def release(self, atom: Atom) -> None:
        """Record that one use of the atom has been written."""
        if not isinstance(atom, Var):
            return
        atom.remaining -= 1
        if not atom.remaining:
            for buffer in self.values[atom].buffers:
                buffer.holders -= 1

    def owned(self, atom: Atom, x: Value) -> View:
        """Memory with the entries of an array, which may be changed: the memory of the
        array itself if nothing else reads that, else a copy."""
        if isinstance(x, View) and isinstance(atom, Var) and not atom.remaining:
            buffer = x.buffer
            mine = buffer.is_own and buffer.block is self.scope
            if mine and not buffer.holders and same_memory(x, View(buffer, x.shape)):
                return x
        return self.copied(x)

    def run(self, block: Block) -> list[Value]:
        """Write a block. Returns its results."""
        for node in block.nodes:
            self.write(node)
        outs = [self.read(a) for a in block.outs]
        for atom in block.outs:
            self.release(atom)
        return outs

    def write(self, node: Node) -> None:
        """Write a node."""
        ins = [self.read(a) for a in node.ins]
        for atom in node.ins:
            self.release(atom)
        dtypes = [v.dtype for v in ins]
        made: Any
        entry = None
        if node.op not in _RULES and ins:
            out = node.outs[0].dtype
            entry = operation(node.op, node.params, dtypes, out, self.shared)
        if entry is not None:
            made = self._entries(node, ins, *entry)
        elif node.op in _RULES:
            made = _RULES[node.op](self, node, *ins)
        else:
            raise refuse(node.op, "this operation is not implemented in C", node.where)
        made = made if isinstance(made, list) else [made]
        for var, value in zip(node.outs, made, strict=True):
            self.bind(var, value)

    def _entries(self, node: Node, ins: Sequence[Value], make: Any, cost: int) -> Value:
        (out,) = node.outs
        if not self.is_few(out):
            ins = [self.indexable(x) for x in ins]
            ins = [
                self.cheap(x) if x.size < np.prod(out.shape, dtype=int) else x
                for x in ins
            ]
        else:
            ins = [self.cheap(x) if x.shape != out.shape else x for x in ins]

        def at(i):
            return make([x.at(broadcast(i, x.shape)) for x in ins])

        return self.formula(out.shape, out.dtype, at, ins, cost)
