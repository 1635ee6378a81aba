"""A study in stages: each is written when it is done, and read the next time."""

import csv
import io
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..._files import replaced
from ..._module import load, save


class Stages:
    """A folder that a study is written to, and how far it is.

    **Arguments:**

    - `out`: the folder.
    - `settings`: what the study is of; a folder holds one study.
    - `say`: what to do with a line of text.
    - `progress`: whether trainings show a bar.

    **Raises:** `ValueError` if the folder holds a study with other settings, or one
        whose settings are damaged.
    """

    def __init__(
        self,
        out: Path,
        settings: dict[str, Any],
        say: Callable[[str], Any],
        progress: bool,
    ):
        self.out, self.say, self.progress = out, say, progress
        self.seconds: dict[str, float] = {}
        known = out / "settings.json"
        (out / "controllers").mkdir(parents=True, exist_ok=True)
        if known.exists():
            _check_settings(known, settings)
        else:
            self.write("settings.json", json.dumps(settings, indent=1) + "\n")

    def training(
        self, name: str, words: str, train: Callable[..., Any], *args: Any
    ) -> Any:
        """A stage that trains: what `train` returns for the arguments and the options
        of `fit`. Its checkpoints are kept until it is done."""
        options = dict(checkpoint=self.out / f"{name}.fit", progress=self.progress)
        return self.stage(name, words, lambda: train(*args, **options))

    def stage(self, name: str, words: str, make: Callable[[], Any]) -> Any:
        """What `make` returns, or what it returned before, from its file."""
        path = self.out / f"{name}.dlx"
        if path.exists():
            stored = load(path)
            self.seconds[name] = float(stored["seconds"])
            self.say(f"{words}: found ({self.seconds[name]:.0f} s then)")
            return stored["value"]
        began = time.perf_counter()
        self.say(f"{words} ...")
        value = make()
        self.seconds[name] = time.perf_counter() - began
        save(path, {"value": value, "seconds": self.seconds[name]})
        for left in self.out.glob(f"{name}.fit*"):
            left.unlink()
        self.say(f"  {self.seconds[name]:.0f} s")
        return value

    def write(self, name: str, text: str) -> None:
        """Write a file whole or not at all."""
        with replaced(self.out / name) as file:
            file.write(text.encode())

    def write_table(self, name: str, rows: list[dict[str, Any]]) -> None:
        """Write rows to a file of comma-separated values."""
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)
        self.write(name, text.getvalue())


def _check_settings(known: Path, settings: dict[str, Any]) -> None:
    """Raise unless a study was begun with the same settings."""
    try:
        stored = json.loads(known.read_text())
    except ValueError as error:
        raise ValueError(
            f"lung: '{known}' is damaged ({error}); delete the folder, or name "
            "another one with out."
        ) from None
    given = json.loads(json.dumps(settings))
    for name in sorted(given.keys() | stored.keys()):
        if given.get(name) != stored.get(name):
            raise ValueError(
                f"lung: '{known.parent}' holds a study with other settings: {name} is "
                f"{stored.get(name)} there and {given.get(name)} here. Delete the "
                "folder, or name another one with out."
            )
