"""The breaths of the study, and the simulators that are fitted to them."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array

from ... import lung
from ..._module import positive, stack, unstack
from ..._typing import PRNGKey
from ...environments import Environment
from ...simulation import rollout, Trajectory
from ._stages import INSPIRATION, Size, TRAIN_PIPS


class Kind(NamedTuple):
    """A kind of lung model, and how it is fitted.

    - `make`: a function that makes the model from a key, before it is fitted.
    - `positive`, `free`: the names of the parameters to fit, separated by spaces: those
        that must stay positive, and the others. Without names, the weights are fitted.
    - `steps`: a factor on the number of steps of the study.
    - `learning_rate`: the learning rate of the fit.
    """

    make: Callable[[PRNGKey], lung.AbstractLung]
    positive: str = ""
    free: str = ""
    steps: int = 1
    learning_rate: float = 0.05


KINDS = {
    "single compartment": Kind(
        lambda key: lung.SingleCompartment(), "resistance compliance"
    ),
    "balloon": Kind(lambda key: lung.BalloonLung(), "resistance stiffness rest"),
    "double compartment": Kind(
        lambda key: lung.DoubleCompartment(central=0.5, share=0.4, imbalance=3.0),
        *("resistance compliance imbalance", "central share", 2),
    ),
    "neural ODE": Kind(
        lambda key: lung.NeuralLung(key=key), steps=2, learning_rate=1e-2
    ),
    "grey box": Kind(
        lambda key: lung.GreyBoxLung(key=key),
        *("single.resistance single.compliance", "network memory", 2, 1e-2),
    ),
}


def task_of(resistance: float, compliance: float, sensor_delay: int) -> Environment:
    """The task of a lung of the study."""
    system = lung.DoubleCompartment(resistance, compliance)
    return lung.double_compartment(system, sensor_delay=sensor_delay)


def explored(size: Size) -> lung.Breaths:
    """Breaths of the lungs of the study, stacked over the lungs."""
    made = []
    for i, (R, C) in enumerate(size.lungs):
        env = task_of(R, C, size.sensor_delay)
        known: Any = dict(resistance=R, compliance=C)
        made.append(lung.explore(env, size.breaths, key=jr.key(i), **known))
    return stack(made)


def grouped(breaths: lung.Breaths) -> Any:
    """The lungs of a file, and the same number of breaths of each lung."""
    R, C = np.asarray(breaths.resistance), np.asarray(breaths.compliance)
    lungs = sorted(set(zip(R.tolist(), C.tolist(), strict=True)))
    parts = [breaths[np.flatnonzero((R == r) & (C == c))] for r, c in lungs]
    fewest, (r, c) = min((len(part), at) for part, at in zip(parts, lungs, strict=True))
    if fewest < 6:
        raise ValueError(
            f"lung: data must have at least 6 breaths of each lung, got {fewest} with "
            f"R = {r:g} and C = {c:g}."
        )
    return np.asarray(lungs), stack(part[:fewest] for part in parts)


def left_out(recorded: lung.Breaths, breaths: lung.Breaths) -> str:
    """A sentence about the recorded breaths that are left out; empty if none is."""
    lungs, each = breaths.pressure.shape[:2]
    count = len(recorded) - lungs * each
    if not count:
        return ""
    return (
        f"{count} of the {len(recorded)} breaths are left out, so that each of the "
        f"{lungs} lungs has {each} breaths, as many as the lung with the fewest."
    )


def divided(breaths: lung.Breaths, key: PRNGKey) -> tuple[lung.Breaths, lung.Breaths]:
    """Split the breaths of each lung into breaths to train on and to test on."""
    halves = [part.split(1 / 6, key=key) for part in unstack(breaths)]
    train, test = (stack(parts) for parts in zip(*halves, strict=True))
    return train, test


def learned(
    train: lung.Breaths, size: Size, key: PRNGKey, **options: Any
) -> lung.LearnedLung:
    """A learned lung for each lung, stacked."""
    keys = jr.split(jr.fold_in(key, 2), train.pressure.shape[0])
    parts = zip(unstack(train), keys, strict=True)
    options |= dict(teacher_steps=size.teacher_steps, steps=size.simulator_steps)
    models = stack([lung.LearnedLung(part, key=own) for part, own in parts])
    return lung.fit_lungs(models, train, key=jr.fold_in(key, 3), **options).model


def fitted(
    name: str, train: lung.Breaths, size: Size, key: PRNGKey, **options: Any
) -> lung.LungModel:
    """Models of one kind, fitted to the breaths of each lung and stacked."""
    kind = KINDS[name]
    keys = jr.split(jr.fold_in(key, 4), train.pressure.shape[0])
    sensor = train.dt[0], size.sensor_delay
    models = stack([lung.LungModel(kind.make(k), *sensor) for k in keys])
    of_system = lambda names: [f"dynamics.dynamics.system.{n}" for n in names.split()]
    constraints = dict.fromkeys(of_system(kind.positive), positive)
    options |= dict(
        steps=size.physics_steps * kind.steps,
        learning_rate=kind.learning_rate,
        trainable=constraints | dict.fromkeys(of_system(kind.free)) or None,
        batch_size=32,
    )
    return lung.fit_lungs(models, train, key=jr.fold_in(key, 5), **options).model


@eqx.filter_jit
def closed_loop(
    envs: Environment, controllers: Any, pips: Array, keys: PRNGKey, horizon: int
) -> tuple[Array, Array, Trajectory]:
    """Run the controllers, one for each lung. Returns the errors over an inspiration,
    the highest pressures, and the breaths, of shape `(lungs, keys, pips)`."""

    def in_lung(env, controller):
        def one(pip, key):
            world, policy = lung.BreathWaveform.at_pip((env, controller), pip)
            run: Any = rollout(world, policy, key=key, horizon=horizon, throw=False)
            highest = jnp.max(run.states[:, env.cost.index])
            return jnp.mean(run.costs[:INSPIRATION]), highest, run

        return jax.vmap(lambda key: jax.vmap(one, (0, None))(pips, key))(keys)

    return eqx.filter_vmap(in_lung)(envs, controllers)


def closed_loop_errors(
    envs: Environment, models: dict[str, Any], controllers: Any
) -> dict[str, np.ndarray]:
    """The mean distance between the pressures in each simulator and in the lung, under
    the same controller and without noise. By kind, of shape `(lungs,)`."""
    waveforms = envs.cost.waveform  # pyright: ignore[reportAttributeAccessIssue]
    whole = eqx.filter_vmap(lung.Breathing)(controllers, waveforms)
    pips, keys = jnp.asarray(TRAIN_PIPS), jr.key(0)[None]

    def read(envs):
        run: Any = closed_loop(envs, whole, pips, keys, INSPIRATION)[-1]
        return run.observations[:, 0, :, :, 0]

    truth = read(eqx.tree_at(lambda env: env.sensor_noise, envs, None))
    task = lambda model, waveform: lung.learned_lung(model, waveform=waveform)
    read_in = lambda model: read(eqx.filter_vmap(task)(model, waveforms))
    apart = lambda model: np.abs(np.asarray(read_in(model) - truth))
    return {name: np.mean(apart(m), axis=(1, 2)) for name, m in models.items()}
