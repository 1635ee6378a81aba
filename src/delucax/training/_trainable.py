"""The partition of a model into its trainable values and the rest."""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from .._check import check_finite, is_concrete
from .._message import shortened
from .._module import AbstractConstraint, get_path, marked_leaves, path_string


class Assembly(eqx.Module):
    """A model without its trainable leaves.

    Call it with their unconstrained values to rebuild the model.
    """

    leaves: list[Any]
    structure: Any = eqx.field(static=True)
    holes: tuple[tuple[int, str, bool], ...] = eqx.field(static=True)
    constraints: dict[str, AbstractConstraint]

    def __call__(self, values: dict[str, Array]) -> Any:
        constrained, leaves = self.constrained(values), list(self.leaves)
        for index, path, is_weak in self.holes:
            value = constrained[path]
            leaves[index] = _with_weak_type(value) if is_weak else value
        return jax.tree.unflatten(self.structure, leaves)

    def constrained(self, values: dict[str, Array]) -> dict[str, Array]:
        """The values of the model's leaves, after the constraints."""
        limits = self.constraints.items()
        return values | {path: limit.constrain(values[path]) for path, limit in limits}


def partition_trainable(
    model: PyTree, trainable: Any, where: str
) -> tuple[Assembly, dict[str, Array]]:
    """The assembly of `model`, and its unconstrained trainable values by path."""
    leaves_of = marked_leaves(model)
    entries: list[Any] = [(path_string(path), *marks) for path, *marks in leaves_of]
    given: Mapping[str, AbstractConstraint | None] = {}
    if trainable is None:
        chosen = [role == "weight" and is_float(leaf) for _, leaf, role, _ in entries]
    elif (paths := _as_paths(trainable, where)) is not None:
        given = paths
        chosen = _chosen_by_path(model, entries, paths, where)
    else:
        chosen = _chosen_by_filter(model, entries, trainable, where)
    if not any(chosen):
        floats = [repr(path) for path, leaf, _, _ in entries if is_float(leaf)]
        named = ", ".join(floats[:8]) or "none"
        more = f" and {len(floats) - 8} more" if len(floats) > 8 else ""
        reason = "no field is marked weight()"
        if trainable is not None:
            reason = f"trainable={shortened(trainable)} picks no leaf"
        raise ValueError(
            f"{where}: nothing in {type(model).__name__} is trainable: {reason}. The "
            f"floating-point arrays that could be are {named}{more}."
        )
    leaves, holes, constraints, values = [], [], {}, {}
    for index, (path, leaf, _, constraint) in enumerate(entries):
        leaves.append(None if chosen[index] else leaf)
        if not chosen[index]:
            continue
        name = path or "the model"
        check_finite(leaf, name, where)
        for prefix, other in given.items():
            if other is not None and _is_under(path, prefix):
                constraint = other
        value = strip_weak_type(leaf)
        if constraint is not None:
            # A leaf with known values is checked even while other values are traced.
            with jax.ensure_compile_time_eval():
                holds = not is_concrete(leaf) or bool(np.all(constraint.holds(leaf)))
            if not holds:
                raise ValueError(f"{where}: {name} must be {constraint}, got {leaf}.")
            constraints[path] = constraint
            value = constraint.unconstrain(value)
        values[path] = value
        holes.append((index, path, leaf.weak_type))
    assembly = Assembly(leaves, jax.tree.structure(model), tuple(holes), constraints)
    return assembly, values


def weights_of(model: PyTree) -> tuple[PyTree, PyTree]:
    """The weights of `model` and the rest: two pytrees like `model`, with `None` for
    each leaf of the other one.

    The weights are the leaves marked `weight()`. If none is marked, they are all
    floating-point arrays.
    """
    entries = list(marked_leaves(model))
    marked = [role == "weight" and is_float(leaf) for _, leaf, role, _ in entries]
    if not any(marked):
        marked = [is_float(leaf) for _, leaf, _, _ in entries]
    spec = jax.tree.unflatten(jax.tree.structure(model), marked)
    return eqx.partition(model, spec)


def is_float(leaf: Any) -> bool:
    """Whether `leaf` is a JAX array of real floating-point numbers."""
    return eqx.is_array(leaf) and jnp.issubdtype(leaf.dtype, jnp.floating)


def strip_weak_type(leaf: Any) -> Any:
    """A floating-point array without its weak type; anything else as it is.

    An optimiser returns strong types after its first step, so the loop would compile
    again.
    """
    return lax.convert_element_type(leaf, leaf.dtype) if is_float(leaf) else leaf


def _with_weak_type(value: Array) -> Array:
    """`value` with a weak type, like the leaf of the original model."""
    like = jnp.asarray(0.0)
    if value.dtype != like.dtype:
        return value
    # `full_like` is the only public operation that gives a traced number a weak type.
    if value.ndim == 0:
        return lax.full_like(like, value)
    flat = jax.vmap(lambda v: lax.full_like(like, v))(value.ravel())
    return flat.reshape(value.shape)


def _as_paths(
    trainable: Any, where: str
) -> Mapping[str, AbstractConstraint | None] | None:
    """A mapping from paths to constraints, or `None` if `trainable` has no paths."""
    if isinstance(trainable, str):
        return {trainable: None}
    several = isinstance(trainable, tuple | list | set | frozenset | Mapping)
    if not several or not all(isinstance(path, str) for path in trainable):
        return None
    if not isinstance(trainable, Mapping):
        return dict.fromkeys(trainable)
    given = [c for c in trainable.values() if c is not None]
    named = [isinstance(c, AbstractConstraint) for c in given]
    if any(named) and not all(named):
        raise ValueError(
            f"{where}: trainable must map each path to delucax.positive, "
            f"delucax.bounded(low, high) or None, got {dict(trainable)!r}."
        )
    return trainable if all(named) else None


def _is_under(path: str, prefix: str) -> bool:
    return path == prefix or path.startswith(prefix + ".")


def _chosen_by_path(model, entries, paths, where) -> list[bool]:
    chosen = set()
    for prefix in paths:
        try:
            node = get_path(model, prefix)
        except ValueError as error:
            raise ValueError(f"{where}: trainable: {error}") from None
        under = [
            p for p, leaf, *_ in entries if _is_under(p, prefix) and is_float(leaf)
        ]
        chosen.update(under)
        if not under:
            got = f"dtype {node.dtype}" if eqx.is_array(node) else shortened(node)
            raise ValueError(
                f"{where}: trainable: {prefix!r} must be a floating-point array, or "
                f"hold some, got {got}. A number becomes an array if its field is "
                "declared with delucax.parameter() or delucax.weight()."
            )
    return [path in chosen for path, *_ in entries]


def _chosen_by_filter(model, entries, trainable, where) -> list[bool]:
    if callable(trainable) and not isinstance(trainable, eqx.Module):
        chosen = [trainable(leaf) for _, leaf, _, _ in entries]
    else:
        try:
            chosen = jax.tree.leaves(jax.tree.broadcast(trainable, model))
        except (ValueError, TypeError):
            chosen = []
        if len(chosen) != len(entries):
            raise ValueError(
                f"{where}: trainable must be a path, several paths, a function of a "
                "leaf, or booleans in the structure of the model, got "
                f"{shortened(trainable)}."
            )
    for (path, leaf, _, _), moves in zip(entries, chosen, strict=True):
        if not isinstance(moves, bool | np.bool_):
            raise ValueError(
                f"{where}: trainable must be True or False for each leaf, got "
                f"{moves!r} for {path!r}."
            )
        if moves and not is_float(leaf):
            raise ValueError(
                f"{where}: trainable picks {path!r}, which is not a floating-point "
                f"array: {shortened(leaf)}."
            )
    return [bool(moves) for moves in chosen]
