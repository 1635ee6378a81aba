"""The lungs by name."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import diffrax

from .._check import check_count, check_instance, check_keywords, keywords_of
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
from ._ventilation import ventilated
from ._waveform import BreathWaveform, check_peep


def _task(
    task: Callable[..., Environment],
    kind: type[AbstractLung],
    system: AbstractLung | None,
    horizon: int,
    options: dict[str, Any],
    delay: int = 0,
) -> Environment:
    """A lung, `system` or one of `kind`, that is to breathe.

    `task` is the function that a user called, which errors name, and `delay` the steps
    until a control acts.
    """
    where = task.__name__
    check_keywords(options, where, task, kind, _discretised, ventilated, Environment)
    constants = {n: options.pop(n) for n in keywords_of(kind) if n in options}
    if system is None:
        system = kind(**constants)
    elif constants:
        names = ", ".join(constants)
        raise ValueError(f"{where}: give a system or its {names}, not both.")
    check_instance(system, kind, "system", where)
    return _discretised(task, system, delay, horizon=horizon, **options)


def _discretised(
    task: Callable[..., Environment],
    system: AbstractLung,
    delay: int,
    /,
    waveform: BreathWaveform | None = None,
    *,
    dt: Any = 0.03,
    solver: diffrax.AbstractSolver | None = None,
    substeps: int = 1,
    **options: Any,
) -> Environment:
    """The task of a lung that rests at the PEEP of its valves."""
    valves: Any = system.valves  # pyright: ignore[reportAttributeAccessIssue]
    waveform = BreathWaveform() if waveform is None else waveform
    rest = system.resting(valves.peep)
    dynamics = Discretized(system, dt, solver, substeps)
    if delay:
        dynamics = Delayed(dynamics, controls=delay)
        rest = dynamics.filled(rest)
    env = ventilated(task, dynamics, rest, waveform, **options)
    check_peep(waveform, valves, task.__name__)
    return env


def balloon_lung(
    system: BalloonLung | None = None, *, horizon: int = 100, **options: Any
) -> Environment:
    """Make a balloon breathe as a waveform says.

    The controls, the observation, the state and the cost are those of
    [`delucax.lung.ventilation`][]. Starts at rest at PEEP. Never terminates.

    **Arguments:**

    - `system`: a [`delucax.lung.BalloonLung`][]; made of `options` by default.
    - `horizon`: steps an episode, 100 by default.
    - `**options`: arguments of the lung; the control interval `dt` (0.03 by default),
        `solver` and `substeps` of [`delucax.Discretized`][]; `waveform`,
        `sensor_delay`, `noise` and others of [`delucax.lung.ventilation`][]; those of
        [`delucax.Environment`][].

    **Returns:** an [`delucax.Environment`][].

    **Raises:** `ValueError` on illegal numbers, or if the PEEP of `waveform` is below
    that of its valves.

    Source: Gradu, Hallman, Suo, Yu, Agarwal, Ghai, Singh, Zhang, Majumdar and Hazan,
    2021 (Deluca), retuned.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("lung/balloon_lung", resistance=10.0)
        ```
    """
    return _task(balloon_lung, BalloonLung, system, horizon, options)


def delay_lung(
    system: DelayLung | None = None,
    *,
    delay: int = 5,
    horizon: int = 100,
    **options: Any,
) -> Environment:
    """Make a balloon breathe through a long pipe, which what is done must first pass.

    As `lung/balloon_lung`, but that the controls act some steps late, and that the pipe
    is elastic.

    **Arguments:**

    - `system`: a [`delucax.lung.DelayLung`][]; made of `options` by default.
    - `delay`: steps until a control acts, 5 by default.
    - `horizon`: steps an episode, 100 by default.
    - `**options`: as of `lung/balloon_lung`; `substeps` is 4 by default, because air
        rushes out of the pipe in some 25 ms.

    **Returns:** an [`delucax.Environment`][].

    **Raises:** `ValueError` on illegal numbers, or if the PEEP of `waveform` is below
    that of its valves.

    Source: Gradu, Hallman, Suo, Yu, Agarwal, Ghai, Singh, Zhang, Majumdar and Hazan,
    2021 (Deluca), as a differential equation and retuned.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("lung/delay_lung", delay=3)
        ```
    """
    delay = check_count(delay, "delay", "delay_lung", least=0)
    options = dict(substeps=4) | options
    return _task(delay_lung, DelayLung, system, horizon, options, delay)


def single_compartment(
    system: SingleCompartment | None = None, *, horizon: int = 100, **options: Any
) -> Environment:
    """Make a lung of one compartment breathe as a waveform says.

    As `lung/balloon_lung`, with another lung.

    **Arguments:**

    - `system`: a [`delucax.lung.SingleCompartment`][]; made of `options` by default.
    - `horizon`: steps an episode, 100 by default.
    - `**options`: as of `lung/balloon_lung`.

    **Returns:** an [`delucax.Environment`][].

    **Raises:** `ValueError` on illegal numbers, or if the PEEP of `waveform` is below
    that of its valves.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("lung/single_compartment", resistance=50.0, compliance=10.0)
        ```
    """
    return _task(single_compartment, SingleCompartment, system, horizon, options)


def double_compartment(
    system: DoubleCompartment | None = None, *, horizon: int = 100, **options: Any
) -> Environment:
    """Make a lung of a fast and a slow compartment breathe, with delay and noise.

    The plant of the ventilator study: as `lung/single_compartment`, with another lung
    and a real sensor.

    **Arguments:**

    - `system`: a [`delucax.lung.DoubleCompartment`][]; made of `options` by default.
    - `horizon`: steps an episode, 100 by default.
    - `**options`: as of `lung/balloon_lung`; `sensor_delay` is 2 steps and `noise`
        0.2 cmH2O by default, and `substeps` is 2, because with the expiratory valve
        open the fast compartment of a narrow lung is empty within some 10 ms.

    **Returns:** an [`delucax.Environment`][].

    **Raises:** `ValueError` on illegal numbers, or if the PEEP of `waveform` is below
    that of its valves.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("lung/double_compartment", resistance=50.0, compliance=10.0)
        ```
    """
    options = dict(sensor_delay=2, noise=0.2, substeps=2) | options
    return _task(double_compartment, DoubleCompartment, system, horizon, options)


def learned_lung(
    model: LearnedLung | None = None, *, horizon: int = 100, **options: Any
) -> Environment:
    """Make a lung breathe that was learned from breaths.

    As `lung/balloon_lung`; its time step is that of the breaths, and what it is let out
    to is the pressure that they start at, whatever the PEEP of `waveform`.

    **Arguments:**

    - `model`: a [`delucax.lung.LearnedLung`][]. By default the one that comes with the
        library, learned from breaths of the task `lung/double_compartment`; its sensor
        is two samples late, and so is its pressure. In the repository,
        `python -m benchmarks.learned_lung` makes it.
    - `horizon`: steps an episode, 100 by default.
    - `**options`: `waveform`, `noise` and others of [`delucax.lung.ventilation`][] and
        [`delucax.Environment`][].

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
    return ventilated(learned_lung, lung, rest, horizon=horizon, **options)
