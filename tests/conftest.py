"""Precision comes from JAX_ENABLE_X64; both are run."""

import sys
from pathlib import Path

import jax
import pytest


sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture
def key():
    return jax.random.key(0)
