"""Compiled programs on disk: JAX's persistent cache, in a folder of our own.

The command line, the tests and the benchmarks call this. The library does not, because
the cache is a setting of the process.
"""

import contextlib
import os
import sys
import tempfile
import warnings
from pathlib import Path

import jax


_LIMIT = 2**30
"""Bytes that a folder of ours may hold when a process starts."""


def keep_programs(
    folder: str | Path | None = None, otherwise: Path | None = None
) -> Path | None:
    """Keep what this process, and those that it starts, compile in a folder.

    **Arguments:**

    - `folder`: the folder. By default that of `JAX_COMPILATION_CACHE_DIR`.
    - `otherwise`: the folder if neither is given, by default one in the user's caches.

    Programs are kept however short their compilation was, unless
    `JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS` says otherwise. The programs that were
    not used for longest are deleted if a folder has grown too large; the one that
    `JAX_COMPILATION_CACHE_DIR` names may be shared, and is left as it is.

    **Returns:** the folder, or `None` if nothing is kept: with
    `JAX_ENABLE_COMPILATION_CACHE=false`, or after a warning if the folder cannot be
    written to.
    """
    if not jax.config.jax_enable_compilation_cache:
        return None
    theirs = None if folder else jax.config.jax_compilation_cache_dir
    kept: str | Path | None = folder or theirs or otherwise
    try:
        kept = Path(kept or user_folder()).absolute()
        kept.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=kept).close()
    except (OSError, RuntimeError) as error:  # the latter if there is no home
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
    """Keep no compiled programs on disk, and look for none there."""
    _set("jax_enable_compilation_cache", False)


def user_folder(kind: str = "programs") -> Path:
    """A folder of ours among the user's caches, by default that of programs."""
    home = Path.home()
    if sys.platform == "win32":
        name, caches = "LOCALAPPDATA", home / "AppData" / "Local"
    elif sys.platform == "darwin":
        name, caches = "XDG_CACHE_HOME", home / "Library" / "Caches"
    else:
        name, caches = "XDG_CACHE_HOME", home / ".cache"
    return Path(os.environ.get(name) or caches) / "delucax" / kind


def _set(name: str, value: str | float | bool) -> None:
    """Set an option of JAX, here and in processes that start from here."""
    jax.config.update(name, value)
    os.environ[name.upper()] = str(value)


def prune(folder: Path, limit: int) -> None:
    """Delete programs until three quarters of `limit` are left, if there are more.

    JAX's own limit needs another package, and a lock for every program that is read.
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
