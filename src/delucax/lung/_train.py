"""Training controllers in fitted lungs."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array

from .._check import (
    check_bool,
    check_count,
    check_key,
    check_positive,
    check_range,
)
from .._controller import AbstractController
from .._module import function_field, parameter
from .._typing import PRNGKey
from ..costs import AbstractCost
from ..dynamics import AbstractDynamics
from ..environments import Environment
from ..simulation import rollout
from ..training import analytic, fit, Fitted
from ..training._loss import cost_and_metrics
from ._data import _waveform_of, LENGTH, PIPS
from ._environment import BreathCost, ventilation
from ._fitting import kept_at
from ._learned import LearnedLung
from ._models import LungModel
from ._policies import Breathing
from ._stacking import count_of
from ._waveform import as_pips, at_pip, BreathWaveform, check_waveform


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

    **Raises:** `ValueError` if it is no such model, or `waveform` is none.

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

    **Raises:** `ValueError` if the arguments are illegal (a peak pressure below PEEP,
    say).

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
    where = "breath_error"
    waveform = _waveform_of(env, where)
    if not isinstance(controller, AbstractController):
        raise ValueError(
            f"{where}: controller must be an AbstractController, got "
            f"{type(controller).__name__}."
        )
    pips = as_pips(pips, (waveform, controller), where)
    horizon = check_count(horizon, "horizon", where)
    whole = controller
    if not isinstance(controller, Breathing):
        whole = Breathing(controller, waveform)

    def one(pip, key):
        world, policy = at_pip((env, whole), pip)
        run: Any = rollout(
            world, policy, key=key, horizon=horizon, keep=("costs",), throw=False
        )
        return jnp.mean(run.costs)

    keys = jax.random.split(check_key(key, where), pips.shape[0])
    return jax.vmap(one)(pips, keys)


class _Careful(AbstractCost):
    """A cost of breaths, and ten times what the pressure is above a limit."""

    inner: BreathCost
    limit: Array = parameter()

    @property
    def waveform(self) -> BreathWaveform:
        """That of the cost."""
        return self.inner.waveform

    def __call__(self, t, x, u):
        excess = jnp.maximum(x[self.inner.index] - self.limit, 0)
        return (self.inner(t, x, u) + 10 * excess).astype(x.dtype)


class _Ventilated(eqx.Module):
    """The mean error of a batch of controllers, each in its own lungs."""

    models: Any
    waveform: BreathWaveform
    pips: Array
    noise: Array
    limit: Array | None
    horizon: int = eqx.field(static=True)
    shared: bool = eqx.field(static=True)
    throw: bool = eqx.field(static=True)

    def _counted(self, errors):
        """Errors, 0 for those that are not finite and are not to raise."""
        return errors if self.throw else jnp.where(jnp.isfinite(errors), errors, 0)

    def __call__(self, controllers, key):
        def one(model, controller, key):
            env = model
            if not isinstance(model, Environment):
                env = lung_environment(
                    model, self.waveform, noise=self.noise, horizon=self.horizon
                )
            if self.limit is not None:
                cost: Any = env.cost
                careful = _Careful(cost, self.limit)
                env = eqx.tree_at(lambda env: env.cost, env, careful)
            pips = self.pips
            options: Any = dict(pips=pips, horizon=self.horizon, key=key)
            return jnp.mean(breath_error(env, controller, **options))

        over_lungs = eqx.filter_vmap(
            one, in_axes=(eqx.if_array(0), None if self.shared else eqx.if_array(0), 0)
        )

        def of(controllers, key):
            keys = jax.random.split(key, count_of(self.models))
            errors = over_lungs(self.models, controllers, keys)
            if not self.shared:
                errors = self._counted(errors)
            return self._counted(jnp.mean(errors))

        keys = jax.random.split(key, count_of(controllers))
        return jnp.mean(eqx.filter_vmap(of)(controllers, keys))


class _Apart(eqx.Module):
    """A gradient that counts as 0 for a controller for which it is not finite."""

    gradient: Callable[..., Any] = function_field()
    axes: int = eqx.field(static=True)

    def __call__(self, loss, values, key):
        value, slope = self.gradient(loss, values, key)
        fine: Any = True
        for leaf in jax.tree.leaves(slope):
            inner = tuple(range(self.axes, leaf.ndim))
            fine = fine & jnp.all(jnp.isfinite(leaf), axis=inner)

        def kept(leaf):
            more = (1,) * (leaf.ndim - self.axes)
            return jnp.where(fine.reshape(fine.shape + more), leaf, 0)

        cost, metrics = cost_and_metrics(value, "train_controllers")
        lost = jnp.sum(~fine).astype(cost.dtype)
        return (cost, metrics | {"diverged": lost}), jax.tree.map(kept, slope)


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
    limit: Any = None,
    trainable: Any = None,
    gradient: Any = None,
    progress: bool = False,
    checkpoint: Any = None,
    throw: bool = True,
) -> Fitted:
    """Train controllers through fitted lungs, by the gradient of their error.

    The loss is [`delucax.lung.breath_error`][] over all peak pressures, with fresh
    noise in each step; Adam with a learning rate that falls to 0 along a cosine. As
    Adam moves each weight by itself, those of one controller do not feel the others.

    **Arguments:**

    - `models`: lungs, stacked by [`delucax.lung.stack`][]; or tasks of lungs, stacked,
        with a waveform and a noise of their own.
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
    - `limit`: a pressure above which each cmH2O counts ten times more, as an alarm is
        worse than an error [cmH2O]; none by default.
    - `trainable`, `gradient`, `progress`, `checkpoint`: of [`delucax.training.fit`][];
        the weights, the analytic gradient, no bar and no file by default.
    - `throw`: raise if an error or its gradient is NaN or infinite (default); if false,
        that gradient counts as 0, the other controllers are trained as if nothing were,
        and `history["diverged"]` says of how many it was in each step.

    **Returns:** a [`delucax.training.Fitted`][].

    **Raises:** `ValueError` if the arguments are illegal (a peak pressure below PEEP,
    say), `RuntimeError` as `throw` says.

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
    one_of = LungModel | Environment
    dynamics = models.dynamics if isinstance(models, one_of) else models
    if not isinstance(dynamics, AbstractDynamics) or jnp.ndim(dynamics.dt) != 1:
        raise ValueError(
            f"{where}: models must be LearnedLungs, LungModels or tasks of lungs that "
            f"delucax.lung.stack made one of, got one {type(models).__name__}."
        )
    waveform = BreathWaveform() if waveform is None else waveform
    check_waveform(waveform, where)
    steps = check_count(steps, "steps", where)
    check_positive(learning_rate, "learning_rate", where)
    check_range(noise, "noise", where)
    if limit is not None:
        check_positive(limit, "limit", where)
    loss = _Ventilated(
        models,
        waveform,
        as_pips(pips, (waveform, controllers), where),
        jnp.asarray(noise, float),
        None if limit is None else jnp.asarray(limit, float),
        check_count(horizon, "horizon", where),
        check_bool(shared, "shared", where),
        check_bool(throw, "throw", where),
    )
    gradient = analytic if gradient is None else gradient
    return fit(
        loss,
        controllers,
        optax.adam(optax.cosine_decay_schedule(learning_rate, steps)),
        steps,
        key=check_key(key, where),
        trainable=trainable,
        gradient=gradient if throw else _Apart(gradient, 1 if shared else 2),
        progress=progress,
        throw=throw,
        **kept_at(checkpoint),
    )
