"""Checks of models: their sizes, names and matrices."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp

from ._check import as_matrix, check_count, check_key
from ._module import indexed_names, mlp, names_of
from ._typing import Array


_FORWARD = diffrax.DirectAdjoint, diffrax.ForwardMode


def output_of(function: Any, *shapes: tuple[int, ...]) -> Any:
    """The shapes of what `function` returns for arrays of `shapes`. Functions that only
    differ in the values of their arrays are traced once."""
    dtype = jnp.result_type(float)
    inputs = [jax.ShapeDtypeStruct(shape, dtype) for shape in shapes]
    leaves, structure = jax.tree.flatten(function)
    try:
        hash(structure)
        arrays = tuple(jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in leaves)
    except (TypeError, AttributeError):
        # An unhashable field, or a leaf that is not an array.
        return eqx.filter_eval_shape(function, *inputs)
    return _traced(structure, arrays, tuple(inputs))


@functools.lru_cache(maxsize=256)
def _traced(structure: Any, arrays: Any, inputs: Any) -> Any:
    call = lambda arrays, inputs: jax.tree.unflatten(structure, arrays)(*inputs)
    return jax.eval_shape(call, arrays, inputs)


def check_cost_sizes(cost: Any, sizes: tuple[int, int], name: str, where: str) -> None:
    """Raise unless `cost` accepts states and controls of these `sizes`."""
    n, m = sizes
    try:
        output_of(cost, (), (n,), (m,))
        output_of(cost.final, (), (n,))
    except jax.errors.JAXTypeError:  # not traceable, but it works outside of jit
        return
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"{where}: {name} must fit a state of size {n} and a control of size {m}, "
            f"but calling it failed: {error}"
        ) from error


def checked_names(
    names: Sequence[str] | None, letter: str, size: int, argument: str, where: str
) -> tuple[str, ...]:
    """`names` as a tuple of `size` names; indexed names if there are none."""
    if names is None:
        return indexed_names(letter, size)
    if isinstance(names, str) or len(names) != size:
        raise ValueError(f"{where}: {argument} must have {size} names, got {names!r}.")
    return tuple(names)


def check_matrices(
    A: Any, B: Any, C: Any, E: Any, where: str
) -> tuple[Array, Array, Any, Any]:
    """`A`, `B`, `C`, `E` as matrices, or an error unless their shapes fit."""
    A = as_matrix(A, "A", where)
    n = A.shape[0]
    if A.shape != (n, n) or n == 0:
        raise ValueError(f"{where}: A must be square, got shape {A.shape}.")
    B = _as_part(B, "B", n, "rows", where)
    C = None if C is None else _as_part(C, "C", n, "columns", where)
    E = None if E is None else _as_part(E, "E", n, "rows", where)
    return A, B, C, E


def _as_part(value: Any, name: str, n: int, side: str, where: str) -> Array:
    """`value` as a matrix with as many rows or columns as there are states."""
    matrix = as_matrix(value, name, where)
    if matrix.shape[side == "columns"] != n:
        raise ValueError(
            f"{where}: {name} must have as many {side} as A ({n}), got shape "
            f"{matrix.shape}."
        )
    return matrix


def check_time_invariant(model: Any, name: str, where: str) -> None:
    """Raise if the matrices of a linear model depend on time."""
    if model.is_time_varying:
        raise ValueError(
            f"{where}: {name} must be time-invariant, got matrices at {len(model.A)} "
            "times. Use `dynamics.at(t)` for those at one time."
        )


def state_network(
    states: int | Sequence[str],
    controls: int | Sequence[str],
    width: int,
    depth: int,
    activation: Callable[[Array], Array],
    key: Any,
    where: str,
) -> tuple[tuple[str, ...], tuple[str, ...], Any]:
    """The names of the states and of the controls, and a network from both to as many
    outputs as there are states."""
    check_key(key, where)
    names = names_of(states, "x", "states", where)
    inputs = names_of(controls, "u", "controls", where)
    width = check_count(width, "width", where)
    depth = check_count(depth, "depth", where, least=0)
    size = len(names) + len(inputs)
    return names, inputs, mlp(size, len(names), width, depth, activation, key=key)


def check_forward_mode(model: Any, where: str) -> None:
    """Raise if a plant with adaptive steps inside of `model` has no forward mode."""
    # `Discretized` itself is on a higher floor.
    fields = "stepsize_controller", "adjoint"
    is_plant = lambda node: all(hasattr(node, name) for name in fields)
    for plant in filter(is_plant, jax.tree.leaves(model, is_leaf=is_plant)):
        has_forward = isinstance(plant.adjoint, _FORWARD)
        if plant.stepsize_controller is not None and not has_forward:
            raise ValueError(
                f"{where}: dynamics with a stepsize_controller must have an adjoint "
                "with a forward mode, adjoint=diffrax.DirectAdjoint(), got "
                f"{plant.adjoint!r}."
            )
