"""What the ventilator study leaves to be measured by itself: the published training of
a simulator, and how closely a breath can be followed at all."""

from typing import Any

import equinox as eqx
import jax.random as jr
import numpy as np
import optax

import delucax as dlx
from delucax import lung
from delucax._module import stack, unstack
from delucax.studies.ventilator._simulators import divided, explored
from delucax.studies.ventilator._stages import FULL, INSPIRATION as LENGTH


EPOCHS, BATCH, SEEDS = 500, 64, 3
SIZES = dict(boundary=LENGTH - 1, u_window=5, p_window=3)
PIP = 35.0
TASKS = {"lung/single_compartment": 0, "lung/balloon_lung": 0, "lung/delay_lung": 5}
"""How many steps late a control acts in each."""


def as_published() -> dict[str, float]:
    """The open-loop error of a learned lung in each lung of the study, on the same
    breaths, the mean of some seeds, with the inputs, the sizes and the training of the
    paper: windows of 5 controls and 3 pressures, four layers of ten, a network for each
    step, each pressure predicted from the recorded ones, AdamW at 1e-3 with a weight
    decay of 1e-4, 500 epochs.

    Not as published: tanh, and batches of 64 breaths instead of 512, of which there are
    not as many; the published size would leave a seventh of the steps.
    """
    every = [_as_published(seed) for seed in range(SEEDS)]
    return {name: float(np.mean([one[name] for one in every])) for name in every[0]}


def _as_published(seed: int) -> dict[str, float]:
    key = jr.key(0)
    train, test = divided(explored(FULL), jr.fold_in(key, 1))
    fit_key = jr.fold_in(jr.fold_in(key, 3), seed)
    keys = jr.split(jr.fold_in(fit_key, 2), len(FULL.lungs))
    models = [
        lung.LearnedLung(part, 10, 4, published=True, key=own, **SIZES)
        for part, own in zip(unstack(train), keys, strict=True)
    ]
    steps = EPOCHS * -(-train.pressure.shape[1] // BATCH)
    fitted = lung.fit_lungs(
        stack(models),
        train,
        key=fit_key,
        teacher_steps=steps,
        steps=0,
        optimiser=optax.adamw(
            optax.cosine_decay_schedule(1e-3, steps), weight_decay=1e-4
        ),
        batch_size=BATCH,
        progress=True,
    )
    errors = eqx.filter_vmap(lung.Breaths.open_loop_error)(test, fitted.model)
    names = [f"R{R:g}C{C:g}" for R, C in FULL.lungs]
    return dict(zip(names, np.asarray(errors).tolist(), strict=True))


def least_errors() -> list[dict[str, Any]]:
    """About the least error in other tasks at 35 cmH2O, and how much of it is of the
    samples before any control can act."""
    rows = []
    for name, late in TASKS.items():
        env = dlx.make(name)
        (least,) = np.asarray(lung.least_error(env, pips=[PIP])).tolist()
        peep = float(env.cost.waveform.peep)  # pyright: ignore
        before = (late + 1) * (PIP - peep) / LENGTH
        rows.append({"task": name, "least error": least, "before a control": before})
    return rows
