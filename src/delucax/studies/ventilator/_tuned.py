"""PIDs with a feed-forward, tuned on the lungs themselves: what networks must beat."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array, Float

from ... import lung
from ..._typing import PRNGKey
from ...controllers import LeakyPID, PID
from ...environments import Environment
from ._contenders import Trainer
from ._settings import SEEN


_STARTS = 4


@eqx.filter_jit
def _drawn(
    kind: type[LeakyPID | PID],
    count: int,
    dt: Array,
    waveform: lung.BreathWaveform,
    key: PRNGKey,
) -> lung.Summed:
    """PIDs with a feed-forward, gains at random over orders of magnitude."""

    def one(key):
        keys = jr.split(key, 7)
        some = jr.bernoulli(keys[0], 0.5, (3,))
        between = lambda key, low, high: jnp.exp(  # noqa: E731
            jr.uniform(key, minval=jnp.log(low), maxval=jnp.log(high))
        )
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
    pips = jnp.asarray(SEEN)
    of = lambda env, one: jnp.mean(  # noqa: E731
        lung.breath_error(env, one, key=key, pips=pips)
    )
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
    for k, (kind, name) in enumerate(((PID, "PID"), (LeakyPID, "leaky PID"))):
        keys = jr.split(jr.fold_in(trainer.key, 20 + k), 4)
        draw_key, search_key, fit_key, judge_key = keys
        drawn = _drawn(kind, size.tuned, dt, trainer.waveform, draw_key)
        errors = _errors(envs, drawn, search_key, False)
        for shared in (False, True):
            ranked = jnp.mean(errors, axis=0) if shared else errors.T
            begin = taken(drawn, jnp.argsort(ranked, axis=0)[:_STARTS])
            label = f"tuned {name} + feed-forward" + (" for all" if shared else "")
            trained = lung.train_controllers(
                envs,
                begin,
                key=fit_key,
                shared=shared,
                steps=size.pid_steps,
                learning_rate=0.03,
                checkpoint=Path(f"{checkpoint}.{label.replace(' ', '_')}"),
                progress=progress,
                throw=False,
            )
            candidates = lung.stack(
                [*lung.unstack(begin), *lung.unstack(trained.model)]
            )
            judged = _errors(envs, candidates, judge_key, not shared)
            if words := _lost(trained.history["diverged"], judged):
                say(f"  {label}: {words}")
            best[label] = best_of(candidates, judged, shared)
    return best


def _lost(diverged: Any, errors: Any) -> str:
    """What there is to say of PIDs that diverged, nothing if none did."""
    lost, steps = int(jnp.sum(~jnp.isfinite(errors))), int(np.sum(diverged > 0))
    if not lost and not steps:
        return ""
    return (
        f"{lost} of {errors.size} errors are not finite, and count as infinite; in "
        f"{steps} of {len(diverged)} steps a PID had no finite gradient."
    )
