"""Provenance of results: commit, versions, precision, device and date."""

import datetime
import functools
import importlib.metadata
import platform
import subprocess
from pathlib import Path
from typing import Any

import jax


_PACKAGES = ("delucax", "jax", "jaxlib", "equinox", "diffrax", "numpy")
VERSIONS = (*_PACKAGES, "python")
"""The names of the versions in a provenance."""

version = functools.cache(importlib.metadata.version)
"""The version of an installed package."""


def provenance(folder: Path) -> dict[str, Any]:
    """Commit, versions, precision, processor and date of a run of code in `folder`."""
    versions = {name: version(name) for name in _PACKAGES}
    versions["python"] = platform.python_version()
    commit, dirty = _git(folder)
    return {
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "commit": commit,
        "dirty": dirty,
        "dtype": "float64" if jax.config.jax_enable_x64 else "float32",
        "versions": versions,
    }


def device() -> str:
    """The kind and the number of the devices that JAX uses by default."""
    devices = jax.devices()
    kind = devices[0].device_kind
    return kind if len(devices) == 1 else f"{len(devices)} x {kind}"


def _git(folder: Path) -> tuple[str | None, bool | None]:
    """The commit, and whether the files differ from it; `(None, None)` outside of a
    repository. New files count only if they are Python files or notebooks, because a
    run may write other files."""

    def ask(*words: str) -> str:
        how: Any = dict(cwd=folder, timeout=20, check=True)
        done = subprocess.run(["git", *words], capture_output=True, text=True, **how)
        return done.stdout.strip()

    try:
        commit = ask("rev-parse", "HEAD")
        changed = ask("status", "--porcelain", "--untracked-files=all").splitlines()
        code = (".py", ".ipynb", '.py"', '.ipynb"')  # a name with blanks is quoted
        dirty = any(
            not line.startswith("??") or line.endswith(code) for line in changed
        )
        return commit, dirty
    except (OSError, subprocess.SubprocessError):
        return None, None
