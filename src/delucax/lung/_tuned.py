"""PIDs with a feed-forward, tuned on the lungs themselves: what networks must beat."""

from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr

from ..environments import Environment
from ._grid import make_pid
from ._policies import FeedForward, Summed
from ._size import SEEN, Size
from ._train import breath_error, train_controllers
from ._waveform import BreathWaveform


_STARTS = 4


@eqx.filter_jit
def _drawn(kind: Any, count: int, dt: Any, waveform: BreathWaveform, key: Any) -> Any:
    """PIDs with a feed-forward, gains at random over orders of magnitude."""

    def one(key):
        keys = jr.split(key, 7)
        some = jr.bernoulli(keys[0], 0.5, (3,))
        between = lambda key, low, high: jnp.exp(  # noqa: E731
            jr.uniform(key, minval=jnp.log(low), maxval=jnp.log(high))
        )
        kd = between(keys[1], 0.003, 0.2) * (1.0 if kind == "true" else 20.0)
        gains = between(keys[2], 0.03, 8.0), between(keys[3], 0.05, 40.0), some[0] * kd
        forward = FeedForward(
            waveform,
            some[1] * jr.uniform(keys[4], maxval=3.0),
            some[2] * jr.uniform(keys[5], minval=-10.0, maxval=15.0),
        )
        return Summed(make_pid(gains, kind, dt, waveform), forward)

    return eqx.filter_vmap(one)(jr.split(key, count))


@eqx.filter_jit
def _errors(envs: Environment, controllers: Any, key: Any, own: bool) -> Any:
    """The error of each in each lung, shape `(lungs, controllers)`; of controllers of
    shape `(controllers,)`, or `(controllers, lungs)` if each lung has its own."""
    pips = jnp.asarray(SEEN)
    of = lambda env, one: jnp.mean(  # noqa: E731
        breath_error(env, one, key=key, pips=pips)
    )
    across = eqx.filter_vmap(of, in_axes=(None, eqx.if_array(0)))
    over = eqx.if_array(1) if own else None
    found = eqx.filter_vmap(across, in_axes=(eqx.if_array(0), over))(envs, controllers)
    return jnp.nan_to_num(found, nan=jnp.inf)


def _taken(controllers: Any, index: Any) -> Any:
    return jax.tree.map(
        lambda leaf: leaf[index] if eqx.is_array(leaf) else leaf, controllers
    )


def _joined(one: Any, other: Any) -> Any:
    join = lambda a, b: jnp.concatenate([a, b]) if eqx.is_array(a) else a  # noqa: E731
    return jax.tree.map(join, one, other)


def tuned_pids(
    envs: Environment, waveform: BreathWaveform, size: Size, key: Any, options: Any
) -> dict[str, Any]:
    """The best of many at random and of the best few of them trained on, in each lung
    and for all: by their errors in the lungs themselves, which no network is given."""
    found: dict[str, Any] = {}
    dt = envs.dt[0]
    for k, (kind, name) in enumerate((("true", "PID"), ("leaky", "leaky PID"))):
        draw_key, search_key, fit_key, judge_key = jr.split(jr.fold_in(key, 20 + k), 4)
        drawn = _drawn(kind, size.tuned, dt, waveform, draw_key)
        errors = _errors(envs, drawn, search_key, False)
        for shared in (False, True):
            ranked = jnp.mean(errors, axis=0) if shared else errors.T
            best = jnp.argsort(ranked, axis=0)[:_STARTS]
            begin = _taken(drawn, best)
            label = f"tuned {name} + feed-forward" + (" for all" if shared else "")
            trained = train_controllers(
                envs,
                begin,
                key=fit_key,
                shared=shared,
                steps=size.pid_steps,
                learning_rate=0.03,
                checkpoint=Path(f"{options['checkpoint']}.{label.replace(' ', '_')}"),
                progress=options["progress"],
            ).model
            candidates = _joined(begin, trained)
            judged = _errors(envs, candidates, judge_key, not shared)
            if shared:
                found[label] = _taken(candidates, jnp.argmin(jnp.mean(judged, axis=0)))
            else:
                lungs = jnp.arange(judged.shape[0])
                found[label] = _taken(candidates, (jnp.argmin(judged, axis=1), lungs))
    return found
