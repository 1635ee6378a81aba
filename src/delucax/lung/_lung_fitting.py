"""Fitting lungs to breaths, one or several stacked."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array

from .._check import check_count, check_instance, check_key
from .._module import stack, unstack
from .._typing import PRNGKey
from ..training import fit, Fitted
from ._breaths import Breaths
from ._learned_lung import LearnedLung


class _Simulation(eqx.Module):
    """The error of a batch of lungs over breaths, relative to the scale of each."""

    scale: Array
    teacher: bool = eqx.field(static=True)

    def __call__(self, models, batch, key):
        del key
        u_in, pressure = (jnp.swapaxes(column, 0, 1) for column in batch)

        def one(model, u_in, pressure):
            inputs = (u_in, pressure) if self.teacher else (u_in,)
            predict = model.one_step if self.teacher else model.predict
            return jnp.mean(jnp.abs(jax.vmap(predict)(*inputs) - pressure))

        errors = eqx.filter_vmap(one)(models, u_in, pressure)
        return jnp.mean(errors / self.scale)


def fit_lungs(
    models: Any,
    breaths: Breaths,
    *,
    key: PRNGKey,
    teacher_steps: int = 1000,
    steps: int = 800,
    learning_rate: float = 5e-3,
    optimiser: optax.GradientTransformation | None = None,
    batch_size: int | None = 64,
    trainable: Any = None,
    progress: bool = False,
    checkpoint: Any = None,
) -> Fitted:
    """Fit lungs to breaths, each to its own: many at once.

    First, where the model can (a [`delucax.lung.LearnedLung`][]), each pressure is
    predicted from the recorded ones before it, as published; then the whole breath from
    its controls alone, which the noise of the sensor does not bias. The loss is the
    mean absolute error, relative to the standard deviation of the pressures; Adam with
    a learning rate that falls to 0 along a cosine.

    **Arguments:**

    - `models`: a [`delucax.lung.LearnedLung`][] or [`delucax.lung.LungModel`][], or
        several in one module, each array with a leading axis over them, as
        `equinox.filter_vmap` makes of them.
    - `breaths`: [`delucax.lung.Breaths`][] of shape `(B, T)`; of `(models, B, T)` for
        several.
    - `key`: a random key, for the batches.
    - `teacher_steps`: of the first part, 1000 by default.
    - `steps`: of the second part, 800 by default.
    - `learning_rate`: 5e-3 by default, and twice that in the first part.
    - `optimiser`: an Optax optimiser of both parts instead of Adam, with a learning
        rate of its own; none by default.
    - `batch_size`: breaths of each lung in a step, 64 by default; `None` for all.
    - `trainable`: what moves, as in [`delucax.training.fit`][]; the weights by default.
    - `progress`: whether to show a bar, false by default.
    - `checkpoint`: the path of a file from which a run that was cut off goes on
        (beside it, with `.first` added, that of the first part); none by default.

    **Returns:** a [`delucax.training.Fitted`][], that of the last part.

    **Raises:** `ValueError` if the arguments are illegal, `RuntimeError` if it
    diverges.

    Source: Suo, Agarwal, Xia, Chen, Ghai, Yu, Gradu, Singh, Zhang, Minasyan, LaChance,
    Zajdel, Schottdorf, Cohen and Hazan, 2021 (the first part).

    !!! example

        ```python
        import jax
        import jax.numpy as jnp
        from delucax import lung

        u = jnp.linspace(0.0, 50.0, 40).reshape(10, 4)
        breaths = lung.Breaths(u, 0 * u, 5 + u / 2, dt=0.03)
        model = lung.LearnedLung(breaths, width=2, boundary=1, key=jax.random.key(1))
        few = dict(teacher_steps=0, steps=5, batch_size=None)
        fitted = lung.fit_lungs(model, breaths, key=jax.random.key(2), **few)
        ```
    """
    where = "fit_lungs"
    check_key(key, where)
    check_instance(breaths, Breaths, "breaths", where)
    single = breaths.pressure.ndim == 2
    u_in, pressure = breaths.u_in, breaths.pressure
    if single:
        models = stack([models])
        u_in, pressure = u_in[None], pressure[None]
    data = jnp.swapaxes(u_in, 0, 1), jnp.swapaxes(pressure, 0, 1)
    size = data[0].shape[0]
    batch_size = None if batch_size is None or batch_size >= size else batch_size
    scale = jnp.std(pressure, axis=(1, 2))
    learned = isinstance(models, LearnedLung)
    parts = [(True, teacher_steps, "teacher_steps", 2)] if learned else []
    parts += [(False, steps, "steps", 1)]
    fitted = None
    for teacher, count, name, times in parts:
        if check_count(count, name, where, least=0) == 0:
            continue
        schedule = optax.cosine_decay_schedule(times * learning_rate, count)
        adam = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(schedule))
        fitted = fit(
            _Simulation(scale, teacher),
            models,
            adam if optimiser is None else optimiser,
            count,
            key=jax.random.fold_in(key, int(teacher)),
            data=data,
            batch_size=batch_size,
            trainable=trainable,
            progress=progress,
            checkpoint=checkpoint and f"{checkpoint}{'.first' if teacher else ''}",
            checkpoint_every=100 if checkpoint else None,
        )
        models = fitted.model
    if fitted is None:
        raise ValueError(f"{where}: steps must not all be 0.")
    if single:
        fitted = Fitted(unstack(fitted.model)[0], fitted.history, fitted.result)
    return fitted
