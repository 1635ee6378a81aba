"""Speed of batches on CPU: a barrier against recomputation, small products without
calls of a library, and a sequential `vmap`.

XLA on CPU compiles each component of a loop's state into a program of its own, and
repeats in it everything on which the component depends. Both components of a pendulum's
next state compute its sine, and every component of a Runge-Kutta step computes all the
stages. For a batch it is about twice as fast to store such a value once, in cache.
Without a batch or on accelerators that would be slower, so there the barrier does
nothing.
"""

import functools
import operator
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.extend.core import jaxpr_as_fun, Primitive
from jax.interpreters import ad, batching, mlir

from .._host import on_host


_fence = Primitive("fence")
_fence.multiple_results = True


def fence(*values: Any) -> list[Any]:
    """The same arrays. A batch on CPU is stored before it is used."""
    return _fence.bind(*values, batched=False)


def _same(*values, **_):
    return list(values)


def _stored(*values, batched):
    # XLA moves nothing across a barrier, so it cannot repeat the operations before it.
    return lax.optimization_barrier(list(values)) if batched else list(values)


def _batch(values, dims, **_):
    # `vmap` turns the parameter on, which tells the lowering about the batch.
    return _fence.bind(*values, batched=True), dims


def _jvp(primals, tangents, *, batched):
    return _fence.bind(*primals, batched=batched), _fence_nonzero(tangents, batched)


def _transpose(cotangents, *_, batched):
    return _fence_nonzero(cotangents, batched)


def _fence_nonzero(values, batched):
    """The values, behind a fence unless they are symbolically zero."""
    nonzero = [value for value in values if type(value) is not ad.Zero]
    fenced = iter(_fence.bind(*nonzero, batched=batched))
    return [v if type(v) is ad.Zero else next(fenced) for v in values]


_fence.def_impl(_same)
_fence.def_abstract_eval(_same)
batching.primitive_batchers[_fence] = _batch
ad.primitive_jvps[_fence] = _jvp
ad.primitive_transposes[_fence] = _transpose
mlir.register_lowering(_fence, mlir.lower_fun(_same, multiple_results=True))
mlir.register_lowering(
    _fence, mlir.lower_fun(_stored, multiple_results=True), platform="cpu"
)


_matmul = Primitive("matmul")
_OUTER = 16
_FEW = 8**3
"""Up to this number of scalar products, a product outside of a batch becomes a sum."""


def matmul(left: Any, right: Any) -> Any:
    """The product of two matrices. On CPU, small ones are computed without a library.

    XLA gives each product of a batch to its pool of threads, unless a flag turns the
    pool off. For matrices with a few rows that takes ten times as long as the product
    itself. Also, XLA compiles a loop over small arrays as a whole only if it calls no
    library. It then compiles faster, and runs without a call for each operation.
    """
    if on_host() or left.shape[1] > _OUTER:
        return left @ right
    precision = jax.config.jax_default_matmul_precision  # pyright: ignore
    return _matmul.bind(left, right, batched=False, precision=precision)


def _product(left, right, *, precision, **_):
    return jnp.matmul(left, right, precision=precision)


def _sum_of_products(left, right, *, batched, precision):
    if not batched and left.size * right.shape[1] > _FEW:
        return jnp.matmul(left, right, precision=precision)
    # Without barriers, operations that XLA fuses with the sum are computed for each of
    # its terms. For a single product that is little work, and compiles faster.
    if batched:
        left, right = lax.optimization_barrier((left, right))
    terms = (
        left[..., :, k, None] * right[..., None, k, :] for k in range(left.shape[-1])
    )
    return lax.optimization_barrier(functools.reduce(operator.add, terms))


def _matmul_shape(left, right, **_):
    return left.update(shape=(*left.shape[:-1], right.shape[-1]))


def _matmul_batch(values, dims, **params):
    pairs = list(zip(values, dims, strict=True))
    (size,) = {v.shape[d] for v, d in pairs if d is not None}
    left, right = (batching.bdim_at_front(v, d, size) for v, d in pairs)
    return _matmul.bind(left, right, **params | {"batched": True}), 0


_matmul.def_impl(_product)
_matmul.def_abstract_eval(_matmul_shape)
batching.primitive_batchers[_matmul] = _matmul_batch
ad.defbilinear(
    _matmul,
    lambda t, left, right, **params: _matmul.bind(t, right.mT, **params),
    lambda t, left, right, **params: _matmul.bind(left.mT, t, **params),
)
mlir.register_lowering(_matmul, mlir.lower_fun(_product, multiple_results=False))
mlir.register_lowering(
    _matmul, mlir.lower_fun(_sum_of_products, multiple_results=False), platform="cpu"
)


def hoisted(function: Callable[..., Any], *args: Any) -> Callable[..., Any]:
    """`function`, traced at `args`, with all arrays that it closes over as leaves."""
    # A lambda, because Equinox only looks into functions with a closure.
    return eqx.filter_closure_convert(lambda *args: function(*args), *args)


def by_lanes(function: Callable[..., Any], *args: Any) -> Any:
    """`function(*args)`, whose batches run one member after the other on CPU.

    In a batch, each iteration waits for the longest line search and the slowest member.
    On CPU nothing is gained in return: a sequential run is as fast, or up to six times
    faster. Accelerators run the batch as one. The function needs its own derivative
    rule, and its closed-over arrays must be leaves.
    """
    arrays, static = eqx.partition((function, args), eqx.is_array)
    leaves, structure = jax.tree.flatten(arrays)

    def evaluate(*leaves):
        arrays = jax.tree.unflatten(structure, leaves)
        function, args = eqx.combine(arrays, static)
        return function(*args)

    program, shapes = jax.make_jaxpr(evaluate, return_shape=True)(*leaves)
    outs = _lanes.bind(*leaves, program=program, batches=())
    return jax.tree.unflatten(jax.tree.structure(shapes), outs)


_lanes = Primitive("lanes")
"""A program and its batches, the outermost first: for each, its size and which
arguments it batches. The platform decides later how they run, so the program is traced
only in the way in which it runs."""
_lanes.multiple_results = True


def _nested(over: Callable[..., Any]) -> Callable[..., Any]:
    """The function that runs the program, with its batches mapped by `over`."""

    def run(*values, program, batches):
        function = jaxpr_as_fun(program)
        for _, batched in reversed(batches):
            function = over(function, batched)
        return function(*values)

    return run


def _sequentially(function, batched):
    def mapped(*values):
        lanes, shared = eqx.partition(list(values), list(batched))
        return lax.map(lambda lane: function(*eqx.combine(lane, shared)), lanes)

    return mapped


def _together(function, batched):
    return jax.vmap(function, [0 if b else None for b in batched])


def _lanes_batch(values, dims, *, program, batches):
    size = next(v.shape[d] for v, d in zip(values, dims, strict=True) if d is not None)
    batched = tuple(d is not None for d in dims)
    values = [
        value if d is None else batching.bdim_at_front(value, d, size)
        for value, d in zip(values, dims, strict=True)
    ]
    batches = ((size, batched), *batches)
    outs = _lanes.bind(*values, program=program, batches=batches)
    return outs, [0] * len(outs)


def _lanes_shapes(*_, program, batches):
    sizes = tuple(size for size, _ in batches)
    outs = [out.update(shape=(*sizes, *out.shape)) for out in program.out_avals]
    return outs, program.effects


# JAX operations that are lowered late, such as `jnp.searchsorted`, may stay inside,
# because the program is lowered as a whole. Older versions of JAX have none.
_lanes.is_high = lambda *_, **__: False
_lanes.def_impl(_nested(_sequentially))
_lanes.def_effectful_abstract_eval(_lanes_shapes)
batching.primitive_batchers[_lanes] = _lanes_batch
mlir.register_lowering(_lanes, mlir.lower_fun(_nested(_together)))
mlir.register_lowering(_lanes, mlir.lower_fun(_nested(_sequentially)), platform="cpu")
