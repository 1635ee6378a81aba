"""The largest number of rounds of a `while` loop.

It is known if the loop carries a counter, and goes on while the counter is on one side
of a limit. The loop may test the counter in its condition. It may also test it in its
body, and set a flag that the condition reads.
"""

from typing import Any, NamedTuple

import numpy as np

from ._blocks import Atom, Block, Const, Node, Var


class Definitions:
    """The node that defines each value of a program."""

    def __init__(self, block: Block):
        self.made: dict[Var, Node] = {}
        self.carried: dict[Var, tuple[Atom, Atom]] = {}
        """For each value carried by a loop: its start, and the value after a round."""
        self._add(block)

    def _add(self, block: Block) -> None:
        for node in block.nodes:
            for out in node.outs:
                self.made[out] = node
            for inner in node.blocks:
                self._add(inner)
            if node.op in ("scan", "while"):
                body = node.blocks[-1]
                count = node.params.get("carried", len(node.ins))
                parts = body.params[:count], node.ins, body.outs
                for param, start, out in zip(*parts, strict=False):
                    self.carried[param] = start, out


class Bound(NamedTuple):
    """The bound of a loop: its condition and body, the first values of what it carries,
    and the definitions of what it reads."""

    cond: Block
    body: Block
    starts: Any
    definitions: Definitions

    def rounds(self) -> int | None:
        """The largest number of rounds; `None` if no counter bounds it."""
        return self._while(self.cond, self.cond.outs[0], True)

    def _made(self, atom: Atom) -> Node | None:
        return None if isinstance(atom, Const) else self.definitions.made.get(atom)

    def _while(self, block: Block, atom: Any, value: bool) -> int | None:
        """The round from which on `atom` never has the truth value `value`; `None` if
        that is unknown."""
        if atom in block.params and block is self.cond:
            # A flag that the previous round has set.
            return self._while(
                self.body, self.body.outs[block.params.index(atom)], value
            )
        node = self._made(atom)
        if node is None:
            return None
        if node.op == "not":
            return self._while(block, node.ins[0], not value)
        if node.op in ("and", "or", "convert_element_type"):
            limits = [self._while(block, a, value) for a in node.ins]
            known = [n for n in limits if n is not None]
            if node.op == ("or" if value else "and"):
                return max(known) if len(known) == len(limits) else None
            return min(known, default=None)
        return self._counted(node, value, block is self.body)

    def _counted(self, test: Node, value: bool, is_late: bool) -> int | None:
        """As `_while`, for a comparison of a counter with a limit."""
        op = test.op if value else _OPPOSITE.get(test.op, "")
        if op not in _TESTS:
            return None
        sign, reaches = _TESTS[op]
        left, right = test.ins
        block = self.body if is_late else self.cond
        k = self._counter(block, left)
        if k is None:
            left, right, sign = right, left, -sign
            k = self._counter(block, left)
        if k is None:
            return None
        # The body tests the counter from before the round, or from after it.
        late = int(is_late and left in block.params)
        start, steps = self.starts[k], self._steps(k)
        if not isinstance(start, Const) or start.value.ndim or steps is None:
            return None
        first, step = steps
        is_exact = sign == 0
        sign = sign or (1 if step > 0 else -1)
        limit = self._limit(right, sign)
        if limit is None or sign * step <= 0:
            return None
        if start.value.dtype.kind == "f":
            # A floating-point counter may step over a limit that it should equal.
            if is_exact:
                return None
            more = _rounded_steps(start.value, first, step, limit, sign, reaches)
            return None if more is None else more + 1 + late
        rounds = sign * (limit - float(start.value) - first) / abs(step)
        if not np.isfinite(rounds):
            return None
        exact = int(np.floor(rounds)) + 1 if reaches else int(np.ceil(rounds))
        return max(exact + 1 + late, int(is_late))

    def _counter(self, block: Block, atom: Any) -> int | None:
        """The index of `atom` among the carried values; `None` if it is not carried."""
        if isinstance(atom, Const):
            return None
        for group in (block.params, self.body.outs if block is self.body else []):
            if atom in group:
                return group.index(atom)
        return None

    def _limit(
        self, atom: Atom, sign: int, visited: tuple[Var, ...] = ()
    ) -> float | None:
        """The largest value that `atom` can have; the smallest if `sign` is -1."""
        if isinstance(atom, Const):
            ends = atom.value.max, atom.value.min
            return float(ends[sign < 0]()) if atom.value.size else None
        node, is_any = self._made(atom), False
        if atom in self.definitions.carried and atom not in visited:
            visited = (*visited, atom)
            parts = self.definitions.carried[atom]
        elif node is None or node.op not in _BETWEEN:
            return None
        else:
            parts = node.ins[1:] if node.op == "select_n" else node.ins
            is_any = node.op == ("min" if sign > 0 else "max")
        limits = [self._limit(a, sign, visited) for a in parts]
        known = [sign * n for n in limits if n is not None]
        if not known or not is_any and len(known) < len(limits):
            return None
        return sign * (min(known) if is_any else max(known))

    def _steps(self, k: int) -> tuple[float, float] | None:
        """The change of the carried value `k` in the first round, and in each later
        round; `None` if it is unknown."""
        param, node = self.body.params[k], self._made(self.body.outs[k])
        if node is not None and node.op == "cond":
            node = self._counting(node, self.body.outs[k], param)
        if node is None or node.op not in ("add", "sub"):
            return None
        a, b = node.ins
        if node.op == "add" and a is not param:
            a, b = b, a
        if a is not param:
            return None
        turn = 1 if node.op == "add" else -1
        while (node := self._made(b)) is not None:
            if node.op != "convert_element_type":
                return None
            (b,) = node.ins
        first = later = b
        if not isinstance(b, Const) and b in self.body.params:
            # The loop carries the step, for example a flag that the first round sets.
            j = self.body.params.index(b)
            first, later = self.starts[j], self.body.outs[j]
        pair = [a.value for a in (first, later) if isinstance(a, Const)]
        if len(pair) < 2 or any(value.ndim for value in pair):
            return None
        return turn * float(pair[0]), turn * float(pair[1])

    def _counting(self, node: Node, out: Any, param: Var) -> Node | None:
        """The node that counts in one branch of a choice. `None` unless the other
        branch leaves the counter unchanged, and only the last round takes it."""
        if len(node.blocks) != 2:
            return None
        at = node.outs.index(out)
        counts = [block.outs[at] for block in node.blocks]
        if param not in counts:
            return None
        same = counts.index(param)
        which, ends = node.ins[0], bool(same)
        while (maker := self._made(which)) is not None:
            if maker.op not in ("convert_element_type", "not"):
                break
            ends = ends != (maker.op == "not")
            (which,) = maker.ins
        if not ends or which not in self.body.outs:
            return None
        flag = self.body.params[self.body.outs.index(which)]
        test = self._made(self.cond.outs[0])
        if test is None or test.op != "not":
            return None
        is_flag = test.ins[0] is self.cond.params[self.body.params.index(flag)]
        return self._made(counts[1 - same]) if is_flag else None


def _rounded_steps(
    start: Any, first: float, step: float, limit: float, sign: int, reaches: int
) -> int | None:
    """The steps of a floating-point counter up to a limit, after its first step; `None`
    if there are too many. Each sum is rounded as in the loop, which changes their
    number."""
    kind = start.dtype.type
    value, step, limit = kind(start + kind(first)), kind(step), kind(limit)
    for count in range(_MOST_STEPS):
        if not (sign * value < sign * limit or reaches and value == limit):
            return count
        value = kind(value + step)
    return None


_MOST_STEPS = 1_000_000
_BETWEEN = "select_n", "convert_element_type", "min", "max", "squeeze"
_TESTS = {
    "lt": (1, 0),
    "le": (1, 1),
    "gt": (-1, 0),
    "ge": (-1, 1),
    "ne": (0, 0),
    "eq": (0, 1),
}
_OPPOSITE = {"lt": "ge", "le": "gt", "gt": "le", "ge": "lt", "eq": "ne", "ne": "eq"}
