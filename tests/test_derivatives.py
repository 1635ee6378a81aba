"""Derivatives of programs that have none in one of the two modes."""

import jax
import jax.lax as lax
import jax.numpy as jnp
import pytest
from helpers import once

from delucax._jax import first_possible


def unbounded(x):
    """It has no derivative in reverse."""
    return lax.while_loop(lambda y: y < 10, lambda y: 2 * y, x)


@jax.custom_vjp
def square(x):
    """It has no derivative forward."""
    return x * x


square.defvjp(lambda x: (square(x), x), lambda x, g: (2 * x * g,))


@once
@pytest.mark.parametrize("function, slope", [(unbounded, 4.0), (square, 6.0)])
def test_the_mode_that_a_program_has(function, slope):
    for modes in (jax.jacfwd, jax.jacrev), (jax.jacrev, jax.jacfwd):
        derivative = first_possible(*(mode(function) for mode in modes))
        assert derivative(3.0) == slope
        assert jax.jit(derivative)(3.0) == slope


@once
def test_an_error_of_the_program_is_raised_as_it_is():
    def wrong(x):
        raise ValueError(f"x must be a vector, got shape {jnp.shape(x)}.")

    with pytest.raises(ValueError, match=r"x must be a vector, got shape \(\)"):
        first_possible(jax.jacrev(wrong), jax.jacfwd(wrong))(1.0)


@once
def test_where_no_mode_is_possible_the_first_error_is_raised():
    both = lambda x: unbounded(square(x))
    with pytest.raises(ValueError, match="Reverse-mode"):
        first_possible(jax.jacrev(both), jax.jacfwd(both))(1.0)
