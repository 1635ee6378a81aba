"""Tangents of what has no derivative: NaN, where they are used."""

import functools

import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array


_nan_tangent = Primitive("nan_tangent")


def nan_tangent(tangent: Array, ok: Array) -> Array:
    """The tangent where `ok` holds; elsewhere NaN, unless the tangent is zero.

    The same in reverse: what does not depend on a failed solve (a masked lane of a
    batch) keeps its gradient, and the gradient of what does is NaN. A product with NaN
    would not do, because that of NaN and zero is NaN.
    """
    return _nan_tangent.bind(tangent, jnp.broadcast_to(ok, tangent.shape))


def _value(tangent, ok):
    return jnp.where(ok | (tangent == 0), tangent, jnp.nan)


def _batch(values, dims):
    size = next(v.shape[d] for v, d in zip(values, dims, strict=True) if d is not None)
    at_front = functools.partial(batching.bdim_at_front, size=size)
    return _nan_tangent.bind(*map(at_front, values, dims)), 0


def _jvp(primals, tangents):
    tangent, ok = primals
    change = ad.instantiate_zeros(tangents[0])
    return _nan_tangent.bind(tangent, ok), _nan_tangent.bind(change, ok)


def _transpose(cotangent, tangent, ok):
    del tangent
    if type(cotangent) is ad.Zero:
        return cotangent, None
    return _nan_tangent.bind(cotangent, ok), None


_nan_tangent.def_impl(_value)
_nan_tangent.def_abstract_eval(lambda tangent, ok: tangent)
batching.primitive_batchers[_nan_tangent] = _batch
ad.primitive_jvps[_nan_tangent] = _jvp
ad.primitive_transposes[_nan_tangent] = _transpose
mlir.register_lowering(_nan_tangent, mlir.lower_fun(_value, multiple_results=False))
