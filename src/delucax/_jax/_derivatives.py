"""Derivatives in a mode that solvers support, and NaN tangents of failed solves."""

import functools
from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import jaxpr_as_fun, Primitive
from jax.flatten_util import ravel_pytree
from jax.interpreters import ad, batching, mlir, partial_eval
from jaxtyping import Array


_LOOPED_UP_TO = 64
"""More directions than this are taken at once, by matrix products."""


def first_possible(*derivatives: Callable[..., Any]) -> Callable[..., Any]:
    """Try several ways to differentiate, and use the first that the solvers inside
    support.

    Some solvers have no reverse mode, others no forward mode. If all ways fail, the
    error of the first is raised. That includes errors of the program itself.
    """

    def evaluate(*args):
        errors = []
        for derivative in derivatives:
            try:
                return derivative(*args)
            except (RuntimeError, TypeError, ValueError) as error:
                errors.append(error)
        raise errors[0]

    return evaluate


def jacobian(f: Callable[..., Any]) -> Callable[..., Any]:
    """The Jacobian of `f` in forward mode, or in reverse mode if a solver inside of it
    supports only that."""
    return first_possible(jax.jacfwd(f), jax.jacrev(f))


def value_and_jacobians(
    f: Callable[..., Array], *args: Array, in_loop: bool = False
) -> tuple[Array, Any]:
    """The value of `f` at vectors and its Jacobians with respect to each, from one copy
    of `f`.

    Use `in_loop` for code that runs seldom. Few directions are then taken one after the
    other: XLA on CPU compiles a loop over small arrays as a whole, in half the time.
    """
    joined, split = ravel_pytree(args)

    def twice(joined):
        value = f(*split(joined))
        return value, value

    def looped(joined):
        def along(direction):
            # Without the barrier, XLA would move everything that depends only on the
            # point out of the loop, one operation after the other.
            point, direction = lax.optimization_barrier((joined, direction))
            return jax.jvp(lambda z: f(*split(z)), (point,), (direction,))

        # A solver without forward mode appears in the program as this primitive. XLA
        # would refuse it only later, when no other way can be tried.
        directions = jnp.eye(joined.size, dtype=joined.dtype)
        traced = jax.make_jaxpr(along)(directions[0])
        if "custom_lin" in _primitives(traced):
            raise TypeError("A solver inside has no forward mode.")
        values, rows = lax.map(jaxpr_as_fun(traced), directions)
        return rows.T, values[0]

    in_loop = in_loop and joined.size <= _LOOPED_UP_TO
    forward = looped if in_loop else jax.jacfwd(twice, has_aux=True)
    J, value = first_possible(forward, jax.jacrev(twice, has_aux=True))(joined)
    ends = np.cumsum([arg.size for arg in args])
    return value, jnp.split(J, ends[:-1], axis=1)


def _primitives(jaxpr: Any) -> Iterator[str]:
    """The names of the operations of a program, including those of nested programs."""
    for equation in jaxpr.eqns:
        yield equation.primitive.name
        for leaf in jax.tree.leaves(list(equation.params.values())):
            if hasattr(leaf, "eqns"):
                yield from _primitives(leaf)


def operations(f: Callable[..., Any], *args: Any) -> int:
    """The number of operations of the program of `f`, including nested programs."""
    return sum(1 for _ in _primitives(jax.make_jaxpr(f)(*args)))


def is_constant(f: Callable[..., Any], *args: Any) -> bool:
    """Whether the array that `f` returns depends on none of its arguments."""
    # Dead code elimination says which inputs the output needs.
    traced = jax.make_jaxpr(f)(*args)
    _, used = partial_eval.dce_jaxpr(traced.jaxpr, [True])
    return not any(used)


_nan_tangent = Primitive("nan_tangent")


def without_tangents(tree: Any) -> Any:
    """The tree without the derivatives that its arrays carry."""
    floats, rest = eqx.partition(tree, eqx.is_inexact_array)
    return eqx.combine(jax.tree.map(lax.stop_gradient, floats), rest)


def nan_tangent(tangent: Array, ok: Array) -> Array:
    """The tangent where `ok` holds; NaN elsewhere, unless the tangent is zero.

    The same holds in reverse mode. A value that does not depend on a failed solve, such
    as a masked member of a batch, keeps its gradient. Other gradients are NaN. To
    multiply by NaN would not do, because NaN times zero is NaN.
    """
    return _nan_tangent.bind(tangent, jnp.broadcast_to(ok, tangent.shape))


def _value(tangent, ok):
    return jnp.where(ok | (tangent == 0), tangent, jnp.nan)


def _batch(values, dims):
    # Elementwise, so a batch only moves its axis to the front.
    size = next(v.shape[d] for v, d in zip(values, dims, strict=True) if d is not None)
    at_front = functools.partial(batching.bdim_at_front, size=size)
    return _nan_tangent.bind(*map(at_front, values, dims)), 0


def _transpose(cotangent, _, ok):
    # A diagonal map is its own transpose.
    is_zero = type(cotangent) is ad.Zero
    return cotangent if is_zero else _nan_tangent.bind(cotangent, ok), None


_nan_tangent.def_impl(_value)
_nan_tangent.def_abstract_eval(lambda tangent, ok: tangent)
batching.primitive_batchers[_nan_tangent] = _batch
# Linear in the tangent, so that its own derivative is the same map.
ad.defjvp(_nan_tangent, lambda change, _, ok: _nan_tangent.bind(change, ok), None)
ad.primitive_transposes[_nan_tangent] = _transpose
mlir.register_lowering(_nan_tangent, mlir.lower_fun(_value, multiple_results=False))


def deferred(
    function: Callable[[Any, Any], Array], like: Array, given: Any, tangents: Any
) -> Array:
    """`function(given, tangents)`, an array like `like`, linear in the tangents.

    It is traced where its value or its transpose is needed, not where it is called. So
    a tangent on which nothing depends takes no time to compile. The function must not
    close over arrays.
    """
    arrays, static = eqx.partition(given, eqx.is_array)
    leaves, structure = jax.tree.flatten((arrays, tangents))
    linear = len(jax.tree.leaves(tangents))

    def evaluate(*leaves):
        arrays, tangents = jax.tree.unflatten(structure, leaves)
        return function(eqx.combine(arrays, static), tangents)

    out = jax.typeof(like)
    return _deferred.bind(*leaves, function=evaluate, linear=linear, out=out)


_deferred = Primitive("deferred")
"""A function, with the type `out` of its value. Its last `linear` arguments are the
tangents."""


def _deferred_value(*values, function, **_):
    return function(*values)


def _deferred_batch(values, dims, *, function, linear, out):
    size = next(v.shape[d] for v, d in zip(values, dims, strict=True) if d is not None)
    params: dict[str, Any] = dict(
        function=jax.vmap(function, dims, axis_size=size),
        linear=linear,
        out=out.update(shape=(size, *out.shape)),
    )
    return _deferred.bind(*values, **params), 0


def _deferred_jvp(primals, tangents, *, function, **params):
    out = _deferred.bind(*primals, function=function, **params)
    split = len(primals) - params["linear"]
    changes = [ad.instantiate_zeros(t) for t in tangents]
    if all(type(t) is ad.Zero for t in tangents[:split]):
        inputs = *primals[:split], *changes[split:]
        return out, _deferred.bind(*inputs, function=function, **params)
    return out, jax.jvp(function, primals, tuple(changes))[1]


def _deferred_transpose(cotangent, *values, function, **_):
    unknown = [ad.is_undefined_primal(value) for value in values]
    if type(cotangent) is ad.Zero:
        return [None] * len(values)

    def linear(*tangents):
        left = iter(tangents)
        pairs = zip(unknown, values, strict=True)
        return function(*(next(left) if free else value for free, value in pairs))

    like = [v.aval for v, free in zip(values, unknown, strict=True) if free]
    back = iter(jax.linear_transpose(linear, *like)(cotangent))
    return [next(back) if free else None for free in unknown]


_deferred.def_impl(_deferred_value)
_deferred.def_abstract_eval(lambda *_, out, **params: out)
batching.primitive_batchers[_deferred] = _deferred_batch
ad.primitive_jvps[_deferred] = _deferred_jvp
ad.primitive_transposes[_deferred] = _deferred_transpose
mlir.register_lowering(
    _deferred, mlir.lower_fun(_deferred_value, multiple_results=False)
)
