"""Derivatives of programs that have none in one of the two modes."""

import jax
import jax.lax as lax
import jax.numpy as jnp
import pytest
from helpers import assert_close, once

from delucax._jax import first_possible, value_and_jacobians


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


@once
def test_directions_in_a_loop_are_those_at_once():
    f = lambda x, u: jnp.stack([jnp.sin(x[0]) * u[0], x[1] ** 2, x[0] * x[1]])
    xs, us = jnp.array([[1.0, 2.0], [-3.0, 0.5]]), jnp.array([[2.0], [0.7]])

    def lanes(in_loop):
        def derivatives(x, u):
            return value_and_jacobians(f, x, u, in_loop=in_loop)

        total = lambda x, u: jnp.sum(derivatives(x, u)[1][0] ** 3)
        both = jax.vmap(lambda x, u: (derivatives(x, u), jax.grad(total)(x, u)))
        return jax.jit(both)(xs, us)

    same = lambda a, b: assert_close(a, b, rtol=1e-6)
    jax.tree.map(same, lanes(in_loop=True), lanes(in_loop=False))


@once
def test_many_directions_and_reverse_mode_alone_have_no_loop():
    for f, n in ((jnp.sin, 65), (jax.vmap(square), 2)):
        x = jnp.arange(1.0, n + 1)
        value, (J,) = value_and_jacobians(f, x, in_loop=True)
        assert_close(J, jax.jacrev(f)(x))
        assert_close(value, f(x))
