"""Precision comes from JAX_ENABLE_X64; both are run."""

import gc
import sys
from pathlib import Path

import jax
import pytest


sys.path.insert(0, str(Path(__file__).parent))

# Tracing makes many objects that live on, and each collection looks at all of them: an
# eighth of the time of the tests with Python's own threshold.
gc.set_threshold(200_000, 50, 100)


@pytest.fixture(autouse=True, scope="module")
def released_programs():
    """Thousands of programs are compiled."""
    # Not before the tests' import hook is there.
    from delucax.experiments._execute import clear_programs

    yield
    clear_programs()


@pytest.fixture
def key():
    return jax.random.key(0)
