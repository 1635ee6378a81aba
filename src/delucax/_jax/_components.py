"""Small vectors as scalars: a transformation of jaxprs, for speed on CPU.

A user writes `x[0]` and `jnp.stack([...])`. Their gradient pads each component back to
a vector and adds the vectors up. XLA does not simplify that, and for a batch it takes
longer than the physics. Here a function is traced, and replayed with every small vector
held as its components. To take an entry of a stack is then no operation at all, forward
or backward. The numbers are the same.

A loop carries the state in the same way. Each component of a batch is then a vector of
its own, which stays in registers.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import Tracer
from jax.extend.core import Literal
from jaxtyping import Array

from ._batches import fence


COMPONENTS_UP_TO = 16
"""Longer vectors are left whole, to keep programs short."""

_REPEATED_UP_TO = 300
"""A value that takes more operations is stored."""

_STACKED_FIRST_UP_TO = 6
"""Trajectories with more components are extended before they are stacked."""

_ELEMENTWISE = frozenset(
    "abs add and atan2 ceil clamp convert_element_type cos copy cosh div eq erf exp"
    " exp2 expm1 floor ge gt integer_pow is_finite le log log1p logistic lt max min mul"
    " ne neg not or pow rem round rsqrt select_n sign sin sinh sqrt square"
    " stop_gradient sub tan tanh xor".split()
)


class _Components:
    """A vector, held as its entries."""

    def __init__(self, entries: Sequence[Any]):
        self.entries = tuple(entries)


def by_components(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function` with its small vectors replaced by their components.

    **Arguments:** `function`: maps pytrees of arrays to pytrees of arrays and `None`.

    **Returns:** a function with the same values and a faster gradient.
    """

    def replayed(*args):
        closed, shapes = jax.make_jaxpr(function, return_shape=True)(*args)
        outs = _replay(closed, jax.tree.leaves(args), _apply)
        return jax.tree.unflatten(jax.tree.structure(shapes), map(_whole, outs))

    return replayed


def _replay(
    closed: Any,
    args: Sequence[Any],
    apply: Callable[[Any, list[Any]], Sequence[Any]],
) -> list[Any]:
    """The outputs of a jaxpr; `apply` gives those of one equation."""
    jaxpr = closed.jaxpr
    env = dict(zip(jaxpr.constvars, closed.consts, strict=True))
    env.update(zip(jaxpr.invars, args, strict=True))
    read = lambda atom: atom.val if isinstance(atom, Literal) else env[atom]
    for equation in jaxpr.eqns:
        out = apply(equation, [read(atom) for atom in equation.invars])
        env.update(zip(equation.outvars, out, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _apply(equation: Any, values: list[Any]) -> Sequence[Any]:
    """The outputs of one equation."""
    primitive, params = equation.primitive, equation.params
    # An inner `jit` would take and return whole vectors, so it is replayed as well.
    if primitive.name in ("jit", "pjit"):
        return _replay(params["jaxpr"], values, _apply)
    first_out = equation.outvars[0].aval if equation.outvars else None
    shape = getattr(first_out, "shape", None)
    out = _on_components(primitive, params, shape, values)
    if out is not None:
        return out
    out = _bind(equation, map(_whole, values))
    # The sines of `delucax.math` are stored once. A solve has several outputs; a fence
    # around them would need cotangents that some do not have.
    single = primitive.name == "custom_jvp_call" and len(out) == 1 and shape == ()
    return fence(*out) if single else out


def _bind(equation: Any, values: Iterable[Any]) -> Sequence[Any]:
    primitive = equation.primitive
    bound = primitive.get_bind_params(equation.params)
    # JAX before 0.11 returns the inner functions and the other parameters separately.
    functions, bound = bound if isinstance(bound, tuple) else ((), bound)
    out = primitive.bind(*functions, *values, **bound)
    return out if primitive.multiple_results else [out]


def with_stores(function: Callable[..., Any], *like: Any) -> Callable[..., Any]:
    """`function` with long chains of operations behind fences.

    XLA repeats cheap operations wherever their value is used. So it repeats the start
    of a chain, such as the stages of a step, in each of the later programs. Here the
    repeated operations are counted, and a value that takes too many is stored.

    **Arguments:**

    - `function`: a function of pytrees of arrays, such as one from `by_components`.
    - `like`: the shapes of its arguments. It is traced here once, not in each
        derivative.

    **Returns:** a function with the same values, which compiles in less time.
    """
    closed, shapes = jax.make_jaxpr(function, return_shape=True)(*like)

    def replayed(*args):
        repeated: dict[Any, int] = {}

        def stored(equation, values):
            out = _bind(equation, values)
            if equation.primitive.name in _ELEMENTWISE:
                given = [v for v in equation.invars if not isinstance(v, Literal)]
                count = 1 + sum(repeated.get(v, 0) for v in given)
                out = out if count <= _REPEATED_UP_TO else fence(*out)
                count = count if count <= _REPEATED_UP_TO else 0
                repeated[equation.outvars[0]] = count
            return out

        outs = _replay(closed, jax.tree.leaves(args), stored)
        return jax.tree.unflatten(jax.tree.structure(shapes), outs)

    return replayed


def _on_components(
    primitive: Any, params: Any, shape: Any, values: list[Any]
) -> Sequence[Any] | None:
    """The outputs of a primitive that makes components or acts on them; `None` if it
    needs whole arrays. `shape` is the shape of its first output."""
    name, (first, *others) = primitive.name, values or [None]
    split = [isinstance(value, _Components) for value in values]
    size = shape[0] if shape and len(shape) == 1 else None
    if name in ("broadcast_in_dim", "reshape") and not others and shape == (1,):
        if not split[0] and jnp.shape(first) == ():
            return [_Components([first])]
    if (
        name == "concatenate"
        and size is not None
        and size <= COMPONENTS_UP_TO
        and all(split)
    ):
        return [_Components([entry for v in values for entry in v.entries])]
    if name == "stack" and shape == (len(values),) and len(values) <= COMPONENTS_UP_TO:
        return [_Components(values)]
    if name in _ELEMENTWISE and size is not None and any(split):
        # Elementwise primitives have no axes in `params`, which thus fit an entry too.
        columns = [_entries(value, size) for value in values]
        if any(column is None for column in columns):
            return None
        rows = zip(*columns, strict=True)
        return [_Components([primitive.bind(*row, **params) for row in rows])]
    if not isinstance(first, _Components):
        return None
    if name == "unstack":
        return first.entries
    if name in ("squeeze", "reshape") and shape == ():
        return first.entries[:1]
    if name == "slice":
        ends = params["start_indices"] + params["limit_indices"]
        taken = first.entries[slice(*ends, *(params["strides"] or ()))]
        return [_Components(taken)] if taken else None
    # For `x[-1]` and the like, the start is a number. JAX clamps it to the vector.
    if name == "dynamic_slice" and not isinstance(others[0], Tracer):
        (count,) = params["slice_sizes"]
        start = min(max(int(others[0]), 0), len(first.entries) - count)
        return [_Components(first.entries[start : start + count])]
    return None


def _entries(value: Any, size: int) -> Sequence[Any] | None:
    """`size` entries of a vector; a scalar or a single entry is repeated."""
    if isinstance(value, _Components):
        return value.entries * (size // len(value.entries))
    if jnp.shape(value) == ():
        return [value] * size
    return [value[i] for i in range(size)] if jnp.shape(value) == (size,) else None


def _whole(value: Any) -> Any:
    return jnp.stack(value.entries) if isinstance(value, _Components) else value


def split_state(x: Array, most: int = COMPONENTS_UP_TO) -> tuple[Array, ...]:
    """The components of a state, as loops carry it; a state with more than `most`
    entries is left whole."""
    return tuple(x) if x.shape[0] <= most else (x,)


def join_state(parts: tuple[Array, ...]) -> Array:
    """The inverse of `split_state`."""
    return parts[0] if parts[0].ndim else jnp.stack(parts)


def stack_steps(
    parts: tuple[Array, ...], size: int, last: tuple[Array, ...] = ()
) -> Array:
    """Vectors over time, shape `(T, size)`, from the components of each step.

    `last` is appended. A few components are stacked first and many are extended one by
    one, which a batch on CPU transposes fastest.

    A loop should keep the state before each step and append the last one here. If it
    kept the state after each step, XLA would compute the step twice: once to carry the
    state and once to keep it.
    """
    if size <= _STACKED_FIRST_UP_TO:
        # For one component a reshape, because a stack would copy it.
        steps = parts[0][:, None] if size == 1 else jnp.stack(parts, axis=1)
        if last:
            steps = jnp.concatenate([steps, jnp.stack(last)[None].astype(steps.dtype)])
        return steps
    if last:
        parts = tuple(
            jnp.concatenate([a, b[None].astype(a.dtype)])
            for a, b in zip(parts, last, strict=True)
        )
    return jnp.stack(parts, axis=1) if parts[0].ndim == 1 else parts[0]
