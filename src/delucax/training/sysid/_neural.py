"""Neural models, fitted to one step or to several."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._check import (
    as_entries,
    check_at_most,
    check_count,
    check_instance,
    check_positive,
)
from ..._check_models import state_network
from ..._module import parameter, positive, shown, weight
from ..._results import Result, RESULTS
from ..._typing import PRNGKey, RealScalar
from ...dynamics import AbstractDynamics
from ._record import grouped, Record, Records, uniform_records


class NeuralDynamics(AbstractDynamics):
    """A discrete-time map that is a fully connected network,

    `x_next = x + step_scale * network((x - x_mean) / x_scale, u / u_scale)`.

    A neural ODE is [`delucax.Discretized`][] of a
    [`delucax.systems.NeuralSystem`][]; both are fitted by the same losses.

    **Arguments:**

    - `states`, `controls`: their names, or how many there are.
    - `width`: units in a hidden layer, 64 by default.
    - `depth`: hidden layers, 2 by default.
    - `dt`: the step, 1 by default.
    - `x_mean`, `x_scale`: shape `(n,)` or a number; 0 and 1 by default.
    - `u_scale`: shape `(m,)` or a number; 1 by default.
    - `step_scale`: the size of a step, shape `(n,)` or a number; 1 by default.
    - `activation`: of the hidden layers, `jnp.tanh` by default.
    - `key`: a random key, for the first weights.

    **Attributes:** `network`, an `eqx.nn.MLP`, trainable.

    **Raises:** `ValueError` if a size is below 1, a scale is not positive, or there is
    no key.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        Net = dlx.training.sysid.NeuralDynamics
        dynamics = Net(2, 1, width=8, depth=1, dt=0.05, key=jax.random.key(0))
        dynamics(0.0, jnp.ones(2), jnp.zeros(1))
        ```
    """

    network: eqx.nn.MLP = weight()
    dt: Array = parameter()
    x_mean: Float[Array, "..."] = parameter()
    x_scale: Float[Array, "..."] = parameter(constraint=positive)
    u_scale: Float[Array, "..."] = parameter(constraint=positive)
    step_scale: Float[Array, "..."] = parameter(constraint=positive)
    state_names: tuple[str, ...] = eqx.field(static=True)
    control_names: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        states: int | Sequence[str],
        controls: int | Sequence[str],
        width: int = 64,
        depth: int = 2,
        *,
        dt: Any = 1.0,
        x_mean: Any = 0.0,
        x_scale: Any = 1.0,
        u_scale: Any = 1.0,
        step_scale: Any = 1.0,
        activation: Callable[[Array], Array] = jnp.tanh,
        key: PRNGKey,
    ):
        self.state_names, self.control_names, self.network = state_network(
            states, controls, width, depth, activation, key, "NeuralDynamics"
        )
        self.dt, self.x_mean, self.x_scale = dt, x_mean, x_scale
        self.u_scale, self.step_scale = u_scale, step_scale

    def __check_init__(self):
        where, n, m = "NeuralDynamics", self.state_size, self.control_size
        sizes = dict(x_mean=n, x_scale=n, u_scale=m, step_scale=n)
        for name, size in sizes.items():
            array = getattr(self, name)
            if name != "x_mean":
                check_positive(array, name, where)
            as_entries(array, size, name, where)

    def advance(
        self,
        t: RealScalar,
        x: Float[Array, " n"],
        u: Float[Array, " m"],
        w: Float[Array, " n"] | None,
    ) -> tuple[Float[Array, " n"], Result]:
        # The network learns the step and not the next state, which is nearly x itself.
        z = jnp.concatenate([(x - self.x_mean) / self.x_scale, u / self.u_scale])
        x_next = x + self.step_scale * self.network(z)
        x_next = x_next if w is None else x_next + w
        return x_next.astype(x.dtype), RESULTS.successful


def windows(
    record: Records, steps: int, *, stride: int = 1
) -> tuple[Array, Array, Array]:
    """Stretches of records of the state: the data of a multi-step fit.

    **Arguments:**

    - `record`: a [`delucax.training.sysid.Record`][], whose outputs are the states, or
        a list of them; uniform in time.
    - `steps`: of a stretch; 1 for a one-step fit.
    - `stride`: steps between the beginnings of two stretches, 1 by default.

    **Returns:** `(times, states, controls)` of shapes `(N,)`, `(N, steps + 1, n)` and
    `(N, steps, m)`, for `data=` of [`delucax.training.fit`][].

    **Raises:** `ValueError` if `record` is not one, or shorter than a stretch.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        states, controls = jnp.zeros((101, 2)), jnp.zeros((100, 1))
        record = dlx.training.sysid.Record(states, controls, dt=0.05)
        data = dlx.training.sysid.windows(record, 10)
        data[1].shape
        ```
    """
    where = "sysid.windows"
    records = uniform_records(record, where)
    steps = check_count(steps, "steps", where)
    stride = check_count(stride, "stride", where)
    of = "of the shortest record"
    check_at_most(steps, min(map(len, records)) - 1, "steps", where, of)
    return _cut(grouped(records), steps, stride)


@eqx.filter_jit
def _cut(groups: list[Record], steps: int, stride: int) -> tuple[Array, Array, Array]:
    parts = []
    for group in groups:
        begins = np.arange(0, group.times.shape[1] - steps, stride)
        inside = begins[:, None] + np.arange(steps + 1)
        taken = group.times[:, begins], group.outputs[:, inside]
        taken += (group.controls[:, inside[:, :-1]],)
        parts.append([array.reshape(-1, *array.shape[2:]) for array in taken])
    times, states, controls = (jnp.concatenate(p) for p in zip(*parts, strict=True))
    return times, states, controls


class PredictionError(eqx.Module):
    r"""The loss of a model of the dynamics: how far its predictions are off,

    `1 / (N steps) sum over stretches and steps of |(x_k - xhat_k) / scale|^2`,

    with `xhat` what the recorded controls lead to from the first state of a stretch, by
    the model alone. A stretch of one step is a one-step fit; longer ones penalise
    errors that accumulate. Angles are compared by `model.difference`.

    **Arguments:** `scale`: of each state, a number or shape `(n,)`; 1 by default.

    **Returns:** from a call `loss(model, batch, key)`, with `model` any dynamics and
    `batch` as [`delucax.training.sysid.windows`][] makes it: a scalar.

    **Raises:** `ValueError` if `scale` is not positive.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import optax

        key = jax.random.key(0)
        true = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05)
        controls = jax.random.normal(key, (100, 1))
        states = dlx.open_loop(true, [3.0, 0.0], controls)
        record = dlx.training.sysid.Record(states, controls, dt=0.05)
        field = dlx.systems.NeuralSystem(2, 1, width=8, depth=1, key=key)
        fitted = dlx.training.fit(
            dlx.training.sysid.PredictionError(),
            dlx.Discretized(field, dt=0.05),
            optax.adam(1e-2),
            steps=20,
            key=key,
            data=dlx.training.sysid.windows(record, 5),
            batch_size=32,
        )
        fitted.model.system
        ```
    """

    scale: Float[Array, "..."] = parameter(1.0, constraint=positive)

    __repr__ = shown

    def __check_init__(self):
        check_positive(self.scale, "scale", "PredictionError")

    def __call__(
        self, model: AbstractDynamics, batch: tuple[Array, Array, Array], key: PRNGKey
    ) -> Array:
        """The loss.

        **Arguments:** `model`: the dynamics. `batch`: stretches. `key`: not used.

        **Returns:** a scalar.
        """
        check_instance(model, AbstractDynamics, "model", "PredictionError")

        def stretch(t, states, controls):
            def step(x, inputs):
                k, u, recorded = inputs
                x_next, _ = model.advance(t + k * model.dt, x, u, None)
                error = model.difference(x_next, recorded) / self.scale
                return x_next.astype(x.dtype), jnp.sum(error**2)

            # Recomputed in the backward pass, so that memory holds the states alone.
            inputs = (jnp.arange(controls.shape[0]), controls, states[1:])
            return jnp.mean(lax.scan(jax.checkpoint(step), states[0], inputs)[1])

        return jnp.mean(jax.vmap(stretch)(*batch))
