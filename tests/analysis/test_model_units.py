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
    A[1] = -1e8, -1e3
    assert_close(an.dcgain(system([1.0, 0.0])), [[1e-8]], rtol=1e-5)
    A = np.diag([-1e-4, -1e4])
    gain = an.dcgain(LinearSystem(A, np.ones((2, 1))))
    assert_close(gain, [[1e4], [1e-4]], rtol=1e-5)
