"""Every PID of a grid at once."""

from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._check import check_choice, check_finite, check_key
from .._module import as_float_array
from .._typing import PRNGKey
from ..controllers import LeakyPID, PID
from ..environments import Environment
from ._controller_training import breath_error
from ._exploration import GAINS
from ._stacking import stack
from ._ventilation import waveform_of
from ._waveform import as_pips, PIPS


_KINDS: dict[str, Any] = {"leaky": LeakyPID, "true": PID}


class PIDGrid(eqx.Module):
    """The errors of a grid of PIDs in some lungs.

    **Attributes:**

    - `gains`: (kp, ki, kd) of each, shape `(grid, 3)`.
    - `errors`: the mean error of each in each lung, shape `(lungs, grid)` [cmH2O].

    !!! example

        ```python
        import jax.numpy as jnp
        from delucax.lung import PIDGrid

        grid = PIDGrid(jnp.ones((2, 3)), jnp.array([[3.0, 2.0]]))
        grid.best()
        ```
    """

    gains: Array
    errors: Array

    def best(self) -> Array:
        """The gains with the least error in each lung, shape `(lungs, 3)`."""
        return self.gains[jnp.argmin(self.errors, axis=1)]

    def best_of_all(self) -> Array:
        """The gains with the least error on average over the lungs, shape `(3,)`."""
        return self.gains[jnp.argmin(jnp.mean(self.errors, axis=0))]


@eqx.filter_jit
def _searched(envs, lists, pips, key, kind):
    """All combinations of the lists of gains, and the error of each in each lung."""
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

        envs = lung.stack([lung.single_compartment(resistance=R) for R in (5.0, 20.0)])
        few = dict(kp=[0.5, 1.0], ki=[1.0], pips=[20.0])
        lung.pid_grid(envs, key=jax.random.key(0), **few).best()
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
    return PIDGrid(*_searched(envs, lists, pips, key, kind))
