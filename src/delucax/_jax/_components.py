"""Programs that work on the components of small vectors, not on the vectors.

A user writes `x[0]` and `jnp.stack([...])`. Left as they are, their gradient pads each
component back to a vector and adds the vectors up, which XLA does not undo, and which
costs a batch more than the physics. Here a function is traced, and replayed with every
small vector held as its components: taking an entry of a stack is then no operation at
all, forward or backward. The numbers are the same.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import Tracer
from jax.extend.core import Literal

from ._fence import fence


LARGEST = 16
"""Vectors with more entries are left whole, to keep programs short."""

_ELEMENTWISE = frozenset(
    "abs add and atan2 ceil clamp convert_element_type cos copy cosh div eq erf exp"
    " exp2 expm1 floor ge gt integer_pow is_finite le log log1p logistic lt max min mul"
    " ne neg not or pow rem round rsqrt select_n sign sin sinh sqrt square"
    " stop_gradient sub tan tanh xor".split()
)


class _Components:
    """A vector as its entries."""

    def __init__(self, entries: Sequence[Any]):
        self.entries = tuple(entries)


def by_components(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function` with its small vectors replaced by their components.

    **Arguments:** `function`: of pytrees of arrays, to pytrees of arrays and `None`.

    **Returns:** a function with the same values and a faster gradient.
    """

    def replayed(*args):
        closed, shapes = jax.make_jaxpr(function, return_shape=True)(*args)
        outs = _replay(closed.jaxpr, closed.consts, jax.tree.leaves(args))
        return jax.tree.unflatten(jax.tree.structure(shapes), map(_whole, outs))

    return replayed


def _replay(jaxpr: Any, consts: Sequence[Any], args: Sequence[Any]) -> list[Any]:
    known: dict[Any, Any] = {}

    def read(atom):
        return atom.val if isinstance(atom, Literal) else known[atom]

    known.update(zip(jaxpr.constvars, consts, strict=True))
    known.update(zip(jaxpr.invars, args, strict=True))
    for equation in jaxpr.eqns:
        values = [read(atom) for atom in equation.invars]
        known.update(zip(equation.outvars, _apply(equation, values), strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _apply(equation: Any, values: list[Any]) -> Sequence[Any]:
    """The outputs of one equation."""
    name, params = equation.primitive.name, equation.params
    if name in ("jit", "pjit"):
        inner = params["jaxpr"]
        return _replay(inner.jaxpr, inner.consts, values)
    shape: Any = None
    if equation.outvars:
        shape = getattr(equation.outvars[0].aval, "shape", None)
    if name in ("broadcast_in_dim", "reshape") and len(values) == 1 and shape == (1,):
        if not isinstance(values[0], _Components) and jnp.shape(values[0]) == ():
            return [_Components([values[0]])]
    if name == "concatenate" and shape is not None and len(shape) == 1:
        if shape[0] <= LARGEST and all(isinstance(v, _Components) for v in values):
            return [_Components([e for v in values for e in v.entries])]
    if name == "stack" and shape == (len(values),) and len(values) <= LARGEST:
        return [_Components(values)]
    if name == "unstack" and isinstance(values[0], _Components):
        return values[0].entries
    if any(isinstance(value, _Components) for value in values):
        found = _of_components(equation.primitive, params, shape, values)
        if found is not None:
            return [found]
    whole = [_whole(value) for value in values]
    bound = equation.primitive.get_bind_params(params)
    # JAX before 0.11 returns the functions inside apart from the other parameters.
    functions, bound = bound if isinstance(bound, tuple) else ((), bound)
    out = equation.primitive.bind(*functions, *whole, **bound)
    out = out if equation.primitive.multiple_results else [out]
    # The sines of `delucax.math` are stored once. A solve has several outputs, and a
    # fence around them would ask for a cotangent of those that have none.
    single = name == "custom_jvp_call" and len(out) == 1 and shape == ()
    return fence(*out) if single else out


def _of_components(primitive, params, shape, values):
    """What some primitives make of components; `None` for those that need the whole."""
    name, first = primitive.name, values[0]
    if name == "slice" and isinstance(first, _Components):
        (start,), (stop,) = params["start_indices"], params["limit_indices"]
        step = 1 if params["strides"] is None else params["strides"][0]
        taken = first.entries[start:stop:step]
        return _Components(taken) if taken else None
    if (
        name in ("squeeze", "reshape")
        and shape == ()
        and isinstance(first, _Components)
    ):
        return first.entries[0]
    if name == "dynamic_slice" and isinstance(first, _Components):
        start, (size,) = values[1], params["slice_sizes"]
        if isinstance(start, int) or not isinstance(start, Tracer):
            start = min(max(int(start), 0), len(first.entries) - size)
            return _Components(first.entries[start : start + size])
        return None
    if name in _ELEMENTWISE and shape is not None and len(shape) == 1:
        (size,) = shape
        split = [_entries(value, size) for value in values]
        if any(entries is None for entries in split):
            return None
        entries = zip(*split, strict=True)
        return _Components([primitive.bind(*entry, **params) for entry in entries])
    return None


def _entries(value: Any, size: int) -> Sequence[Any] | None:
    """`size` entries of a vector, or as many times a scalar or the only entry."""
    if isinstance(value, _Components):
        return value.entries * (size // len(value.entries))
    if jnp.shape(value) == ():
        return [value] * size
    return [value[i] for i in range(size)] if jnp.shape(value) == (size,) else None


def _whole(value: Any) -> Any:
    return jnp.stack(value.entries) if isinstance(value, _Components) else value
