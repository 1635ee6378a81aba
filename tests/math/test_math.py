import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, needs_x32, needs_x64, once
from jax.test_util import check_grads
from scipy.stats import kstest

import delucax as dlx


@needs_x32
@pytest.mark.parametrize("name", ["sin", "cos"])
def test_error_up_to_ten_thousand(name):
    x = np.linspace(-1e4, 1e4, 400_001).astype(np.float32)
    found = np.asarray(getattr(dlx.math, name)(x), np.float64)
    exact = getattr(np, name)(x.astype(np.float64))
    assert np.max(np.abs(found - exact)) <= 1.5e-7


@needs_x64
@pytest.mark.parametrize("name", ["sin", "cos"])
def test_double_precision_is_exact(name):
    x = np.linspace(-100, 100, 10_001)
    assert_close(getattr(dlx.math, name)(x), getattr(np, name)(x), atol=1e-15)


@pytest.mark.parametrize("f", [dlx.math.sin, dlx.math.cos])
@needs_x64
def test_trig_gradients(f):
    check_grads(f, (jnp.linspace(-3.0, 3.0, 7),), order=2, atol=1e-5, rtol=1e-5)


@needs_x32
@pytest.mark.parametrize("f, g", [(dlx.math.sin, jnp.sin), (dlx.math.cos, jnp.cos)])
def test_trig_second_derivative(f, g):
    x = jnp.linspace(-3.0, 3.0, 7)
    second = [jax.jit(jax.vmap(jax.grad(jax.grad(h))))(x) for h in (f, g)]
    assert_close(*second, atol=3e-7)


@once
def test_trig_is_nan_at_infinity():
    assert np.isnan(dlx.math.sin(jnp.array(jnp.inf)))
    assert np.isnan(dlx.math.cos(jnp.array(-jnp.inf)))


@once
def test_wrap():
    x = jnp.linspace(-20.0, 20.0, 1001)
    wrapped = dlx.math.wrap(x)
    assert np.all(np.abs(wrapped) <= np.pi + 1e-5)
    assert_close(jnp.cos(wrapped), jnp.cos(x), atol=1e-5)
    assert_close(jnp.sin(wrapped), jnp.sin(x), atol=1e-5)
    assert jax.grad(dlx.math.wrap)(jnp.array(4.0)) == 1.0


@once
def test_safe_norm():
    assert np.all(jax.grad(dlx.math.safe_norm)(jnp.zeros(3)) == 0)
    x = jnp.array([3.0, 4.0])
    assert_close(dlx.math.safe_norm(x), 5.0, rtol=1e-6)
    assert_close(jax.grad(dlx.math.safe_norm)(x), x / 5, rtol=1e-6)
    assert dlx.math.safe_norm(jnp.ones((2, 3)), keepdims=True).shape == (2, 1)


@once
@pytest.mark.parametrize("m, n", [(1, 1), (1, 3), (4, 8), (5, 9)])
def test_small_products(m, n):
    rng = np.random.default_rng(0)
    shapes = (m, n), (n,), (n, n)
    matrices = [rng.normal(size=shape).astype(np.float32) for shape in shapes]
    (M, x, S), (left, right, square) = matrices, map(jnp.asarray, matrices)
    assert_close(dlx.math.matvec(left, right), M @ x, rtol=1e-5, atol=1e-5)
    assert_close(
        dlx.math.quadratic_form(square, right),
        x @ S @ x,
        rtol=1e-4,
        atol=1e-5,
    )


@once
@pytest.mark.parametrize("name, size", [("matvec", 2), ("quadratic_form", 3)])
def test_small_products_name_the_shapes(name, size):
    with pytest.raises(ValueError, match=rf"{name}: .*\(2, 3\).*\({size},\)"):
        getattr(dlx.math, name)(jnp.ones((2, 3)), jnp.ones(size))


@needs_x32
@pytest.mark.parametrize("shape", [(200_001,), (1000, 3, 50)])
def test_normal_noise_is_normal(shape, key):
    from delucax._jax import normal

    x = np.asarray(normal(key, shape, jnp.float32)).ravel()
    assert x.shape == (np.prod(shape),) and np.all(np.isfinite(x))
    statistic = kstest(x, "norm").statistic
    assert statistic < 1.95 / np.sqrt(x.size)  # 0.1% level
    assert abs(np.mean(x[:-1] * x[1:])) < 4 / np.sqrt(x.size)
    half = x.size // 2  # the two halves come of the same uniform numbers
    assert abs(np.mean(x[:half] ** 2 * x[-half:] ** 2) - 1) < 10 / np.sqrt(half)


@needs_x32
def test_normal_noise_of_any_kind_of_key():
    from delucax._jax import normal

    old = normal(jax.random.PRNGKey(3), (5,), jnp.float32)
    assert_close(normal(jax.random.key(3), (5,), jnp.float32), old)
    other = normal(jax.random.key(3, impl="rbg"), (1000,), jnp.float32)
    assert kstest(np.asarray(other), "norm").pvalue > 1e-3


@once
def test_clip():
    x = jnp.array([-3.0, -2.0, 0.5, 2.0, 3.0, jnp.nan])
    assert_close(dlx.math.clip(x, -2.0, 2.0), jnp.clip(x, -2.0, 2.0))
    assert_close(dlx.math.clip(x, -jnp.inf, 1.0), jnp.clip(x, None, 1.0))
    assert dlx.math.clip(x, -2, 2).dtype == x.dtype
    slopes = jax.vmap(jax.grad(dlx.math.clip, (0, 1, 2)), in_axes=(0, None, None))
    inside, at_low, at_high = slopes(x[:-1], -2.0, 2.0)
    assert_close(inside, [0.0, 1.0, 1.0, 1.0, 0.0])
    assert_close(at_low, [1.0, 0.0, 0.0, 0.0, 0.0])
    assert_close(at_high, [0.0, 0.0, 0.0, 0.0, 1.0])
