"""The controllers of the study: designed, searched for, or trained in simulators."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array, Float

from ... import lung
from ..._controller import AbstractController
from ..._module import parameter, stack, taken, unstack, weight
from ..._typing import PRNGKey
from ...controllers import gpc, LeakyPID, online_newton, OutputFeedback, PID
from ...costs import Tracking
from ...dynamics import LinearDynamics
from ...environments import Environment
from ...estimators import KalmanFilter
from ...training.sysid import arx, Record
from ._stages import ABORT, NOISE, Size, Stages, TRAIN_PIPS


TRUE_PID = dict(
    kp=(0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0),
    ki=(0.0, 0.3, 1.0, 2.0, 3.0, 5.0, 10.0, 20.0),
    kd=(0.0, 0.01, 0.03),
)
"""The gains of true PIDs to try."""
_TUNED_KINDS = {"PID": PID, "leaky PID": LeakyPID}
_TUNED_FURTHER = 4
"""The number of PIDs drawn at random that are trained further."""
_TRAINING_LIMIT = ABORT - 15
"""The limit of the pressure in the training of the network for all lungs [cmH2O]. It is
well below the abort limit, because the network does not know which lung it ventilates.
"""


class Summed(AbstractController):
    """The sum of two controllers, such as a PID and a network trained on top of it. The
    `offset` is subtracted."""

    first: AbstractController
    second: AbstractController
    offset: Array = parameter(0.0)

    def init(self, *, key=None):
        keys = (None, None) if key is None else jr.split(key)
        return self.first.init(key=keys[0]), self.second.init(key=keys[1])

    def __call__(self, t, y, state):
        u, first = self.first(t, y, state[0])
        v, second = self.second(t, y, state[1])
        return (u + (v - self.offset)).astype(y.dtype), (first, second)

    def applied(self, u, cost, state):
        first = self.first.applied(u, cost, state[0])
        return first, self.second.applied(u, cost, state[1])


class FeedForward(AbstractController):
    r"""A feed-forward of the target, $u = \mathrm{gain} \, (r(t) - \mathrm{peep}) +
    \mathrm{offset}$."""

    waveform: lung.BreathWaveform
    gain: Array = weight(1.0)
    offset: Array = weight(0.0)

    def __call__(self, t, y, state):
        u = self.gain * (self.waveform(t) - self.waveform.peep) + self.offset
        return u.astype(y.dtype), state


class Contender(NamedTuple):
    """A row of the report, before it is run.

    - `label`, `seed`: its name in the report.
    - `controllers`: controllers of the inspiratory valve, stacked over the lungs, or a
        single controller if it is `shared` by all lungs.
    """

    label: str
    seed: int
    controllers: Any
    shared: bool = False


class Trainer(NamedTuple):
    """Trains controllers in simulators of the lungs, which are stacked."""

    simulators: Any
    waveform: lung.BreathWaveform
    size: Size
    key: PRNGKey
    say: Callable[[str], Any] = print

    @property
    def count(self) -> int:
        """The number of lungs."""
        return self.simulators.dt.shape[0]

    def __call__(
        self, start: Any, steps: int, fold: int, *, limit: Any = None, **options: Any
    ) -> Any:
        """Train controllers; see [`delucax.lung.train_controllers`][]."""
        options |= dict(steps=steps, key=jr.fold_in(self.key, fold))
        given: Any = dict(waveform=self.waveform, noise=NOISE, limit=limit)
        task = lambda model: lung.learned_lung(model, **given)
        # Compiled like the trainings, so that the first states are rounded as there.
        envs = eqx.filter_jit(eqx.filter_vmap(task))(self.simulators)
        return lung.train_controllers(envs, start, **options).model

    def pid(self, kind: type[LeakyPID | PID], gains: Any) -> LeakyPID | PID:
        """A PID that follows the waveform."""
        return kind(*gains, dt=self.simulators.dt[0], reference=self.waveform)

    def policies(self, shape: tuple[int, ...], fold: int, **options: Any) -> Any:
        """Untrained networks, stacked to `shape`."""
        given = self.waveform, self.simulators.dt[0]
        make = lambda key: lung.BreathPolicy(*given, key=key, **options)
        for _ in shape:
            make = lambda keys, one=make: stack(map(one, keys))
        return make(jr.split(jr.fold_in(self.key, fold), shape))

    def networks(
        self, shape: tuple[int, ...], fold: int, steps: int, **sizes: Any
    ) -> Callable[..., Any]:
        """A function that trains networks of these sizes, stacked to `shape`."""
        start = lambda: self.policies(shape, fold, **sizes)
        return lambda **options: self(start(), steps, fold + 1, **options)


def searched_pids(envs: Environment, trainer: Trainer) -> dict[str, LeakyPID | PID]:
    """The best PID of each kind, for each lung and for all lungs."""
    best: dict[str, Any] = {}
    key, true = jr.fold_in(trainer.key, 6), dict[str, Any](TRUE_PID, kind="true")
    for name, kind, options in (("leaky PID", LeakyPID, {}), ("PID", PID, true)):
        grid, errors = lung.pid_grid(envs, key=key, **options)
        # The error is NaN where a simulation failed.
        of_all = jnp.nanargmin(jnp.mean(errors, axis=0))
        own = jnp.nanargmin(errors, axis=1)
        best[name] = stack([trainer.pid(kind, gains) for gains in grid[own]])
        best[f"{name} for all"] = trainer.pid(kind, grid[of_all])
    return best


def trained_pids(
    trainer: Trainer, pids: dict[str, Any], *, checkpoint: Path, progress: bool
) -> dict[str, Any]:
    """The PIDs after more training by the gradient, alone and with a feed-forward."""
    forward = FeedForward(trainer.waveform, jnp.asarray(0.3))
    forwards = stack([forward] * trainer.count)
    starts = {f"trained {name}": pid for name, pid in pids.items()}
    starts["PID + feed-forward"] = eqx.filter_vmap(Summed)(pids["PID"], forwards)
    starts["PID + feed-forward for all"] = Summed(pids["PID for all"], forward)
    trained, options = {}, dict(learning_rate=0.05, progress=progress)
    for name, start in starts.items():
        steps = trainer.size.pid_steps * (2 if "forward" in name else 1)
        file = f"{checkpoint}.{name.replace(' ', '_')}"
        options |= dict(shared=name.endswith("for all"), checkpoint=file)
        trained[name] = taken(trainer(stack([start]), steps, 6, **options), 0)
    return trained


@eqx.filter_jit
def _drawn(
    kind: type[LeakyPID | PID], count: int, dt: Array, waveform: Any, key: PRNGKey
) -> Summed:
    """PIDs with a feed-forward, whose gains are random over orders of magnitude."""

    def between(key, low, high):
        return jnp.exp(jr.uniform(key, minval=jnp.log(low), maxval=jnp.log(high)))

    def one(key):
        keys = jr.split(key, 7)
        # The derivative, the feed-forward gain and the offset are each 0 in half of
        # the PIDs.
        some = jr.bernoulli(keys[0], 0.5, (3,))
        kd = between(keys[1], 0.003, 0.2) * (1.0 if kind is PID else 20.0)
        gains = between(keys[2], 0.03, 8.0), between(keys[3], 0.05, 40.0), some[0] * kd
        gain = some[1] * jr.uniform(keys[4], maxval=3.0)
        offset = some[2] * jr.uniform(keys[5], minval=-10.0, maxval=15.0)
        forward = FeedForward(waveform, gain, offset)
        return Summed(kind(*gains, dt=dt, reference=waveform), forward)

    return eqx.filter_vmap(one)(jr.split(key, count))


@eqx.filter_jit
def _errors(
    envs: Environment, controllers: Any, key: PRNGKey, own: bool
) -> Float[Array, "lungs controllers"]:
    """The error of each controller in each lung. Controllers are stacked to the shape
    `(controllers,)`, or `(controllers, lungs)` if each lung has its `own`."""
    options: Any = dict(key=key, pips=jnp.asarray(TRAIN_PIPS))
    of = lambda env, one: jnp.mean(lung.breath_error(env, one, **options))
    across = eqx.filter_vmap(of, in_axes=(None, eqx.if_array(0)))
    over = eqx.if_array(1) if own else None
    errors = eqx.filter_vmap(across, in_axes=(eqx.if_array(0), over))(envs, controllers)
    return jnp.where(jnp.isfinite(errors), errors, jnp.inf)


def best_candidates(candidates: Any, errors: Any, shared: bool) -> Any:
    """The candidate with the least error in each lung, or, if it is `shared`, on
    average over all lungs. Errors have the shape `(lungs, candidates)`."""
    if shared:
        return taken(candidates, jnp.argmin(jnp.mean(errors, axis=0)))
    return taken(candidates, (jnp.argmin(errors, axis=1), jnp.arange(errors.shape[0])))


def tuned_pids(
    envs: Environment, trainer: Trainer, *, checkpoint: Path, progress: bool
) -> dict[str, Any]:
    """The best PIDs for each lung and for all lungs. Many are drawn at random, and the
    best few are trained further. They are judged in the lungs themselves, to which the
    networks have no access."""
    best: dict[str, Any] = {}
    dt, size = envs.dt[0], trainer.size
    options: Any = dict(steps=size.pid_steps, progress=progress)
    options |= dict(learning_rate=0.03, throw=False)
    for k, (name, kind) in enumerate(_TUNED_KINDS.items()):
        keys = jr.split(jr.fold_in(trainer.key, 20 + k), 4)
        draw_key, search_key, fit_key, judge_key = keys
        drawn = _drawn(kind, size.tuned, dt, trainer.waveform, draw_key)
        errors = _errors(envs, drawn, search_key, False)
        for shared in (False, True):
            # The indices of the best: one list for all lungs, or one per lung.
            ranked = jnp.mean(errors, axis=0) if shared else errors.T
            begin = taken(drawn, jnp.argsort(ranked, axis=0)[:_TUNED_FURTHER])
            label = f"tuned {name} + feed-forward" + (" for all" if shared else "")
            file = Path(f"{checkpoint}.{label.replace(' ', '_')}")
            options |= dict(checkpoint=file, shared=shared)
            trained = lung.train_controllers(envs, begin, key=fit_key, **options)
            candidates = stack([*unstack(begin), *unstack(trained.model)])
            judged = _errors(envs, candidates, judge_key, not shared)
            if words := divergence_note(trained.history["diverged"], judged):
                trainer.say(f"  {label}: {words}")
            best[label] = best_candidates(candidates, judged, shared)
    return best


def divergence_note(diverged: Any, errors: Any) -> str:
    """A sentence about the PIDs that diverged; empty if none did."""
    lost, steps = int(jnp.sum(~jnp.isfinite(errors))), int(np.sum(diverged > 0))
    if not lost and not steps:
        return ""
    return (
        f"{lost} of {errors.size} errors are not finite and count as infinite. In "
        f"{steps} of {len(diverged)} training steps a gradient was not finite."
    )


def pid_contenders(pids: dict[str, Any]) -> list[Contender]:
    """The rows of PIDs by name. A PID whose name ends with "for all" is shared."""
    return [Contender(n, 0, pid, n.endswith("for all")) for n, pid in pids.items()]


def online_learners(
    train: lung.Breaths, pids: dict[str, Any], waveform: lung.BreathWaveform, delay: int
) -> Any:
    """GPC around the best leaky PID of each lung, stacked over the lungs.

    Its model is a linear least-squares fit of the next pressure to the last pressures
    and controls in the breaths. A Kalman filter estimates the state.
    """
    newton = online_newton()

    def learner(breaths: lung.Breaths, pid: LeakyPID) -> OutputFeedback:
        dt: Any = breaths.dt
        measured = zip(breaths.pressure, breaths.u_in, strict=True)
        records = [Record(pressure, u_in, dt=dt) for pressure, u_in in measured]
        # The model only predicts, so not all of its numbers must be identifiable.
        lags: Any = dict(outputs_back=2, controls_back=4, delay=delay + 1)
        identified = arx(records, throw=False, **lags).model
        model = LinearDynamics(identified.A, identified.B, dt=dt)
        gains = pid.kp, pid.ki, pid.kd
        base = LeakyPID(*gains, dt=dt, reference=waveform, output=0)
        error = jnp.zeros(identified.state_size).at[0].set(1.0)
        cost = Tracking(error, jnp.zeros(1), _Target(waveform, len(error)))
        online = gpc(model, cost, base=base, horizon=10, optimiser=newton)
        # All of the residual variance counts as process noise, and almost none as noise
        # of the sensor.
        process = jnp.diag(NOISE**2 * error)
        # The outputs among the states start at PEEP.
        mean = error.at[1].set(1.0) * waveform.peep
        kalman = KalmanFilter(identified, process, 1e-4 * jnp.eye(1), mean=mean)
        return OutputFeedback(online, kalman)

    return stack(map(learner, unstack(train), unstack(pids["leaky PID"])))


class _Target(eqx.Module):
    """A target for the first of `size` states; zero for the others."""

    waveform: lung.BreathWaveform
    size: int = eqx.field(static=True)

    def __call__(self, t):
        return jnp.zeros(self.size).at[0].set(self.waveform.pressure(t))


def contenders(
    stages: Stages, envs: Environment, train: lung.Breaths, trainer: Trainer
) -> list[Contender]:
    """All controllers, in the order of the report."""
    size, waveform, count = trainer.size, trainer.waveform, trainer.count
    training, steps = stages.training, size.controller_steps
    pids = stages.stage(
        "pids", "Searching PID gains", lambda: searched_pids(envs, trainer)
    )

    def residuals(**kept):
        # With this offset the network adds nothing before it is trained.
        offset = 100 * jax.nn.sigmoid(jnp.asarray(-2.0))
        summed = eqx.filter_vmap(lambda a, b: Summed(a, b, offset=offset))
        start = stack([summed(pids["leaky PID"], trainer.policies((count,), 9))])
        return trainer(start, steps, 10, **kept)

    # Zero control, as a PID without gains, which needs no program of its own.
    none = trainer.pid(LeakyPID, (0.0, 0.0, 0.0))
    rows = [Contender("zero", 0, none, True), *pid_contenders(pids)]
    seeds = f"({size.seeds} at once)" if size.seeds > 1 else ""
    networks = trainer.networks((size.seeds, count), 7, steps, width=32)
    own = training("own", f"Training a network for each lung {seeds}".strip(), networks)
    sizes = dict(zip(("width", "controls"), size.shared_network, strict=True))
    networks = trainer.networks((size.seeds,), 11, size.shared_steps, **sizes)
    networks = functools.partial(networks, shared=True, limit=_TRAINING_LIMIT)
    shared = training("shared", f"Training one for all lungs {seeds}".strip(), networks)
    if size.tuned:
        words = "Tuning PIDs with feed-forward on the lungs"
        tuned = training("tuned_pids", words, tuned_pids, envs, trainer)
        rows += pid_contenders(tuned)
    if size.extras:
        more = training(
            "trained_pids", "Training the PIDs further", trained_pids, trainer, pids
        )
        networks = trainer.networks((1, count), 7, steps, kind="cnn", width=12)
        convolved = training(
            "own_cnn", "Training a convolutional network for each lung", networks
        )
        words = "Training a network on top of the PID of each lung"
        residual = training("residual", words, residuals)
        learn = lambda: online_learners(train, pids, waveform, size.sensor_delay)
        online = stages.stage("online", "Setting up GPC around the PIDs", learn)
        given: Any = trainer.simulators, envs.cost.waveform  # pyright: ignore
        planners = eqx.filter_vmap(lung.ShootingMPC)(*given)
        rows += [
            *pid_contenders(more),
            Contender("bang-bang", 0, lung.BangBang(waveform), True),
            Contender("GPC", 0, online),
            Contender("MPC", 0, planners),
            Contender("CNN", 0, taken(convolved, 0)),
            Contender("PID + MLP", 0, taken(residual, 0)),
        ]
    rows += [Contender("MLP", seed, one) for seed, one in enumerate(unstack(own))]
    for seed, one in enumerate(unstack(shared)):
        rows.append(Contender("MLP for all", seed, one, True))
    return rows
