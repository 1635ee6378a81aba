"""Stores results in a file as they arrive: a line of JSON for each case.

The first line names the format. A line `run` says how the cases after it were made. A
line `case` holds the results of a case for some of its seeds. A line is written by one
call. A line that was cut short is dropped when the file is next opened, so a process
may be killed at any moment. If a case ran again, its last line counts.
"""

import contextlib
import json
import os
from pathlib import Path
from typing import Any

from .._check import as_path
from .._provenance import VERSIONS


try:
    import fcntl
except ImportError:  # Windows has no such lock: two runs could write to one file
    fcntl = None

_FORMAT = "delucax-results"
_VERSION = 1
_HEADER = {"format": _FORMAT, "version": _VERSION}
# The columns of the table that come from a line `case` and from a line `run`.
CASE_COLUMNS = "error", "traceback", "compile_seconds", "run_seconds", "device", "hash"
RUN_COLUMNS = ("date", "commit", "dirty", "dtype")
_KEYS = ("experiment", "case", "seed", "status", "versions")
_NEEDED = {"run", "parameters", "status", "error", "device"}
PASSED = ("passed", "passed unexpectedly")
FAILED = ("failed", "passed unexpectedly")
RESERVED = (*_KEYS, *CASE_COLUMNS, *RUN_COLUMNS, *VERSIONS)
"""The names that neither a parameter nor a result can have."""


class Store:
    """The lines of a results file. Without a path they are only kept in memory.

    `cases` maps (experiment, case) to a dictionary with `hash`, `order` and `seeds`.
    `seeds` maps each seed to its latest record: a line with the values of this seed.
    """

    def __init__(self, path: Any, where: str):
        self.where = where
        self.path = None if path is None else as_path(path, "store", where)
        self.cases: dict[tuple[str, str], dict[str, Any]] = {}
        self.runs: dict[int, dict[str, Any]] = {}
        self._file: int | None = None
        # The length of the file when it was read, and of its whole lines.
        self._size = self._whole = 0
        if self.path is not None and self.path.exists():
            self._read(self.path)

    def _error(self, why: str) -> ValueError:
        return ValueError(f"{self.where}: '{self.path}' {why}")

    def _read(self, path: Path) -> None:
        if path.is_dir():
            raise self._error("is a folder, not a results file.")
        if not path.is_file():  # a device may have no end
            raise self._error("is not a regular file.")
        try:
            content = path.read_bytes()
        except OSError as error:
            where = f"{self.where}: '{path}'"
            raise type(error)(f"{where} cannot be read: {error}") from error
        self._size = len(content)
        lines = content.split(b"\n")
        # The last line has no newline if its process was killed.
        self._whole = len(content) - len(lines.pop())
        if lines or not _line(_HEADER).startswith(content):
            self._check_header(lines[0] if lines else content)
        for number, line in enumerate(lines[1:], 2):
            try:
                self._add(json.loads(line))
            except (ValueError, KeyError, TypeError, AttributeError) as error:
                raise ValueError(
                    f"{self.where}: line {number} of '{path}' is damaged; remove it "
                    "to run its case again."
                ) from error

    def _check_header(self, line: bytes) -> None:
        try:
            header = json.loads(line)
            if header["format"] != _FORMAT:
                raise KeyError
            version = header["version"]
        except (ValueError, KeyError, TypeError):
            raise self._error("is not a results file of delucax.") from None
        if version != _VERSION:
            raise self._error(
                f"has format {version}, and this version of delucax reads and writes "
                f"{_VERSION}; it is left as it is. Write to another file, or use the "
                "delucax that wrote it."
            )

    def _add(self, record: dict[str, Any]) -> None:
        if record["kind"] == "run":
            self.runs[record["run"]] = record
            return
        key = record["experiment"], record["case"]
        values, seeds = record["values"], record["seeds"]
        is_whole = _NEEDED <= record.keys()
        if not is_whole or any(len(column) != len(seeds) for column in values.values()):
            raise ValueError
        entry = self.cases.get(key)
        if entry is None or entry["hash"] != record["hash"]:
            entry = self.cases[key] = {"hash": record["hash"], "seeds": {}}
        entry["order"] = tuple(record["order"])
        for place, seed in enumerate(seeds):
            own = {name: column[place] for name, column in values.items()}
            entry["seeds"][seed] = {**record, "seed": seed, "values": own}

    def stored(self, key: tuple[str, str], hash: str) -> dict[int, dict[str, Any]]:
        """The results of a case by seed, if its code and values have this hash."""
        entry = self.cases.get(key, {"hash": None})
        return entry["seeds"] if entry["hash"] == hash else {}

    def open(self) -> None:
        """Open for writing: lock the file and cut off a partial last line."""
        if self.path is None or self._file is not None:
            return
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = os.open(self.path, os.O_CREAT | os.O_RDWR | os.O_APPEND, 0o666)
        except OSError as error:
            raise self._unwritable(error) from error
        if fcntl is not None:
            try:
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                self.close()
                raise self._error("is being written by another run.") from error
        if os.fstat(self._file).st_size != self._size:
            self.close()
            raise self._error("was written by another run meanwhile; call again.")
        if self._size > self._whole:
            os.ftruncate(self._file, self._whole)
        if self._whole == 0:
            self._write(_HEADER)

    def write_run(self, provenance: dict[str, Any]) -> int:
        """Write the provenance of the cases that follow; returns its number."""
        number = max(self.runs, default=-1) + 1
        self.append({"kind": "run", "run": number, **provenance})
        return number

    def append(self, record: dict[str, Any]) -> None:
        """Add a line to the file and to `cases`."""
        if self.path is not None:
            self._write(record)
        self._add(record)

    def _write(self, record: dict[str, Any]) -> None:
        line = _line(record)
        assert self._file is not None
        try:
            written = os.write(self._file, line)
            while written < len(line):
                written += os.write(self._file, line[written:])
        except OSError as error:
            with contextlib.suppress(OSError):
                os.ftruncate(self._file, self._whole)
            raise self._unwritable(error) from error
        self._whole += len(line)

    def _unwritable(self, error: OSError) -> OSError:
        kept = sum(len(entry["seeds"]) for entry in self.cases.values())
        return type(error)(
            error.errno,
            f"{self.where}: '{self.path}' cannot be written ({error.strerror}); the "
            f"{kept} results so far are kept, and the same call continues from them",
        )

    def close(self) -> None:
        """Release the lock, so that others can write."""
        if self._file is not None:
            with contextlib.suppress(OSError):
                os.fsync(self._file)
            os.close(self._file)
            self._file = None


def _line(record: dict[str, Any]) -> bytes:
    return (json.dumps(record, separators=(",", ":")) + "\n").encode()
