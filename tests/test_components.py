"""Replaying a function by components changes no number and no derivative."""

import jax
import jax.numpy as jnp
import pytest
from helpers import assert_close, needs_x64

from delucax._jax import by_components, with_stores


pytestmark = needs_x64


@jax.jit
def _inner(x):
    return x[::-1] * 2


@jax.custom_jvp
def _custom(x):
    return jnp.sum(x**2)


_custom.defjvp(lambda p, t: (_custom(*p), jnp.sum(2 * p[0] * t[0])))


def _everything(x, A, s):
    a, b, c = x
    y = jnp.stack([a * b, x[-1], jnp.sin(c)])
    y = y + x * s - jnp.where(x > 0, x, 2.0)
    y = _inner(y) + A @ y + jnp.concatenate([y[1:], x[:1]])
    z = jnp.clip(y, -0.5, 0.5) + jnp.exp(-jnp.abs(x)) + _custom(y)
    n = jax.lax.cond(x[0] > 0, lambda v: v[0], lambda v: v[1] * v[2], z)
    w = z.at[1].set(n) + jnp.tanh(z)[jnp.array([2, 0, 1])]
    return {"w": w, "n": n, "same": x, "pair": (z[0], None), "m": jnp.outer(w, w)}


def _arguments():
    key = jax.random.key(0)
    x = jnp.array([0.3, -0.7, 0.9])
    return x, jax.random.normal(key, (3, 3)), jnp.array(1.5)


def _leaves_close(a, b):
    for p, q in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert_close(p, q, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("wrap", [lambda f: f, jax.jit])
def test_same_numbers(wrap):
    expected = _everything(*_arguments())
    found = wrap(by_components(_everything))(*_arguments())
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    _leaves_close(found, expected)


def test_same_derivatives():
    def scalar(f):
        return lambda *args: sum(jnp.sum(v) for v in jax.tree.leaves(f(*args)))

    def derivatives(f, *args):
        every = 0, 1, 2

        def slopes(*args):
            gradient = jax.grad(f, every)(*args)
            return gradient, gradient

        forward = jax.jacfwd(f, every)(*args)
        return forward, *jax.jacfwd(slopes, every, has_aux=True)(*args)

    ours, plain = scalar(by_components(_everything)), scalar(_everything)
    derivatives = jax.jit(derivatives, static_argnums=0)
    found, expected = (derivatives(f, *_arguments()) for f in (ours, plain))
    _leaves_close(found, expected)


def test_batches_and_loops():
    x, A, s = _arguments()
    batch = jnp.stack([x, 2 * x, -x])
    f = by_components(lambda x: _everything(x, A, s)["w"])
    g = lambda x: _everything(x, A, s)["w"]
    _leaves_close(jax.jit(jax.vmap(f))(batch), jax.jit(jax.vmap(g))(batch))
    step = by_components(lambda x, k: (0.1 * f(x) + k, x[0]))
    _, found = jax.lax.scan(step, x, jnp.arange(3.0))
    _, expected = jax.lax.scan(lambda x, k: (0.1 * g(x) + k, x[0]), x, jnp.arange(3.0))
    _leaves_close(found, expected)


def test_the_gradient_does_not_pad():
    """What the replay is for: no entry is padded back to a vector."""

    def field(x, u):
        return jnp.stack([x[1], u[0] - x[0] * x[1]])

    def loss(a, b, u):
        return field(jnp.stack([a, b]), u)[1]

    def program(f):
        return str(jax.make_jaxpr(jax.grad(f, (0, 1)))(1.0, 2.0, jnp.ones(1)))

    assert "pad[" in program(loss)
    assert "pad[" not in program(by_components(loss))


def test_an_only_entry_meets_all():
    twice = lambda x: jax.lax.mul(jnp.stack([x[0], x[1]]), jnp.stack([x[0]]))
    assert_close(by_components(twice)(jnp.array([2.0, 3.0])), [4.0, 6.0])


def test_stores_of_a_long_chain_change_no_derivative():
    def chain(x, A, s):
        for _ in range(8):
            x = x + 0.1 * jnp.sin(x) * (x + s)
        return A @ x

    def at(f):
        return jax.vmap(jax.jacfwd(jax.jacrev(f)), (0, None, None))

    x, A, s = _arguments()
    lanes = jnp.linspace(-1.0, 1.0, 4)[:, None] * x
    stored = with_stores(by_components(chain), x, A, s)
    assert str(jax.make_jaxpr(stored)(x, A, s)).count("fence") > 2
    assert_close(stored(x, A, s), chain(x, A, s), rtol=1e-12)
    assert_close(at(stored)(lanes, A, s), at(chain)(lanes, A, s), rtol=1e-10)
