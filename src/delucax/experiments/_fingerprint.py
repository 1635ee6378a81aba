"""Hashes of the code and the values that a case depends on."""

import ast
import contextlib
import copyreg
import dataclasses
import functools
import hashlib
import inspect
import os
import sys
import sysconfig
import textwrap
import types
from collections.abc import Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


_STANDARD = os.path.realpath(sysconfig.get_paths()["stdlib"])


def fingerprint(value: Any, *, root: str | None = None) -> str:
    """A hash of what `value` is, the same in another process.

    A function is its source without comments, docstring and decorators, what it closes
    over, and the functions, classes and values that it names, as long as they are the
    user's own: libraries count by their names alone. An object is what it holds and the
    code of its class. `root` is a module whose code counts although it is a library's.

    **Raises:** `TypeError` if something in it has no content to tell it by.
    """
    hasher = _Hasher(root)
    hasher.feed(value)
    return hasher.sha.hexdigest()[:16]


def is_library(module: str | None) -> bool:
    """Whether a module belongs to an installed package, or to Python."""
    # One that is not loaded was made by `exec`, as in the tests of the pages.
    if module == "__main__" or module not in sys.modules:
        return False
    file = getattr(sys.modules[module], "__file__", None)
    is_ours = module.partition(".")[0] == "delucax"
    return is_ours or file is None or _is_installed(file)


@functools.cache
def _is_installed(file: str) -> bool:
    file = os.path.realpath(file)
    return "site-packages" in file or file.startswith(_STANDARD + os.sep)


class _Hasher:
    def __init__(self, root: str | None):
        self.sha = hashlib.sha256()
        self.root = root
        # Visited objects with their numbers; kept alive, so that ids are not reused.
        self.visited: dict[int, tuple[int, Any]] = {}

    def visit(self, thing: Any) -> bool:
        """Whether it is visited for the first time."""
        if id(thing) in self.visited:
            return False
        self.visited[id(thing)] = len(self.visited), thing
        return True

    def own(self, module: str | None) -> bool:
        return module == self.root or not is_library(module)

    def word(self, *words: Any) -> None:
        for word in words:
            word = word if isinstance(word, bytes) else str(word).encode()
            self.sha.update(b"%d:" % len(word) + word)

    def feed(self, value: Any) -> None:
        kind = type(value)
        # A subclass of list or dict by the user is hashed with its class.
        own = self.own(kind.__module__)
        if value is None or kind in (bool, int, float, complex, str, bytes, range):
            self.word(kind.__name__, repr(value))
        elif isinstance(value, jax.Array | np.ndarray | np.generic):
            self.array(value)
        elif isinstance(value, Mapping) and not own:
            self.word("mapping", len(value))
            for _, key in sorted((repr(key), key) for key in value):
                self.feed(key)
                self.feed(value[key])
        elif isinstance(value, set | frozenset):
            if own:
                self.type(kind)
            self.word("set", *sorted(fingerprint(member) for member in value))
        elif isinstance(value, list | tuple) and not own:
            self.word(kind.__name__, len(value))
            for member in value:
                self.feed(member)
        elif isinstance(value, types.FunctionType):
            self.function(value)
        elif isinstance(value, types.BuiltinFunctionType | np.ufunc):
            self.word("builtin", getattr(value, "__module__", ""), value.__name__)
        elif isinstance(value, type):
            self.type(value)
        elif isinstance(value, types.ModuleType):
            self.module(value)
        elif not own and hasattr(value, "__wrapped__"):
            self.feed(value.__wrapped__)  # type: ignore
        elif dataclasses.is_dataclass(value):
            self.feed(kind)
            for field in dataclasses.fields(value):
                self.word(field.name)
                self.feed(getattr(value, field.name, None))
        else:
            self.other(value)

    def array(self, value: Any) -> None:
        if jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
            self.word("key", value.dtype)
            value = jax.random.key_data(value)
        content = np.asarray(value)
        if content.dtype == object:
            self.word("objects", content.shape)
            self.feed(content.ravel().tolist())
        else:
            self.word("array", content.dtype, content.shape, content.tobytes())

    def function(self, f: types.FunctionType) -> None:
        self.word("function", f.__qualname__)
        if not self.visit(f):
            return
        names: set[str] = set()
        if self.own(f.__module__):
            self.word(source_of(f))
            names = _names(f.__code__)
        else:
            self.word(f.__module__)
        self.feed([f.__defaults__, f.__kwdefaults__])
        for cell in f.__closure__ or ():
            try:
                self.feed_named(cell.cell_contents)
            except ValueError:  # not yet set
                self.word("empty")
        for name in sorted(names & f.__globals__.keys()):
            self.word(name)
            self.feed_named(f.__globals__[name])

    def feed_named(self, value: Any) -> None:
        """A value that the code names: one without content counts by its type."""
        if id(value) in self.visited:
            return
        before, count = self.sha.copy(), len(self.visited)
        try:
            self.feed(value)
        except (TypeError, RecursionError):
            self.sha = before
            while len(self.visited) > count:
                self.visited.popitem()
            self.word("thing", type(value).__qualname__)
            if self.own(type(value).__module__):
                self.type(type(value))

    def type(self, cls: type) -> None:
        self.word("type", cls.__module__, cls.__qualname__)
        if not (self.own(cls.__module__) and self.visit(cls)):
            return
        for name, member in sorted(vars(cls).items()):
            code = [f for f in _functions(member) if self.own(f.__module__)]
            if code or not name.startswith("__"):
                self.word(name)
                self.feed_named(code or member)
        for base in cls.__bases__:
            self.type(base)

    def module(self, module: types.ModuleType) -> None:
        self.word("module", module.__name__)
        if self.own(module.__name__) and self.visit(module):
            try:
                self.word(_plain(inspect.getsource(module)))
            except (OSError, TypeError, SyntaxError):
                self.word("no source")
            # Members from other modules of the user.
            for member in vars(module).values():
                if isinstance(member, types.ModuleType):
                    self.module(member)
                elif isinstance(member, types.FunctionType | type):
                    self.feed_named(member)

    def other(self, value: Any) -> None:
        if isinstance(value, Iterator):
            raise TypeError(f"a {type(value).__name__}, which is used up when read")
        kind = type(value)
        if not self.visit(value):
            self.word("again", self.visited[id(value)][0])
            return
        # The parts that pickle would write, and their code.
        reduce = copyreg.dispatch_table.get(kind, lambda value: value.__reduce_ex__(4))
        try:
            parts: Any = reduce(value)
        except Exception as error:
            raise TypeError(f"a {kind.__name__}, which {error}") from error
        self.type(kind)
        if isinstance(parts, str):
            self.word(parts)
            return
        for k, part in enumerate(parts):
            # The fourth and fifth run over members of lists and of dictionaries.
            self.feed(list(part) if k in (3, 4) and part is not None else part)


def _functions(member: Any) -> list[types.FunctionType]:
    """The functions of a member of a class: a method, a property or the like."""
    parts: list[Any] = [member]
    if isinstance(member, property | functools.cached_property):
        names = ("fget", "fset", "fdel", "func")
        parts = [getattr(member, name, None) for name in names]
    return [f for f in map(inspect.unwrap, parts) if isinstance(f, types.FunctionType)]


def source_of(f: types.FunctionType) -> str:
    """The code of a function, the same whatever its comments and its layout."""
    if f.__name__ != "<lambda>":
        with contextlib.suppress(OSError, TypeError, SyntaxError):
            return _plain(inspect.getsource(f))
    return repr(_bytecode(f.__code__))


def _plain(source: str) -> str:
    tree = ast.parse(textwrap.dedent(source))
    if len(tree.body) == 1 and hasattr(tree.body[0], "decorator_list"):
        tree.body[0].decorator_list = []  # type: ignore
    for node in ast.walk(tree):
        match getattr(node, "body", None):
            case [ast.Expr(ast.Constant()), _, *_]:  # a docstring
                del node.body[0]  # type: ignore
    return ast.unparse(tree)


def _bytecode(code: types.CodeType) -> tuple:
    constants = tuple(
        _bytecode(c)
        if isinstance(c, types.CodeType)
        # The order of a set is another one in another process.
        else str(sorted(map(repr, c)))
        if isinstance(c, frozenset)
        else repr(c)
        for c in code.co_consts
    )
    return code.co_code, constants, code.co_names, code.co_varnames


def _names(code: types.CodeType) -> set[str]:
    """The names that the code uses, those of functions within it too."""
    inner = [c for c in code.co_consts if isinstance(c, types.CodeType)]
    return {*code.co_names}.union(*map(_names, inner))
