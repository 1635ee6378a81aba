"""What has no derivative: NaN, where it is asked for."""

from typing import Any

import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array


_poison = Primitive("poison")


def poison(tangent: Array, ok: Array) -> Array:
    """The tangent where all is well; elsewhere NaN, unless it is zero.

    In reverse too: what does not look at a failed solve (a masked lane of a batch)
    keeps its gradient, and what does is told. No product with NaN does that, as the
    product with zero is NaN.
    """
    return _poison.bind(tangent, jnp.broadcast_to(ok, tangent.shape))


def _value(tangent, ok):
    return jnp.where(ok | (tangent == 0), tangent, jnp.nan)


def _batch(values, dims):
    tangent, ok = values
    size = next(v.shape[d] for v, d in zip(values, dims, strict=True) if d is not None)
    moved: list[Any] = []
    for value, dim in ((tangent, dims[0]), (ok, dims[1])):
        if dim is None:
            value = jnp.broadcast_to(value, (size, *value.shape))
        else:
            value = jnp.moveaxis(value, dim, 0)
        moved.append(value)
    return _poison.bind(*moved), 0


def _jvp(primals, tangents):
    tangent, ok = primals
    change = ad.instantiate_zeros(tangents[0])
    return _poison.bind(tangent, ok), _poison.bind(change, ok)


def _transpose(cotangent, tangent, ok):
    del tangent
    if type(cotangent) is ad.Zero:
        return cotangent, None
    return _poison.bind(cotangent, ok), None


_poison.def_impl(_value)
_poison.def_abstract_eval(lambda tangent, ok: tangent)
batching.primitive_batchers[_poison] = _batch
ad.primitive_jvps[_poison] = _jvp
ad.primitive_transposes[_poison] = _transpose
mlir.register_lowering(_poison, mlir.lower_fun(_value, multiple_results=False))
