"""Speed of batches on CPU: a barrier against recomputation, small products without
calls of a library, and a sequential `vmap`.

XLA on CPU compiles each component of a loop's state into a program of its own and
repeats in it all that the component depends on: both components of a pendulum's next
state compute its sine, and every component of a Runge-Kutta step computes all the
stages. For a batch it is about twice as fast to store such a value once, in cache. The
barrier does nothing without a batch or on accelerators, where it would be slower.
"""

import functools
import operator
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from .._host import on_host


_fence = Primitive("fence")
_fence.multiple_results = True


def fence(*values: Any) -> list[Any]:
    """The same arrays; a batch of them, on CPU, is stored before it is used."""
    return _fence.bind(*values, batched=False)


def _same(*values, **_):
    return list(values)


def _stored(*values, batched):
    # XLA moves nothing across a barrier, and so cannot repeat what is before it.
    return lax.optimization_barrier(list(values)) if batched else list(values)


def _batch(values, dims, **_):
    # Under `vmap` the parameter turns on: that is how the lowering knows of the batch.
    return _fence.bind(*values, batched=True), dims


def _jvp(primals, tangents, *, batched):
    return _fence.bind(*primals, batched=batched), _fence_nonzero(tangents, batched)


def _transpose(cotangents, *_, batched):
    return _fence_nonzero(cotangents, batched)


def _fence_nonzero(values, batched):
    """The values with those that are not symbolically zero behind a fence."""
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


def matmul(left: Any, right: Any) -> Any:
    """The product of two matrices; a batch of small ones, on CPU, is one loop.

    XLA gives each product of a batch to its pool of threads, unless a flag turns the
    pool off. For matrices of a few rows that takes ten times as long as the product.
    """
    if on_host() or left.shape[1] > _OUTER:
        return left @ right
    precision = jax.config.jax_default_matmul_precision  # pyright: ignore
    return _matmul.bind(left, right, batched=False, precision=precision)


def _product(left, right, *, precision, **_):
    return jnp.matmul(left, right, precision=precision)


def _sum_of_products(left, right, *, batched, precision):
    if not batched:
        return jnp.matmul(left, right, precision=precision)
    # Barriers, or what is fused with the sum is computed for each of its terms.
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


def by_lanes(function: Callable[..., Any], *args: Any) -> Any:
    """`function(*args)` of arrays, whose batches run sequentially on CPU.

    In a batch each iteration waits for the longest line search and the slowest member,
    and on CPU nothing is gained in return: a sequential run is between equally fast and
    six times as fast. Accelerators run the batch as one.
    """
    # Arrays that a cost or a constraint of the user closes over are batched as well.
    # Equinox looks into functions with a closure alone, such as this lambda.
    closed = eqx.filter_closure_convert(lambda *args: function(*args), *args)
    arrays, static = eqx.partition((closed, args), eqx.is_array)
    leaves, structure = jax.tree.flatten(arrays)

    def evaluate(*leaves):
        arrays = jax.tree.unflatten(structure, leaves)
        closed, args = eqx.combine(arrays, static)
        return closed(*args)

    run = custom_vmap(evaluate)

    @run.def_vmap
    def _(_, batched, *leaves):
        lanes, shared = eqx.partition(list(leaves), list(batched))
        of = lambda f: lambda lane: f(*eqx.combine(lane, shared))
        # Which platform it is turns out when the program is lowered, not now.
        out = lax.platform_dependent(
            lanes,
            # `run`, not `evaluate`: an outer `vmap` goes lane by lane as well.
            cpu=lambda lanes: lax.map(of(run), lanes),
            default=jax.vmap(of(evaluate)),
        )
        return out, jax.tree.map(lambda _: True, out)

    return run(*leaves)
