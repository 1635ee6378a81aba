"""Bouc-Wen: an oscillator with a hysteretic force, of which the position is measured.

The data are made here, from the published equations and constants, because the test
records are not public under a licence: same equations and signals, own draws of their
phases. Five periods of a multisine of 5 to 150 Hz and 50 N rms are for estimation, with
noise of 8e-6 m; another, in the steady state, and a sweep of 40 N from 20 to 50 Hz at
10 Hz a minute are the tests, without noise.

The model knows the oscillator and that a force remembers, and not how: a network tells
the rate of that force.

Source: Noel and Schoukens, 2016.
"""

from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import delucax as dlx
from delucax.training import sysid


UNIT = "um"
BEST = 7.16
"""Published, um rms on the multisine: Schoukens, 2021."""
LIMITS = {"multisine": 1.5 * BEST}
RATE, OVERSAMPLED, PERIOD = 750.0, 20, 8192
BAND, FORCE, NOISE = (5.0, 150.0), 50.0, 8.0
SWEEP, SWEPT, SWEEP_FORCE = (20.0, 50.0), 180.0, 40.0
FITTED = PERIOD
PARAMETERS = ("damping", "hysteresis", "mass", "stiffness")
KNOWN = ("alpha", "damping", "delta", "gamma", "mass", "stiffness")


class BoucWen(dlx.AbstractSystem):
    """`m y'' + c y' + k y + z = u` and
    `z' = alpha y' - beta (gamma |y'| z + delta y' |z|)`; position in m."""

    state_names, control_names = ("position", "velocity", "force"), ("u",)
    mass: Array = dlx.parameter(2.0)
    damping: Array = dlx.parameter(10.0)
    stiffness: Array = dlx.parameter(5e4)
    alpha: Array = dlx.parameter(5e4)
    beta: Array = dlx.parameter(1e3)
    gamma: Array = dlx.parameter(0.8)
    delta: Array = dlx.parameter(-1.1)

    def vector_field(self, t, x, u, w):
        y, v, z = x
        pull = self.stiffness * y + self.damping * v + z
        bend = self.gamma * jnp.abs(v) * z + self.delta * v * jnp.abs(z)
        rate = self.alpha * v - self.beta * bend
        return jnp.stack([v, (u[0] - pull) / self.mass, rate])


class Known(BoucWen):
    """The same, whose position is measured in um."""

    def observe(self, t, x):
        return 1e6 * x[:1]


class Oscillator(dlx.AbstractSystem):
    """The same without the hysteresis; position in um, velocity in mm/s."""

    state_names, control_names = ("position", "velocity", "force"), ("u",)
    mass: Array = dlx.parameter(1.5, constraint=dlx.positive)
    damping: Array = dlx.parameter(20.0, constraint=dlx.positive)
    stiffness: Array = dlx.parameter(7e4, constraint=dlx.positive)
    hysteresis: Array = dlx.parameter(2e4, constraint=dlx.positive)

    def vector_field(self, t, x, u, w):
        y, v, z = 1e-6 * x[0], 1e-3 * x[1], x[2]
        pull = self.stiffness * y + self.damping * v + z
        rate = self.hysteresis * v
        return jnp.stack([1e6 * v, 1e3 * (u[0] - pull) / self.mass, rate])

    def observe(self, t, x):
        return x[:1]


def records(data: Path) -> tuple[sysid.Record, dict[str, Any]]:
    """What is fitted, and the tests, in um."""
    del data
    rng = np.random.default_rng(2016)
    estimation = _multisine(rng, periods=5)
    # The last period is in the steady state.
    test = _multisine(rng, periods=3)[:, -PERIOD:]
    noisy = estimation + NOISE * rng.normal(size=estimation.shape) * [[0.0], [1.0]]
    record = lambda u, y: sysid.Record(y, u, dt=1 / RATE, hold="cubic")
    tests = dict(multisine=record(*test), sweep=record(*_sweep()))
    return record(*noisy)[:FITTED], tests


def fitted(record: sysid.Record, seed: int) -> Any:
    """The oscillator alone, and with a network for the rate of the force."""
    guess = dlx.Discretized(Oscillator(), 1 / RATE)
    names = [f"system.{name}" for name in PARAMETERS]
    options: Any = dict(x0=first(record), window=200, max_steps=150, width=10)
    options |= dict(corrected=["force"], spreads=[3.0])
    return sysid.grey_box(guess, record, names, key=jax.random.key(seed), **options)


def known(record: sysid.Record) -> Any:
    """The published equations, from a guess that is 20% off. The product of beta with
    gamma and delta counts, so beta is given."""
    guess = dlx.Discretized(Known(), 1 / RATE, substeps=4)
    names = [f"system.{name}" for name in KNOWN]
    off = {f"system.{name}": 1.2 * getattr(Known(), name) for name in KNOWN}
    guess = dlx.replace(guess, off)
    x0 = [1e-6 * float(record.outputs[0, 0]), 0.0, 0.0]
    return sysid.physical(guess, record, names, x0=x0, window=200, max_steps=150)


def first(record: sysid.Record) -> Any:
    """A guess of the first state."""
    return [float(record.outputs[0, 0]), 0.0, 0.0]


def _multisine(rng: np.random.Generator, periods: int) -> np.ndarray:
    """`(u, y)` of a signal with random phases, sampled at the rate of the benchmark."""
    count = PERIOD * OVERSAMPLED
    lines = np.arange(*(int(f * PERIOD / RATE) for f in BAND)) + 1
    spectrum = np.zeros(count, complex)
    spectrum[lines] = np.exp(2j * np.pi * rng.random(len(lines)))
    u = np.real(np.fft.ifft(spectrum))
    return _measured(np.tile(FORCE * u / np.std(u), periods))


def _sweep() -> np.ndarray:
    t = np.arange(int(SWEPT * RATE * OVERSAMPLED)) / (RATE * OVERSAMPLED)
    rate = (SWEEP[1] - SWEEP[0]) / SWEPT
    return _measured(SWEEP_FORCE * np.sin(2 * np.pi * (SWEEP[0] + rate * t / 2) * t))


def _measured(u: np.ndarray) -> np.ndarray:
    """The input and the position in um, after integration at 15 kHz from rest."""
    plant = dlx.Discretized(BoucWen(), 1 / (RATE * OVERSAMPLED))
    # A control is held over a step. Its mean there is not late by half a step.
    held = (u + np.append(u[1:], u[-1])) / 2
    states = eqx.filter_jit(dlx.open_loop)(plant, jnp.zeros(3), held[:, None])
    y = 1e6 * np.asarray(states)[:-1, 0]
    return np.stack([u, y])[:, ::OVERSAMPLED]
