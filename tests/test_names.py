"""Each name of ours that a page writes in its text exists."""

import importlib
import importlib.util
import re
from pathlib import Path

import pytest
from helpers import name_of, once, pages_of


pytestmark = once

ROOT = Path(__file__).parents[1]
PAGES = pages_of(ROOT)
NAME = re.compile(r"\b(?:dlx|delucax)((?:\.[A-Za-z_]\w*)+)")
CODE = re.compile(r"^( *)```.*?^\1``` *$", re.DOTALL | re.MULTILINE)


def _names(text):
    """The dotted names in backticks or in links to the reference."""
    plain = CODE.sub("", text)
    marked = re.findall(r"`([^`\n]+)`|\]\[([\w.]+)\]", plain)
    return {m for pair in marked for part in pair for m in NAME.findall(part)}


def _exists(dotted):
    found = importlib.import_module("delucax")
    path, parts = "delucax", dotted.strip(".").split(".")
    for i, part in enumerate(parts):
        path = f"{path}.{part}"
        if not hasattr(found, part):
            try:
                found = importlib.import_module(path)
                continue
            except ModuleNotFoundError:
                return False
            except ImportError:  # an extra that the tests do without
                source = Path(importlib.util.find_spec(path).origin).read_text()
                return all(f" as {name}" in source for name in parts[i + 1 :])
        found = getattr(found, part)
    return True


def test_what_is_looked_for():
    text = "`dlx.riccati.dare(A, B)` and [`x`][delucax.nothing]\n```\ndlx.hidden\n```\n"
    assert _names(text) == {".riccati.dare", ".nothing"}
    assert _exists(".riccati.dare") and not _exists(".nothing")
    sb3 = ".interop.stable_baselines3"
    assert _exists(f"{sb3}.SB3VecEnv") and not _exists(f"{sb3}.Nothing")


@pytest.mark.parametrize("page", PAGES, ids=[name_of(ROOT, page) for page in PAGES])
def test_names_exist(page):
    missing = sorted(
        f"delucax{name}" for name in _names(page.read_text()) if not _exists(name)
    )
    assert not missing
