"""How often intervals of 95% hold the truth, on simulated records.

Three grey-box plants, each with parameters at a guess that is 20% off and a hidden
state: a pendulum whose angle is measured, two tanks of which the lower one is, and a
stirred reactor whose temperature is. 1,000 records each, with other controls, other
noise and another start. A fit counts if it converged; those that did not are counted.

The limits are for the windows and controls that suit each plant. For information, also
with the default window, and for tanks of which the upper one seldom overflows.
"""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array

import delucax as dlx
from benchmarks._identified.tanks import Tanks
from delucax.training import sysid


RECORDS, STEPS = 1000, 200
LIMITS = 92.5, 97.5
"""Percent."""
FAILURES = 1.0
"""Percent, at most."""
DEFAULT = 20
"""The window of `sysid.physical` by default."""
_OFF = 1.2


class Pendulum(dlx.systems.Pendulum):
    """The angle alone is measured."""

    def observe(self, t, x):
        return x[:1]


class Reactor(dlx.AbstractSystem):
    """A stirred tank with a cooling jacket: `c' = 1 - c - r` and
    `T' = 350 - T + 209.2 r + UA (u - T)` with `r = k exp(-8750 / T) c`, of which the
    temperature is measured."""

    state_names, control_names = ("c", "T"), ("jacket",)
    k: Array = dlx.parameter(7.2e10, constraint=dlx.positive)
    UA: Array = dlx.parameter(2.092, constraint=dlx.positive)

    def vector_field(self, t, x, u, w):
        rate = self.k * jnp.exp(-8750 / x[1]) * x[0]
        heat = 350 - x[1] + 209.2 * rate + self.UA * (u[0] - x[1])
        return jnp.stack([1 - x[0] - rate, heat])

    def observe(self, t, x):
        return x[1:]


def plants() -> dict[str, dict[str, Any]]:
    """The truth, what is estimated, where records begin, their controls, and the window
    of the fit, with the rows that are for information."""
    judged = _plants()
    few = dict(controls=(0.5, 5.0))
    default = {
        f"{name}, default window": plant | dict(window=DEFAULT, judged=False)
        for name, plant in judged.items()
    }
    seldom = {"tanks, seldom full": judged["tanks"] | few | dict(judged=False)}
    return judged | default | seldom


def _plants() -> dict[str, dict[str, Any]]:
    midpoint = lambda system, dt, substeps: dlx.Discretized(
        system, dt, diffrax.Midpoint(), substeps
    )
    return {
        "pendulum": dict(
            dynamics=midpoint(Pendulum(length=0.8, mass=1.3, damping=0.2), 0.05, 1),
            parameters=["damping", "length", "mass"],
            start=([-1.0, -1.0], [1.0, 1.0]),
            controls=(-4.0, 4.0),
            held=5,
            noise=0.02,
            window=40,
        ),
        "tanks": dict(
            dynamics=midpoint(Tanks(), 4.0, 1),
            parameters=["lower", "pump", "through"],
            start=([3.0, 3.0], [6.0, 6.0]),
            # So much that the upper tank overflows in each record. If it does not, the
            # data hardly tell how full it is.
            controls=(0.5, 7.0),
            held=10,
            noise=0.05,
            window=STEPS,
        ),
        "reactor": dict(
            dynamics=midpoint(Reactor(), 0.05, 4),
            parameters=["UA", "k"],
            start=([0.45, 338.0], [0.55, 346.0]),
            controls=(285.0, 300.0),
            held=5,
            noise=0.5,
            window=40,
        ),
    }


def coverage(records: int = RECORDS) -> list[dict[str, Any]]:
    """A row for each plant."""
    rows, order = [], list(_plants())
    for name, plant in plants().items():
        paths = [f"system.{path}" for path in plant["parameters"]]
        truth = jnp.stack(
            [getattr(plant["dynamics"].system, p) for p in plant["parameters"]]
        )
        run = _one(plant, paths, truth)
        # The rows for information are of the records of their plants.
        keys = jr.split(jr.key(order.index(name.split(",")[0])), records)
        solved, inside = map(np.stack, zip(*map(run, keys), strict=True))
        share = np.mean(inside[solved], axis=0)
        rows.append(
            {
                "plant": name,
                "covered, %": float(100 * np.mean(share)),
                "each, %": [round(float(100 * s), 1) for s in share],
                "failures, %": float(100 * np.mean(~solved)),
                "records": records,
                "window": plant["window"],
                "judged": plant.get("judged", True),
            }
        )
        print("  ", rows[-1], flush=True)
    return rows


def _one(plant: dict[str, Any], paths: list[str], truth: Array) -> Any:
    """Whether one record is fitted, and whether each interval holds the truth."""
    dynamics, dt = plant["dynamics"], plant["dynamics"].dt
    changed = {p: _OFF * v for p, v in zip(paths, truth, strict=True)}
    guess = dlx.replace(dynamics, changed)
    low, high = (jnp.asarray(end) for end in plant["start"])

    @eqx.filter_jit
    def measured(key):
        keys = jr.split(key, 3)
        levels = jr.uniform(
            keys[0], (STEPS // plant["held"], 1), float, *plant["controls"]
        )
        controls = jnp.repeat(levels, plant["held"], axis=0)
        x0 = jr.uniform(keys[1], low.shape, float, low, high)
        states = dlx.open_loop(dynamics, x0, controls)
        outputs = jax.vmap(lambda x: dynamics.observe(0.0, x))(states)
        noise = plant["noise"] * jr.normal(keys[2], outputs.shape)
        return outputs + noise, controls

    def run(key):
        outputs, controls = measured(key)
        record = sysid.Record(outputs, controls, dt=dt)
        options: Any = dict(x0=(low + high) / 2, window=plant["window"])
        fit = sysid.physical(guess, record, paths, **options, throw=False)
        result: Any = fit.result
        order = [fit.names.index(path) for path in paths]
        low_, high_ = np.asarray(fit.low)[order], np.asarray(fit.high)[order]
        inside = (low_ <= truth) & (truth <= high_)
        return bool(result == dlx.RESULTS.successful), inside

    return run
