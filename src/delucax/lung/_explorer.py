"""Collects breaths by exploring a lung."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array, PyTree

from .._check import check_count, check_key, check_positive, check_step
from .._controller import AbstractController
from .._module import parameter, positive
from .._typing import PRNGKey, RealScalar
from ..controllers import LeakyPID
from ..environments import Environment
from ..math import clip
from ..simulation import rollout
from ._breaths import Breaths
from ._ventilation import waveform_of
from ._waveform import as_pips, BreathWaveform, check_waveform, LENGTH, PIPS


GAINS = (*(i / 10 for i in range(10)), *(float(i) for i in range(1, 11)))
"""The published grid of gains: 0, 0.1, ..., 0.9, 1, 2, ..., 10."""


class Explorer(AbstractController):
    r"""A PID with random gains and a random disturbance, to collect data from a lung.

    In the inspiratory phase, the control of the inspiratory valve is the output of the
    PID plus a disturbance (a bump), clipped to [0, 100], and the expiratory valve is
    closed. In the expiratory phase the control is (0, 1): the inspiratory valve is
    closed and the expiratory valve is open.

    The gains `kp` and `ki` of the [`delucax.controllers.LeakyPID`][] are drawn for each
    episode from {0, 0.1, ..., 0.9, 1, 2, ..., 10}, times `scale`. A bump is drawn for
    each episode too: a triangle with a height from -30 to 30 % and a width from 0.1 to
    0.5 s, at a random time in the inspiration. With probability 0.15, the bump is a
    ramp in place of a triangle. The ramp starts at a random height from 0 to 100 %, and
    falls to zero within 0.05 to 0.3 s.

    **Arguments:**

    - `dt`: the control interval [s].
    - `waveform`: the target, a [`delucax.lung.BreathWaveform`][].
    - `scale`: the factor by which the random gains are multiplied, 1 by default.

    **Raises:** `ValueError` if an argument is not a finite number, `dt` is not
    positive, or `waveform` is not a `BreathWaveform`.

    Source: Suo, Agarwal, Xia, Chen, Ghai, Yu, Gradu, Singh, Zhang, Minasyan, LaChance,
    Zajdel, Schottdorf, Cohen and Hazan, 2021.

    !!! example

        ```python
        import delucax as dlx
        import jax
        from delucax import lung

        env = dlx.make("lung/single_compartment")
        explorer = lung.Explorer(dt=env.dt, waveform=env.cost.waveform)
        dlx.rollout(env, explorer, key=jax.random.key(0), horizon=29).controls
        ```
    """

    dt: Array = parameter(constraint=positive)
    waveform: BreathWaveform
    scale: Array = parameter(1.0)

    def __check_init__(self):
        check_waveform(self.waveform, "Explorer")
        check_step(self.dt, "Explorer")

    def _pid(self, gains: Array) -> LeakyPID:
        return LeakyPID(gains[0], gains[1], dt=self.dt, reference=self.waveform)

    def init(self, *, key: PRNGKey | None = None) -> PyTree:
        keys = jr.split(jr.key(0) if key is None else key, 4)
        gains = self.scale * jr.choice(keys[0], jnp.array(GAINS), (2,))
        low = jnp.array([-30.0, 0.1, 0.0, 0.0, 0.05])
        high = jnp.array([30.0, 0.5, 1.0, 100.0, 0.3])
        bump = low + (high - low) * jr.uniform(keys[1], (5,))
        is_ramp = jr.bernoulli(keys[2], 0.15)
        return gains, bump, is_ramp, self._pid(gains).init()

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        gains, bump, is_ramp, memory = state
        waveform, pid = self.waveform, self._pid(gains)
        u, memory = pid(t, y, memory)
        since = waveform.share(t) * waveform.period
        inspiration = waveform.inspiration * waveform.period
        height, width, place, top, duration = (bump[i] for i in range(5))
        # The triangle lies within the inspiration. `place`, from 0 to 1, says where.
        middle = width / 2 + place * (inspiration - width)
        triangle = height * jnp.maximum(0, 1 - jnp.abs(since - middle) / (width / 2))
        ramp = top * jnp.maximum(0, 1 - since / duration)
        u = clip(u[0] + jnp.where(is_ramp, ramp, triangle), 0, 100)
        inhale = waveform.is_inspiration(t)
        u = jnp.stack([jnp.where(inhale, u, 0), jnp.where(inhale, 0.0, 1.0)])
        return u.astype(y.dtype), (gains, bump, is_ramp, memory)


@eqx.filter_jit
def _explored(env, explorer, pips, keys, length):
    def one(pip, key):
        world, controller = BreathWaveform.at_pip((env, explorer), pip)
        run: Any = rollout(world, controller, key=key, horizon=length, throw=False)
        truth = jax.vmap(lambda x: env.dynamics.observe(0.0, x))(run.states[:-1])
        highest = jnp.max(run.states[:, env.cost.index])
        u, y = run.controls, run.observations
        return u[:, 0], u[:, 1], y[:, 0], truth[:, 0], highest

    return jax.vmap(one)(pips, keys)


def explore(
    env: Environment,
    breaths: int,
    *,
    key: PRNGKey,
    length: int = LENGTH,
    pips: Any = PIPS,
    scale: Any = 1.0,
    abort: Any = 70.0,
    resistance: Any = None,
    compliance: Any = None,
) -> Breaths:
    """Collect breaths of a lung with a [`delucax.lung.Explorer`][].

    Each breath is the first breath of a new episode. Breaths whose pressure exceeds the
    limit `abort` are discarded, because a real machine would not finish them. New
    breaths are drawn in their place.

    **Arguments:**

    - `env`: a task of a lung, such as `delucax.make("lung/double_compartment")`.
    - `breaths`: the number of breaths.
    - `key`: a random key.
    - `length`: the number of samples per breath, 29 by default.
    - `pips`: the peak pressures of the target from which one is drawn for each breath,
        10, 15, ..., 35 cmH2O by default.
    - `scale`: the factor by which the random PID gains are multiplied, 1 by default.
    - `abort`: the pressure above which a breath is discarded [cmH2O], 70 by default.
    - `resistance`, `compliance`: the resistance and the compliance of the lung, which
        are stored with the breaths; `None` by default.

    **Returns:** a [`delucax.lung.Breaths`][] with `truth`.

    **Raises:** `ValueError` if the arguments are invalid (for example, a peak pressure
    below PEEP), or if too few breaths stay below the limit `abort`.

    Source: Suo, Agarwal, Xia, Chen, Ghai, Yu, Gradu, Singh, Zhang, Minasyan, LaChance,
    Zajdel, Schottdorf, Cohen and Hazan, 2021.

    !!! example

        ```python
        import delucax as dlx
        import jax
        from delucax import lung

        env = dlx.make("lung/single_compartment", noise=0.2)
        breaths = lung.explore(env, 8, key=jax.random.key(0), scale=0.3)
        breaths.pressure.shape
        ```
    """
    where = "explore"
    breaths = check_count(breaths, "breaths", where)
    length = check_count(length, "length", where)
    check_key(key, where)
    check_positive(abort, "abort", where)
    waveform = waveform_of(env, where)
    pips = as_pips(pips, waveform, where)
    explorer = Explorer(dt=env.dt, waveform=waveform, scale=scale)
    kept, count = [], 0
    for attempt in range(50):
        # Draw four times as many as needed, so that one batch is mostly enough.
        draw_key, run_key = jr.split(jr.fold_in(key, attempt))
        drawn = jr.choice(draw_key, pips, (4 * breaths,))
        keys = jr.split(run_key, 4 * breaths)
        *columns, highest = _explored(env, explorer, drawn, keys, length)
        fine = np.asarray(highest) <= float(abort)
        kept.append([np.asarray(column)[fine] for column in columns])
        count += int(fine.sum())
        if count >= breaths:
            break
    else:
        raise ValueError(
            f"{where}: abort must be a limit that some breaths stay below, but only "
            f"{count} of {200 * breaths} breaths stayed below {abort}. Lower scale."
        )
    whole = [np.concatenate(column)[:breaths] for column in zip(*kept, strict=True)]
    u_in, u_out, pressure, truth = map(jnp.asarray, whole)
    each = lambda value: None if value is None else jnp.full(breaths, float(value))
    lungs = each(resistance), each(compliance)
    return Breaths(u_in, u_out, pressure, env.dt, *lungs, truth)
