"""Compiled programs hold memory maps, whose number is limited in each process."""

from pathlib import Path

import jax


_IN_USE = Path("/proc/self/maps")
_LIMIT = Path("/proc/sys/vm/max_map_count")


def release_programs(limit: int | None = None) -> bool:
    """Forget all compiled programs if they hold too many memory maps.

    A program that XLA has compiled holds tens of the maps that Linux allows a process,
    65,530 by default, and a compilation that finds none left ends in a
    segmentation fault. Programs that are still needed are compiled anew. Elsewhere than
    on Linux nothing is done.

    `limit` is how many maps are too many, by default half of what is allowed. Returns
    whether the programs were forgotten.
    """
    try:
        if limit is None:
            limit = int(_LIMIT.read_text()) // 2
        used = _IN_USE.read_bytes().count(b"\n")
    except (OSError, ValueError):
        return False
    if used <= limit:
        return False
    jax.clear_caches()
    return True
