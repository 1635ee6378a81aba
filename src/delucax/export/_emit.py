"""The writer of statements in C: scopes, variables, memory and loops."""

import contextlib
import itertools
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from ._expressions import c_type, Expr, Index, known, literal, NOTHING
from ._routines import routine
from ._values import Buffer, Formula, Scalars, Table, Value, View


class Line:
    """A statement. It is removed later if nothing reads what it writes."""

    __slots__ = ("reads", "text", "writes")

    def __init__(self, text: str, reads: frozenset[str], writes: str | None):
        self.text, self.reads, self.writes = text, reads, writes


class Group:
    """A loop or a choice: scopes, each with a header line."""

    __slots__ = ("headers", "reads", "scopes")

    def __init__(self, headers: list[str], scopes: "list[Scope]", reads):
        self.headers, self.scopes, self.reads = headers, scopes, reads


class Scope:
    """Statements in braces."""

    def __init__(self, parent: "Scope | None" = None, repeats: bool = False):
        self.parent, self.repeats = parent, repeats
        self.items: list[Line | Group] = []
        self.cost = 0

    def is_within(self, other: "Scope") -> bool:
        """Whether this scope is `other`, or lies inside it."""
        scope: Scope | None = self
        while scope is not None:
            if scope is other:
                return True
            scope = scope.parent
        return False


class Writer:
    """Writes the statements of one function in C.

    **Arguments:**

    - `unroll`: arrays with at most this many entries become variables; larger ones
        become memory.
    - `shared`: the tables and routines of the file.
    """

    def __init__(self, unroll: int, shared: "Shared"):
        self.unroll, self.shared = unroll, shared
        self.scope = self.top = Scope()
        self.buffers: list[Buffer] = []
        self._count = itertools.count()
        self.failed: Expr | None = None
        """The flag of a raised error; `None` if the program cannot raise one."""
        self._stored: dict[Any, tuple[Scope, Value, View]] = {}

    # Statements

    def line(
        self, text: str, reads: frozenset[str], writes: str | None, cost: int = 0
    ) -> None:
        """Add a statement."""
        self.scope.cost += cost
        self.scope.items.append(Line(text, reads, writes))

    def name(self, letter: str) -> str:
        """A new name that begins with `letter`."""
        return f"{letter}{next(self._count)}"

    def define(self, expr: Expr) -> Expr:
        """A new constant with the value of an expression."""
        if expr.value is not None or expr.text.isidentifier():
            return expr
        name = self.name("v")
        text = f"const {c_type(expr.dtype)} {name} = {bare(expr.text)};"
        self.line(text, expr.reads, name, expr.cost)
        return expr._replace(text=name, reads=frozenset([name]), cost=0)

    def copy_of(self, expr: Expr) -> Expr:
        """A new constant with the value of a variable."""
        return self.define(expr._replace(text=f"({expr.text})"))

    def variable(self, dtype: Any, start: Expr | None = None) -> Expr:
        """A new variable that may change."""
        name = self.name("v")
        if start is None:
            self.line(f"{c_type(dtype)} {name};", NOTHING, name)
        else:
            text = f"{c_type(dtype)} {name} = {bare(start.text)};"
            self.line(text, start.reads, name, start.cost)
        return Expr(name, np.dtype(dtype), frozenset([name]))

    def failure(self) -> Expr:
        """The variable that says whether an error was raised."""
        if self.failed is None:
            name, boolean = self.name("v"), np.dtype(bool)
            line = Line(f"{c_type(boolean)} {name} = 0;", NOTHING, name)
            self.top.items.insert(0, line)
            self.failed = Expr(name, boolean, frozenset([name]), low=0, high=1)
        return self.failed

    def assign(self, variable: Expr, expr: Expr) -> None:
        """Assign a new value to a variable."""
        if expr.text != variable.text:
            text = f"{variable.text} = {bare(expr.text)};"
            self.line(text, expr.reads, variable.text, expr.cost)

    def store(self, view: View, indices: Sequence[Index], expr: Expr) -> None:
        """Write an entry of an array in memory."""
        target = view.at(tuple(indices))
        reads = expr.reads | (target.reads - {view.buffer.name})
        text = f"{target.text} = {bare(expr.text)};"
        self.line(text, reads, view.buffer.name, expr.cost)

    @contextlib.contextmanager
    def loop(self, length: int) -> Iterator[Index]:
        """A loop over an index."""
        if length == 1:
            yield known(0)
            return
        name = self.name("i")
        inside = Scope(self.scope, True)
        outside, self.scope = self.scope, inside
        index = Index(0, ((name, 1, 0, length - 1),), frozenset([name]))
        yield index
        self.scope = outside
        header = f"for (int {name} = 0; {name} < {length}; ++{name}) {{"
        outside.items.append(Group([header], [inside], NOTHING))
        outside.cost += length * inside.cost

    @contextlib.contextmanager
    def over(self, shape: Sequence[int]) -> Iterator[tuple[Index, ...]]:
        """Loops over all indices of a shape."""
        with contextlib.ExitStack() as stack:
            yield tuple([stack.enter_context(self.loop(n)) for n in shape])

    def choose(self, which: Expr, count: int, inside: Any) -> None:
        """Write `inside(k)` for case `k`. Numbers beyond the cases take the nearest."""
        which = self.define(which)
        headers, scopes, outside = [], [], self.scope
        for k in range(count):
            if count == 2:
                test = f"!{which.text}" if which.low >= 0 else f"{which.text} <= 0"
                headers.append(f"if ({test}) {{" if not k else "} else {")
            elif k == count - 1:
                headers.append("} else {")
            else:
                test = f"if ({which.text} <= {k}) {{"
                headers.append(test if not k else "} else " + test)
            self.scope = Scope(outside)
            scopes.append(self.scope)
            inside(k)
        self.scope = outside
        outside.cost += 1 + max(s.cost for s in scopes)
        outside.items.append(Group(headers, scopes, which.reads))

    # Memory

    def buffer(self, dtype: Any, size: int) -> Buffer:
        """New memory for `size` entries."""
        buffer = Buffer(self.name("b"), dtype, size, self.scope, True)
        self.buffers.append(buffer)
        return buffer

    def new_view(self, shape: Sequence[int], dtype: Any) -> View:
        """New memory for an array."""
        return View(self.buffer(dtype, int(np.prod(shape, dtype=int))), shape)

    def stored(self, value: Value) -> View:
        """The array as a view of memory, to which it is written if need be."""
        if isinstance(value, View):
            return value
        if isinstance(value, Table):
            least, strides = value.least()
            name = self.shared.table(least)
            buffer = Buffer(name, value.dtype, least.size, None, False)
            return View(buffer, value.shape, strides)
        # A copy that was stored in a branch does not exist outside that branch.
        if id(value) in self._stored:
            scope, same, view = self._stored[id(value)]
            if same is value and self.scope.is_within(scope):
                return view
        view = self.copied(value)
        # The copy may be read again, so nothing may change it.
        view.buffer.is_own = False
        self._stored[id(value)] = self.scope, value, view
        return view

    def packed(self, value: Value) -> View:
        """The array as a contiguous view of memory."""
        view = self.stored(value)
        return view if view.is_contiguous else self.copied(view)

    def copied(self, value: Value) -> View:
        """A copy of the array in new memory."""
        view = self.new_view(value.shape, value.dtype)
        self.fill(view, value)
        return view

    def fill(self, view: View, value: Value) -> None:
        """Write all entries of an array to memory."""
        if not value.size:
            return
        if isinstance(value, Scalars):
            for indices in itertools.product(*map(range, value.shape)):
                indices = tuple(map(known, indices))
                self.store(view, indices, value.at(indices))
            return
        if isinstance(value, Table) and not value.is_uniform:
            value = self.stored(value)
        if isinstance(value, View) and value.is_contiguous and view.is_contiguous:
            if value.size > self.unroll:
                self.copy(view, value)
                return
        with self.over(value.shape) as indices:
            self.store(view, indices, value.at(indices))

    def copy(self, view: View, value: View) -> None:
        """Copy one contiguous view to another."""
        kind = c_type(value.dtype, stored=True)
        text = f"memcpy({view.pointer}, {value.pointer}, "
        reads = view.start.reads | value.start.reads | {value.buffer.name}
        target = view.buffer.name
        self.line(f"{text}{value.size} * sizeof({kind}));", reads, target)

    def zeros(self, shape: Sequence[int], dtype: Any) -> View:
        """New memory for an array of zeros."""
        view = self.new_view(shape, dtype)
        kind = c_type(dtype, stored=True)
        text = f"memset({view.pointer}, 0, {view.size} * sizeof({kind}));"
        self.line(text, NOTHING, view.buffer.name)
        return view

    def place(self, shape: Sequence[int], dtype: Any) -> Value:
        """The place of an array that may change: variables, or memory."""
        size = int(np.prod(shape, dtype=int))
        if size > self.unroll:
            return self.new_view(shape, dtype)
        parts = [self.variable(dtype) for _ in range(size)]
        return Scalars(shape, dtype, parts, frozenset())

    def put(self, place: Value, value: Value) -> None:
        """Set the array at a place."""
        if isinstance(place, View):
            if value is not place:
                self.fill(place, value)
            return
        for variable, expr in zip(place.entries(), value.entries(), strict=True):
            self.assign(variable, expr)

    def put_all(self, places: Sequence[Value], values: Sequence[Value]) -> None:
        """Set several arrays at once. All values are read before a place changes."""
        pairs = [
            (p, v)
            for p, v in zip(places, values, strict=True)
            if v is not p and not same_memory(p, v)
        ]
        changed = {b for p, _ in pairs for b in p.buffers}
        names = {e.text for p, _ in pairs if isinstance(p, Scalars) for e in p.parts}
        changed_names = names | {b.name for b in changed}
        ready = []
        for place, value in pairs:
            if isinstance(value, Scalars):
                own = (
                    {p.text for p in place.parts}
                    if isinstance(place, Scalars)
                    else set()
                )
                others = changed_names - own if value.size == 1 else changed_names
                parts = [self.define(e) if e.reads & others else e for e in value.parts]
                # A variable is copied, because it may change before it is read.
                parts = [self.copy_of(e) if e.text in others else e for e in parts]
                value = Scalars(value.shape, value.dtype, parts, frozenset())
            elif isinstance(place, Scalars):
                value = Scalars(
                    value.shape,
                    value.dtype,
                    [self.define(e) for e in value.entries()],
                    frozenset(),
                )
            elif value.buffers & changed:
                value = self.copied(value)
            ready.append((place, value))
        for place, value in ready:
            if isinstance(place, View):
                self.fill(place, value)
        for place, value in ready:
            if isinstance(place, Scalars):
                self.put(place, value)

    # Values

    def formula(self, shape: Any, dtype: Any, at: Any, of: Iterable[Value], cost: int):
        """An array that is a function of its indices. A small one is written out."""
        shape, of = tuple(shape), list(of)
        if int(np.prod(shape, dtype=int)) <= self.unroll:
            corners = itertools.product(*map(range, shape))
            parts = [at(tuple(map(known, i))) for i in corners]
            buffers = frozenset().union(*(v.buffers for v in of))
            return Scalars(shape, dtype, parts, buffers)
        return Formula(shape, dtype, at, of, cost)

    def indexable(self, value: Value) -> Value:
        """The array in a form that can be read inside a loop."""
        is_few = isinstance(value, Scalars) and value.size > 1
        return self.stored(value) if is_few else value

    def cheap(self, value: Value) -> Value:
        """The array in a form in which reading an entry costs no operation."""
        if isinstance(value, Formula) and value.cost:
            return self.stored(value)
        if isinstance(value, Scalars):
            parts = [self.define(p) if p.cost else p for p in value.parts]
            return Scalars(value.shape, value.dtype, parts, value.buffers)
        return value

    def settled(self, value: Value, weight: int) -> Value:
        """The array for `weight` readers: entries with a cost are computed once."""
        if isinstance(value, Formula):
            return self.copied(value) if weight > 1 and value.cost else value
        if isinstance(value, Scalars):
            parts = [
                self.define(p) if weight > 1 and p.cost or len(p.text) > 160 else p
                for p in value.parts
            ]
            return Scalars(value.shape, value.dtype, parts, value.buffers)
        return value


class Shared:
    """The tables and the routines that the functions of a file share."""

    def __init__(self):
        self.tables: dict[Any, tuple[str, np.ndarray]] = {}
        self.routines: dict[str, str] = {}

    def table(self, array: np.ndarray) -> str:
        """The name of the table of a known array."""
        key = str(array.dtype), array.size, array.tobytes()
        if key not in self.tables:
            self.tables[key] = f"c{len(self.tables)}", array
        return self.tables[key][0]

    def routine(self, name: str, dtype: Any, out: Any = None) -> str:
        """The name of a routine, which is added to the file."""
        name, text = routine(name, dtype, out)
        self.routines[name] = text
        return name


def same_memory(a: Value, b: Value) -> bool:
    """Whether both arrays are the same view of memory."""
    if not (isinstance(a, View) and isinstance(b, View)) or a.buffer is not b.buffer:
        return False
    return (a.shape, a.strides, a.start) == (b.shape, b.strides, b.start)


def bare(text: str) -> str:
    """The expression without the parentheses around it, if there are any."""
    if not text.startswith("("):
        return text
    depth = 0
    for k, mark in enumerate(text):
        depth += (mark == "(") - (mark == ")")
        if not depth:
            return text[1:-1] if k == len(text) - 1 else text
    return text


def numbers(array: np.ndarray) -> str:
    """The entries of a known array as text in C."""
    return ", ".join(literal(x, array.dtype).text for x in array.flat)
