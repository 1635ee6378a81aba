"""Leaves by their path: `replace(env, {"dynamics.system.length": 1.2})`."""

import itertools
import math
import warnings
from collections.abc import Iterator, Mapping
from typing import Any, TypeVar

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, PyTree

from .._message import did_you_mean, shortened
from ._fields import (
    as_float_array,
    check_module,
    check_parameters,
    children_of,
    fields_of,
)


_T = TypeVar("_T")

_MOST_MEMBERS = 4096
"""The largest number of members of a batch that are checked. A check takes up to a
millisecond."""


def get_path(tree: PyTree, path: str) -> Any:
    """The node of `tree` at `path`, such as `"dynamics.system.length"`.

    **Arguments:**

    - `tree`: any pytree of modules, sequences and dictionaries.
    - `path`: names joined by dots; a whole number indexes a sequence.

    **Returns:** the node.

    **Raises:** `ValueError` if a part of the path does not exist.
    """
    return _nodes_along(tree, path)[-1]


def _nodes_along(tree: Any, path: str) -> list[Any]:
    """The nodes from the root to the one at `path`, both included."""
    nodes = [tree]
    for part in path.split(".") if path else ():
        children = children_of(nodes[-1])
        if part not in children:
            hint = did_you_mean(part, children) if children else "it is a leaf."
            if places := list(itertools.islice(_places_of(part, nodes[-1]), 3)):
                hint = f"did you mean {' or '.join(map(repr, places))}?"
            kind = type(nodes[-1]).__name__
            raise ValueError(f"path: {kind} has no {part!r} (in {path!r}); {hint}")
        nodes.append(children[part])
    return nodes


def _places_of(name: str, node: Any, levels: int = 4) -> Iterator[str]:
    """The paths below a node that end in a name."""
    for part, child in children_of(node).items():
        if part == name:
            yield part
        elif levels:
            yield from (f"{part}.{p}" for p in _places_of(name, child, levels - 1))


def with_values(tree: _T, values: Mapping[str, Any]) -> _T:
    """A copy of `tree` with the arrays `values` at their paths, without checks. Use it
    inside of traced code and loops."""
    if not values:
        return tree
    at = lambda tree: [get_path(tree, path) for path in values]
    return eqx.tree_at(at, tree, list(values.values()))


def by_path(flat: Array, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Array]:
    """The entries of a vector, cut into arrays by path."""
    values, at = {}, 0
    for path, shape in shapes.items():
        size = math.prod(shape)
        values[path] = flat[at : at + size].reshape(shape)
        at += size
    return values


def replace(tree: _T, changes: Mapping[str, Any]) -> _T:
    """Copy a `tree` with new values for the leaves at given paths.

    A function that was compiled for `tree` does not compile again for the copy, because
    a number that replaces a [`delucax.parameter`][] is converted to the same kind of
    array. If you replace the dynamics of an environment, delucax also replaces the
    default disturbance and an initial state of zeros, because they belong to the old
    dynamics.

    After all changes, every module that contains a changed leaf runs the checks of its
    constructor. If several new values are valid only together, pass them in one call.
    In a batch from `jax.vmap`, the checks run for every member of the batch. If the
    batch has more than 4096 members, the checks run only for some members, with a
    warning: for the members with extreme numbers, and for others that are spread evenly
    over the batch. For traced values, only shapes are checked.

    **Arguments:**

    - `tree`: any pytree, for example an environment or a controller.
    - `changes`: a dictionary from paths to new values. A path is a string of names
        joined by dots, such as `"dynamics.system.length"`; a whole number is the index
        of an item in a sequence.

    **Returns:** the copy.

    **Raises:** `ValueError` if a path does not exist, if a path is part of another
    path, or if the values are not valid.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("pendulum")
        longer = dlx.replace(env, {"dynamics.system.length": 1.2})
        longer.dynamics.system.length
        ```

        ```text
        Array(1.2, dtype=float32, weak_type=True)
        ```
    """
    if not isinstance(changes, Mapping):
        raise ValueError(
            "replace: changes must be a dictionary from paths to values, such as "
            f"{{'dynamics.system.length': 1.2}}, got {changes!r}."
        )
    check_paths(changes, "replace")
    changed = tree
    for path, value in changes.items():
        changed = _with(changed, path, value)
    # The deepest first, so that derived defaults are in place when an owner is checked.
    for path in _owners(changes):
        before = get_path(tree, path)
        changed = _with_defaults(changed, path, before, changes)
        _check(get_path(changed, path), before)
    return changed


def check_paths(changes: Mapping[Any, Any], where: str) -> None:
    """Raise unless the keys are paths, and none of them is part of another."""
    for path in changes:
        if not isinstance(path, str):
            raise ValueError(
                f"{where}: a path must be a string such as 'dynamics.system.length', "
                f"got {shortened(path)}."
            )
        if not path:
            raise ValueError(f"{where}: a path must not be empty.")
        parts = path.split(".")
        for end in range(1, len(parts)):
            above = ".".join(parts[:end])
            if above in changes:
                raise ValueError(
                    f"{where}: paths must not overlap, got {above!r} and {path!r}. "
                    "Make the second change in the value of the first."
                )


def _with(tree: Any, path: str, value: Any) -> Any:
    """A copy of `tree` with `value` at `path`, converted as its owner would."""
    names, nodes = path.split("."), _nodes_along(tree, path)
    for parent, name in zip(nodes, names, strict=False):
        field = fields_of(parent).get(name)
        if field is not None and field.metadata.get("static", False):
            raise ValueError(
                f"replace: {path!r} must be a leaf, got {name}, which is part of the "
                f"structure of {type(parent).__name__}. Construct a new one instead."
            )
    *_, parent, old = nodes
    if isinstance(parent, eqx.Module):
        metadata = fields_of(parent)[names[-1]].metadata
        value = metadata.get("converter", lambda value: value)(value)
    elif eqx.is_inexact_array(old):
        value = as_float_array(value)
    at = lambda tree: get_path(tree, path)
    return eqx.tree_at(at, tree, value, is_leaf=lambda node: node is None)


def _with_defaults(
    tree: Any, path: str, before: Any, changes: Mapping[str, Any]
) -> Any:
    """A copy of `tree` with new defaults in the node at `path`, where these derive from
    a part that changed."""
    node = get_path(tree, path)
    if type(node) is not type(before) or not hasattr(node, "__replaced__"):
        return tree
    for name, value in node.__replaced__(before).items():
        place = f"{path}.{name}".lstrip(".")
        if not any(_is_within(place, at) or _is_within(at, place) for at in changes):
            tree = _with(tree, place, value)
    return tree


def _is_within(path: str, other: str) -> bool:
    return f"{path}.".startswith(f"{other}.")


def _owners(changes: Mapping[str, Any]) -> list[str]:
    """The paths of all nodes above the changes, with the deepest first."""
    parts = [path.split(".") for path in changes]
    owners = {".".join(p[:end]) for p in parts for end in range(len(p))}
    return sorted(owners, key=lambda path: (-len(path.split(".")), not path, path))


def _check(module: Any, before: Any) -> None:
    """Run the checks of one module above a change; it was `before`."""
    error = _error_of(module)
    if error is None:
        return
    if type(before) is type(module) and _error_of(before) is not None:
        # `before` is not a valid module either, so both may be batches.
        check_parameters(module)
        _check_members(module, before)
    elif isinstance(error, ValueError):
        raise error
    else:
        raise ValueError(
            f"replace: {type(module).__name__} does not accept these values: {error}"
        ) from error


def _error_of(module: Any) -> Exception | None:
    """The validation error of a module, if any. A batch from `jax.vmap` has one,
    because its shapes are not those of one module."""
    try:
        if isinstance(module, eqx.Module):
            check_module(module)
    except (TypeError, ValueError) as error:
        return error


def _check_members(module: eqx.Module, before: eqx.Module) -> None:
    """Run the checks of the members of a batch; it was `before`."""
    # A member may be a batch itself, of which only the members are valid.
    valid = lambda m: _error_of(m) is None or any(map(valid, _members(m).values()))
    like = next(filter(valid, _members(before).values()), None)
    if like is None:  # not a batch, or a traced one
        return
    members = _members(module)
    for place, member in members.items():
        try:
            _check(member, like)
        except ValueError as error:
            raise ValueError(f"{error} It is member {place} of a batch.") from error
    count = len(jax.tree.leaves(eqx.filter(module, eqx.is_array))[0])
    if 0 < len(members) < count:
        warnings.warn(
            f"replace: {type(module).__name__} is a batch of {count} members, and only "
            f"{len(members)} of them were checked. In a batch of up to "
            f"{_MOST_MEMBERS}, all are.",
            stacklevel=2,
        )


def _members(module: eqx.Module) -> dict[int, eqx.Module]:
    """Members of a batch by their place, at most `_MOST_MEMBERS`. There are none if the
    arrays of `module` share no leading axis or are traced."""
    arrays, rest = eqx.partition(module, eqx.is_array)
    leaves, structure = jax.tree.flatten(arrays)
    lengths = {leaf.shape[:1] for leaf in leaves}
    is_traced = any(isinstance(leaf, Tracer) for leaf in leaves)
    if len(lengths) != 1 or () in lengths or is_traced:
        return {}
    ((count,),) = lengths
    places = range(count) if count <= _MOST_MEMBERS else _sampled(leaves, count)
    rows = zip(*(list(leaf[np.asarray(places)]) for leaf in leaves), strict=True)
    member = lambda row: eqx.combine(jax.tree.unflatten(structure, row), rest)
    return {int(k): member(row) for k, row in zip(places, rows, strict=True)}


def _sampled(leaves: list[Any], count: int) -> np.ndarray:
    """The members of a large batch to check: those with the smallest or largest entry
    of an array, because extremes violate a constraint first, and others spread evenly.
    """
    half = _MOST_MEMBERS // 2
    flat = [np.asarray(a).reshape(count, -1) for a in leaves if eqx.is_inexact_array(a)]
    ends = [end for a in flat for end in (np.argmin(a, axis=0), np.argmax(a, axis=0))]
    extreme = np.unique(np.concatenate([*ends, np.zeros(0, int)]))[:half]
    return np.union1d(extreme, np.linspace(0, count - 1, half).astype(int))
