"""Files of results that are made part by part."""

import argparse
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benchmarks._machine import describe, keep_programs, limit_cores


def updated(path: Path, change: Callable[[dict[str, Any]], dict[str, Any]]) -> Any:
    """Write what `change` makes of the file's content as it is now: other parts may
    have been written while this one ran."""
    before = json.loads(path.read_text()) if path.exists() else {}
    after = plain(before | change(before))
    path.write_text(json.dumps(after, indent=1) + "\n")
    return after


def plain(value: Any) -> Any:
    """With `None` for what JSON has no word for."""
    if isinstance(value, dict):
        return {key: plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def run_in_parts(
    program: str,
    parts: Mapping[str, Callable[[bool], Any]],
    about: dict[str, Any],
    results: Path,
    draw: Callable[[dict[str, Any]], Any],
) -> None:
    """The command of a study in float64: run its parts, or one of them again, write
    each when it is done, and draw or judge what they found."""
    parser = argparse.ArgumentParser(prog=f"python -m benchmarks.{program}")
    parser.add_argument("--quick", action="store_true", help="small sizes, no file")
    parser.add_argument("--draw", action="store_true", help="from the file alone")
    parser.add_argument("--part", choices=tuple(parts), help="one part alone, again")
    options = parser.parse_args()
    if options.draw:
        draw(json.loads(results.read_text()))
        return
    limit_cores(1)
    keep_programs()
    jax.config.update("jax_enable_x64", True)
    about = {"machine": describe()} | about
    content: dict[str, Any] = {}
    for name in [options.part] if options.part else list(parts):
        found = {name: parts[name](options.quick)}
        if not options.quick:
            content = updated(results, lambda before, found=found: about | found)
    if all(name in content for name in parts):
        draw(content)
        print(f"\nwritten: {results}")
