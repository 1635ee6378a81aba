"""Silverbox: an electronic oscillator with a spring that hardens.

The file is `silverbox/SNLS80mV.csv.gz`, with the columns `V1` (input) and `V2` (output)
in V at 610.35 Hz. The splits are those of `nonlinear_benchmarks`: an arrow, whose
amplitude grows beyond all that is fitted, and a multisine, of which the first three
quarters are for estimation.
"""

import gzip
import shutil
import tempfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

import delucax as dlx
from delucax.training import sysid


UNIT, LIMITS = "mV", {"multisine": 0.27, "arrow": 0.35}
FILE = "silverbox/SNLS80mV.csv.gz"
RATE = 610.35
PARAMETERS = ("cubic", "damping", "frequency", "gain", "offset", "square")
ARROW, MULTISINE, SHARE, INSIDE = slice(100, 40575), slice(40650, 127400), 0.75, 32000
FITTED = 16000
"""The samples that are fitted, of the 65,062 for estimation: two minutes suffice."""
# In mV, about the largest output.
_UNIT = 100.0


class Spring(dlx.AbstractSystem):
    """`x'' / f^2 + 2 d x' / f + x + cubic terms = gain u + offset`, with the velocity
    in units of f, so that both states are of one size."""

    state_names, control_names = ("position", "velocity"), ("input",)
    frequency: Array = dlx.parameter(400.0, constraint=dlx.positive)
    damping: Array = dlx.parameter(0.05, constraint=dlx.positive)
    cubic: Array = dlx.parameter(0.1)
    square: Array = dlx.parameter(0.0)
    gain: Array = dlx.parameter(1.0)
    offset: Array = dlx.parameter(0.0)

    def vector_field(self, t, x, u, w):
        z = x[0] / _UNIT
        spring = x[0] + _UNIT * (self.square * z**2 + self.cubic * z**3)
        force = self.gain * u[0] + self.offset - spring - 2 * self.damping * x[1]
        return self.frequency * jnp.stack([x[1], force])

    def observe(self, t, x):
        return x[:1]


def records(data: Path) -> tuple[sysid.Record, dict[str, Any]]:
    """What is fitted, and the tests, in mV."""
    with (
        gzip.open(data / FILE) as packed,
        tempfile.NamedTemporaryFile(suffix=".csv") as plain,
    ):
        shutil.copyfileobj(packed, plain)
        plain.flush()
        raw = sysid.read_csv(plain.name, outputs="V2", controls="V1", dt=1 / RATE)
    scaled = lambda part: sysid.Record(
        1e3 * part.outputs, 1e3 * part.controls, dt=1 / RATE, hold="cubic"
    )
    arrow, (estimation, test) = raw[ARROW], raw[MULTISINE].split(SHARE)
    tests = dict(multisine=test, arrow=arrow, inside=arrow[:INSIDE])
    tests = {name: scaled(part) for name, part in tests.items()}
    return scaled(estimation[:FITTED]), tests


def fitted(record: sysid.Record, seed: int) -> Any:
    """Physics alone, and with a network of the force."""
    guess = dlx.Discretized(Spring(), 1 / RATE)
    names = [f"system.{name}" for name in PARAMETERS]
    options: Any = dict(x0=first(record), window=200, max_steps=20, width=6)
    options |= dict(corrected=["velocity"], spreads=[0.03, 0.3])
    return sysid.grey_box(guess, record, names, key=jax.random.key(seed), **options)


def first(record: sysid.Record) -> Any:
    """A guess of the first state."""
    return [float(record.outputs[0, 0]), 0.0]
