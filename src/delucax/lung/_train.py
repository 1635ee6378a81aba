"""Fitting lungs to breaths, and training controllers in them."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array

from .._check import check_count, check_key
from .._controller import AbstractController
from .._typing import PRNGKey
from ..environments import Environment
from ..simulation import rollout
from ..training import analytic, fit, Fitted
from ._data import Breaths, LENGTH, PIPS
from ._environment import ventilation
from ._learned import LearnedLung
from ._models import LungModel
from ._policies import Breathing
from ._waveform import at_pip, BreathWaveform


class _Simulation(eqx.Module):
    """The error of a batch of lungs over breaths, relative to the scale of each."""

    scale: Array
    teacher: bool = eqx.field(static=True)

    def __call__(self, models, batch, key):
        del key
        u_in, pressure = (jnp.swapaxes(column, 0, 1) for column in batch)

        def one(model, u_in, pressure):
            if self.teacher:
                found = jax.vmap(model.one_step)(u_in, pressure)
            else:
                found = jax.vmap(model.predict)(u_in)
            return jnp.mean(jnp.abs(found - pressure))

        errors = eqx.filter_vmap(one)(models, u_in, pressure)
        return jnp.mean(errors / self.scale)


def _kept(checkpoint: Any, ending: str = "") -> dict[str, Any]:
    """Where `fit` writes its checkpoints, and how often."""
    if checkpoint is None:
        return {}
    return dict(checkpoint=f"{checkpoint}{ending}", checkpoint_every=100)


def stack(trees: Sequence[Any]) -> Any:
    """Modules of one structure as one, each array with a leading axis over them.

    **Arguments:** `trees`: the modules.

    **Returns:** the stacked module.

    **Raises:** `ValueError` if there are none, or their structures differ.

    !!! example

        ```python
        from delucax.lung import SingleCompartment, stack

        stack([SingleCompartment(r) for r in (5.0, 20.0, 50.0)]).resistance
        ```
    """
    trees = list(trees)
    if not trees:
        raise ValueError("stack: trees must not be empty.")
    structures = {jax.tree.structure(eqx.filter(tree, eqx.is_array)) for tree in trees}
    if len(structures) > 1:
        raise ValueError("stack: trees must be of one structure.")

    def joined(*leaves):
        return jnp.stack(leaves) if eqx.is_array(leaves[0]) else leaves[0]

    return jax.tree.map(joined, *trees)


def unstack(tree: Any) -> list[Any]:
    """The modules that [`delucax.lung.stack`][] made one of.

    **Arguments:** `tree`: the stacked module.

    **Returns:** a list of modules.

    !!! example

        ```python
        from delucax.lung import SingleCompartment, stack, unstack

        unstack(stack([SingleCompartment(r) for r in (5.0, 20.0)]))[1].resistance
        ```
    """
    arrays, rest = eqx.partition(tree, eqx.is_array)
    count = jax.tree.leaves(arrays)[0].shape[0]
    return [
        eqx.combine(jax.tree.map(lambda a, i=i: a[i], arrays), rest)
        for i in range(count)
    ]


def fit_lungs(
    models: Any,
    breaths: Breaths,
    *,
    key: PRNGKey,
    teacher_steps: int = 1000,
    steps: int = 800,
    learning_rate: float = 5e-3,
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
        several as [`delucax.lung.stack`][] makes one of them.
    - `breaths`: [`delucax.lung.Breaths`][] of shape `(B, T)`; of `(models, B, T)` for
        several.
    - `key`: a random key, for the batches.
    - `teacher_steps`: of the first part, 1000 by default.
    - `steps`: of the second part, 800 by default.
    - `learning_rate`: 5e-3 by default, and twice that in the first part.
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
    if not isinstance(breaths, Breaths):
        raise ValueError(
            f"{where}: breaths must be Breaths, got {type(breaths).__name__}."
        )
    single = breaths.pressure.ndim == 2
    u_in, pressure = breaths.u_in, breaths.pressure
    if single:
        arrays, rest = eqx.partition(models, eqx.is_array)
        models = eqx.combine(jax.tree.map(lambda a: a[None], arrays), rest)
        u_in, pressure = u_in[None], pressure[None]
    data = jnp.swapaxes(u_in, 0, 1), jnp.swapaxes(pressure, 0, 1)
    size = data[0].shape[0]
    batch_size = None if batch_size is None or batch_size >= size else batch_size
    scale = jnp.std(pressure, axis=(1, 2))
    learned = isinstance(models, LearnedLung)
    parts = [(True, teacher_steps, 2 * learning_rate)] if learned else []
    parts += [(False, steps, learning_rate)]
    fitted = None
    for teacher, count, rate in parts:
        if count == 0:
            continue
        schedule = optax.cosine_decay_schedule(rate, check_count(count, "steps", where))
        fitted = fit(
            _Simulation(scale, teacher),
            models,
            optax.chain(optax.clip_by_global_norm(1.0), optax.adam(schedule)),
            count,
            key=jax.random.fold_in(key, int(teacher)),
            data=data,
            batch_size=batch_size,
            trainable=trainable,
            progress=progress,
            **_kept(checkpoint, ".first" if teacher else ""),
        )
        models = fitted.model
    if fitted is None:
        raise ValueError(f"{where}: steps must not all be 0.")
    if single:
        arrays, rest = eqx.partition(models, eqx.is_array)
        model = eqx.combine(jax.tree.map(lambda a: a[0], arrays), rest)
        fitted = Fitted(model, fitted.history, fitted.result)
    return fitted


def open_loop_error(model: Any, breaths: Breaths) -> Array:
    """The mean absolute error of a lung that is given the recorded controls alone.

    Against the truth of the breaths where it is known, else against what the sensor
    read.

    **Arguments:**

    - `model`: a [`delucax.lung.LearnedLung`][] or [`delucax.lung.LungModel`][].
    - `breaths`: [`delucax.lung.Breaths`][], shape `(B, T)`.

    **Returns:** a scalar [cmH2O].

    !!! example

        ```python
        import jax.numpy as jnp
        from delucax import lung

        model = lung.LungModel(lung.SingleCompartment())
        u = 20.0 * jnp.ones((2, 10))
        breaths = lung.Breaths(u, 0 * u, 5 + 0 * u, dt=0.03)
        lung.open_loop_error(model, breaths)
        ```
    """
    truth = breaths.pressure if breaths.truth is None else breaths.truth
    return jnp.mean(jnp.abs(jax.vmap(model.predict)(breaths.u_in) - truth))


def lung_environment(
    model: Any,
    waveform: BreathWaveform | None = None,
    *,
    noise: Any = 0.2,
    horizon: int = LENGTH,
) -> Environment:
    """A task in a fitted lung: where controllers are trained.

    **Arguments:**

    - `model`: a [`delucax.lung.LearnedLung`][] or [`delucax.lung.LungModel`][].
    - `waveform`: the target, a [`delucax.lung.BreathWaveform`][]; the default one by
        default.
    - `noise`: the standard deviation of what the sensor adds [cmH2O], 0.2 by default.
    - `horizon`: steps an episode, 29 by default.

    **Returns:** an [`delucax.Environment`][].

    **Raises:** `ValueError` if it is no such model.

    !!! example

        ```python
        from delucax import lung

        env = lung.lung_environment(lung.LungModel(lung.SingleCompartment()))
        ```
    """
    if isinstance(model, LungModel):
        inner, delay = model.dynamics.dynamics, model.dynamics.delay
        rest = model.system.resting(model.peep)
    elif isinstance(model, LearnedLung):
        inner, delay, rest = model, 0, model.resting()
    else:
        raise ValueError(
            "lung_environment: model must be a LearnedLung or a LungModel, got "
            f"{type(model).__name__}."
        )
    arguments = ventilation(
        inner, waveform, rest=rest, sensor_delay=delay, noise=noise, horizon=horizon
    )
    return Environment(**arguments)


def breath_error(
    env: Environment,
    controller: AbstractController,
    *,
    key: PRNGKey,
    pips: Any = PIPS,
    horizon: int = LENGTH,
) -> Array:
    """How far from the target a controller keeps the pressure, on average.

    **Arguments:**

    - `env`: a task of a lung.
    - `controller`: of both valves ([`delucax.lung.Breathing`][]), or of the inspiratory
        one alone.
    - `key`: a random key, for the noise of the sensor.
    - `pips`: the peak pressures to follow, each in an episode of its own;
        10, 15, ..., 35 cmH2O by default.
    - `horizon`: steps an episode, 29 by default: 0.87 s of an inspiration.

    **Returns:** the mean of `|p - r|` over the steps of each episode, shape `(pips,)`
        [cmH2O]. NaN where a run failed.

    !!! example

        ```python
        import delucax as dlx
        import jax
        from delucax import lung

        env = dlx.make("lung/single_compartment")
        waveform = env.cost.waveform
        pid = dlx.controllers.LeakyPID(dt=env.dt, reference=waveform)
        lung.breath_error(env, pid, key=jax.random.key(0), pips=[20.0, 30.0])
        ```
    """
    waveform = env.cost.waveform  # pyright: ignore[reportAttributeAccessIssue]
    whole = controller
    if not isinstance(controller, Breathing):
        whole = Breathing(controller, waveform)

    def one(pip, key):
        world, policy = at_pip((env, whole), pip)
        run: Any = rollout(
            world, policy, key=key, horizon=horizon, keep=("costs",), throw=False
        )
        return jnp.mean(run.costs)

    pips = jnp.asarray(pips, float)
    return jax.vmap(one)(pips, jax.random.split(key, pips.shape[0]))


class _Ventilated(eqx.Module):
    """The mean error of a batch of controllers, each in its own lungs."""

    models: Any
    waveform: BreathWaveform
    pips: Array
    noise: Array
    horizon: int = eqx.field(static=True)
    shared: bool = eqx.field(static=True)

    def __call__(self, controllers, key):
        def one(model, controller, key):
            env = lung_environment(
                model, self.waveform, noise=self.noise, horizon=self.horizon
            )
            pips = self.pips
            options: Any = dict(pips=pips, horizon=self.horizon, key=key)
            return jnp.mean(breath_error(env, controller, **options))

        over_lungs = eqx.filter_vmap(
            one, in_axes=(eqx.if_array(0), None if self.shared else eqx.if_array(0), 0)
        )

        def of(controllers, key):
            count = jax.tree.leaves(eqx.filter(self.models, eqx.is_array))[0].shape[0]
            keys = jax.random.split(key, count)
            return jnp.mean(over_lungs(self.models, controllers, keys))

        seeds = jax.tree.leaves(eqx.filter(controllers, eqx.is_array))[0].shape[0]
        keys = jax.random.split(key, seeds)
        return jnp.mean(eqx.filter_vmap(of)(controllers, keys))


def train_controllers(
    models: Any,
    controllers: Any,
    *,
    key: PRNGKey,
    waveform: BreathWaveform | None = None,
    shared: bool = False,
    steps: int = 400,
    learning_rate: float = 1e-2,
    pips: Any = PIPS,
    noise: Any = 0.2,
    horizon: int = LENGTH,
    trainable: Any = None,
    gradient: Any = None,
    progress: bool = False,
    checkpoint: Any = None,
) -> Fitted:
    """Train controllers through fitted lungs, by the gradient of their error.

    The loss is [`delucax.lung.breath_error`][] over all peak pressures, with fresh
    noise in each step; Adam with a learning rate that falls to 0 along a cosine. As
    Adam moves each weight by itself, those of one controller do not feel the others.

    **Arguments:**

    - `models`: lungs, stacked by [`delucax.lung.stack`][].
    - `controllers`: of the inspiratory valve, stacked over seeds, and within a seed
        over the lungs: leaves of shape `(seeds, lungs, ...)`. With `shared`, of shape
        `(seeds, ...)`.
    - `key`: a random key, for the noise.
    - `waveform`: a [`delucax.lung.BreathWaveform`][]; the default one by default.
    - `shared`: whether one controller is for all lungs; false by default.
    - `steps`: 400 by default.
    - `learning_rate`: 1e-2 by default.
    - `pips`: the peak pressures to follow, 10, 15, ..., 35 cmH2O by default.
    - `noise`: the standard deviation of what the sensor adds [cmH2O], 0.2 by default.
    - `horizon`: steps an episode, 29 by default.
    - `trainable`, `gradient`, `progress`, `checkpoint`: of [`delucax.training.fit`][];
        the weights, the analytic gradient, no bar and no file by default.

    **Returns:** a [`delucax.training.Fitted`][].

    **Raises:** `ValueError` if the arguments are illegal, `RuntimeError` if it
    diverges.

    Source: Suo, Agarwal, Xia, Chen, Ghai, Yu, Gradu, Singh, Zhang, Minasyan, LaChance,
    Zajdel, Schottdorf, Cohen and Hazan, 2021.

    !!! example

        ```python
        import equinox as eqx
        import jax
        from delucax import lung

        models = lung.stack([lung.LungModel(lung.SingleCompartment())])
        forward = lung.FeedForward(lung.BreathWaveform(), gain=0.5)
        one = lung.stack([lung.stack([forward])])
        few = dict(steps=3, horizon=2, pips=[20.0])
        lung.train_controllers(models, one, key=jax.random.key(0), **few).history.loss
        ```
    """
    where = "train_controllers"
    waveform = BreathWaveform() if waveform is None else waveform
    steps = check_count(steps, "steps", where)
    loss = _Ventilated(
        models,
        waveform,
        jnp.asarray(pips, float),
        jnp.asarray(noise, float),
        check_count(horizon, "horizon", where),
        shared,
    )
    return fit(
        loss,
        controllers,
        optax.adam(optax.cosine_decay_schedule(learning_rate, steps)),
        steps,
        key=check_key(key, where),
        trainable=trainable,
        gradient=analytic if gradient is None else gradient,
        progress=progress,
        **_kept(checkpoint),
    )
