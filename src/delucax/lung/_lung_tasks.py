"""The lungs by name."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import diffrax

from .._check import check_count, check_instance
from .._module import load
from ..dynamics import Delayed, Discretized
from ..environments import Environment
from ._learned_lung import LearnedLung
from ._lungs import (
    AbstractLung,
    BalloonLung,
    DelayLung,
    DoubleCompartment,
    SingleCompartment,
)
from ._valves import Valves
from ._ventilation import ventilated
from ._waveform import BreathWaveform, check_peep


def _task(
    task: Callable[..., Environment],
    plant: AbstractLung,
    delay: int = 0,
    /,
    waveform: BreathWaveform | None = None,
    *,
    dt: Any = 0.03,
    solver: diffrax.AbstractSolver | None = None,
    substeps: int = 1,
    **options: Any,
) -> Environment:
    """A lung that rests at the PEEP of its valves and is to breathe.

    `task` is the function that a user called, which errors name, and `delay` the steps
    until a control acts.
    """
    valves: Any = plant.valves  # pyright: ignore[reportAttributeAccessIssue]
    waveform = BreathWaveform() if waveform is None else waveform
    rest = plant.resting(valves.peep)
    dynamics = Discretized(plant, dt, solver, substeps)
    if delay:
        dynamics = Delayed(dynamics, controls=delay)
        rest = dynamics.filled(rest)
    env = ventilated((task, _task), dynamics, rest, waveform, **options)
    check_peep(waveform, valves, task.__name__)
    return env


def balloon_lung(
    resistance: Any = 20.0,
    stiffness: Any = 40.0,
    rest: Any = 1.5,
    *,
    valves: Valves | None = None,
    horizon: int = 100,
    **options: Any,
) -> Environment:
    """Make a balloon breathe as a waveform says.

    The controls, the observation, the state and the cost are those of
    [`delucax.lung.ventilation`][]. Starts at rest at PEEP. Never terminates.

    **Arguments:**

    - `resistance`, `stiffness`, `rest`, `valves`: of [`delucax.lung.BalloonLung`][].
    - `horizon`: steps an episode, 100 by default, which is one breath.
    - `**options`: the control interval `dt` (0.03 by default), `solver` and `substeps`
        of [`delucax.Discretized`][]; `waveform`, `sensor_delay`, `noise` and others of
        [`delucax.lung.ventilation`][]; those of [`delucax.Environment`][].

    **Returns:** an [`delucax.Environment`][].

    **Raises:** `ValueError` on illegal numbers, or if the PEEP of `waveform` is below
    that of `valves`.

    Source: Gradu, Hallman, Suo, Yu, Agarwal, Ghai, Singh, Zhang, Majumdar and Hazan,
    2021 (Deluca), retuned.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("lung/balloon_lung", resistance=10.0)
        ```
    """
    plant = BalloonLung(resistance, stiffness, rest, valves or Valves())
    return _task(balloon_lung, plant, horizon=horizon, **options)


def delay_lung(
    resistance: Any = 20.0,
    stiffness: Any = 40.0,
    rest: Any = 1.5,
    pipe: Any = 5.0,
    *,
    delay: int = 5,
    valves: Valves | None = None,
    horizon: int = 100,
    substeps: int = 4,
    **options: Any,
) -> Environment:
    """Make a balloon breathe through a long pipe, which what is done must first pass.

    As `lung/balloon_lung`, but that the controls act some steps late, and that the pipe
    is elastic.

    **Arguments:**

    - `resistance`, `stiffness`, `rest`, `pipe`, `valves`: of
        [`delucax.lung.DelayLung`][].
    - `delay`: steps until a control acts, 5 by default.
    - `horizon`: steps an episode, 100 by default, which is one breath.
    - `substeps`: solver steps an interval, 4 by default: air rushes out of the pipe in
        some 25 ms.
    - `**options`: the control interval `dt` (0.03 by default), `solver` and `substeps`
        of [`delucax.Discretized`][]; `waveform`, `sensor_delay`, `noise` and others of
        [`delucax.lung.ventilation`][]; those of [`delucax.Environment`][].

    **Returns:** an [`delucax.Environment`][].

    **Raises:** `ValueError` on illegal numbers, or if the PEEP of `waveform` is below
    that of `valves`.

    Source: Gradu, Hallman, Suo, Yu, Agarwal, Ghai, Singh, Zhang, Majumdar and Hazan,
    2021 (Deluca), as a differential equation and retuned.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("lung/delay_lung", delay=3)
        ```
    """
    plant = DelayLung(resistance, stiffness, rest, pipe, valves or Valves())
    delay = check_count(delay, "delay", "delay_lung", least=0)
    options = dict(options, horizon=horizon, substeps=substeps)
    return _task(delay_lung, plant, delay, **options)


def single_compartment(
    resistance: Any = 20.0,
    compliance: Any = 20.0,
    *,
    valves: Valves | None = None,
    horizon: int = 100,
    **options: Any,
) -> Environment:
    """Make a lung of one compartment breathe as a waveform says.

    As `lung/balloon_lung`, with another lung.

    **Arguments:**

    - `resistance`, `compliance`, `valves`: of [`delucax.lung.SingleCompartment`][].
    - `horizon`: steps an episode, 100 by default, which is one breath.
    - `**options`: `waveform`, `sensor_delay`, `noise` and others of
        [`delucax.lung.ventilation`][] and [`delucax.Environment`][].

    **Returns:** an [`delucax.Environment`][].

    **Raises:** `ValueError` on illegal numbers, or if the PEEP of `waveform` is below
    that of `valves`.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("lung/single_compartment", resistance=50.0, compliance=10.0)
        ```
    """
    plant = SingleCompartment(resistance, compliance, valves or Valves())
    return _task(single_compartment, plant, horizon=horizon, **options)


def double_compartment(
    resistance: Any = 20.0,
    compliance: Any = 20.0,
    central: Any = 0.3,
    share: Any = 0.1,
    imbalance: Any = 10.0,
    *,
    valves: Valves | None = None,
    sensor_delay: int = 2,
    noise: Any = 0.2,
    horizon: int = 100,
    substeps: int = 2,
    **options: Any,
) -> Environment:
    """Make a lung of a fast and a slow compartment breathe, seen late and with noise.

    The plant of the ventilator study: as `lung/single_compartment`, with another lung
    and a real sensor.

    **Arguments:**

    - `resistance`, `compliance`, `central`, `share`, `imbalance`, `valves`: of
        [`delucax.lung.DoubleCompartment`][].
    - `sensor_delay`: steps until a pressure is seen, 2 by default.
    - `noise`: the standard deviation of what the sensor adds [cmH2O], 0.2 by default.
    - `horizon`: steps an episode, 100 by default, which is one breath.
    - `substeps`: solver steps an interval, 2 by default: with the expiratory valve open
        the fast compartment of a narrow lung is empty within some 10 ms.
    - `**options`: `waveform`, `sensor_delay`, `noise` and others of
        [`delucax.lung.ventilation`][] and [`delucax.Environment`][].

    **Returns:** an [`delucax.Environment`][].

    **Raises:** `ValueError` on illegal numbers, or if the PEEP of `waveform` is below
    that of `valves`.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("lung/double_compartment", resistance=50.0, compliance=10.0)
        ```
    """
    plant = DoubleCompartment(
        resistance, compliance, central, share, imbalance, valves or Valves()
    )
    options = dict(options, sensor_delay=sensor_delay, noise=noise)
    options = dict(options, horizon=horizon, substeps=substeps)
    return _task(double_compartment, plant, **options)


def learned_lung(
    model: LearnedLung | None = None,
    *,
    horizon: int = 100,
    **options: Any,
) -> Environment:
    """Make a lung breathe that was learned from breaths.

    As `lung/balloon_lung`; its time step is that of the breaths, and what it is let out
    to is the pressure that they start at, whatever the PEEP of `waveform`.

    **Arguments:**

    - `model`: a [`delucax.lung.LearnedLung`][]. By default the one that comes with the
        library, learned from breaths of the task `lung/double_compartment`; its sensor
        is two samples late, and so is its pressure. In the repository,
        `python -m benchmarks.learned_lung` makes it.
    - `horizon`: steps an episode, 100 by default, which is one breath.
    - `**options`: `waveform`, `noise` and others of
        [`delucax.lung.ventilation`][] and [`delucax.Environment`][].

    **Returns:** an [`delucax.Environment`][].

    **Raises:** `ValueError` if `model` is another one, or on illegal numbers.

    Source: Suo, Agarwal, Xia, Chen, Ghai, Yu, Gradu, Singh, Zhang, Minasyan, LaChance,
    Zajdel, Schottdorf, Cohen and Hazan, 2021.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("lung/learned_lung")
        ```
    """
    lung: Any = model
    if model is None:
        lung = load(Path(__file__).with_name("learned_lung.dlx"))
    check_instance(lung, LearnedLung, "model", "learned_lung")
    rest = lung.resting()
    return ventilated((learned_lung,), lung, rest, horizon=horizon, **options)
