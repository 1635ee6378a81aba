"""Room for compiled programs in a long run."""

from pathlib import Path

import jax


_TAKEN = Path("/proc/self/maps")
_LIMIT = Path("/proc/sys/vm/max_map_count")


def make_room(limit: int | None = None) -> bool:
    """Let all compiled programs go if they take too many memory maps.

    A program that XLA has compiled holds tens of the maps that Linux allows a process,
    65,530 unless it is told otherwise, and the compilation that finds none left is a
    segmentation fault. Programs that are still needed are compiled anew. Elsewhere than
    on Linux nothing is done.

    `limit` is how many maps are too many, by default half of what is allowed. Returns
    whether the programs were let go.
    """
    try:
        if limit is None:
            limit = int(_LIMIT.read_text()) // 2
        taken = _TAKEN.read_bytes().count(b"\n")
    except (OSError, ValueError):
        return False
    if taken <= limit:
        return False
    jax.clear_caches()
    return True
