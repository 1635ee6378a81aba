"""Modules and trajectories in files, without pickle.

A file has three parts: a line with the format, its version and a SHA-256 of the rest; a
line of JSON that describes the structure; and the bytes of the arrays.
"""

import dataclasses
import functools
import hashlib
import json
import math
import os
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jax.core import Tracer

from .._files import as_path, replaced
from .._results import Result
from ._qualified import import_named, qualified_name


_MAGIC = "delucax-file"
_VERSION = 1
_FROM_TEXT = {"float": float, "complex": complex, "dtype": jnp.dtype}
_SEQUENCES = {"tuple": tuple, "list": list, "frozenset": frozenset}
_PARTIALS: dict[str, Any] = {
    "partial": functools.partial,
    "Partial": jax.tree_util.Partial,
}


def save(path: str | os.PathLike, obj: Any) -> None:
    """Save a module, a trajectory, or any pytree of modules and trajectories to a file.

    For every module, the file holds the name of its class, its fields, and the bytes of
    its arrays. Functions are saved by name. If writing fails, no partial file is left.

    **Arguments:**

    - `path`: the file to write.
    - `obj`: a module, trajectory, array, number or string, or a tuple, list or
        dictionary of these.

    **Raises:** `ValueError` if a function or class in `obj` has no name, such as a
    lambda. The error message says where in `obj` this function or class is. `OSError`
    if the file cannot be written.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.save("controller.dlx", dlx.controllers.Linear(jnp.ones((1, 2))))
        controller = dlx.load("controller.dlx")
        controller(0.0, jnp.array([1.0, 2.0]), None)
        ```

        ```text
        (Array([-3.], dtype=float32), None)
        ```
    """
    path = _file(path, "save")
    writer = _Writer()
    tree = writer.describe(obj, "obj")
    arrays = [{"dtype": a.dtype.name, "shape": list(a.shape)} for a in writer.arrays]
    header = {"tree": tree, "arrays": arrays}
    text = json.dumps(header, allow_nan=False, separators=(",", ":"))
    body = b"".join([text.encode(), b"\n", *(a.tobytes() for a in writer.arrays)])
    first = f"{_MAGIC} {_VERSION} {hashlib.sha256(body).hexdigest()}\n"
    try:
        with replaced(path) as file:
            file.write(first.encode() + body)
    except OSError as error:
        raise type(error)(f"save: '{path}' cannot be written: {error}") from error


def load(path: str | os.PathLike, *, trust: Sequence[str] = ()) -> Any:
    """Load what [`delucax.save`][] wrote.

    Loading runs no code from the file, because the file contains classes and functions
    only by name. `load` looks up these names, and only in trusted packages. But the
    loaded object calls the functions that the file names when you use this object. Only
    load files from sources that you trust.

    **Arguments:**

    - `path`: the file to read.
    - `trust`: names of additional packages or modules whose classes and functions the
        file may use; none by default. delucax, Diffrax, Equinox, Lineax, Optax,
        Optimistix, the public functions of JAX and NumPy, and everything that you
        defined in the running notebook or script are always trusted.

    **Returns:** the object, with the same structure. A function that was compiled for
    the saved object does not compile again for the loaded object. If JAX is in single
    precision, arrays in double precision are rounded, with a warning.

    **Raises:** `ValueError` if the file is damaged, if the file is not from delucax or
    is from a newer version, or if the file names a class or function that is not
    trusted, that does not exist, or whose fields have changed. `OSError` if it cannot
    be read.

    !!! example

        ```python
        import delucax as dlx

        dlx.save("pendulum.dlx", dlx.make("pendulum"))
        env = dlx.load("pendulum.dlx")
        env.horizon
        ```

        ```text
        200
        ```
    """
    path = _file(path, "load")
    trust = (trust,) if isinstance(trust, str) else trust
    listed = isinstance(trust, list | tuple | set | frozenset)
    if not (listed and all(isinstance(name, str) for name in trust)):
        raise ValueError(
            f"load: trust must be the names of packages or modules, got {trust!r}."
        )
    text, payload = _checked(path)
    try:
        header = json.loads(text)
        reader = _Reader(_split(payload, header["arrays"]), tuple(trust))
        obj = reader.build(header["tree"])
    except (ValueError, TypeError, LookupError, AttributeError) as error:
        raise ValueError(f"load: '{path}' cannot be used: {error}") from error
    if reader.narrowed:
        warnings.warn(
            f"load: '{path}' holds arrays in double precision, which were rounded to "
            "single precision. Set jax_enable_x64 to keep their precision.",
            stacklevel=2,
        )
    return obj


def _file(path: Any, where: str) -> Path:
    path = as_path(path, "path", where)
    if path.is_dir():
        raise ValueError(
            f"{where}: path must be the path of a file, got the folder '{path}'."
        )
    return path


def _checked(path: Path) -> tuple[bytes, bytes]:
    """The header and the bytes of the arrays, once the checksum is verified."""
    try:
        first, _, body = path.read_bytes().partition(b"\n")
    except OSError as error:
        raise type(error)(f"load: '{path}' cannot be read: {error}") from error
    words = first.decode(errors="replace").split(" ")
    is_ours = len(words) == 3 and words[0] == _MAGIC and words[1].isdecimal()
    if not is_ours or int(words[1]) < 1:
        raise ValueError(
            f"load: '{path}' must be a file from delucax.save; it is not, or its "
            "beginning is damaged."
        )
    if int(words[1]) > _VERSION:
        raise ValueError(
            f"load: '{path}' has format {words[1]}, but this version of delucax reads "
            f"formats up to {_VERSION}. Update delucax."
        )
    if hashlib.sha256(body).hexdigest() != words[2]:
        raise ValueError(f"load: '{path}' is damaged: its checksum does not match.")
    text, _, payload = body.partition(b"\n")
    return text, payload


def _split(payload: bytes, descriptions: list[dict[str, Any]]) -> list[np.ndarray]:
    arrays, offset = [], 0
    for description in descriptions:
        dtype, shape = jnp.dtype(description["dtype"]), description["shape"]
        flat = np.frombuffer(payload, dtype, math.prod(shape), offset)
        arrays.append(flat.reshape(shape).copy())
        offset += flat.nbytes
    return arrays


class _Writer:
    """Describes a tree in JSON, and collects its arrays.

    Numbers, strings and `None` stand for themselves. Anything else is a dictionary,
    whose first key is its kind.
    """

    def __init__(self):
        self.arrays: list[np.ndarray] = []

    def describe(self, node: Any, path: str) -> Any:
        kind = type(node)
        if node is None or kind in (bool, int, str):
            return node
        if kind is float and math.isfinite(node):
            return node
        if kind in _FROM_TEXT.values():
            return {kind.__name__: repr(node)}
        if isinstance(node, Tracer):
            raise ValueError(
                f"save: {path} is traced by JAX. Save outside of jit, grad and vmap."
            )
        if isinstance(node, jax.Array | np.ndarray | np.generic):
            return self.array(node, path)
        if isinstance(node, np.dtype):
            return {"dtype": node.name}
        if isinstance(node, Result):
            return self.result(node, path)
        if isinstance(node, eqx.Module):
            return self.module(node, path)
        if kind in _PARTIALS.values():
            parts = {"function": node.func, "args": node.args}
            parts["keywords"] = node.keywords
            return {"partial": kind.__name__, **self.fields(parts, path)}
        if isinstance(node, tuple) and hasattr(node, "_fields"):
            names: Any = kind._fields  # pyright: ignore[reportAttributeAccessIssue]
            fields = self.fields(dict(zip(names, node, strict=True)), path)
            return {"namedtuple": self.name(kind, path), "fields": fields}
        if kind in _SEQUENCES.values():
            items = sorted(node, key=repr) if kind is frozenset else node
            items = [self.describe(c, f"{path}.{i}") for i, c in enumerate(items)]
            return {kind.__name__: items}
        if type(node) is dict:
            at = lambda part, key: self.describe(part, f"{path}.{key}")
            return {"dict": [[at(k, k), at(v, k)] for k, v in node.items()]}
        return {"name": self.name(node, path)}

    def fields(self, nodes: Mapping[Any, Any], path: str) -> dict[Any, Any]:
        return {k: self.describe(node, f"{path}.{k}") for k, node in nodes.items()}

    def array(self, node: Any, path: str) -> dict[str, Any]:
        extra = {}
        if not isinstance(node, jax.Array):
            kind = "numpy" if isinstance(node, np.ndarray) else "scalar"
        elif jnp.issubdtype(node.dtype, jax.dtypes.prng_key):
            kind, extra["impl"] = "key", str(jr.key_impl(node))
            node = jr.key_data(node)
        else:
            kind = "weak" if node.weak_type else "array"
        array = np.asarray(node)
        if array.dtype.kind in "OMmSUT" or array.dtype.names is not None:
            raise ValueError(
                f"save: {path} must be an array of numbers, got dtype {array.dtype}."
            )
        self.arrays.append(array.astype(array.dtype.newbyteorder("="), copy=False))
        return {kind: len(self.arrays) - 1, **extra}

    def name(self, thing: Any, path: str) -> str:
        name = qualified_name(thing)
        if name is not None:
            return name
        remedy = "Use numbers, strings, arrays, modules, or functions with a name."
        if isinstance(thing, type):
            remedy = "Define the class at the top level of a module."
        elif callable(thing):
            remedy = (
                "Use a function that is defined at the top level of a module, or an "
                "eqx.Module with a `__call__`, not a lambda or a function inside of "
                "another."
            )
        raise ValueError(
            f"save: {path} must have a name to import it by, got {thing!r}. {remedy}"
        )

    def result(self, node: Any, path: str) -> dict[str, Any]:
        """A result, by the names of its items, because their numbers may change."""
        enumeration, (value,) = node._enumeration, jax.tree.leaves(node)
        names = {_number(item): n for n, item in enumeration._name_to_item.items()}
        return {
            "result": self.name(enumeration, path),
            "value": self.describe(value, path),
            "items": {str(k): names[k] for k in np.unique(np.asarray(value)).tolist()},
        }

    def module(self, node: Any, path: str) -> dict[str, Any]:
        held = vars(node)
        if "__func__" in held:
            name, owner = node.__func__.__name__, node.__self__
            again = getattr(owner, name, None)
            if getattr(again, "__func__", None) is not held["__func__"]:
                raise ValueError(
                    f"save: {path} is a method with the name {name!r}, but "
                    f"{type(owner).__name__} has another one under this name."
                )
            return {"method": name, "of": self.describe(owner, f"{path}.__self__")}
        names = [field.name for field in dataclasses.fields(node)]
        if set(held) != set(names):  # what Equinox made of a function
            return {"name": self.name(node, path)}
        fields = self.fields({name: held[name] for name in names}, path)
        return {"module": self.name(type(node), path), "fields": fields}


class _Reader:
    """Builds a tree from its description.

    `build_KIND` takes the value of the key KIND, and the whole description.
    """

    def __init__(self, arrays: list[np.ndarray], trust: tuple[str, ...]):
        self.arrays = arrays
        self.trust = trust
        self.narrowed = False

    def build(self, node: Any) -> Any:
        if not isinstance(node, dict):
            return node
        kind, content = next(iter(node.items()))
        if kind in _FROM_TEXT:
            return _FROM_TEXT[kind](content)
        if kind in _SEQUENCES:
            return _SEQUENCES[kind](map(self.build, content))
        return getattr(self, f"build_{kind}")(content, node)

    def build_array(self, content, node):
        # `jnp.asarray` would compile a program for each shape.
        return jax.device_put(self.fitted(self.arrays[content]))

    def build_weak(self, content, node):
        # A weak type takes the current precision. Setting entries of a weakly typed
        # array keeps its type.
        array = self.arrays[content]
        if array.ndim == 0:
            return jax.device_put(array.item())
        zero = jnp.asarray(array.dtype.type(0).item())
        return jnp.broadcast_to(zero, array.shape).at[...].set(array)

    def build_key(self, content, node):
        data = jnp.asarray(self.arrays[content])
        return jr.wrap_key_data(data, impl=node["impl"])

    def build_numpy(self, content, node):
        return self.arrays[content]

    def build_scalar(self, content, node):
        return self.arrays[content][()]

    def build_name(self, content, node):
        return import_named(content, self.trust)

    def build_result(self, content, node):
        enumeration, value = self.build_name(content, node), self.build(node["value"])
        fitted = numbers = np.asarray(value)
        for number, name in node["items"].items():
            item = getattr(enumeration, name, None)
            if item is None:
                raise ValueError(f"it needs the item {name!r}, unknown to {content!r}.")
            fitted = np.where(numbers == int(number), _number(item), fitted)
        fitted = fitted.astype(numbers.dtype)
        fitted = jnp.asarray(fitted) if isinstance(value, jax.Array) else fitted
        first = next(iter(enumeration._name_to_item.values()))
        return jax.tree.map(lambda _: fitted, first)

    def build_module(self, content, node):
        cls = self.class_of(content, eqx.Module, "module class")
        names = [field.name for field in dataclasses.fields(cls)]
        _check_fields(content, sorted(names), sorted(node["fields"]))
        # As Equinox unflattens one: its `__init__` is not called.
        module = object.__new__(cls)
        for name, value in node["fields"].items():
            object.__setattr__(module, name, self.build(value))
        return module

    def build_method(self, content, node):
        method = getattr(self.build(node["of"]), content, None)
        if not hasattr(method, "__func__"):
            raise ValueError(f"it needs the method {content!r}, which does not exist.")
        return method

    def build_partial(self, content, node):
        args, keywords = self.build(node["args"]), self.build(node["keywords"])
        return _PARTIALS[content](self.build(node["function"]), *args, **keywords)

    def build_namedtuple(self, content, node):
        cls = self.class_of(content, tuple, "named tuple")
        _check_fields(content, list(cls._fields), list(node["fields"]))
        return tuple.__new__(cls, map(self.build, node["fields"].values()))

    def build_dict(self, content, node):
        return {self.build(key): self.build(value) for key, value in content}

    def class_of(self, name: str, base: type, what: str) -> Any:
        cls = import_named(name, self.trust)
        if not (isinstance(cls, type) and issubclass(cls, base)):
            raise ValueError(f"it needs a {what}, but {name!r} is none.")
        return cls

    def fitted(self, array: np.ndarray) -> np.ndarray:
        """`array` in the precision of JAX's current setting."""
        narrow = array.astype(jax.dtypes.canonicalize_dtype(array.dtype), copy=False)
        is_whole = array.dtype.kind in "iu"
        if is_whole and not np.array_equal(narrow, array):
            raise ValueError(
                "it holds whole numbers that need 64 bits. Set jax_enable_x64."
            )
        self.narrowed |= not is_whole and narrow.dtype != array.dtype
        return narrow


def _number(item: Any) -> int:
    """The number of an item of an enumeration."""
    return int(jax.tree.leaves(item)[0])


def _check_fields(name: str, known: list[str], written: list[str]) -> None:
    if known != written:
        raise ValueError(
            f"{name!r} has changed since it was saved: it has the fields {known}, and "
            f"the file has {written}."
        )
