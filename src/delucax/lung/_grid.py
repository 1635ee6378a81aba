"""Every PID of a grid at once, and the best that any control could do."""

from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array

from .._check import check_count, check_finite, check_key
from .._module import as_float_array
from .._typing import PRNGKey
from ..controllers import LeakyPID, PID
from ..environments import Environment
from ._data import _waveform_of, LENGTH, PIPS
from ._stacking import stack
from ._train import breath_error
from ._waveform import as_pips, at_pip


GAINS = (*(i / 10 for i in range(10)), *(float(i) for i in range(1, 11)))
"""The published grid of gains: 0, 0.1, ..., 0.9, 1, 2, ..., 10."""


class PIDGrid(eqx.Module):
    """The errors of a grid of PIDs in some lungs.

    **Attributes:**

    - `gains`: (kp, ki, kd) of each, shape `(grid, 3)`.
    - `errors`: the mean error of each in each lung, shape `(lungs, grid)` [cmH2O].
    - `kind`: `"leaky"` or `"true"`.

    !!! example

        ```python
        import jax.numpy as jnp
        from delucax.lung import PIDGrid

        grid = PIDGrid(jnp.ones((2, 3)), jnp.array([[3.0, 2.0]]), "leaky")
        grid.best()
        ```
    """

    gains: Array
    errors: Array
    kind: Literal["leaky", "true"] = eqx.field(static=True)

    def best(self) -> Array:
        """The gains with the least error in each lung, shape `(lungs, 3)`."""
        return self.gains[jnp.argmin(self.errors, axis=1)]

    def best_of_all(self) -> Array:
        """The gains with the least error on average over the lungs, shape `(3,)`."""
        return self.gains[jnp.argmin(jnp.mean(self.errors, axis=0))]


def make_pid(gains: Any, kind: str, dt: Any, waveform: Any) -> LeakyPID | PID:
    """The PID of a kind with those gains, which follows a waveform."""
    kp, ki, kd = gains
    if kind == "leaky":
        return LeakyPID(kp, ki, kd, dt=dt, reference=waveform)
    return PID(kp, ki, kd, dt=dt, reference=waveform)


@eqx.filter_jit
def _searched(envs, lists, pips, key, kind):
    """All combinations of the lists of gains, and the error of each in each lung."""
    lists = [jnp.ravel(values).astype(float) for values in lists]
    gains = jnp.stack(jnp.meshgrid(*lists, indexing="ij"), -1).reshape(-1, 3)

    def in_lung(env):
        def one(gains):
            pid = make_pid(gains, kind, env.dt, env.cost.waveform)
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
) -> PIDGrid:
    """The error of every PID of a grid in every lung, all at once.

    **Arguments:**

    - `envs`: tasks of lungs, as [`delucax.lung.stack`][] makes one of them, or a
        single task.
    - `key`: a random key, for the noise of the sensor, which is the same for all.
    - `kind`: `"leaky"` for [`delucax.controllers.LeakyPID`][], which is that of the
        original (default); `"true"` for [`delucax.controllers.PID`][].
    - `kp`, `ki`, `kd`: the gains, of which all combinations are tried; 0, 0.1, ...,
        0.9, 1, 2, ..., 10 for the first two and 0 for the last by default.
    - `pips`: the peak pressures to follow, 10, 15, ..., 35 cmH2O by default.

    **Returns:** a [`delucax.lung.PIDGrid`][], that of one lung for a single task.

    **Raises:** `ValueError` if the arguments are illegal (a peak pressure below PEEP,
    say).

    !!! example

        ```python
        import jax
        from delucax import lung

        envs = lung.stack([lung.single_compartment(R) for R in (5.0, 20.0)])
        few = dict(kp=[0.5, 1.0], ki=[1.0], pips=[20.0])
        lung.pid_grid(envs, key=jax.random.key(0), **few).best()
        ```
    """
    where = "pid_grid"
    pips = as_pips(pips, _waveform_of(envs, where, stacked=True), where)
    check_key(key, where)
    if kind not in ("leaky", "true"):
        raise ValueError(f"{where}: kind must be 'leaky' or 'true', got {kind!r}.")
    lists = []
    for name, values in (("kp", kp), ("ki", ki), ("kd", kd)):
        array = as_float_array(values)
        if not eqx.is_inexact_array(array) or not array.size:
            raise ValueError(f"{where}: {name} must be numbers, got {values!r}.")
        check_finite(array, name, where)
        lists.append(array)
    envs = envs if jnp.ndim(envs.dt) else stack([envs])
    return PIDGrid(*_searched(envs, lists, pips, key, kind), kind)


def least_error(
    env: Environment, *, pips: Any = PIPS, steps: int = 600, horizon: int = LENGTH
) -> Array:
    """About the least error that any control of the inspiratory valve could have.

    The controls of each breath are chosen by gradient descent with the true lung at
    hand, nothing to measure and no noise: what a controller that is right from the
    start would reach, to the accuracy of the descent.

    **Arguments:**

    - `env`: a task of a lung.
    - `pips`: the peak pressures to follow, 10, 15, ..., 35 cmH2O by default.
    - `steps`: of the descent, 600 by default.
    - `horizon`: steps an episode, 29 by default.

    **Returns:** the mean error at each of the pressures, shape `(pips,)` [cmH2O].

    **Raises:** `ValueError` if the arguments are illegal (a peak pressure below PEEP,
    say).

    !!! example

        ```python
        import delucax as dlx
        from delucax import lung

        env = dlx.make("lung/single_compartment")
        lung.least_error(env, pips=[20.0], steps=20, horizon=10)
        ```
    """
    where = "least_error"
    pips = as_pips(pips, _waveform_of(env, where), where)
    steps = check_count(steps, "steps", where)
    horizon = check_count(horizon, "horizon", where)
    schedule = optax.cosine_decay_schedule(0.3, steps)
    optimiser = optax.adam(schedule)

    def of(pip):
        world = at_pip(env, pip)
        x0: Any = world.initial_state

        def error(z):
            @jax.checkpoint
            def body(x, inputs):
                k, u = inputs
                u = jnp.stack([100 * jax.nn.sigmoid(u), jnp.zeros_like(u)])
                step = world.step(k * world.dt, x, u)
                return step.state, step.cost

            _, costs = jax.lax.scan(body, x0, (jnp.arange(horizon), z))
            return jnp.mean(costs)

        def descend(carry, _):
            z, memory, least = carry
            value, slope = jax.value_and_grad(error)(z)
            move, memory = optimiser.update(slope, memory)
            return (z + move, memory, jnp.minimum(least, value)), None

        z = jnp.full(horizon, -1.0)
        start = z, optimiser.init(z), jnp.asarray(jnp.inf, z.dtype)
        (_, _, least), _ = jax.lax.scan(descend, start, None, steps)
        return least

    return eqx.filter_jit(jax.vmap(of))(pips)
