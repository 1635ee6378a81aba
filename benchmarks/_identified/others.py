"""Problems of which the user has the files: no physics, so a linear model and a neural
state-space model.

A folder `DIR/others/NAME` has `estimation.csv` and tests `test*.csv`, with columns
`u...` and `y...`, a row for each sample. The sampling is uniform.
"""

import csv
from pathlib import Path
from typing import Any, NamedTuple

from delucax.training import sysid


FOLDER = "others"
STATES = 4


class Folder(NamedTuple):
    """A problem of these files."""

    name: str
    UNIT: str = ""
    LIMITS: dict[str, float] = {}

    def records(self, data: Path) -> tuple[sysid.Record, dict[str, Any]]:
        """What is fitted, and the tests."""
        tests = sorted((data / self.name).glob("test*.csv"))
        if not tests:
            raise ValueError(f"{data / self.name} must have a test.csv.")
        return _read(data / self.name / "estimation.csv"), {
            file.stem: _read(file) for file in tests
        }

    def first(self, record: sysid.Record) -> Any:
        """As many zeros as states."""
        return [0.0] * STATES


def names(data: Path) -> list[str]:
    """The problems that are there."""
    files = sorted(data.glob(f"{FOLDER}/*/estimation.csv"))
    return [f"{FOLDER}/{file.parent.name}" for file in files]


def _read(file: Path) -> sysid.Record:
    with file.open() as lines:
        columns = [name.strip() for name in next(csv.reader(lines), [])]
    of = lambda letter: [name for name in columns if name.startswith(letter)]
    return sysid.read_csv(file, outputs=of("y"), controls=of("u"), dt=1.0)
