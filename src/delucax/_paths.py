"""Leaves by their path: `replace(env, {"dynamics.system.length": 1.2})`."""

import difflib
from collections.abc import Mapping
from typing import Any, TypeVar

import equinox as eqx
import jax
from jaxtyping import PyTree

from ._fields import as_float_array, converter_of, is_static


_T = TypeVar("_T")


def get_path(tree: PyTree, path: str) -> Any:
    """The node of `tree` at `path`, such as `"dynamics.system.length"`.

    **Arguments:**

    - `tree`: any pytree of modules, sequences and dictionaries.
    - `path`: names joined by dots; a whole number indexes a sequence.

    **Raises:** `ValueError` naming the part that is not there, and the close ones.
    """
    node = tree
    for part in path.split("."):
        node = _child(node, part, path)
    return node


def _child(node: Any, part: str, path: str) -> Any:
    if isinstance(node, Mapping):
        if part in node:
            return node[part]
        names = [str(name) for name in node]
    elif isinstance(node, tuple | list) and not hasattr(node, "_fields"):
        if part.isdigit() and int(part) < len(node):
            return node[int(part)]
        names = [str(i) for i in range(len(node))]
    else:
        names = list(getattr(node, "__dataclass_fields__", ()))
        names = names or list(getattr(node, "_fields", ()))
        if part in names:
            return getattr(node, part)
    close = difflib.get_close_matches(part, names, n=3) or names
    raise ValueError(
        f"path: {type(node).__name__} has no {part!r} (in {path!r}); "
        f"did you mean one of {', '.join(close) or 'nothing: it is a leaf'}?"
    )


def replace(tree: _T, changes: Mapping[str, Any]) -> _T:
    """A copy of `tree` with the named leaves replaced.

    Nothing compiles again for it: a number put in the place of a
    [`delucax.parameter`][] becomes the same kind of leaf as the old one was.

    **Arguments:**

    - `tree`: any pytree, for example an environment or a controller.
    - `changes`: from a path (names joined by dots; whole numbers index sequences) to
        its new value.

    **Returns:** the copy.

    **Raises:** `ValueError` if a path is not in the tree, or if a value is not legal
    where it goes.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("pendulum")
        longer = dlx.replace(env, {"dynamics.system.length": 1.2})
        ```
    """
    if not isinstance(changes, Mapping):
        raise ValueError(
            "replace: changes must be a dictionary from paths to values, such as "
            f"{{'dynamics.system.length': 1.2}}, got {changes!r}."
        )
    for path, value in changes.items():
        parent_path, _, name = path.rpartition(".")
        parent = get_path(tree, parent_path) if parent_path else tree
        old = _child(parent, name, path)
        if is_static(parent, name):
            raise ValueError(
                f"replace: {path!r} is part of the structure of "
                f"{type(parent).__name__}, not a leaf; build it anew with another "
                f"{name}."
            )
        if isinstance(parent, eqx.Module):
            value = converter_of(parent, name)(value)
        elif eqx.is_inexact_array(old):
            value = as_float_array(value)
        tree = eqx.tree_at(
            lambda tree, path=path: get_path(tree, path),
            tree,
            value,
            is_leaf=lambda node: node is None,
        )
        if isinstance(parent, eqx.Module) and hasattr(parent, "__check_init__"):
            _check(get_path(tree, parent_path) if parent_path else tree)
    return tree


def _check(module: Any) -> None:
    """Run the checks that the constructor of `module` runs."""
    for cls in reversed(type(module).__mro__):
        if "__check_init__" in cls.__dict__:
            cls.__dict__["__check_init__"](module)


def path_string(path: tuple) -> str:
    """A JAX key path in the form that [`delucax.replace`][] takes."""
    parts = []
    for key in path:
        if isinstance(key, jax.tree_util.GetAttrKey):
            parts.append(key.name)
        elif isinstance(key, jax.tree_util.SequenceKey):
            parts.append(str(key.idx))
        elif isinstance(key, jax.tree_util.DictKey):
            parts.append(str(key.key))
        else:
            parts.append(str(key))
    return ".".join(parts)
