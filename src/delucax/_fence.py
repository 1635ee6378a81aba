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
    tangents = [ad.instantiate_zeros(t) for t in tangents]
    return _fence.bind(*primals, batched=batched), _fence.bind(
        *tangents, batched=batched
    )


def _transpose(cotangents, *values, batched):
    del values
    known = [i for i, c in enumerate(cotangents) if type(c) is not ad.Zero]
    fenced = _fence.bind(*(cotangents[i] for i in known), batched=batched)
    found = list(cotangents)
    for i, value in zip(known, fenced, strict=True):
        found[i] = value
    return found


_fence.def_impl(_same)
_fence.def_abstract_eval(_same)
batching.primitive_batchers[_fence] = _batch
ad.primitive_jvps[_fence] = _jvp
ad.primitive_transposes[_fence] = _transpose
mlir.register_lowering(_fence, mlir.lower_fun(_same, multiple_results=True))
mlir.register_lowering(
    _fence, mlir.lower_fun(_stored, multiple_results=True), platform="cpu"
)
