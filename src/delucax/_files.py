"""Checks of paths, and atomic writes."""

import contextlib
import os
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

from ._message import shortened


def as_path(value: Any, name: str, where: str) -> Path:
    """`value` as a path, or an error if it is not a path."""
    if not isinstance(value, str | os.PathLike):
        raise ValueError(
            f"{where}: {name} must be the path of a file, got {shortened(value)}."
        )
    return Path(value)


@contextlib.contextmanager
def replaced(path: Path) -> Iterator[BinaryIO]:
    """A temporary file beside `path`, which replaces it at the end of the block.

    If the block raises, `path` stays unchanged. The content is on the disk before the
    file is renamed, so a crash leaves either the old or the new file. A device, such as
    `/dev/stdout`, is written to directly.

    **Raises:** `OSError` if the file cannot be written.
    """
    if path.exists() and not path.is_file():
        with open(path, "wb") as file:
            yield file
        return
    # The file that a link points to is replaced, not the link.
    path = path.resolve()
    beside = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        with open(beside, "xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        if path.exists():
            shutil.copymode(path, beside)
        os.replace(beside, path)
    except BaseException:
        with contextlib.suppress(OSError):
            beside.unlink()
        raise
