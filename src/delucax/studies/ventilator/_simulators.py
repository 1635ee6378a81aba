"""The breaths of the study, and the simulators that are fitted to them."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

from ... import lung
from ..._module import positive
from ..._typing import PRNGKey
from ...environments import Environment
from ...simulation import rollout
from ._stages import INSPIRATION, SEEN, Size


class Kind(NamedTuple):
    """A kind of lung model, and how it is fitted.

    - `make`: a function of a key to the model before it is fitted.
    - `trainable`: what is fitted of it, each with its constraint; the weights where
        none is named.
    - `steps`: how often the steps of the study are taken.
    - `learning_rate`: of the fit.
    """

    make: Callable[[PRNGKey], lung.AbstractLung]
    trainable: dict[str, Any] = {}
    steps: int = 1
    learning_rate: float = 0.05


def _fitted(positives: str, *free: str) -> dict[str, Any]:
    """What is fitted: what stays positive, its names in one string, and the rest."""
    return dict.fromkeys(positives.split(), positive) | dict.fromkeys(free)


_DOUBLE: Any = dict(central=0.5, share=0.4, imbalance=3.0)
KINDS = {
    "single compartment": Kind(
        lambda key: lung.SingleCompartment(), _fitted("resistance compliance")
    ),
    "balloon": Kind(
        lambda key: lung.BalloonLung(), _fitted("resistance stiffness rest")
    ),
    "double compartment": Kind(
        lambda key: lung.DoubleCompartment(**_DOUBLE),
        _fitted("resistance compliance imbalance", "central", "share"),
        steps=2,
    ),
    "neural ODE": Kind(
        lambda key: lung.NeuralLung(key=key), steps=2, learning_rate=1e-2
    ),
    "grey box": Kind(
        lambda key: lung.GreyBoxLung(key=key),
        _fitted("single.resistance single.compliance", "network", "memory"),
        steps=2,
        learning_rate=1e-2,
    ),
}


def task_of(resistance: float, compliance: float, sensor_delay: int) -> Environment:
    """The task of a lung of the study."""
    system = lung.DoubleCompartment(resistance, compliance)
    return lung.double_compartment(system, sensor_delay=sensor_delay)


def explored(size: Size) -> lung.Breaths:
    """Breaths of the lungs of the study, stacked over them."""
    made = []
    for i, (R, C) in enumerate(size.lungs):
        env = task_of(R, C, size.sensor_delay)
        known: Any = dict(resistance=R, compliance=C)
        made.append(lung.explore(env, size.breaths, key=jr.key(i), **known))
    return stack_breaths(made)


def grouped(breaths: lung.Breaths) -> Any:
    """The lungs of a file, and as many breaths of each (see `left_out`)."""
    R, C = np.asarray(breaths.resistance), np.asarray(breaths.compliance)
    lungs = sorted(set(zip(R.tolist(), C.tolist(), strict=True)))
    parts = [breaths[np.flatnonzero((R == r) & (C == c))] for r, c in lungs]
    fewest = min(len(part) for part in parts)
    if fewest < 6:
        worst = lungs[int(np.argmin([len(part) for part in parts]))]
        raise ValueError(
            f"lung: data must have at least 6 breaths of each lung, got {fewest} with "
            f"R = {worst[0]:g} and C = {worst[1]:g}."
        )
    return np.asarray(lungs), stack_breaths(parts)


def left_out(recorded: lung.Breaths, breaths: lung.Breaths) -> str:
    """A sentence about the recorded breaths that are left out; empty if none is."""
    lungs, each = breaths.pressure.shape[:2]
    count = len(recorded) - lungs * each
    if not count:
        return ""
    return (
        f"{count} of the {len(recorded)} breaths are left out: each of the {lungs} "
        f"lungs has {each}, as many as there are of the one with the fewest."
    )


def stack_breaths(parts: list[lung.Breaths]) -> lung.Breaths:
    """Breaths of several lungs as one: the first of each, as many as there are of the
    one with the fewest."""
    fewest = min(len(part) for part in parts)
    return lung.stack([part[:fewest] for part in parts])


def divided(breaths: lung.Breaths, key: PRNGKey) -> tuple[lung.Breaths, lung.Breaths]:
    """Breaths of each lung to train on, and to test on."""
    halves = [lung.split(part, 1 / 6, key=key) for part in lung.unstack(breaths)]
    train, test = (stack_breaths(list(part)) for part in zip(*halves, strict=True))
    return train, test


def learned(
    train: lung.Breaths, size: Size, key: PRNGKey, **options: Any
) -> lung.LearnedLung:
    """A learned lung of each lung, stacked."""
    keys = jr.split(jr.fold_in(key, 2), train.pressure.shape[0])
    parts = zip(lung.unstack(train), keys, strict=True)
    options |= dict(teacher_steps=size.teacher_steps, steps=size.simulator_steps)
    models = lung.stack([lung.LearnedLung(part, key=own) for part, own in parts])
    return lung.fit_lungs(models, train, key=jr.fold_in(key, 3), **options).model


def fitted(
    name: str, train: lung.Breaths, size: Size, key: PRNGKey, **options: Any
) -> lung.LungModel:
    """Models of a kind, stacked, fitted to the breaths of each lung."""
    kind = KINDS[name]
    keys = jr.split(jr.fold_in(key, 4), train.pressure.shape[0])
    delay = size.sensor_delay
    models = [lung.LungModel(kind.make(k), train.dt[0], delay) for k in keys]
    system = "dynamics.dynamics.system."
    options |= dict(
        steps=size.physics_steps * kind.steps,
        learning_rate=kind.learning_rate,
        trainable={f"{system}{n}": c for n, c in kind.trainable.items()} or None,
    )
    key = jr.fold_in(key, 5)
    models = lung.stack(models)
    return lung.fit_lungs(models, train, key=key, batch_size=32, **options).model


def open_loop_rows(
    names: list[str], test: lung.Breaths, models: dict[str, Any]
) -> list[dict[str, Any]]:
    """The error of each simulator on the breaths of each lung, a row each."""
    error_of = eqx.filter_jit(eqx.filter_vmap(lung.open_loop_error))
    errors = {kind: np.asarray(error_of(model, test)) for kind, model in models.items()}
    return [
        {"lung": name, "simulator": kind, "mae": float(error)}
        for kind, each in errors.items()
        for name, error in zip(names, each, strict=True)
    ]


@eqx.filter_jit
def _observed(envs, controllers, pips):
    """What the sensor reads in an inspiration, shape `(lungs, pips, steps)`."""

    options: Any = dict(horizon=INSPIRATION, keep=("observations",), throw=False)

    def in_lung(env, controller):
        def one(pip):
            world, policy = lung.at_pip((env, controller), pip)
            run: Any = rollout(world, policy, key=jr.key(0), **options)
            return run.observations[:, 0]

        return jax.vmap(one)(pips)

    return eqx.filter_vmap(in_lung)(envs, controllers)


def closed_loop_errors(
    envs: Environment,
    models: dict[str, Any],
    controllers: Any,
    waveform: lung.BreathWaveform,
) -> dict[str, Any]:
    """How far the pressures in each simulator are from those in the lung, each under
    the same controller and without noise, by kind: shape `(lungs,)`."""
    pips, count = jnp.asarray(SEEN), len(envs.dt)
    waveforms = lung.stack([waveform] * count)
    whole = eqx.filter_vmap(lung.Breathing)(controllers, waveforms)
    silent = eqx.tree_at(lambda env: env.sensor_noise, envs, None)
    truth = _observed(silent, whole, pips)
    silent_task = lambda model: lung.lung_environment(model, waveform, noise=0.0)
    errors = {}
    for kind, model in models.items():
        pressure = _observed(eqx.filter_vmap(silent_task)(model), whole, pips)
        errors[kind] = np.mean(np.abs(np.asarray(pressure - truth)), axis=(1, 2))
    return errors
