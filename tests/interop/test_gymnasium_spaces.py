"""The spaces of our tasks in Gymnasium's interface."""

import gymnasium
import numpy as np
import pytest
from helpers import once

import delucax.interop.gymnasium as interop


pytestmark = once

THEIRS = [
    "Acrobot-v1",
    "CartPole-v1",
    "MountainCar-v0",
    "MountainCarContinuous-v0",
    "Pendulum-v1",
]


@pytest.mark.parametrize("id", THEIRS)
def test_spaces_are_gymnasiums(id):
    ours = gymnasium.make(f"delucax/{id}")
    theirs = gymnasium.make(id)
    assert ours.action_space == theirs.action_space
    assert ours.observation_space == theirs.observation_space


def test_spaces_end_where_the_physics_does():
    low = interop.make("reacher", goal=(0.0, 1.5)).observation_space.low
    largest = np.finfo(np.float32).max
    expected = [-1, -1, -1, -1, -largest, -largest, -2, -3.5]
    np.testing.assert_allclose(low, np.array(expected, np.float32), rtol=1e-6)
    heading = interop.make("kinematic_bicycle").observation_space
    np.testing.assert_array_equal(heading.high == largest, [1, 1, 0, 0, 1])
    np.testing.assert_array_equal(heading.high[2:4], 1.0)
