"""Hashes of the code and the values that a case depends on."""

import ast
import contextlib
import copyreg
import dataclasses
import dis
import functools
import hashlib
import importlib.util
import inspect
import os
import sys
import sysconfig
import textwrap
import types
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


_STANDARD = os.path.realpath(sysconfig.get_paths()["stdlib"])


def fingerprint(value: Any, *, root: str | None = None) -> str:
    """A hash of the content of `value`, which is the same in another process.

    A function is hashed by its source without comments, docstring and decorators, by
    the values that it closes over, and by the functions, classes and values that it
    names or imports. Only the user's code counts: functions and classes of libraries
    are hashed by name. An object is hashed by its content and the code of its class.
    `root` is a module whose code counts even if it belongs to a library.

    **Raises:** `TypeError` if a value in it cannot be hashed by its content.
    """
    hasher = _Hasher(root)
    hasher.add(value)
    return hasher.sha.hexdigest()[:16]


def is_library(module: str | None) -> bool:
    """Whether a module belongs to an installed package, or to Python."""
    # A module that is not loaded was made by `exec`, as in the tests of the pages.
    if module == "__main__" or module not in sys.modules:
        return False
    loaded = sys.modules[module]
    file, folders = getattr(loaded, "__file__", None), getattr(loaded, "__path__", ())
    return _is_of_library(module, file, folders)


def _is_of_library(module: str, file: str | None, folders: Iterable[str]) -> bool:
    # A namespace package has folders, but no file.
    place = file or next(iter(folders), None)
    is_ours = module.partition(".")[0] == "delucax"
    return is_ours or place is None or _is_installed(place)


@functools.cache
def _is_installed(file: str) -> bool:
    file = os.path.realpath(file)
    return "site-packages" in file or file.startswith(_STANDARD + os.sep)


class _Hasher:
    def __init__(self, root: str | None):
        self.sha = hashlib.sha256()
        self.root = root
        # Visited objects and their numbers. They stay alive so that no id is reused.
        self.visited: dict[int, tuple[int, Any]] = {}

    def mark_visited(self, thing: Any) -> bool:
        """Give an object a number, or add the number that it has. Returns whether the
        object is new."""
        if id(thing) in self.visited:
            self.update("again", self.visited[id(thing)][0])
            return False
        self.visited[id(thing)] = len(self.visited), thing
        return True

    def is_own(self, module: str | None) -> bool:
        return module == self.root or not is_library(module)

    def update(self, *words: Any) -> None:
        for word in words:
            word = word if isinstance(word, bytes) else str(word).encode()
            self.sha.update(b"%d:" % len(word) + word)

    def add(self, value: Any) -> None:
        kind = type(value)
        # A subclass of list or dict by the user is hashed with its class.
        own = self.is_own(kind.__module__)
        if value is None or kind in (bool, int, float, complex, str, bytes, range):
            self.update(kind.__name__, repr(value))
        elif isinstance(value, jax.Array | np.ndarray | np.generic):
            self.array(value)
        elif isinstance(value, Mapping) and not own:
            self.update("mapping", len(value))
            for _, key in sorted((repr(key), key) for key in value):
                self.add(key)
                self.add(value[key])
        elif isinstance(value, set | frozenset):
            if own:
                self.type(kind)
            self.update("set", *sorted(fingerprint(member) for member in value))
        elif isinstance(value, list | tuple) and not own:
            self.update(kind.__name__, len(value))
            for member in value:
                self.add(member)
        elif isinstance(value, types.FunctionType):
            self.function(value)
        elif isinstance(value, types.BuiltinFunctionType | np.ufunc):
            self.update("builtin", getattr(value, "__module__", ""), value.__name__)
        elif isinstance(value, type):
            self.type(value)
        elif isinstance(value, types.ModuleType):
            self.module(value)
        elif not own and hasattr(value, "__wrapped__"):
            self.add(value.__wrapped__)  # type: ignore
        elif dataclasses.is_dataclass(value):
            self.add(kind)
            for field in dataclasses.fields(value):
                self.update(field.name)
                self.add(getattr(value, field.name, None))
        else:
            self.other(value)

    def array(self, value: Any) -> None:
        if jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
            self.update("key", value.dtype)
            value = jax.random.key_data(value)
        content = np.asarray(value)
        if content.dtype == object:
            self.update("objects", content.shape)
            self.add(content.ravel().tolist())
        else:
            self.update("array", content.dtype, content.shape, content.tobytes())

    def function(self, f: types.FunctionType) -> None:
        self.update("function", f.__qualname__)
        if not self.mark_visited(f):
            return
        names: set[str] = set()
        if self.is_own(f.__module__):
            self.update(source_of(f))
            names = _names(f.__code__)
            for name, thing in _imported(f.__code__, f.__globals__):
                self.update(name)
                self.add_named(thing)
        else:
            self.update(f.__module__)
        self.add([f.__defaults__, f.__kwdefaults__])
        for cell in f.__closure__ or ():
            try:
                self.add_named(cell.cell_contents)
            except ValueError:  # not yet set
                self.update("empty")
        for name in sorted(names & f.__globals__.keys()):
            self.update(name)
            self.add_named(f.__globals__[name])

    def add_named(self, value: Any) -> None:
        """Add a value that the code names. A value that cannot be hashed counts by its
        type."""
        before, count = self.sha.copy(), len(self.visited)
        try:
            self.add(value)
        except (TypeError, RecursionError):
            self.sha = before
            while len(self.visited) > count:
                self.visited.popitem()
            self.update("thing", type(value).__qualname__)
            if self.is_own(type(value).__module__):
                self.type(type(value))

    def type(self, cls: type) -> None:
        self.update("type", cls.__module__, cls.__qualname__)
        if not (self.is_own(cls.__module__) and self.mark_visited(cls)):
            return
        for name, member in sorted(vars(cls).items()):
            code = [f for f in _functions(member) if self.is_own(f.__module__)]
            if code or not name.startswith("__"):
                self.update(name)
                self.add_named(code or member)
        for base in cls.__bases__:
            self.type(base)

    def module(self, module: types.ModuleType) -> None:
        self.update("module", module.__name__)
        if self.is_own(module.__name__) and self.mark_visited(module):
            try:
                self.update(_plain(inspect.getsource(module)))
            except (OSError, TypeError, SyntaxError):
                self.update("no source")
            # Members can come from other modules of the user.
            for member in vars(module).values():
                if isinstance(member, types.ModuleType):
                    self.module(member)
                elif isinstance(member, types.FunctionType | type):
                    self.add_named(member)

    def other(self, value: Any) -> None:
        if isinstance(value, Iterator):
            raise TypeError(f"a {type(value).__name__}, which is used up when read")
        kind = type(value)
        if not self.mark_visited(value):
            return
        # The parts that pickle would write, and their code.
        reduce = copyreg.dispatch_table.get(kind, lambda value: value.__reduce_ex__(4))
        try:
            parts: Any = reduce(value)
        except Exception as error:
            raise TypeError(f"a {kind.__name__} ({error})") from error
        self.type(kind)
        if isinstance(parts, str):
            self.update(parts)
            return
        for k, part in enumerate(parts):
            # The fourth and fifth parts are iterators over members of lists and dicts.
            self.add(list(part) if k in (3, 4) and part is not None else part)


def _functions(member: Any) -> list[types.FunctionType]:
    """The functions of a member of a class: a method, a property or the like."""
    parts: list[Any] = [member]
    if isinstance(member, property | functools.cached_property):
        names = ("fget", "fset", "fdel", "func")
        parts = [getattr(member, name, None) for name in names]
    return [f for f in map(inspect.unwrap, parts) if isinstance(f, types.FunctionType)]


def source_of(f: types.FunctionType) -> str:
    """The code of a function, without its comments and layout."""
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
        # The order of a set differs between processes.
        else str(sorted(map(repr, c)))
        if isinstance(c, frozenset)
        else repr(c)
        for c in code.co_consts
    )
    return code.co_code, constants, code.co_names, code.co_varnames


def _names(code: types.CodeType) -> set[str]:
    """The names that the code uses, also in the functions within it."""
    inner = [c for c in code.co_consts if isinstance(c, types.CodeType)]
    return {*code.co_names}.union(*map(_names, inner))


def _imported(code: types.CodeType, scope: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    """What the code imports from the user's modules when it runs, by name. The modules
    are imported here, because the hash must not depend on whether they were."""
    steps = [s for s in dis.get_instructions(code) if s.opname != "EXTENDED_ARG"]
    for level, members, step in zip(steps, steps[1:], steps[2:], strict=False):
        if step.opname != "IMPORT_NAME":
            continue
        name, level, members = step.argval, level.argval, members.argval
        try:
            if _is_library_on_disk(scope["__package__"] if level else name):
                continue
            module = __import__(name, scope, None, members, level)
            yield from ((m, getattr(module, m)) for m in members or ())
            if not members:
                yield name, module
        except Exception:
            yield name, "not imported"
    for inner in code.co_consts:
        if isinstance(inner, types.CodeType):
            yield from _imported(inner, scope)


def _is_library_on_disk(module: str) -> bool:
    """Whether a module that need not be loaded belongs to a library."""
    top = module.partition(".")[0]
    if top in sys.modules:
        return is_library(top)
    spec = importlib.util.find_spec(top)
    if spec is None:
        return False
    file = spec.origin if spec.has_location else None
    return _is_of_library(top, file, spec.submodule_search_locations or ())
