"""Leaves by their path: `replace(env, {"dynamics.system.length": 1.2})`."""

import dataclasses
import difflib
from collections.abc import Mapping
from typing import Any, TypeVar

import equinox as eqx
import jax
from jaxtyping import PyTree

from ._fields import (
    as_float_array,
    check_module,
    check_parameters,
    converter_of,
    is_static,
)


_T = TypeVar("_T")


def get_path(tree: PyTree, path: str) -> Any:
    """The node of `tree` at `path`, such as `"dynamics.system.length"`.

    **Arguments:**

    - `tree`: any pytree of modules, sequences and dictionaries.
    - `path`: names joined by dots; a whole number indexes a sequence.

    **Raises:** `ValueError` naming the part that is not there, and the close ones.
    """
    node = tree
    for part in path.split(".") if path else ():
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
        if dataclasses.is_dataclass(node):
            names = [field.name for field in dataclasses.fields(node)]
        else:
            names = list(getattr(node, "_fields", ()))
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
    [`delucax.parameter`][] becomes the same kind of leaf as the old one was. All
    changes are made before any is checked, so values that only fit together are given
    in one call. Then every module above a change runs the checks of its constructor;
    traced values cannot be looked at, only their shapes.

    **Arguments:**

    - `tree`: any pytree, for example an environment or a controller.
    - `changes`: from a path (names joined by dots; whole numbers index sequences) to
        its new value.

    **Returns:** the copy.

    **Raises:** `ValueError` if a path is not in the tree, or if the values are not
    legal where they go.

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
    changed = tree
    for path, value in changes.items():
        changed = _with(changed, path, value)
    for path in _owners(changes):
        _check(get_path(changed, path), _node_or_none(tree, path))
    return changed


def _with(tree: Any, path: str, value: Any) -> Any:
    """A copy of `tree` with `value`, converted as its owner does, at `path`."""
    parent, old = None, tree
    for name in path.split("."):
        parent, old = old, _child(old, name, path)
        if is_static(parent, name):
            raise ValueError(
                f"replace: {path!r} is part of the structure of "
                f"{type(parent).__name__}, not a leaf; build it anew with another "
                f"{name}."
            )
    if isinstance(parent, eqx.Module):
        value = converter_of(parent, path.rpartition(".")[2])(value)
    elif eqx.is_inexact_array(old):
        value = as_float_array(value)
    return eqx.tree_at(
        lambda tree: get_path(tree, path),
        tree,
        value,
        is_leaf=lambda node: node is None,
    )


def _owners(changes: Mapping[str, Any]) -> list[str]:
    """The paths of all nodes above the changes, the deepest first."""
    owners = set()
    for path in changes:
        parts = path.split(".")
        owners |= {".".join(parts[:end]) for end in range(len(parts))}
    return sorted(owners, key=lambda path: (-len(path.split(".")), not path, path))


def _node_or_none(tree: Any, path: str) -> Any:
    try:
        return get_path(tree, path)
    except ValueError:
        return None


def _check(module: Any, before: Any) -> None:
    """Run the checks of one owner of a change, which was `before`."""
    if not isinstance(module, eqx.Module):
        return
    try:
        check_module(module)
    except (TypeError, ValueError) as error:
        if type(before) is type(module) and _is_batch(before):
            # Its shapes are not those of one module; its numbers can be checked.
            check_parameters(module)
            return
        if isinstance(error, ValueError):
            raise
        raise ValueError(
            f"replace: {type(module).__name__} cannot work with these values: {error}"
        ) from error


def _is_batch(module: eqx.Module) -> bool:
    """Whether `module` does not pass its own checks, as a batch from `jax.vmap`."""
    try:
        check_module(module)
    except (TypeError, ValueError):
        return True
    return False


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
