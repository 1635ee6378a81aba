"""Values that a batch computes once.

XLA on CPU compiles each component of a loop's state into a program of its own and
repeats in it all that the component depends on: both components of a pendulum's next
state compute its sine, and every component of a Runge-Kutta step computes all the
stages. For a batch it is about twice as fast to store such a value once, in cache. One
unbatched chain and accelerators are better off without, so there it does nothing.
"""

from typing import Any

from jax import lax
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir


_fence = Primitive("fence")
_fence.multiple_results = True


def fence(*values: Any) -> list[Any]:
    """The same arrays; a batch of them, on CPU, is stored before it is used."""
    return _fence.bind(*values, batched=False)


def _same(*values, batched):
    del batched
    return list(values)


def _stored(*values, batched):
    return lax.optimization_barrier(list(values)) if batched else list(values)


def _batch(values, dims, *, batched):
    del batched
    return _fence.bind(*values, batched=True), dims


def _jvp(primals, tangents, *, batched):
    return _fence.bind(*primals, batched=batched), _fence_nonzero(tangents, batched)


def _transpose(cotangents, *values, batched):
    del values
    return _fence_nonzero(cotangents, batched)


def _fence_nonzero(values, batched):
    """The values with those that are not symbolically zero behind a fence."""
    nonzero = [i for i, value in enumerate(values) if type(value) is not ad.Zero]
    fenced = _fence.bind(*(values[i] for i in nonzero), batched=batched)
    out = list(values)
    for i, value in zip(nonzero, fenced, strict=True):
        out[i] = value
    return out


_fence.def_impl(_same)
_fence.def_abstract_eval(_same)
batching.primitive_batchers[_fence] = _batch
ad.primitive_jvps[_fence] = _jvp
ad.primitive_transposes[_fence] = _transpose
mlir.register_lowering(_fence, mlir.lower_fun(_same, multiple_results=True))
mlir.register_lowering(
    _fence, mlir.lower_fun(_stored, multiple_results=True), platform="cpu"
)
