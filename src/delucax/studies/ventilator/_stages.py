"""The sizes of a study, and the folder that keeps its finished stages."""

import csv
import io
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from ..._files import replaced
from ..._module import load, save


TRAIN_PIPS = (10.0, 15.0, 20.0, 25.0, 30.0, 35.0)
"""The peak pressures at which controllers are trained [cmH2O]."""
TEST_PIPS = (12.5, 17.5, 22.5, 27.5, 32.5)
SHOWN = 27.5
"""The peak pressure of the breaths in the figures, one of `TEST_PIPS` [cmH2O]."""
INSPIRATION = 29
"""The number of steps of an inspiration, from which lungs are learned."""
BREATH = 100
"""The number of steps of a whole breath."""
ABORT = 60.0
"""The pressure that no controller may exceed [cmH2O]."""
LUNGS = tuple((R, C) for R in (5.0, 20.0, 50.0) for C in (10.0, 20.0, 50.0))
"""The lungs of the public data set, (R, C)."""
BETWEEN = ((10.0, 15.0), (10.0, 35.0), (35.0, 15.0), (35.0, 35.0))
"""Lungs between those of the training, (R, C)."""
SENSOR_DELAY = 2
"""The delay of the sensor, in samples."""
NOISE = 0.2
"""The standard deviation of the noise of the sensor [cmH2O]."""


class Size(NamedTuple):
    """The sizes of a study; the full one by default.

    - `shared_network`: the hidden units of the network for all lungs, and the number of
        controls among its inputs.
    - `tuned`: the number of random PIDs with feed-forward.
    - `extras`: whether to run the rows that the claims do not need.
    """

    breaths: int = 480
    teacher_steps: int = 1000
    simulator_steps: int = 1200
    physics_steps: int = 200
    controller_steps: int = 400
    shared_steps: int = 500
    shared_network: tuple[int, int] = (48, 6)
    pid_steps: int = 150
    tuned: int = 2000
    bound_steps: int = 500
    seeds: int = 3
    noises: int = 5
    lungs: tuple[tuple[float, float], ...] = LUNGS
    between: tuple[tuple[float, float], ...] = BETWEEN
    physics: tuple[str, ...] = (
        "single compartment",
        "balloon",
        "double compartment",
        "neural ODE",
        "grey box",
    )
    extras: bool = True
    sensor_delay: int = SENSOR_DELAY


FULL = Size()
SMALL = Size(
    breaths=96,
    teacher_steps=0,
    simulator_steps=600,
    physics_steps=40,
    controller_steps=100,
    shared_steps=250,
    shared_network=(32, 4),
    pid_steps=20,
    tuned=0,
    bound_steps=0,
    seeds=1,
    noises=2,
    lungs=((5.0, 20.0), (50.0, 20.0)),
    between=BETWEEN[2:3],
    physics=("single compartment",),
    extras=False,
)


@dataclass(frozen=True)
class Stages:
    """The folder of a study, which keeps its finished stages.

    **Arguments:**

    - `out`: the folder.
    - `settings`: the settings of the study. A folder holds one study.
    - `say`: a function that gets each line of text.
    - `progress`: whether trainings show a progress bar.

    **Raises:** `ValueError` if the folder holds a study with other settings, or with
        damaged settings.
    """

    out: Path
    settings: dict[str, Any]
    say: Callable[[str], Any]
    progress: bool
    seconds: dict[str, float] = field(default_factory=dict)

    def __post_init__(self):
        known = self.out / "settings.json"
        text = json.dumps(self.settings, indent=1) + "\n"
        (self.out / "controllers").mkdir(parents=True, exist_ok=True)
        if not known.exists():
            self.write("settings.json", text)
        instead = "delete the folder, or name another one with out."
        try:
            stored, given = json.loads(known.read_text()), json.loads(text)
        except ValueError as error:
            words = f"lung: '{known}' is damaged ({error}); {instead}"
            raise ValueError(words) from None
        for name in sorted(given.keys() | stored.keys()):
            if given.get(name) != stored.get(name):
                raise ValueError(
                    f"lung: '{self.out}' holds a study with other settings: {name} is "
                    f"{stored.get(name)} there and {given.get(name)} here; {instead}"
                )

    def training(
        self, name: str, words: str, train: Callable[..., Any], *args: Any
    ) -> Any:
        """Run a stage that calls `train` with `args` and options of `fit`. Its
        checkpoints are kept until it is done."""
        options = dict(checkpoint=self.out / f"{name}.fit", progress=self.progress)
        return self.stage(name, words, lambda: train(*args, **options))

    def stage(self, name: str, words: str, make: Callable[[], Any]) -> Any:
        """The value of `make()`, or the stored value if the stage was done before."""
        path = self.out / f"{name}.dlx"
        if path.exists():
            stored = load(path)
            self.seconds[name] = float(stored["seconds"])
            self.say(f"{words}: done before, in {self.seconds[name]:.0f} s")
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
        """Write a file, completely or not at all."""
        with replaced(self.out / name) as file:
            file.write(text.encode())

    def write_table(self, name: str, rows: list[dict[str, Any]]) -> None:
        """Write rows to a file of comma-separated values."""
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)
        self.write(name, text.getvalue())
