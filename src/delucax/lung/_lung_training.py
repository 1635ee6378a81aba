"""Fits lungs to breaths, and trains controllers in lungs."""

from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from .._check import (
    check_bool,
    check_choice,
    check_count,
    check_finite,
    check_instance,
    check_key,
    check_positive,
)
from .._controller import AbstractController, check_controller
from .._module import as_float_array, count_of, stack, unstack
from .._typing import PRNGKey
from ..controllers import LeakyPID, PID
from ..environments import Environment
from ..simulation import rollout
from ..training import analytic, fit, Fitted
from ._breath_controllers import Breathing
from ._breaths import Breaths
from ._explorer import GAINS
from ._learned_lung import LearnedLung
from ._ventilation import waveform_of
from ._waveform import as_pips, BreathWaveform, LENGTH, PIPS


class _Simulation(eqx.Module):
    """The mean error of several lungs over breaths, each relative to its scale."""

    scale: Array
    teacher: bool = eqx.field(static=True)

    def __call__(self, models, batch, key):
        u_in, pressure = (jnp.swapaxes(column, 0, 1) for column in batch)

        def one(model, u_in, pressure):
            inputs = (u_in, pressure) if self.teacher else (u_in,)
            predict = model.one_step if self.teacher else model.predict
            return jnp.mean(jnp.abs(jax.vmap(predict)(*inputs) - pressure))

        # Relative to the scales, so that lungs of large pressures do not dominate.
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
    """Fit several lungs at once, each to its own breaths.

    The training has two parts. The first part trains the model to predict each pressure
    from the recorded pressures before it, as in the paper. The first part is done only
    for a [`delucax.lung.LearnedLung`][]. The second part trains the model to predict
    all pressures of a breath from its controls only, so that the noise of the sensor
    does not bias the model. The loss is the mean absolute error of the pressure,
    divided by the standard deviation of the pressures. The optimiser is Adam with a
    learning rate that falls to 0 along a cosine.

    **Arguments:**

    - `models`: a [`delucax.lung.LearnedLung`][] or [`delucax.lung.LungModel`][], or
        several models stacked in one module, as `equinox.filter_vmap` returns them. In
        a stacked module each array has a leading axis over the models.
    - `breaths`: [`delucax.lung.Breaths`][] of shape `(B, T)`, or of shape
        `(models, B, T)` for several models.
    - `key`: a random key, to draw the batches.
    - `teacher_steps`: the number of steps of the first part, 1000 by default.
    - `steps`: the number of steps of the second part, 800 by default.
    - `learning_rate`: 5e-3 by default. The first part of the training uses twice this
        learning rate.
    - `optimiser`: an Optax optimiser for both parts in place of Adam, with its own
        learning rate; none by default.
    - `batch_size`: the number of breaths of each lung in a training step, 64 by
        default; `None` for all breaths.
    - `trainable`: what to train, as in [`delucax.training.fit`][]; the weights by
        default.
    - `progress`: whether to show a progress bar, `False` by default.
    - `checkpoint`: the path of a file from which an interrupted run continues. The
        first part of the training uses the same path with `.first` added. None by
        default.

    **Returns:** a [`delucax.training.Fitted`][], the result of the last part of the
    training.

    **Raises:** `ValueError` if the arguments are invalid, `RuntimeError` if the loss
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
        model = lung.LungModel(lung.SingleCompartment())
        options = dict(trainable="dynamics.dynamics.system.resistance", steps=5)
        fitted = lung.fit_lungs(model, breaths, key=jax.random.key(2), **options)
        ```
    """
    where = "fit_lungs"
    check_key(key, where)
    check_instance(breaths, Breaths, "breaths", where)
    single = breaths.pressure.ndim == 2
    if single:
        models, breaths = stack([models]), stack([breaths])
    # Batches are drawn along the first axis, the same rows for all lungs.
    data = jnp.swapaxes(breaths.u_in, 0, 1), jnp.swapaxes(breaths.pressure, 0, 1)
    if batch_size is not None and batch_size >= len(data[0]):
        batch_size = None
    scale = jnp.std(breaths.pressure, axis=(1, 2))
    learned = isinstance(models, LearnedLung)
    parts = [(True, teacher_steps, "teacher_steps", 2)] if learned else []
    parts += [(False, steps, "steps", 1)]
    options: Any = dict(trainable=trainable, progress=progress, data=data)
    fitted = None
    for teacher, count, name, times in parts:
        if check_count(count, name, where, least=0) == 0:
            continue
        # In open loop the gradients can grow along a breath: clip them.
        schedule = optax.cosine_decay_schedule(times * learning_rate, count)
        adam = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(schedule))
        if checkpoint is not None:
            ending = ".first" if teacher else ""
            options |= dict(checkpoint=f"{checkpoint}{ending}", checkpoint_every=100)
        fitted = fit(
            _Simulation(scale, teacher),
            models,
            adam if optimiser is None else optimiser,
            count,
            key=jax.random.fold_in(key, int(teacher)),
            batch_size=batch_size,
            **options,
        )
        models = fitted.model
    if fitted is None:
        raise ValueError(f"{where}: steps must not all be 0.")
    if single:
        fitted = Fitted(unstack(fitted.model)[0], fitted.history, fitted.result)
    return fitted


_KINDS: dict[str, Any] = {"leaky": LeakyPID, "true": PID}


def breath_error(
    env: Environment,
    controller: AbstractController,
    *,
    key: PRNGKey,
    pips: Any = PIPS,
    horizon: int = LENGTH,
) -> Array:
    """The mean absolute error of the pressure under a controller, with the weights of
    the task.

    The error of a step is the stage cost of the task, a [`delucax.lung.BreathCost`][].
    So the errors in the expiratory phase are weighted with the `expiration_weight` of
    the task, 0 by default. If the task has a `limit`, a pressure above the limit costs
    more.

    **Arguments:**

    - `env`: a task of a lung.
    - `controller`: a controller of both valves ([`delucax.lung.Breathing`][]), or of
        the inspiratory valve only.
    - `key`: a random key, for the noise of the sensor.
    - `pips`: the peak pressures of the target, one for each episode; 10, 15, ..., 35
        cmH2O by default.
    - `horizon`: the number of steps per episode, 29 by default, which are the first
        0.87 s of an inspiration.

    **Returns:** the mean cost of the steps of each episode [cmH2O], shape `(pips,)`.
        For the default `horizon` and a task without `limit`, this cost is the mean of
        $|p - r|$, the distance of the pressure from the target. The error is NaN if a
        simulation failed.

    **Raises:** `ValueError` if the arguments are invalid (for example, a peak pressure
    below PEEP).

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

        ```text
        Array([2.592, 3.808], dtype=float32)
        ```
    """
    where = "breath_error"
    waveform = waveform_of(env, where)
    check_controller(controller, "controller", where)
    pips = as_pips(pips, (waveform, controller), where)
    horizon = check_count(horizon, "horizon", where)
    is_whole = isinstance(controller, Breathing)
    whole = controller if is_whole else Breathing(controller, waveform)
    options: Any = dict(horizon=horizon, keep=("costs",), throw=False)

    def one(pip, key):
        world, policy = BreathWaveform.at_pip((env, whole), pip)
        run: Any = rollout(world, policy, key=key, **options)
        return jnp.where(run.failed, jnp.nan, jnp.mean(run.costs))

    keys = jax.random.split(check_key(key, where), pips.shape[0])
    return jax.vmap(one)(pips, keys)


class _TrackingError(eqx.Module):
    """The mean error of several controllers, each in its own lungs."""

    envs: Environment
    pips: Array
    horizon: int = eqx.field(static=True)
    shared: bool = eqx.field(static=True)
    throw: bool = eqx.field(static=True)

    def _counted(self, errors: Array) -> Array:
        """The errors, with 0 for those that are not finite unless `throw`."""
        return errors if self.throw else jnp.where(jnp.isfinite(errors), errors, 0)

    def __call__(self, controllers: Any, key: PRNGKey) -> Array:
        given: Any = dict(pips=self.pips, horizon=self.horizon)

        def in_lung(env, controller, key):
            return jnp.mean(breath_error(env, controller, key=key, **given))

        # A shared controller is not mapped over the lungs.
        own = None if self.shared else eqx.if_array(0)
        in_lungs = eqx.filter_vmap(in_lung, in_axes=(eqx.if_array(0), own, 0))

        def of_seed(controllers, key):
            keys = jax.random.split(key, count_of(self.envs))
            errors = in_lungs(self.envs, controllers, keys)
            if not self.shared:
                errors = self._counted(errors)
            return self._counted(jnp.mean(errors))

        keys = jax.random.split(key, count_of(controllers))
        return jnp.mean(eqx.filter_vmap(of_seed)(controllers, keys))


class _FiniteGradients(eqx.Module):
    """The analytic gradient, with 0 for each controller whose gradient is not finite.

    Controllers are stacked along the first `axes` axes of each leaf.
    """

    axes: int = eqx.field(static=True)

    def __call__(self, loss: Any, values: Any, key: PRNGKey) -> tuple[Any, Any]:
        cost, slope = analytic(loss, values, key)
        own = lambda leaf: tuple(range(self.axes, leaf.ndim))
        is_finite = lambda leaf: jnp.all(jnp.isfinite(leaf), axis=own(leaf))
        # Replace the whole gradient of a controller, because a part has no meaning.
        finite = jnp.all(jnp.stack([*map(is_finite, jax.tree.leaves(slope))]), axis=0)
        kept = lambda leaf: jnp.where(jnp.expand_dims(finite, own(leaf)), leaf, 0)
        diverged = jnp.sum(~finite).astype(cost.dtype)
        return (cost, {"diverged": diverged}), jax.tree.map(kept, slope)


def train_controllers(
    envs: Environment,
    controllers: Any,
    *,
    key: PRNGKey,
    shared: bool = False,
    steps: int = 400,
    learning_rate: float = 1e-2,
    pips: Any = PIPS,
    horizon: int = LENGTH,
    trainable: Any = None,
    progress: bool = False,
    checkpoint: Any = None,
    throw: bool = True,
) -> Fitted:
    """Train controllers on simulated lungs, by gradient descent on their error.

    The loss is the mean of [`delucax.lung.breath_error`][] over all peak pressures,
    lungs and seeds. The noise of the sensor is drawn again in each training step. The
    optimiser is Adam with a learning rate that falls to 0 along a cosine. Adam scales
    each weight separately, so the gradients of one controller do not affect the others.

    **Arguments:**

    - `envs`: tasks of lungs, stacked in one module, in which each array has a leading
        axis over the tasks. `equinox.filter_vmap(learned_lung)(models)` makes them from
        stacked models. The example below stacks tasks with several resistances.
    - `controllers`: controllers of the inspiratory valve, stacked in one module. Each
        array has the shape `(seeds, lungs, ...)`, with one controller for each seed and
        lung. If `shared` is true, each array has the shape `(seeds, ...)`.
    - `key`: a random key, for the noise of the sensor.
    - `shared`: whether all lungs share one controller; `False` by default.
    - `steps`: the number of training steps, 400 by default.
    - `learning_rate`: 1e-2 by default.
    - `pips`: the peak pressures to follow, 10, 15, ..., 35 cmH2O by default.
    - `horizon`: the number of steps per episode, 29 by default.
    - `trainable`, `progress`, `checkpoint`: as in [`delucax.training.fit`][]. By
        default the weights are trained, without a progress bar and without a checkpoint
        file.
    - `throw`: whether to raise an error if a loss or its gradient is not finite; `True`
        by default. If `throw` is `False`, a gradient that is not finite is replaced by
        0, so it does not affect the other controllers, and `history["diverged"]` counts
        the controllers with such a gradient at each step.

    **Returns:** a [`delucax.training.Fitted`][].

    **Raises:** `ValueError` if the arguments are invalid (for example, a peak pressure
    below PEEP), `RuntimeError` if `throw` is true and a loss or its gradient is not
    finite.

    Source: Suo, Agarwal, Xia, Chen, Ghai, Yu, Gradu, Singh, Zhang, Minasyan, LaChance,
    Zajdel, Schottdorf, Cohen and Hazan, 2021.

    !!! example

        ```python
        import delucax as dlx
        import equinox as eqx
        import jax
        import jax.numpy as jnp
        from delucax import lung

        task = lambda R: lung.single_compartment(resistance=R)
        envs = eqx.filter_vmap(task)(jnp.array([5.0, 20.0]))
        target = dict(dt=0.03, reference=lung.BreathWaveform())
        pid = lambda kp: dlx.controllers.LeakyPID(kp, 3.0, **target)
        pids = eqx.filter_vmap(eqx.filter_vmap(pid))(jnp.array([[0.5, 1.0]]))
        few = dict(steps=3, horizon=2, pips=[20.0], key=jax.random.key(1))
        lung.train_controllers(envs, pids, **few).model.kp  # one seed, two lungs
        ```
    """
    where = "train_controllers"
    if not isinstance(envs, Environment) or jnp.ndim(envs.dt) != 1:
        raise ValueError(
            f"{where}: envs must be tasks of lungs that are stacked, got one "
            f"{type(envs).__name__}; equinox.filter_vmap(delucax.lung.learned_lung) "
            "makes them from stacked models."
        )
    waveform = waveform_of(envs, where, stacked=True)
    steps = check_count(steps, "steps", where)
    check_positive(learning_rate, "learning_rate", where)
    loss = _TrackingError(
        envs,
        as_pips(pips, (waveform, controllers), where),
        check_count(horizon, "horizon", where),
        check_bool(shared, "shared", where),
        check_bool(throw, "throw", where),
    )
    adam = optax.adam(optax.cosine_decay_schedule(float(learning_rate), steps))
    gradient: Any = analytic if throw else _FiniteGradients(1 if shared else 2)
    options: Any = dict(trainable=trainable, progress=progress, checkpoint=checkpoint)
    options |= dict(checkpoint_every=None if checkpoint is None else 100, throw=throw)
    check_key(key, where)
    return fit(loss, controllers, adam, steps, key=key, gradient=gradient, **options)


@eqx.filter_jit
def _searched(envs, lists, pips, key, kind):
    """All combinations of gains, and the error of each combination in each lung."""
    lists = [jnp.ravel(values).astype(float) for values in lists]
    gains = jnp.stack(jnp.meshgrid(*lists, indexing="ij"), -1).reshape(-1, 3)

    def in_lung(env):
        def one(gains):
            pid = _KINDS[kind](*gains, dt=env.dt, reference=env.cost.waveform)
            return jnp.mean(breath_error(env, pid, key=key, pips=pips))

        return jax.vmap(one)(gains)

    return gains, eqx.filter_vmap(in_lung)(envs)


def pid_grid(
    envs: Environment,
    *,
    key: PRNGKey,
    kind: Literal["leaky", "true"] = "leaky",
    kp: Any = GAINS,
    ki: Any = GAINS,
    kd: Any = (0.0,),
    pips: Any = PIPS,
) -> tuple[Float[Array, "grid 3"], Float[Array, "lungs grid"]]:
    """Compute the error of every PID of a grid of gains in every lung, all at once.

    **Arguments:**

    - `envs`: a task of a lung, or several tasks stacked in one module, in which each
        array has a leading axis over the tasks.
    - `key`: a random key, for the noise of the sensor, which is the same for all PIDs.
    - `kind`: `"leaky"` (default) for [`delucax.controllers.LeakyPID`][], as in the
        original Deluca; `"true"` for [`delucax.controllers.PID`][].
    - `kp`, `ki`, `kd`: the gains. All combinations are tried. By default `kp` and `ki`
        each take the values 0, 0.1, ..., 0.9, 1, 2, ..., 10, and `kd` is 0.
    - `pips`: the peak pressures to follow, 10, 15, ..., 35 cmH2O by default.

    **Returns:** the gains (kp, ki, kd) of each PID, shape `(grid, 3)`, and the mean
        error of each PID in each lung [cmH2O], shape `(lungs, grid)`. A single task
        counts as one lung.

    **Raises:** `ValueError` if the arguments are invalid (for example, a peak pressure
    below PEEP).

    !!! example

        ```python
        import equinox as eqx
        import jax
        import jax.numpy as jnp
        from delucax import lung

        task = lambda R: lung.single_compartment(resistance=R)
        envs = eqx.filter_vmap(task)(jnp.array([5.0, 20.0]))
        few = dict(kp=[0.5, 1.0], ki=[1.0], pips=[20.0])
        gains, errors = lung.pid_grid(envs, key=jax.random.key(0), **few)
        best_in_each_lung = gains[jnp.nanargmin(errors, axis=1)]
        ```
    """
    where = "pid_grid"
    pips = as_pips(pips, waveform_of(envs, where, stacked=True), where)
    check_key(key, where)
    check_choice(kind, tuple(_KINDS), "kind", where)
    lists = []
    for name, values in (("kp", kp), ("ki", ki), ("kd", kd)):
        array = as_float_array(values)
        if not eqx.is_inexact_array(array) or not array.size:
            raise ValueError(f"{where}: {name} must be numbers, got {values!r}.")
        check_finite(array, name, where)
        lists.append(array)
    envs = envs if jnp.ndim(envs.dt) else stack([envs])
    return _searched(envs, lists, pips, key, kind)
