"""`import delucax`: it compiles and runs nothing, and imports the catalogue later."""

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import once

import delucax as dlx


pytestmark = once

_IMPORT = """
import jax
from jax._src import xla_bridge

heard = []
listen = jax.monitoring.register_event_duration_secs_listener
listen(lambda name, *_, **__: heard.append(name))
import delucax
assert not xla_bridge.backends_are_initialized(), "a device was asked for"
assert not heard, heard
"""


def test_import_compiles_and_runs_nothing():
    subprocess.run([sys.executable, "-c", _IMPORT], check=True)


@pytest.mark.parametrize("package", ["", ".costs", ".environments", ".systems"])
def test_what_is_imported_later_is_what_type_checkers_read(package):
    module = importlib.import_module(f"delucax{package}")
    source = ast.parse(Path(module.__file__).read_text())
    (block,) = [node for node in source.body if isinstance(node, ast.If)]
    imports = [node for node in block.body if isinstance(node, ast.ImportFrom)]
    names = {alias.name for node in imports for alias in node.names}
    assert names <= set(dir(module))
    assert all(getattr(module, name) is not None for name in names)


def test_an_unknown_name():
    with pytest.raises(AttributeError, match=r"'delucax.systems' has no .*'Pendlum'"):
        dlx.systems.Pendlum  # noqa: B018
