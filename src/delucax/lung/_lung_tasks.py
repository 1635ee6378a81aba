"""Tasks in which a lung is ventilated."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import diffrax
import numpy as np

from .._check import (
    check_count,
    check_instance,
    check_keywords,
    is_concrete,
    keywords_of,
)
from .._module import load
from ..dynamics import Delayed, Discretized
from ..environments import Environment
from ._learned_lung import LearnedLung
from ._lung_models import LungModel
from ._lungs import (
    AbstractLung,
    BalloonLung,
    DelayLung,
    DoubleCompartment,
    SingleCompartment,
)
from ._published import PublishedLung
from ._ventilation import ventilation
from ._waveform import BreathWaveform


def _task(
    task: Callable[..., Environment],
    kind: type[AbstractLung],
    delay: int,
    system: AbstractLung | None,
    /,
    waveform: BreathWaveform | None = None,
    *,
    dt: Any = 0.03,
    solver: diffrax.AbstractSolver | None = None,
    substeps: int = 1,
    **options: Any,
) -> Environment:
    """The task to ventilate a lung, which starts at rest at the PEEP of its valves.

    The lung is `system`, or one of `kind`. Errors name `task`, the function that the
    user called. `delay` is the number of steps until a control acts.
    """
    where = task.__name__
    check_keywords(options, where, task, kind, _task, ventilation, Environment)
    constants = {n: options.pop(n) for n in keywords_of(kind) if n in options}
    if system is None:
        system = kind(**constants)
    elif constants:
        names = ", ".join(constants)
        raise ValueError(f"{where}: give a system or its {names}, not both.")
    check_instance(system, kind, "system", where)
    valves: Any = system.valves  # pyright: ignore[reportAttributeAccessIssue]
    waveform = BreathWaveform() if waveform is None else waveform
    rest = system.resting(valves.peep)
    dynamics = Discretized(system, dt, solver, substeps)
    if delay:
        dynamics = Delayed(dynamics, controls=delay)
        rest = dynamics.filled(rest)
    options.setdefault("resting_state", rest)
    env = ventilation(dynamics, waveform, **options)
    asked, least = waveform.peep, valves.peep
    # The tolerance allows for rounding, if the two numbers differ in precision.
    if is_concrete(asked) and is_concrete(least):
        if np.any(np.asarray(asked) < np.asarray(least) - 1e-3):
            raise ValueError(
                f"{where}: the peep of waveform must be at least that of valves, "
                f"{least}, below which no lung empties, got {asked}. Change both."
            )
    return env


def balloon_lung(
    system: BalloonLung | None = None, *, horizon: int = 100, **options: Any
) -> Environment:
    """Ventilate a balloon, so that the pressure tracks a waveform.

    The controls, the observation, the state and the cost are described in
    [`delucax.lung.ventilation`][]. At the start of an episode, the lung is at rest at
    PEEP. The task never terminates.

    **Arguments:**

    - `system`: a [`delucax.lung.BalloonLung`][]; by default one is made with the
        arguments in `options`.
    - `horizon`: the number of steps per episode, 100 by default.
    - `**options`: further arguments, which are passed on to the lung, to
        [`delucax.Discretized`][] (the control interval `dt`, 0.03 s by default,
        `solver` and `substeps`), to [`delucax.lung.ventilation`][] (such as `waveform`,
        `sensor_delay` and `noise`) and to [`delucax.Environment`][].

    **Returns:** a [`delucax.Environment`][].

    **Raises:** `ValueError` if a number is invalid, or if the PEEP of `waveform` is
    below the PEEP of the valves.

    Source: Gradu, Hallman, Suo, Yu, Agarwal, Ghai, Singh, Zhang, Majumdar and Hazan,
    2021 (Deluca), retuned.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("lung/balloon_lung", resistance=10.0)
        ```
    """
    return _task(balloon_lung, BalloonLung, 0, system, horizon=horizon, **options)


def delay_lung(
    system: DelayLung | None = None,
    *,
    delay: int = 5,
    horizon: int = 100,
    **options: Any,
) -> Environment:
    """Ventilate a balloon through a long pipe, with a transport delay.

    This task differs from `lung/balloon_lung` in two ways: the controls act some steps
    late, and the pipe is elastic.

    **Arguments:**

    - `system`: a [`delucax.lung.DelayLung`][]; by default one is made with the
        arguments in `options`.
    - `delay`: the number of steps until a control acts, 5 by default.
    - `horizon`: the number of steps per episode, 100 by default.
    - `**options`: the same as for `lung/balloon_lung`. `substeps` is 4 by default,
        because the pipe empties in about 25 ms.

    **Returns:** a [`delucax.Environment`][].

    **Raises:** `ValueError` if a number is invalid, or if the PEEP of `waveform` is
    below the PEEP of the valves.

    Source: Gradu, Hallman, Suo, Yu, Agarwal, Ghai, Singh, Zhang, Majumdar and Hazan,
    2021 (Deluca), as a differential equation and retuned.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("lung/delay_lung", delay=3)
        ```
    """
    delay = check_count(delay, "delay", "delay_lung", least=0)
    options = dict(substeps=4, horizon=horizon) | options
    return _task(delay_lung, DelayLung, delay, system, **options)


def single_compartment(
    system: SingleCompartment | None = None, *, horizon: int = 100, **options: Any
) -> Environment:
    """Ventilate a lung of one compartment, so that the pressure tracks a waveform.

    This task is the same as `lung/balloon_lung`, but with another lung.

    **Arguments:**

    - `system`: a [`delucax.lung.SingleCompartment`][]; by default one is made with the
        arguments in `options`.
    - `horizon`: the number of steps per episode, 100 by default.
    - `**options`: the same as for `lung/balloon_lung`.

    **Returns:** a [`delucax.Environment`][].

    **Raises:** `ValueError` if a number is invalid, or if the PEEP of `waveform` is
    below the PEEP of the valves.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("lung/single_compartment", resistance=50.0, compliance=10.0)
        ```
    """
    options |= dict(horizon=horizon)
    return _task(single_compartment, SingleCompartment, 0, system, **options)


def double_compartment(
    system: DoubleCompartment | None = None, *, horizon: int = 100, **options: Any
) -> Environment:
    """Ventilate a lung with a fast and a slow part. The sensor is delayed and noisy.

    The ventilator study uses this task. It is the task `lung/single_compartment` with
    another lung and a realistic sensor.

    **Arguments:**

    - `system`: a [`delucax.lung.DoubleCompartment`][]; by default one is made with the
        arguments in `options`.
    - `horizon`: the number of steps per episode, 100 by default.
    - `**options`: the same as for `lung/balloon_lung`. By default `sensor_delay` is 2
        steps, `noise` is 0.2 cmH2O and `substeps` is 2. Two substeps are needed because
        the fast compartment of a lung with a low resistance and a low compliance
        empties in about 10 ms when the expiratory valve is open.

    **Returns:** a [`delucax.Environment`][].

    **Raises:** `ValueError` if a number is invalid, or if the PEEP of `waveform` is
    below the PEEP of the valves.

    !!! example

        ```python
        import delucax as dlx

        env = dlx.make("lung/double_compartment", resistance=50.0, compliance=10.0)
        ```
    """
    defaults = dict(sensor_delay=2, noise=0.2, substeps=2, horizon=horizon)
    options = defaults | options
    return _task(double_compartment, DoubleCompartment, 0, system, **options)


def learned_lung(
    model: LearnedLung | LungModel | PublishedLung | None = None,
    *,
    horizon: int = 100,
    **options: Any,
) -> Environment:
    """Ventilate a lung that was learned from breaths, for example to train controllers.

    The task is like `lung/balloon_lung`, but its control interval is the time between
    two samples of the breaths. The lung exhales to the start pressure of the breaths,
    and not to the PEEP of `waveform`. For a [`delucax.lung.LungModel`][], the delay of
    the sensor is the `sensor_delay` of the model.

    **Arguments:**

    - `model`: a [`delucax.lung.LearnedLung`][], a [`delucax.lung.LungModel`][] or a
        [`delucax.lung.PublishedLung`][]. The default is the learned lung that comes
        with the library. This default lung was fitted to breaths of the task
        `lung/double_compartment`. The sensor of that task is two samples late, so the
        pressure of the default lung is late too. In the repository,
        `python -m benchmarks.learned_lung` trains this default lung.
    - `horizon`: the number of steps per episode, 100 by default.
    - `**options`: further arguments of [`delucax.lung.ventilation`][], such as
        `waveform`, `noise` and `limit`, and of [`delucax.Environment`][].

    **Returns:** a [`delucax.Environment`][].

    **Raises:** `ValueError` if `model` has another type, if a number is invalid, or if
    `sensor_delay` is given for a [`delucax.lung.LungModel`][].

    Source: Suo, Agarwal, Xia, Chen, Ghai, Yu, Gradu, Singh, Zhang, Minasyan, LaChance,
    Zajdel, Schottdorf, Cohen and Hazan, 2021.

    !!! example

        ```python
        import delucax as dlx
        from delucax import lung

        env = dlx.make("lung/learned_lung")
        fitted = lung.LungModel(lung.SingleCompartment())
        env = lung.learned_lung(fitted, noise=0.2, horizon=29)
        ```
    """
    where = "learned_lung"
    check_keywords(options, where, learned_lung, ventilation, Environment)
    if model is None:
        model = load(Path(__file__).with_name("learned_lung.dlx"))
    if isinstance(model, LungModel):
        if "sensor_delay" in options:
            raise ValueError(
                f"{where}: sensor_delay cannot be given for a LungModel, because the "
                f"sensor has the delay of the model, {model.dynamics.sensor} steps."
            )
        # The task adds the sensor, and then the delay: take the dynamics without it.
        options |= dict(sensor_delay=model.dynamics.sensor)
        dynamics, rest = model.dynamics.dynamics, model.system.resting(model.peep)
    elif isinstance(model, LearnedLung | PublishedLung):
        dynamics, rest = model, model.resting()
    else:
        raise ValueError(
            f"{where}: model must be a LearnedLung, a LungModel or a PublishedLung, "
            f"got {type(model).__name__}."
        )
    options.setdefault("resting_state", rest)
    return ventilation(dynamics, horizon=horizon, **options)
