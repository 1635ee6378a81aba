"""The system of the page on algebraic equations, against Lambert's W function."""

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, tolerance
from scipy.special import lambertw


PAGE = Path(__file__).parents[2] / "docs/algebraic.md"


@pytest.fixture(scope="module")
def system():
    space = {}
    exec(re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.S)[0], space)
    return space["system"]


def exact(system, drop):
    """`i = V / R W(R I / V exp((drop + R I) / V)) - I`."""
    V, I = float(system.thermal_voltage), float(system.saturation_current)
    R = float(system.resistance)
    return V / R * np.real(lambertw(R * I / V * np.exp((drop + R * I) / V))) - I


def test_the_current(system):
    drops = np.linspace(-20.0, 20.0, 81)
    given = jnp.asarray(drops)
    current = jax.vmap(lambda u: system.current(jnp.zeros_like(u), u))(given)
    assert_close(current, exact(system, drops), atol=tolerance(2e-5, 1e-10))


def test_its_derivatives(system):
    for drop in (-1.0, 0.0, 0.3, 5.0):
        f = lambda u: system.current(jnp.zeros_like(u), u)
        u = jnp.asarray(drop)
        slope = (exact(system, drop + 1e-5) - exact(system, drop - 1e-5)) / 2e-5
        near = dict(rtol=tolerance(1e-3, 1e-7), atol=1e-9)
        assert_close(jax.grad(f)(u), slope, **near)
        assert_close(jax.jvp(f, (u,), (jnp.ones_like(u),))[1], slope, **near)
