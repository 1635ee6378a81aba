"""The controllers of the study: designed, searched for, or trained in simulators."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array

from ...controllers import GPC, LeakyPID, online_newton, OutputFeedback
from ...costs import Tracking
from ...dynamics import LinearDynamics
from ...environments import Environment
from ...estimators import KalmanFilter
from ...lung._data import Breaths
from ...lung._grid import GAINS, make_pid, pid_grid
from ...lung._policies import BangBang, BreathPolicy, FeedForward, Summed
from ...lung._runner import ABORT
from ...lung._shooting import ShootingMPC
from ...lung._stacking import repeat, stack, unstack
from ...lung._train import train_controllers
from ...lung._waveform import BreathWaveform
from ...training.sysid import arx
from ._size import Size


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
    waveform: BreathWaveform

    @property
    def count(self) -> int:
        """How many lungs there are."""
        return self.simulators.dt.shape[0]

    @property
    def dt(self) -> Array:
        """The control interval."""
        return self.simulators.dt[0]

    def __call__(self, start: Any, steps: int, key: Any, **options: Any) -> Any:
        """The trained controllers: see [`delucax.lung.train_controllers`][]."""
        options = dict(waveform=self.waveform, steps=steps, key=key) | options
        return train_controllers(self.simulators, start, **options).model


def zero(trainer: Trainer) -> Contender:
    """No control: a PID without gains, as which it compiles nothing of its own."""
    none = make_pid((0.0, 0.0, 0.0), "leaky", trainer.dt, trainer.waveform)
    return Contender("zero", 0, repeat(none, trainer.count), True)


def bang_bang(trainer: Trainer) -> Contender:
    """The valve open or closed."""
    bang = BangBang(trainer.waveform)
    return Contender("bang-bang", 0, repeat(bang, trainer.count), True)


def searched_pids(envs: Environment, trainer: Trainer, key: Any) -> dict[str, Any]:
    """The best PID of each kind, for each lung and for all."""
    key = jr.fold_in(key, 6)
    grids = {
        "leaky PID": pid_grid(envs, key=key, kp=GAINS, ki=GAINS),
        "PID": pid_grid(envs, key=key, kind="true", **TRUE_PID),
    }
    found: dict[str, Any] = {}
    for name, grid in grids.items():
        make = lambda gains, kind=grid.kind: make_pid(  # noqa: E731
            gains, kind, trainer.dt, trainer.waveform
        )
        found[name] = stack([make(gains) for gains in grid.best()])
        found[f"{name} for all"] = make(grid.best_of_all())
    return found


def trained_pids(
    pids: dict[str, Any], trainer: Trainer, size: Size, key: Any, options: Any
) -> dict[str, Any]:
    """Those PIDs trained on, by themselves and with a feed-forward."""
    weak: Any = 0.3
    forward = FeedForward(trainer.waveform, weak)
    begin: dict[str, Any] = {}
    for name, pid in pids.items():
        begin[f"trained {name}"] = pid
    count = trainer.count
    begin["PID + feed-forward"] = eqx.filter_vmap(Summed)(
        pids["PID"], repeat(forward, count)
    )
    begin["PID + feed-forward for all"] = Summed(pids["PID for all"], forward)
    found = {}
    for name, start in begin.items():
        found[name] = unstack(
            trainer(
                stack([start]),
                size.pid_steps * (2 if "forward" in name else 1),
                jr.fold_in(key, 6),
                learning_rate=0.05,
                shared=name.endswith("for all"),
                checkpoint=f"{options['checkpoint']}.{name.replace(' ', '_')}",
                progress=options["progress"],
            )
        )[0]
    return found


def pid_contenders(pids: dict[str, Any], trainer: Trainer) -> list[Contender]:
    """PIDs by name, those that end with "for all" alike in each lung."""
    made = []
    for label, pid in pids.items():
        shared = label.endswith("for all")
        controllers = repeat(pid, trainer.count) if shared else pid
        made.append(Contender(label, 0, controllers, shared))
    return made


def networks(
    trainer: Trainer, size: Size, key: Any, options: Any, kind: Any = "mlp"
) -> Any:
    """A network for each lung, of shape `(seeds, lungs)`."""
    keys = jr.split(jr.fold_in(key, 7), (size.seeds, trainer.count))
    width = 32 if kind == "mlp" else 12
    make = lambda key: BreathPolicy(  # noqa: E731
        trainer.waveform, trainer.dt, kind, width, key=key
    )
    start = stack([stack([make(k) for k in row]) for row in keys])
    return trainer(start, size.controller_steps, jr.fold_in(key, 8), **options)


def networks_on_pids(
    pids: dict[str, Any], trainer: Trainer, size: Size, key: Any, options: Any
) -> Any:
    """A PID and a network on top of it for each lung, of shape `(1, lungs)`."""
    keys = jr.split(jr.fold_in(key, 9), trainer.count)
    policies = stack([BreathPolicy(trainer.waveform, trainer.dt, key=k) for k in keys])
    # So that the network adds nothing before it is trained.
    offset = 100 * jax.nn.sigmoid(jnp.asarray(-2.0))
    make = lambda a, b: Summed(a, b, offset=offset)  # noqa: E731
    start = stack([eqx.filter_vmap(make)(pids["leaky PID"], policies)])
    return trainer(start, size.controller_steps, jr.fold_in(key, 10), **options)


def networks_for_all(trainer: Trainer, size: Size, key: Any, options: Any) -> Any:
    """A network for all lungs, of shape `(seeds,)`."""
    keys = jr.split(jr.fold_in(key, 11), size.seeds)
    width, controls = size.shared_network
    make = lambda key: BreathPolicy(  # noqa: E731
        trainer.waveform, trainer.dt, width=width, controls=controls, key=key
    )
    start = stack([make(k) for k in keys])
    return trainer(
        start,
        size.shared_steps,
        jr.fold_in(key, 12),
        shared=True,
        limit=_CAREFUL,
        **options,
    )


def planners(trainer: Trainer) -> Contender:
    """Predictive control in the learned lungs."""
    waveforms = repeat(trainer.waveform, trainer.count)
    plan = eqx.filter_vmap(ShootingMPC)(trainer.simulators, waveforms)
    return Contender("MPC", 0, plan, False)


def online_learners(
    train: Breaths, pids: dict[str, Any], trainer: Trainer, sensor_delay: int
) -> Any:
    """GPC around the best leaky PID of each lung, stacked over the lungs.

    Its model is linear: the least-squares fit of the next pressure to the last ones and
    the last controls in the breaths. A Kalman filter gives it the state.
    """
    newton = online_newton()
    made = []
    for breaths, pid in zip(unstack(train), unstack(pids["leaky PID"]), strict=True):
        outputs, controls = breaths.pressure[..., None], breaths.u_in[:, :-1, None]
        # A model to predict with: each of its numbers need not be known.
        lags: Any = dict(delay=sensor_delay + 1, dt=breaths.dt, throw=False)
        seen = arx(outputs, controls, outputs_back=2, controls_back=4, **lags).model
        n = seen.state_size
        model = LinearDynamics(seen.A, seen.B, dt=breaths.dt)
        gains = pid.kp, pid.ki, pid.kd
        follow: Any = dict(dt=breaths.dt, reference=trainer.waveform)
        base = LeakyPID(*gains, **follow, output=0)
        error = jnp.zeros(n).at[0].set(1.0)
        target = _Target(trainer.waveform, n)
        cost = Tracking(error, jnp.zeros(1), target)
        learner = GPC(model, cost, base=base, horizon=10, optimiser=newton)
        # All that the fit leaves over moves the lung; the sensor is taken at its word.
        moves = jnp.diag(_NOISE**2 * error)
        mean = error.at[1].set(1.0) * trainer.waveform.peep
        kalman = KalmanFilter(seen, moves, 1e-4 * jnp.eye(1), mean=mean)
        made.append(OutputFeedback(learner, kalman))
    return stack(made)


class _Target(eqx.Module):
    """The target of the first of so many states; the others have none."""

    waveform: BreathWaveform
    size: int = eqx.field(static=True)

    def __call__(self, t):
        return jnp.zeros(self.size).at[0].set(self.waveform.pressure(t))
