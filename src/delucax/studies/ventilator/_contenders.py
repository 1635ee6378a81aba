"""The controllers of the study: designed, searched for, or trained in simulators."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array, Float

from ... import lung
from ..._typing import PRNGKey
from ...controllers import gpc, LeakyPID, online_newton, OutputFeedback, PID
from ...costs import Tracking
from ...dynamics import LinearDynamics
from ...environments import Environment
from ...estimators import KalmanFilter
from ...training.sysid import arx
from ._stages import ABORT, SEEN, Size


TRUE_PID = dict(
    kp=(0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0),
    ki=(0.0, 0.3, 1.0, 2.0, 3.0, 5.0, 10.0, 20.0),
    kd=(0.0, 0.01, 0.03),
)
"""The gains of the true PIDs that are tried."""
_NOISE = 0.2
_TUNED_FURTHER = 4
"""How many of the PIDs that are drawn at random are trained on."""
_CAREFUL = ABORT - 15
"""One that does not know its lung has to stay well below the limit."""


class Contender(NamedTuple):
    """A row of the report, before it was run.

    - `label`, `seed`: what it is called.
    - `controllers`: of the inspiratory valve, stacked over the lungs; if it is
        `shared`, one for all of them.
    """

    label: str
    seed: int
    controllers: Any
    shared: bool = False


class Trainer(NamedTuple):
    """Trains controllers through simulators of the lungs, stacked."""

    simulators: Any
    waveform: lung.BreathWaveform
    size: Size
    key: PRNGKey

    @property
    def count(self) -> int:
        """How many lungs there are."""
        return self.simulators.dt.shape[0]

    @property
    def dt(self) -> Array:
        """The control interval."""
        return self.simulators.dt[0]

    def __call__(
        self, start: Any, steps: int, fold: int, *, limit: Any = None, **options: Any
    ) -> Any:
        """The trained controllers: see [`delucax.lung.train_controllers`][]."""
        task = lambda model: lung.lung_environment(model, self.waveform, limit=limit)
        # Compiled, as the trainings are: then the first states round as they do there.
        envs = eqx.filter_jit(eqx.filter_vmap(task))(self.simulators)
        options |= dict(steps=steps, key=jr.fold_in(self.key, fold))
        return lung.train_controllers(envs, start, **options).model

    def pid(self, kind: type[LeakyPID | PID], gains: Any) -> LeakyPID | PID:
        """A PID that follows the waveform."""
        return kind(*gains, dt=self.dt, reference=self.waveform)

    def policies(self, shape: tuple[int, ...], fold: int, **options: Any) -> Any:
        """Networks before they are trained, stacked to `shape`."""
        make = lambda key: lung.BreathPolicy(self.waveform, self.dt, key=key, **options)
        return _stacked(make, jr.split(jr.fold_in(self.key, fold), shape))


def _stacked(make: Callable[[PRNGKey], Any], keys: PRNGKey) -> Any:
    return lung.stack([_stacked(make, k) for k in keys]) if keys.ndim else make(keys)


def searched_pids(envs: Environment, trainer: Trainer) -> dict[str, LeakyPID | PID]:
    """The best PID of each kind, for each lung and for all."""
    best: dict[str, Any] = {}
    true: Any = dict(TRUE_PID, kind="true")
    for name, kind, options in (("leaky PID", LeakyPID, {}), ("PID", PID, true)):
        grid = lung.pid_grid(envs, key=jr.fold_in(trainer.key, 6), **options)
        best[name] = lung.stack([trainer.pid(kind, gains) for gains in grid.best()])
        best[f"{name} for all"] = trainer.pid(kind, grid.best_of_all())
    return best


def trained_pids(
    trainer: Trainer, pids: dict[str, Any], *, checkpoint: Path, progress: bool
) -> dict[str, Any]:
    """Those PIDs trained on, by themselves and with a feed-forward."""
    forward = lung.FeedForward(trainer.waveform, jnp.asarray(0.3))
    starts = {f"trained {name}": pid for name, pid in pids.items()}
    starts["PID + feed-forward"] = eqx.filter_vmap(lung.Summed)(
        pids["PID"], lung.stack([forward] * trainer.count)
    )
    starts["PID + feed-forward for all"] = lung.Summed(pids["PID for all"], forward)
    trained, options = {}, dict(learning_rate=0.05, progress=progress)
    for name, start in starts.items():
        steps = trainer.size.pid_steps * (2 if "forward" in name else 1)
        file = f"{checkpoint}.{name.replace(' ', '_')}"
        options |= dict(shared=name.endswith("for all"), checkpoint=file)
        models = trainer(lung.stack([start]), steps, 6, **options)
        trained[name] = lung.unstack(models)[0]
    return trained


def _log_uniform(key: PRNGKey, low: float, high: float) -> Array:
    return jnp.exp(jr.uniform(key, minval=jnp.log(low), maxval=jnp.log(high)))


@eqx.filter_jit
def _drawn(
    kind: type[LeakyPID | PID], count: int, dt: Array, waveform: Any, key: PRNGKey
) -> lung.Summed:
    """PIDs with a feed-forward, gains at random over orders of magnitude."""

    def one(key):
        keys, between = jr.split(key, 7), _log_uniform
        some = jr.bernoulli(keys[0], 0.5, (3,))
        kd = between(keys[1], 0.003, 0.2) * (1.0 if kind is PID else 20.0)
        gains = between(keys[2], 0.03, 8.0), between(keys[3], 0.05, 40.0), some[0] * kd
        forward = lung.FeedForward(
            waveform,
            some[1] * jr.uniform(keys[4], maxval=3.0),
            some[2] * jr.uniform(keys[5], minval=-10.0, maxval=15.0),
        )
        return lung.Summed(kind(*gains, dt=dt, reference=waveform), forward)

    return eqx.filter_vmap(one)(jr.split(key, count))


@eqx.filter_jit
def _errors(
    envs: Environment, controllers: Any, key: PRNGKey, own: bool
) -> Float[Array, "lungs controllers"]:
    """The error of each in each lung, shape `(lungs, controllers)`; of controllers of
    shape `(controllers,)`, or `(controllers, lungs)` if each lung has its own."""
    options: Any = dict(key=key, pips=jnp.asarray(SEEN))
    of = lambda env, one: jnp.mean(lung.breath_error(env, one, **options))
    across = eqx.filter_vmap(of, in_axes=(None, eqx.if_array(0)))
    over = eqx.if_array(1) if own else None
    errors = eqx.filter_vmap(across, in_axes=(eqx.if_array(0), over))(envs, controllers)
    return jnp.where(jnp.isfinite(errors), errors, jnp.inf)


def taken(tree: Any, index: Any) -> Any:
    """What an index takes of each array of stacked modules."""
    return jax.tree.map(lambda a: a[index] if eqx.is_array(a) else a, tree)


def best_of(candidates: Any, errors: Any, shared: bool) -> Any:
    """The candidate with the least error in each lung, or on average over all; errors
    have the shape `(lungs, candidates)`."""
    if shared:
        return taken(candidates, jnp.argmin(jnp.mean(errors, axis=0)))
    return taken(candidates, (jnp.argmin(errors, axis=1), jnp.arange(errors.shape[0])))


def tuned_pids(
    envs: Environment,
    trainer: Trainer,
    say: Callable[[str], Any],
    *,
    checkpoint: Path,
    progress: bool,
) -> dict[str, Any]:
    """The best of many at random and of the best few of them trained on, in each lung
    and for all: by their errors in the lungs themselves, which no network is given."""
    best: dict[str, Any] = {}
    dt, size = envs.dt[0], trainer.size
    options: Any = dict(steps=size.pid_steps, progress=progress)
    options |= dict(learning_rate=0.03, throw=False)
    for k, (kind, name) in enumerate(((PID, "PID"), (LeakyPID, "leaky PID"))):
        keys = jr.split(jr.fold_in(trainer.key, 20 + k), 4)
        draw_key, search_key, fit_key, judge_key = keys
        drawn = _drawn(kind, size.tuned, dt, trainer.waveform, draw_key)
        errors = _errors(envs, drawn, search_key, False)
        for shared in (False, True):
            ranked = jnp.mean(errors, axis=0) if shared else errors.T
            begin = taken(drawn, jnp.argsort(ranked, axis=0)[:_TUNED_FURTHER])
            label = f"tuned {name} + feed-forward" + (" for all" if shared else "")
            file = Path(f"{checkpoint}.{label.replace(' ', '_')}")
            options |= dict(checkpoint=file, shared=shared)
            trained = lung.train_controllers(envs, begin, key=fit_key, **options)
            both = [*lung.unstack(begin), *lung.unstack(trained.model)]
            candidates = lung.stack(both)
            judged = _errors(envs, candidates, judge_key, not shared)
            if words := divergence_note(trained.history["diverged"], judged):
                say(f"  {label}: {words}")
            best[label] = best_of(candidates, judged, shared)
    return best


def divergence_note(diverged: Any, errors: Any) -> str:
    """A sentence about the PIDs that diverged; empty if none did."""
    lost, steps = int(jnp.sum(~jnp.isfinite(errors))), int(np.sum(diverged > 0))
    if not lost and not steps:
        return ""
    return (
        f"{lost} of {errors.size} errors are not finite, and count as infinite; in "
        f"{steps} of {len(diverged)} steps a PID had no finite gradient."
    )


def pid_contenders(pids: dict[str, Any]) -> list[Contender]:
    """PIDs by name, those that end with "for all" alike in each lung."""
    return [Contender(n, 0, pid, n.endswith("for all")) for n, pid in pids.items()]


def networks(
    trainer: Trainer, kind: Literal["mlp", "cnn"], seeds: int, **options: Any
) -> lung.BreathPolicy:
    """A network for each lung, of shape `(seeds, lungs)`."""
    width = 32 if kind == "mlp" else 12
    start = trainer.policies((seeds, trainer.count), 7, kind=kind, width=width)
    return trainer(start, trainer.size.controller_steps, 8, **options)


def networks_on_pids(
    trainer: Trainer, pids: dict[str, Any], **options: Any
) -> lung.Summed:
    """A PID and a network on top of it for each lung, of shape `(1, lungs)`."""
    # So that the network adds nothing before it is trained.
    offset = 100 * jax.nn.sigmoid(jnp.asarray(-2.0))
    summed = eqx.filter_vmap(lambda a, b: lung.Summed(a, b, offset=offset))
    policies = trainer.policies((trainer.count,), 9)
    start = lung.stack([summed(pids["leaky PID"], policies)])
    return trainer(start, trainer.size.controller_steps, 10, **options)


def networks_for_all(trainer: Trainer, **options: Any) -> lung.BreathPolicy:
    """A network for all lungs, of shape `(seeds,)`."""
    size = trainer.size
    width, controls = size.shared_network
    start = trainer.policies((size.seeds,), 11, width=width, controls=controls)
    options |= dict(shared=True, limit=_CAREFUL)
    return trainer(start, size.shared_steps, 12, **options)


def planners(trainer: Trainer) -> Contender:
    """Predictive control in the learned lungs."""
    waveforms = lung.stack([trainer.waveform] * trainer.count)
    plan = eqx.filter_vmap(lung.ShootingMPC)(trainer.simulators, waveforms)
    return Contender("MPC", 0, plan)


def online_learners(
    train: lung.Breaths, pids: dict[str, Any], waveform: lung.BreathWaveform, delay: int
) -> Any:
    """GPC around the best leaky PID of each lung, stacked over the lungs.

    Its model is linear: the least-squares fit of the next pressure to the last ones and
    the last controls in the breaths. A Kalman filter gives it the state.
    """
    newton = online_newton()

    def learner(breaths: lung.Breaths, pid: LeakyPID) -> OutputFeedback:
        outputs, controls = breaths.pressure[..., None], breaths.u_in[:, :-1, None]
        dt: Any = breaths.dt
        # A model to predict with: each of its numbers need not be known.
        lags: Any = dict(outputs_back=2, controls_back=4, delay=delay + 1)
        identified = arx(outputs, controls, dt=dt, throw=False, **lags).model
        n = identified.state_size
        model = LinearDynamics(identified.A, identified.B, dt=dt)
        gains = pid.kp, pid.ki, pid.kd
        base = LeakyPID(*gains, dt=dt, reference=waveform, output=0)
        error = jnp.zeros(n).at[0].set(1.0)
        cost = Tracking(error, jnp.zeros(1), _Target(waveform, n))
        online = gpc(model, cost, base=base, horizon=10, optimiser=newton)
        # All that the fit leaves over moves the lung; the sensor is taken at its word.
        process = jnp.diag(_NOISE**2 * error)
        mean = error.at[1].set(1.0) * waveform.peep
        kalman = KalmanFilter(identified, process, 1e-4 * jnp.eye(1), mean=mean)
        return OutputFeedback(online, kalman)

    each = lung.unstack(train), lung.unstack(pids["leaky PID"])
    return lung.stack([*map(learner, *each)])


class _Target(eqx.Module):
    """A target for the first of `size` states; zero for the others."""

    waveform: lung.BreathWaveform
    size: int = eqx.field(static=True)

    def __call__(self, t):
        return jnp.zeros(self.size).at[0].set(self.waveform.pressure(t))
