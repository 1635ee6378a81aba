"""The controllers of the study: designed, searched for, or trained in simulators."""

from pathlib import Path
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array

from ... import lung
from ..._typing import PRNGKey
from ...controllers import gpc, LeakyPID, online_newton, OutputFeedback, PID
from ...costs import Tracking
from ...dynamics import LinearDynamics
from ...environments import Environment
from ...estimators import KalmanFilter
from ...training.sysid import arx
from ._size import ABORT, Size
from ._stacks import repeated


TRUE_PID = dict(
    kp=(0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0),
    ki=(0.0, 0.3, 1.0, 2.0, 3.0, 5.0, 10.0, 20.0),
    kd=(0.0, 0.01, 0.03),
)
"""The gains of the true PIDs that are tried."""
_NOISE = 0.2
_CAREFUL = ABORT - 15
"""One that does not know its lung has to stay well below the limit."""


class Contender(NamedTuple):
    """A row of the report, before it was run.

    - `label`, `seed`: what it is called.
    - `controllers`: of the inspiratory valve, stacked over the lungs.
    - `shared`: whether they are all the same.
    """

    label: str
    seed: int
    controllers: Any
    shared: bool


class Trainer(NamedTuple):
    """Trains controllers through simulators of the lungs, stacked."""

    simulators: Any
    waveform: lung.BreathWaveform

    @property
    def count(self) -> int:
        """How many lungs there are."""
        return self.simulators.dt.shape[0]

    @property
    def dt(self) -> Array:
        """The control interval."""
        return self.simulators.dt[0]

    def __call__(
        self, start: Any, steps: int, key: PRNGKey, *, limit: Any = None, **options: Any
    ) -> Any:
        """The trained controllers: see [`delucax.lung.train_controllers`][]."""
        in_simulator = lambda model: lung.lung_environment(
            model, self.waveform, limit=limit
        )
        # Compiled, as the trainings are: then the first states round as they do there.
        envs = eqx.filter_jit(eqx.filter_vmap(in_simulator))(self.simulators)
        return lung.train_controllers(
            envs, start, steps=steps, key=key, **options
        ).model


def designed(trainer: Trainer) -> dict[str, Contender]:
    """Those that need no data: no control, and the valve open or closed."""
    none = LeakyPID(0.0, 0.0, 0.0, dt=trainer.dt, reference=trainer.waveform)
    # A PID without gains, as which it compiles nothing of its own.
    controllers = {"zero": none, "bang-bang": lung.BangBang(trainer.waveform)}
    return {
        label: Contender(label, 0, repeated(one, trainer.count), True)
        for label, one in controllers.items()
    }


def searched_pids(
    envs: Environment, trainer: Trainer, key: PRNGKey
) -> dict[str, LeakyPID | PID]:
    """The best PID of each kind, for each lung and for all."""
    key = jr.fold_in(key, 6)
    best: dict[str, Any] = {}
    for name, kind, grid in (
        ("leaky PID", LeakyPID, lung.pid_grid(envs, key=key)),
        ("PID", PID, lung.pid_grid(envs, key=key, kind="true", **TRUE_PID)),
    ):
        options = dict(dt=trainer.dt, reference=trainer.waveform)
        best[name] = lung.stack([kind(*gains, **options) for gains in grid.best()])
        best[f"{name} for all"] = kind(*grid.best_of_all(), **options)
    return best


def trained_pids(
    pids: dict[str, Any],
    trainer: Trainer,
    size: Size,
    key: PRNGKey,
    *,
    checkpoint: Path,
    progress: bool,
) -> dict[str, Any]:
    """Those PIDs trained on, by themselves and with a feed-forward."""
    forward = lung.FeedForward(trainer.waveform, jnp.asarray(0.3))
    starts = {f"trained {name}": pid for name, pid in pids.items()}
    starts["PID + feed-forward"] = eqx.filter_vmap(lung.Summed)(
        pids["PID"], repeated(forward, trainer.count)
    )
    starts["PID + feed-forward for all"] = lung.Summed(pids["PID for all"], forward)
    return {
        name: lung.unstack(
            trainer(
                lung.stack([start]),
                size.pid_steps * (2 if "forward" in name else 1),
                jr.fold_in(key, 6),
                learning_rate=0.05,
                shared=name.endswith("for all"),
                checkpoint=f"{checkpoint}.{name.replace(' ', '_')}",
                progress=progress,
            )
        )[0]
        for name, start in starts.items()
    }


def pid_contenders(pids: dict[str, Any], trainer: Trainer) -> list[Contender]:
    """PIDs by name, those that end with "for all" alike in each lung."""
    return [
        Contender(label, 0, repeated(pid, trainer.count), True)
        if label.endswith("for all")
        else Contender(label, 0, pid, False)
        for label, pid in pids.items()
    ]


def networks(
    kind: Literal["mlp", "cnn"],
    seeds: int,
    trainer: Trainer,
    size: Size,
    key: PRNGKey,
    **options: Any,
) -> lung.BreathPolicy:
    """A network for each lung, of shape `(seeds, lungs)`."""
    keys = jr.split(jr.fold_in(key, 7), (seeds, trainer.count))
    width = 32 if kind == "mlp" else 12
    make = lambda key: lung.BreathPolicy(
        trainer.waveform, trainer.dt, kind, width, key=key
    )
    start = lung.stack([lung.stack([make(k) for k in row]) for row in keys])
    return trainer(start, size.controller_steps, jr.fold_in(key, 8), **options)


def networks_on_pids(
    pids: dict[str, Any], trainer: Trainer, size: Size, key: PRNGKey, **options: Any
) -> lung.Summed:
    """A PID and a network on top of it for each lung, of shape `(1, lungs)`."""
    keys = jr.split(jr.fold_in(key, 9), trainer.count)
    policies = lung.stack(
        [lung.BreathPolicy(trainer.waveform, trainer.dt, key=k) for k in keys]
    )
    # So that the network adds nothing before it is trained.
    offset = 100 * jax.nn.sigmoid(jnp.asarray(-2.0))
    make = lambda a, b: lung.Summed(a, b, offset=offset)
    start = lung.stack([eqx.filter_vmap(make)(pids["leaky PID"], policies)])
    return trainer(start, size.controller_steps, jr.fold_in(key, 10), **options)


def networks_for_all(
    trainer: Trainer, size: Size, key: PRNGKey, **options: Any
) -> lung.BreathPolicy:
    """A network for all lungs, of shape `(seeds,)`."""
    width, controls = size.shared_network
    policy: Any = dict(width=width, controls=controls)
    keys = jr.split(jr.fold_in(key, 11), size.seeds)
    make = lambda key: lung.BreathPolicy(
        trainer.waveform, trainer.dt, key=key, **policy
    )
    start = lung.stack([make(k) for k in keys])
    options = dict(options, shared=True, limit=_CAREFUL)
    return trainer(start, size.shared_steps, jr.fold_in(key, 12), **options)


def planners(trainer: Trainer) -> Contender:
    """Predictive control in the learned lungs."""
    waveforms = repeated(trainer.waveform, trainer.count)
    plan = eqx.filter_vmap(lung.ShootingMPC)(trainer.simulators, waveforms)
    return Contender("MPC", 0, plan, False)


def online_learners(
    train: lung.Breaths, pids: dict[str, Any], trainer: Trainer, sensor_delay: int
) -> Any:
    """GPC around the best leaky PID of each lung, stacked over the lungs.

    Its model is linear: the least-squares fit of the next pressure to the last ones and
    the last controls in the breaths. A Kalman filter gives it the state.
    """
    newton = online_newton()
    learners = []
    for breaths, pid in zip(
        lung.unstack(train), lung.unstack(pids["leaky PID"]), strict=True
    ):
        outputs, controls = breaths.pressure[..., None], breaths.u_in[:, :-1, None]
        # A model to predict with: each of its numbers need not be known.
        lags: Any = dict(outputs_back=2, controls_back=4, delay=sensor_delay + 1)
        identified = arx(outputs, controls, dt=breaths.dt, throw=False, **lags).model
        n = identified.state_size
        model = LinearDynamics(identified.A, identified.B, dt=breaths.dt)
        gains = pid.kp, pid.ki, pid.kd
        follow: Any = dict(dt=breaths.dt, reference=trainer.waveform)
        base = LeakyPID(*gains, **follow, output=0)
        error = jnp.zeros(n).at[0].set(1.0)
        target = _Target(trainer.waveform, n)
        cost = Tracking(error, jnp.zeros(1), target)
        learner = gpc(model, cost, base=base, horizon=10, optimiser=newton)
        # All that the fit leaves over moves the lung; the sensor is taken at its word.
        process = jnp.diag(_NOISE**2 * error)
        mean = error.at[1].set(1.0) * trainer.waveform.peep
        kalman = KalmanFilter(identified, process, 1e-4 * jnp.eye(1), mean=mean)
        learners.append(OutputFeedback(learner, kalman))
    return lung.stack(learners)


class _Target(eqx.Module):
    """The target of the first of so many states; the others have none."""

    waveform: lung.BreathWaveform
    size: int = eqx.field(static=True)

    def __call__(self, t):
        return jnp.zeros(self.size).at[0].set(self.waveform.pressure(t))
