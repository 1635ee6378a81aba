"""The breaths of the study, and the simulators that are fitted to them."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

from ..._module import positive
from ...environments import Environment
from ...lung._data import Breaths, explore, LENGTH, split
from ...lung._fitting import fit_lungs, open_loop_error
from ...lung._learned import LearnedLung
from ...lung._lungs import BalloonLung, DoubleCompartment, SingleCompartment
from ...lung._models import GreyBoxLung, LungModel, NeuralLung
from ...lung._policies import Breathing
from ...lung._stacking import repeat, stack, unstack
from ...lung._tasks import double_compartment
from ...lung._train import lung_environment
from ...lung._waveform import at_pip, BreathWaveform
from ...simulation import rollout
from ._size import SEEN, Size


_SYSTEM = "dynamics.dynamics.system."


def explored(size: Size) -> Breaths:
    """Breaths of the lungs of the study, stacked over them."""
    return stack_breaths(
        [
            explore(
                double_compartment(R, C, sensor_delay=size.sensor_delay),
                size.breaths,
                key=jr.key(i),
                resistance=R,
                compliance=C,
            )
            for i, (R, C) in enumerate(size.lungs)
        ]
    )


def grouped(breaths: Breaths) -> Any:
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


def left_out(recorded: Breaths, breaths: Breaths) -> str:
    """What there is to say of recorded breaths that are not among those of each lung,
    nothing if all are."""
    lungs, each = breaths.pressure.shape[:2]
    count = len(recorded) - lungs * each
    if not count:
        return ""
    return (
        f"{count} of the {len(recorded)} breaths are left out: each of the {lungs} "
        f"lungs has {each}, as many as there are of the one with the fewest."
    )


def stack_breaths(parts: list[Breaths]) -> Breaths:
    """Breaths of several lungs as one: the first of each, as many as there are of the
    one with the fewest."""
    fewest = min(len(part) for part in parts)
    return stack([part[:fewest] for part in parts])


def divided(breaths: Breaths, key: Any) -> tuple[Breaths, Breaths]:
    """Breaths of each lung to train on, and to test on."""
    halves = [split(part, 1 / 6, key=key) for part in unstack(breaths)]
    train, test = (stack_breaths(list(part)) for part in zip(*halves, strict=True))
    return train, test


def learned(train: Breaths, size: Size, key: Any, options: Any) -> Any:
    """A learned lung of each lung, stacked."""
    keys = jr.split(jr.fold_in(key, 2), train.pressure.shape[0])
    parts = zip(unstack(train), keys, strict=True)
    models = stack([LearnedLung(part, key=own) for part, own in parts])
    return fit_lungs(
        models,
        train,
        key=jr.fold_in(key, 3),
        teacher_steps=size.teacher_steps,
        steps=size.simulator_steps,
        **options,
    ).model


def fitted(kind: str, train: Breaths, size: Size, key: Any, options: Any) -> Any:
    """Models of a kind, stacked, fitted to the breaths of each lung."""
    models, moved = _models(kind, train, size.sensor_delay, jr.fold_in(key, 4))
    is_network = kind in ("neural ODE", "grey box")
    is_small = kind in ("single compartment", "balloon")
    return fit_lungs(
        models,
        train,
        key=jr.fold_in(key, 5),
        steps=size.physics_steps * (1 if is_small else 2),
        learning_rate=1e-2 if is_network else 0.05,
        batch_size=32,
        trainable=moved,
        **options,
    ).model


def _models(kind: str, train: Breaths, delay: int, key: Any) -> tuple[Any, Any]:
    """Models of a kind before they are fitted, and what of them is."""
    count = train.pressure.shape[0]
    dt = train.dt[0]
    at = lambda *names: {_SYSTEM + name: positive for name in names}  # noqa: E731
    if kind == "single compartment":
        systems = [SingleCompartment()] * count
        moved: Any = at("resistance", "compliance")
    elif kind == "balloon":
        systems = [BalloonLung()] * count
        moved = at("resistance", "stiffness", "rest")
    elif kind == "double compartment":
        begin: Any = dict(central=0.5, share=0.4, imbalance=3.0)
        systems = [DoubleCompartment(**begin)] * count
        moved = at("resistance", "compliance", "imbalance")
        moved |= {_SYSTEM + "central": None, _SYSTEM + "share": None}
    elif kind == "neural ODE":
        systems = [NeuralLung(key=k) for k in jr.split(key, count)]
        moved = None
    else:
        systems = [GreyBoxLung(key=k) for k in jr.split(key, count)]
        moved = {_SYSTEM + name: None for name in ("network", "memory")}
        moved |= at("single.resistance", "single.compliance")
    return stack([LungModel(system, dt, delay) for system in systems]), moved


def open_loop_rows(
    names: list[str], test: Breaths, models: dict[str, Any]
) -> list[dict[str, Any]]:
    """The error of each simulator on the breaths of each lung, a row each."""
    rows = []
    for kind, model in models.items():
        errors = eqx.filter_jit(eqx.filter_vmap(open_loop_error))(model, test)
        for name, error in zip(names, np.asarray(errors), strict=True):
            rows.append({"lung": name, "simulator": kind, "mae": float(error)})
    return rows


@eqx.filter_jit
def _observed(envs, controllers, pips):
    """What the sensor reads in an inspiration, shape `(lungs, pips, steps)`."""

    def in_lung(env, controller):
        def one(pip):
            world, policy = at_pip((env, controller), pip)
            options: Any = dict(horizon=LENGTH, keep=("observations",), throw=False)
            run: Any = rollout(world, policy, key=jr.key(0), **options)
            return run.observations[:, 0]

        return jax.vmap(one)(pips)

    return eqx.filter_vmap(in_lung)(envs, controllers)


def closed_loop_errors(
    envs: Environment,
    models: dict[str, Any],
    controllers: Any,
    waveform: BreathWaveform,
) -> dict[str, Any]:
    """How far the pressures in each simulator are from those in the lung, each under
    the same controller and without noise, by kind: shape `(lungs,)`."""
    pips = jnp.asarray(SEEN)
    whole = eqx.filter_vmap(Breathing)(controllers, repeat(waveform, len(envs.dt)))
    silent = eqx.tree_at(lambda env: env.sensor_noise, envs, None)
    truth = _observed(silent, whole, pips)
    found = {}
    for kind, model in models.items():
        made = [lung_environment(m, waveform, noise=0.0) for m in unstack(model)]
        seen = _observed(stack(made), whole, pips)
        found[kind] = np.mean(np.abs(np.asarray(seen - truth)), axis=(1, 2))
    return found
