"""Files of results that are made part by part."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np


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
