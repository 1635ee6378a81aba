"""A fence changes no number and no derivative, and stores a batch alone."""

import jax
import jax.numpy as jnp
from helpers import assert_close, once
from jax.test_util import check_grads

from delucax._jax import fence


pytestmark = once


def _fenced(x, y):
    a, b = fence(jnp.sin(x) * y, x**2)
    return a * b + jnp.exp(a)


def _plain(x, y):
    a, b = jnp.sin(x) * y, x**2
    return a * b + jnp.exp(a)


X, Y = jnp.linspace(-1.0, 1.0, 5), jnp.array(0.7)


def test_same_numbers_and_derivatives():
    close = 1e-6
    batch, plain = (jax.vmap(f, in_axes=(0, None)) for f in (_fenced, _plain))
    compiled = jax.jit(batch)
    assert_close(compiled(X, Y), plain(X, Y), rtol=close, atol=close)
    assert_close(batch(X, Y), plain(X, Y), rtol=close, atol=close)
    for derivative in (jax.jacrev, jax.jacfwd, jax.hessian):
        found = jax.jit(derivative(batch, (0, 1)))(X, Y)
        expected = jax.jit(derivative(plain, (0, 1)))(X, Y)
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            assert_close(a, b, rtol=10 * close, atol=10 * close)
    check_grads(compiled, (X, Y), order=2, atol=1e-1, rtol=1e-1)


def test_one_output_may_have_no_cotangent():
    assert_close(jax.grad(lambda x: fence(2 * x, 3 * x)[1])(1.0), 3.0)


def test_it_stores_a_batch_alone():
    def program(f, x):
        return jax.jit(f).lower(x).as_text()

    one = lambda x: fence(jnp.sin(x))[0] + 1
    assert "optimization_barrier" not in program(one, X[0])
    batched = program(jax.vmap(one), X)
    assert ("optimization_barrier" in batched) == (jax.default_backend() == "cpu")
