"""Precision comes from JAX_ENABLE_X64; both are run.

Compiled programs are kept in `.cache/programs` for the next run.
JAX_COMPILATION_CACHE_DIR names another folder; JAX_ENABLE_COMPILATION_CACHE=false keeps
none.
"""

import gc
import sys
from pathlib import Path

import jax
import pytest


sys.path.insert(0, str(Path(__file__).parent))

# Tracing makes many objects that live on, and each collection looks at all of them: an
# eighth of the time of the tests with Python's own threshold.
gc.set_threshold(200_000, 50, 100)


def pytest_addoption(parser):
    words = "of the pages, run only the blocks that show something, and their needs"
    parser.addoption("--only-outputs", action="store_true", help=words)


@pytest.fixture(autouse=True, scope="session")
def kept_programs():
    from delucax._programs import keep_programs

    keep_programs(otherwise=Path(__file__).parents[1] / ".cache/programs")


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
