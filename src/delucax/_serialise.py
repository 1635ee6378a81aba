"""Modules and trajectories in a file: names, numbers and structure; no code, no pickle.

The file is three parts: a line with the format, its version and a SHA-256 of the rest;
a line of JSON that describes the structure; and the bytes of the arrays.
"""

import dataclasses
import hashlib
import importlib
import inspect
import json
import os
import sys
import tempfile
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np


_MAGIC = "delucax-file"
_VERSION = 1
_TRUSTED = (
    "delucax",
    "diffrax",
    "equinox",
    "jax",
    "jaxlib",
    "lineax",
    "optax",
    "optimistix",
    "__main__",
)


def save(path: str | os.PathLike, obj: Any) -> None:
    """Write a module, a trajectory, or any pytree of them, to a file.

    What is written is the class of every module by its name, its fields, and the bytes
    of its arrays; functions are written by name. The file appears whole or not at all.

    **Arguments:**

    - `path`: the file to write.
    - `obj`: a module, trajectory, array, number, string, or a tuple, list or dictionary
        of such.

    **Raises:** `ValueError` naming the place of a thing that has no name to find it by,
    such as a lambda; `OSError` if the file cannot be written.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dlx.save("controller.dlx", dlx.controllers.Linear(jnp.ones((1, 2))))
        controller = dlx.load("controller.dlx")
        ```
    """
    arrays: list[np.ndarray] = []
    tree = _encode(obj, "obj", arrays)
    header = json.dumps({"tree": tree, "arrays": [_describe(a) for a in arrays]})
    body = header.encode() + b"\n" + b"".join(a.tobytes() for a in arrays)
    digest = hashlib.sha256(body).hexdigest()
    first = f"{_MAGIC} {_VERSION} {digest}\n".encode()
    path = Path(path)
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    except OSError as error:
        raise OSError(f"save: path {path} cannot be written: {error}") from error
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(first + body)
        os.replace(name, path)
    except OSError as error:
        os.unlink(name)
        raise OSError(f"save: path {path} cannot be written: {error}") from error


def load(path: str | os.PathLike, *, trust: Sequence[str] = ()) -> Any:
    """Read what [`delucax.save`][] wrote.

    Nothing in the file is run: classes and functions are looked up by name, and only in
    packages that are trusted.

    **Arguments:**

    - `path`: the file to read.
    - `trust`: packages, besides this one, JAX and its kin, and what you defined
        yourself in the running notebook or script, whose classes and functions the file
        may name; none by default.

    **Returns:** the object, of the same structure: a function compiled for the one that
    was saved does not compile again.

    **Raises:** `ValueError` if the file is damaged, foreign or of a newer version, or
    names what is not trusted, not there, or no longer has the same fields; `OSError` if
    it cannot be read.

    !!! example

        ```python
        import delucax as dlx

        dlx.save("pendulum.dlx", dlx.make("pendulum"))
        env = dlx.load("pendulum.dlx")
        ```
    """
    path = Path(path)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise OSError(f"load: path {path} cannot be read: {error}") from error
    first, _, body = content.partition(b"\n")
    words = first.decode(errors="replace").split()
    if len(words) != 3 or words[0] != _MAGIC or not words[1].isdigit():
        raise ValueError(f"load: path {path} is not a file that delucax.save wrote.")
    if int(words[1]) > _VERSION:
        raise ValueError(
            f"load: path {path} has format {words[1]}, newer than the {_VERSION} that "
            "this version of delucax reads; update delucax."
        )
    if hashlib.sha256(body).hexdigest() != words[2]:
        raise ValueError(f"load: path {path} is damaged: its checksum does not match.")
    header, _, payload = body.partition(b"\n")
    description = json.loads(header)
    arrays, offset = [], 0
    for about in description["arrays"]:
        dtype, shape = jnp.dtype(about["dtype"]), tuple(about["shape"])
        size = dtype.itemsize * int(np.prod(shape, dtype=int))
        piece = np.frombuffer(payload[offset : offset + size], dtype).reshape(shape)
        arrays.append(piece)
        offset += size
    names = _Names((*_TRUSTED, *([trust] if isinstance(trust, str) else trust)), path)
    return _decode(description["tree"], arrays, names)


def _describe(array: np.ndarray) -> dict[str, Any]:
    return {"dtype": array.dtype.name, "shape": list(array.shape)}


def _encode(node: Any, path: str, arrays: list[np.ndarray]) -> Any:
    """`node` as JSON; its arrays are put behind `arrays`."""
    if node is None or type(node) in (bool, int, float, str):
        return node
    if isinstance(node, jax.core.Tracer):
        raise ValueError(f"save: {path} is being traced; save outside of jit and grad.")
    if isinstance(node, jax.Array):
        if jnp.issubdtype(node.dtype, jax.dtypes.prng_key):
            arrays.append(np.asarray(jax.random.key_data(node)))
            return {"key": len(arrays) - 1, "impl": str(jax.random.key_impl(node))}
        arrays.append(np.ascontiguousarray(node).reshape(node.shape))
        return {"array": len(arrays) - 1, "weak": bool(node.weak_type)}
    if isinstance(node, np.ndarray | np.generic):
        if node.dtype.hasobject:
            raise ValueError(f"save: {path} is an array of Python objects.")
        arrays.append(np.ascontiguousarray(node).reshape(np.shape(node)))
        kind = "numpy" if isinstance(node, np.ndarray) else "number"
        return {kind: len(arrays) - 1}
    if isinstance(node, np.dtype):
        return {"dtype": node.name}

    def inside(child, step):
        return _encode(child, f"{path}{step}", arrays)

    if inspect.ismethod(node) or type(node).__name__ == "BoundMethod":
        owner, name = node.__self__, node.__func__.__name__
        if getattr(owner, name, None) == node:
            return {"method": name, "of": inside(owner, "")}
    if isinstance(node, eqx.Module):
        fields = {
            field.name: inside(getattr(node, field.name), f".{field.name}")
            for field in dataclasses.fields(node)
            if field.name in vars(node) or hasattr(node, field.name)
        }
        return {"module": _name_of(type(node), path), "fields": fields}
    if isinstance(node, jax.tree_util.Partial):
        parts = [node.func, node.args, node.keywords]
        return {"partial": [inside(part, "") for part in parts]}
    if isinstance(node, tuple) and hasattr(node, "_fields"):
        items = [inside(child, f".{name}") for name, child in node._asdict().items()]
        return {"namedtuple": _name_of(type(node), path), "items": items}
    if type(node) in (tuple, list):
        items = [inside(child, f"[{i}]") for i, child in enumerate(node)]
        return {type(node).__name__: items}
    if type(node) is dict:
        items = [
            [inside(k, f" key {k!r}"), inside(v, f"[{k!r}]")] for k, v in node.items()
        ]
        return {"dict": items}
    return {"name": _name_of(node, path)}


def _name_of(thing: Any, path: str) -> str:
    """`module:name` of a class or function, or of a constant of a module."""
    module = getattr(thing, "__module__", None)
    names = [getattr(thing, "__qualname__", None), getattr(thing, "__name__", None)]
    for name in names:
        if module and name and _look_up(module, name) is thing:
            return f"{module}:{name}"
    # JAX's functions say where they are used from, not where they are defined; and
    # some constants of a module are instances of a class.
    home = type(thing).__module__
    for place in (module, home, "jax.numpy", "jax.nn"):
        for name, value in list(vars(sys.modules.get(place, object)).items()):
            if value is thing:
                return f"{place}:{name}"
    raise ValueError(
        f"save: {path} is {thing!r}, which has no name to find it by. Use a function "
        "defined at the top of a module in place of a lambda, or a module with a "
        "`__call__`."
    )


def _look_up(module: str, name: str) -> Any:
    value: Any = sys.modules.get(module)
    for part in name.split("."):
        value = getattr(value, part, None)
    return value


class _Names:
    """Finds classes and functions by name, in trusted packages alone."""

    def __init__(self, trusted: tuple[str, ...], path: Path):
        self.trusted = trusted
        self.path = path

    def __call__(self, name: str) -> Any:
        module, _, attribute = name.partition(":")
        package = module.partition(".")[0]
        if package not in self.trusted:
            raise ValueError(
                f"load: path {self.path} names {name}, of a package that is not "
                f"trusted; if you trust it, load(..., trust=({package!r},))."
            )
        if module not in sys.modules:
            try:
                importlib.import_module(module)
            except ImportError as error:
                raise ValueError(
                    f"load: path {self.path} needs the module {module}: {error}."
                ) from error
        found = _look_up(module, attribute)
        if found is None:
            where = "define it first" if module == "__main__" else "it is not there"
            raise ValueError(
                f"load: path {self.path} needs {attribute} of {module}: {where}."
            )
        return found


def _decode(node: Any, arrays: list[np.ndarray], names: Callable[[str], Any]) -> Any:
    if not isinstance(node, dict):
        return node
    if "array" in node:
        return _array(arrays[node["array"]], node["weak"])
    if "key" in node:
        data = jnp.asarray(arrays[node["key"]])
        return jax.random.wrap_key_data(data, impl=node["impl"])
    if "numpy" in node:
        return arrays[node["numpy"]].copy()
    if "number" in node:
        return arrays[node["number"]][()]
    if "dtype" in node:
        return jnp.dtype(node["dtype"])
    if "name" in node:
        return names(node["name"])
    inside = lambda child: _decode(child, arrays, names)
    if "module" in node:
        cls = names(node["module"])
        if not (isinstance(cls, type) and issubclass(cls, eqx.Module)):
            raise ValueError(f"load: {node['module']} is not a module class.")
        known = {field.name for field in dataclasses.fields(cls)}
        if not set(node["fields"]) <= known:
            raise ValueError(
                f"load: {node['module']} has changed since the file was written: it "
                f"has fields {sorted(known)}, the file {sorted(node['fields'])}."
            )
        module = object.__new__(cls)
        for name, child in node["fields"].items():
            object.__setattr__(module, name, inside(child))
        return module
    if "method" in node:
        return getattr(inside(node["of"]), node["method"])
    if "partial" in node:
        function, args, keywords = map(inside, node["partial"])
        return jax.tree_util.Partial(function, *args, **keywords)
    if "namedtuple" in node:
        return names(node["namedtuple"])(*map(inside, node["items"]))
    if "tuple" in node:
        return tuple(map(inside, node["tuple"]))
    if "list" in node:
        return list(map(inside, node["list"]))
    return {inside(key): inside(value) for key, value in node["dict"]}


def _array(array: np.ndarray, weak: bool) -> jax.Array:
    if weak and array.shape == ():
        return jnp.asarray(array[()].item())
    if array.dtype == np.float64 and not jax.config.read("jax_enable_x64") and not weak:
        warnings.warn(
            "load: an array was saved in float64 and is read in float32; set "
            "jax_enable_x64 to keep its precision.",
            stacklevel=4,
        )
        array = array.astype(np.float32)
    if weak:
        # A weak type is kept by what is written into a weakly typed array.
        return jnp.broadcast_to(jnp.asarray(0.0), array.shape).at[...].set(array)
    return jnp.asarray(array)
