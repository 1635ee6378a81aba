"""Tests of programs that are compiled for a short wait."""

import jax
import jax.numpy as jnp
import pytest

from delucax._jax import quickly_compiled


@quickly_compiled
def doubled(x):
    return 2 * x


class TestQuicklyCompiled:
    def test_gives_the_same_outside_and_inside_of_transformations(self):
        x = jnp.arange(3.0)
        expected = 2 * x
        for function in (doubled, jax.jit(doubled), jax.vmap(doubled)):
            assert jnp.array_equal(function(x), expected)
        assert jax.grad(doubled)(1.0) == 2
        assert jax.jit(jax.grad(doubled))(1.0) == 2
        # Nothing of the arguments is traced here, but the call is.
        assert jnp.array_equal(jax.jit(lambda: doubled(x))(), expected)

    def test_options_reach_the_compiler_unless_a_level_is_set(self, monkeypatch):
        monkeypatch.setenv("XLA_FLAGS", "")
        refused = {"no_such_option": True}
        monkeypatch.setattr("delucax._jax._compilation._OPTIONS", refused)
        function = quickly_compiled(lambda x: x + 1)
        with pytest.raises(jax.errors.JaxRuntimeError, match="no_such_option"):
            function(1.0)
        monkeypatch.setenv("XLA_FLAGS", "--xla_backend_optimization_level=3")
        assert function(1.0) == 2
