"""Compiled programs on disk: JAX's persistent cache, in a folder of delucax.

The command line, the tests and the benchmarks use it. The library does not, because the
cache is a setting of the whole process.
"""

import contextlib
import os
import sys
import tempfile
import warnings
from pathlib import Path

import jax


_LIMIT = 2**30
"""The largest size of a folder, in bytes, when a process starts."""


def keep_programs(
    folder: str | Path | None = None, otherwise: Path | None = None
) -> Path | None:
    """Keep the programs that this process and its child processes compile in a folder.

    All programs are kept, also those that compile quickly, unless
    `JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS` is set. If the folder is too large, the
    programs that were not used for the longest time are deleted. The folder in
    `JAX_COMPILATION_CACHE_DIR` may be shared, so nothing is deleted there.

    **Arguments:**

    - `folder`: the folder; that in `JAX_COMPILATION_CACHE_DIR` by default.
    - `otherwise`: the folder if neither is given; one in the user's caches by default.

    **Returns:** the folder, or `None` if nothing is kept: with
    `JAX_ENABLE_COMPILATION_CACHE=false`, or if the folder cannot be written to, which
    gives a warning.
    """
    if not jax.config.jax_enable_compilation_cache:
        return None
    theirs = None if folder else jax.config.jax_compilation_cache_dir
    kept: str | Path | None = folder or theirs or otherwise
    try:
        kept = Path(kept or user_folder()).absolute()
        kept.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=kept).close()
    except (OSError, RuntimeError) as error:  # a RuntimeError if there is no home
        forget_programs()
        warnings.warn(f"compiled programs are not kept on disk: {error}", stacklevel=2)
        return None
    if not theirs:
        prune(kept, _LIMIT)
    _set("jax_compilation_cache_dir", str(kept))
    threshold = "jax_persistent_cache_min_compile_time_secs"
    if threshold.upper() not in os.environ:
        _set(threshold, 0.0)
    return kept


def forget_programs() -> None:
    """Keep no compiled programs on disk, and do not look for any there."""
    _set("jax_enable_compilation_cache", False)


def user_folder(kind: str = "programs") -> Path:
    """The folder of delucax among the user's caches, for programs by default."""
    home = Path.home()
    if sys.platform == "win32":
        name, caches = "LOCALAPPDATA", home / "AppData" / "Local"
    elif sys.platform == "darwin":
        name, caches = "XDG_CACHE_HOME", home / "Library" / "Caches"
    else:
        name, caches = "XDG_CACHE_HOME", home / ".cache"
    return Path(os.environ.get(name) or caches) / "delucax" / kind


def _set(name: str, value: str | float | bool) -> None:
    """Set an option of JAX, in this process and its child processes."""
    jax.config.update(name, value)
    os.environ[name.upper()] = str(value)


def prune(folder: Path, limit: int) -> None:
    """If the programs exceed `limit` bytes, delete some until three quarters are left.

    JAX's own limit needs another package, and locks every program that it reads.
    """
    programs = []
    for path in folder.glob("*-cache"):
        with contextlib.suppress(OSError):  # another process may delete it
            about = path.stat()
            used = max(about.st_atime, about.st_mtime)
            programs.append((used, about.st_size, path))
    total = sum(size for _, size, _ in programs)
    if total <= limit:
        return
    for _, size, path in sorted(programs):
        if total <= 0.75 * limit:
            break
        with contextlib.suppress(OSError):
            path.unlink()
        total -= size
