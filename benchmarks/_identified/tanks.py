"""Cascaded tanks: two tanks, the lower of which is measured, and both overflow.

The file is `cascaded_tanks/dataBenchmark.csv`, with the columns `uEst`, `yEst`, `uVal`
and `yVal`: 1,024 samples each for estimation and for the test, every 4 s.
"""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

import delucax as dlx
from delucax.training import sysid


UNIT, LIMITS = "V", {"test": 0.27}
FILE = "cascaded_tanks/dataBenchmark.csv"
DT = 4.0
PARAMETERS = ("depth", "leak", "lower", "offset", "pump", "spill", "through", "upper")
# The height at which the tanks overflow, in volts of the sensor, which is saturated
# there.
_FULL = 10.0
_SOFT = 1e-2


class Tanks(dlx.AbstractSystem):
    """Bernoulli's law in both tanks, whose overflow goes partly into the lower one. The
    pump has an offset, and the outlet of the lower tank may be below its zero."""

    state_names, control_names = ("high", "low"), ("pump",)
    upper: Array = dlx.parameter(0.05, constraint=dlx.positive)
    through: Array = dlx.parameter(0.05, constraint=dlx.positive)
    lower: Array = dlx.parameter(0.05, constraint=dlx.positive)
    pump: Array = dlx.parameter(0.05, constraint=dlx.positive)
    spill: Array = dlx.parameter(0.3, constraint=dlx.positive)
    leak: Array = dlx.parameter(0.05, constraint=dlx.positive)
    offset: Array = dlx.parameter(0.0)
    depth: Array = dlx.parameter(0.0)

    def vector_field(self, t, x, u, w):
        # Smooth where a tank is empty or full.
        above = lambda v: (v + jnp.sqrt(v**2 + _SOFT)) / 2
        flow, excess = jnp.sqrt(above(x[0])), above(x[0] - _FULL)
        into = self.pump * (u[0] + self.offset)
        out = self.lower * jnp.sqrt(above(x[1] + self.depth))
        low = self.through * flow + self.leak * excess - out
        return jnp.stack(
            [
                into - self.upper * flow - self.spill * excess,
                low - self.spill * above(x[1] - _FULL),
            ]
        )

    def observe(self, t, x):
        return x[1:]


def records(data: Path) -> tuple[sysid.Record, dict[str, Any]]:
    """What is fitted, and the tests."""
    read = lambda half: sysid.read_csv(
        data / FILE, outputs=f"y{half}", controls=f"u{half}", dt=DT
    )
    return read("Est"), {"test": read("Val")}


def fitted(record: sysid.Record, seed: int) -> Any:
    """Physics alone, and with a network."""
    guess = dlx.Discretized(Tanks(), DT)
    names = [f"system.{name}" for name in PARAMETERS]
    options: Any = dict(x0=first(record), window=None, max_steps=30)
    return sysid.grey_box(guess, record, names, key=jax.random.key(seed), **options)


def first(record: sysid.Record) -> Any:
    """A guess of the first state: both tanks alike."""
    level = float(record.outputs[0, 0])
    return [level, level]
