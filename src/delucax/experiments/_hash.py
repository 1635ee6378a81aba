"""What a case depends on, in one hash: its code and the values of its parameters."""

import ast
import dataclasses
import enum
import functools
import hashlib
import inspect
import os
import pickle
import re
import sys
import sysconfig
import textwrap
import types
from collections.abc import Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


_ADDRESS = re.compile(r"0x[0-9a-f]+")
_STANDARD = os.path.realpath(sysconfig.get_paths()["stdlib"])


def fingerprint(value: Any, *, root: str | None = None) -> str:
    """A hash of what `value` is, the same in another process.

    A function is its source without comments, docstring and decorators, what it closes
    over, and the functions, classes and values that it names, as long as they are the
    user's own: libraries count by their names alone. `root` is a module whose code
    counts although it is a library's.

    **Raises:** `TypeError` if something in it has no content to tell it by.
    """
    hasher = _Hasher(root)
    hasher.feed(value)
    return hasher.sha.hexdigest()[:16]


def is_library(module: str | None) -> bool:
    """Whether a module belongs to an installed package, or to Python."""
    if not module or module == "__main__":
        return False
    if module.partition(".")[0] == "delucax":
        return True
    loaded = sys.modules.get(module)
    if loaded is None:  # made by `exec`, in the tests of the pages
        return False
    file = getattr(loaded, "__file__", None)
    if file is None:
        return True
    file = os.path.realpath(file)
    return "site-packages" in file or file.startswith(_STANDARD + os.sep)


class _Hasher:
    def __init__(self, root: str | None):
        self.sha = hashlib.sha256()
        self.root = root
        self.seen: set[int] = set()

    def own(self, module: str | None) -> bool:
        return module == self.root or not is_library(module)

    def word(self, *words: Any) -> None:
        for word in words:
            word = word if isinstance(word, bytes) else str(word).encode()
            self.sha.update(b"%d:" % len(word) + word)

    def feed(self, value: Any) -> None:
        kind = type(value)
        if value is None or kind in (bool, int, float, complex, str, bytes, range):
            self.word(kind.__name__, repr(value))
        elif isinstance(value, jax.Array | np.ndarray | np.generic):
            self.array(value)
        elif isinstance(value, Mapping):
            self.word("mapping", len(value))
            for _, key in sorted((repr(key), key) for key in value):
                self.feed(key)
                self.feed(value[key])
        elif isinstance(value, set | frozenset):
            self.word("set", *sorted(fingerprint(member) for member in value))
        elif isinstance(value, list | tuple):
            self.word(kind.__name__, len(value))
            for member in value:
                self.feed(member)
        elif isinstance(value, enum.Enum | np.dtype | os.PathLike):
            self.word(kind.__qualname__, value)
        elif isinstance(value, functools.partial):
            self.word("partial")
            self.feed((value.func, value.args, value.keywords))
        elif isinstance(value, types.MethodType):
            self.feed((value.__self__, value.__func__))
        elif isinstance(value, types.FunctionType):
            self.function(value)
        elif isinstance(value, types.BuiltinFunctionType | np.ufunc):
            self.word("builtin", getattr(value, "__module__", ""), value.__name__)
        elif isinstance(value, type):
            self.type(value)
        elif isinstance(value, types.ModuleType):
            self.module(value)
        elif hasattr(value, "__wrapped__"):
            self.feed(value.__wrapped__)
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
            raise TypeError("an array of objects")
        self.word("array", content.dtype, content.shape, content.tobytes())

    def function(self, f: types.FunctionType) -> None:
        self.word("function", f.__qualname__)
        if id(f) in self.seen:
            return
        self.seen.add(id(f))
        names: set[str] = set()
        if self.own(f.__module__):
            self.word(source_of(f))
            names = _names(f.__code__)
        else:
            self.word(f.__module__)
        self.feed([f.__defaults__, f.__kwdefaults__])
        for cell in f.__closure__ or ():
            try:
                self.lenient(cell.cell_contents)
            except ValueError:  # not yet set
                self.word("empty")
        for name in sorted(names):
            if name in f.__globals__:
                self.word(name)
                self.lenient(f.__globals__[name])

    def lenient(self, value: Any) -> None:
        """A value that the code names: one without content counts by its type."""
        if id(value) in self.seen:
            return
        before = self.sha.copy()
        try:
            self.feed(value)
        except (TypeError, RecursionError):
            self.sha = before
            self.word("thing", type(value).__qualname__)

    def type(self, cls: type) -> None:
        self.word("type", cls.__module__, cls.__qualname__)
        if self.own(cls.__module__) and id(cls) not in self.seen:
            self.seen.add(id(cls))
            try:
                source = _plain(inspect.getsource(cls))
            except (OSError, TypeError, SyntaxError):
                for name, member in sorted(vars(cls).items()):
                    if isinstance(member, types.FunctionType):
                        self.word(name)
                        self.function(member)
            else:
                self.word(source)
                # What its methods name; they may be wrapped, and are read as text.
                scope = vars(sys.modules[cls.__module__])
                nodes = ast.walk(ast.parse(source))
                named = {node.id for node in nodes if isinstance(node, ast.Name)}
                for name in sorted(named & scope.keys()):
                    self.word(name)
                    self.lenient(scope[name])
            for base in cls.__bases__:
                self.type(base)

    def module(self, module: types.ModuleType) -> None:
        self.word("module", module.__name__)
        if self.own(module.__name__) and id(module) not in self.seen:
            self.seen.add(id(module))
            try:
                self.word(_plain(inspect.getsource(module)))
            except (OSError, TypeError, SyntaxError):
                self.word("no source")
            # What its code uses of other modules of the user.
            for member in vars(module).values():
                if isinstance(member, types.ModuleType):
                    self.module(member)
                elif isinstance(member, types.FunctionType | type):
                    self.lenient(member)

    def other(self, value: Any) -> None:
        if isinstance(value, Iterator):
            raise TypeError(f"a {type(value).__name__}, which is used up when read")
        leaves, structure = jax.tree.flatten(value)
        if not (len(leaves) == 1 and leaves[0] is value):
            self.word("tree", _ADDRESS.sub("", str(structure)))
            self.feed(leaves)
            return
        try:
            content = pickle.dumps(value, protocol=4)
        except Exception as error:
            raise TypeError(f"a {type(value).__name__}, which {error}") from error
        self.word(type(value).__qualname__, content)


def source_of(f: types.FunctionType) -> str:
    """The code of a function, the same whatever its comments and its layout."""
    if f.__name__ != "<lambda>":
        try:
            return _plain(inspect.getsource(f))
        except (OSError, TypeError, SyntaxError):
            pass
    return repr(_bytecode(f.__code__))


def _plain(source: str) -> str:
    tree = ast.parse(textwrap.dedent(source))
    if len(tree.body) == 1 and hasattr(tree.body[0], "decorator_list"):
        tree.body[0].decorator_list = []  # type: ignore
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list) and len(body) > 1:
            first = body[0]
            if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant):
                del body[0]
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
    found = set(code.co_names)
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            found |= _names(constant)
    return found
