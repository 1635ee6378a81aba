"""A plant in other units of time, states, inputs and outputs is the same plant."""

import numpy as np
from helpers import assert_close

import delucax as dlx
from delucax.systems import LinearSystem


an = dlx.analysis


def test_plants_of_fast_oscillators():
    """As they are usually written."""
    A = np.array([[0.0, 1.0], [-2e6, -3e3]])
    B = np.array([[0.0], [1.0]])
    system = lambda C: LinearSystem(A, B, np.array([C]))
    assert_close(an.zeros(system([5e3, 1.0])), [-5e3], rtol=1e-5)
    assert an.zeros(system([1.0, 0.0])).shape == (0,)
