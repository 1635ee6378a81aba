import jax
import jax.numpy as jnp
from helpers import assert_close, once, user_error

import delucax as dlx


@once
def test_signals():
    constant = dlx.references.Constant(jnp.array([1.0, 2.0]))
    assert_close(constant(3.0), [1, 2])
    sequence = dlx.references.Sequence(jnp.array([[0.0], [1.0], [4.0]]), dt=0.1)
    times = jnp.array([0.0, 0.1, 0.2, 5.0])
    assert_close(jax.vmap(sequence)(times)[:, 0], [0, 1, 4, 4])
    eight = dlx.references.FigureEight(
        period=8.0, width=2.0, height=3.0, centre=jnp.array([1.0, 1.0])
    )
    assert_close(eight(0.0), [1, 1], atol=1e-6)
    assert_close(eight(2.0), [3, 1], atol=1e-5)
    assert_close(eight(1.0), [1 + 2**0.5, 4], atol=1e-5)


@once
def test_bad_arguments():
    with user_error(match="value must be a vector"):
        dlx.references.Constant(1.0)
    with user_error(match="dt must be positive"):
        dlx.references.Sequence(jnp.ones((3, 1)), dt=-1.0)
    with user_error(match="period must be positive"):
        dlx.references.FigureEight(period=0.0)
