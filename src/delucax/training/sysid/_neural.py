"""Neural dynamics, and the loss of their predictions over one or several steps."""

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
    r"""Discrete-time dynamics given by a fully connected network.

    $$x_{k+1} = x_k + \sigma_\mathrm{step} \, \mathrm{network}\left(
    \frac{x_k - \bar x}{\sigma_x}, \frac{u_k}{\sigma_u}\right)$$

    For a neural ODE, use [`delucax.Discretized`][] of a
    [`delucax.systems.NeuralSystem`][]. The same losses fit both.

    **Arguments:**

    - `states`, `controls`: the names of the states and of the controls, or how many of
        them there are.
    - `width`: units in each hidden layer, 64 by default.
    - `depth`: the number of hidden layers, 2 by default.
    - `dt`: the step, 1 by default.
    - `x_mean`, `x_scale`: $\bar x$ and $\sigma_x$, shape `(n,)` or a number; 0 and 1 by
        default.
    - `u_scale`: $\sigma_u$, shape `(m,)` or a number; 1 by default.
    - `step_scale`: $\sigma_\mathrm{step}$, the typical change of the state in a step,
        shape `(n,)` or a number; 1 by default.
    - `activation`: the activation function of the hidden layers, `jnp.tanh` by default.
    - `key`: a random key for the initial weights.

    **Attributes:** `network`, an `eqx.nn.MLP`, trainable.

    **Raises:** `ValueError` if a size is below 1, a scale is not positive, or `key` is
    not a random key.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        Net = dlx.training.sysid.NeuralDynamics
        dynamics = Net(2, 1, width=8, depth=1, dt=0.05, key=jax.random.key(0))
        dynamics(0.0, jnp.ones(2), jnp.zeros(1))
        ```

        ```text
        Array([1.0643, 0.9569], dtype=float32)
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
        # The network learns the change of the state, because the next state is nearly
        # x itself.
        z = jnp.concatenate([(x - self.x_mean) / self.x_scale, u / self.u_scale])
        x_next = x + self.step_scale * self.network(z)
        x_next = x_next if w is None else x_next + w
        return x_next.astype(x.dtype), RESULTS.successful


def windows(
    record: Records, steps: int, *, stride: int = 1
) -> tuple[Array, Array, Array]:
    """Cut records of the state into windows, which are the data for a multi-step fit.

    **Arguments:**

    - `record`: a [`delucax.training.sysid.Record`][] whose outputs are the states, or a
        list of them; uniform in time.
    - `steps`: the number of steps of a window; 1 for a one-step fit.
    - `stride`: the number of steps between the beginnings of two windows, 1 by default.

    **Returns:** the times at which the windows begin, their states and their controls,
    `(times, states, controls)`, shapes `(N,)`, `(N, steps + 1, n)` and `(N, steps, m)`.
    Pass them as `data` to [`delucax.training.fit`][].

    **Raises:** `ValueError` if `record` is not a uniform record or a list of them, or
    is shorter than a window.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        states = jnp.arange(202.0).reshape(101, 2)
        record = dlx.training.sysid.Record(states, jnp.zeros((100, 1)), dt=0.05)
        data = dlx.training.sysid.windows(record, 10)
        data[1].shape
        ```

        ```text
        (91, 11, 2)
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
    r"""A loss for training dynamics: the mean squared error of their predictions.

    $$\frac{1}{N K} \sum_{i=1}^N \sum_{k=1}^K
    \left|\frac{x_{i,k} - \hat x_{i,k}}{\mathrm{scale}}\right|^2$$

    The sums run over the $N$ windows of a batch and their $K$ steps. The prediction
    $\hat x_{i,k}$ is a simulation of the model with the recorded controls, from the
    first state of window $i$. With windows of one step, the loss measures one-step
    predictions. With longer windows, the loss also penalises errors that accumulate
    from step to step. Angles are compared by `model.difference`.

    **Arguments:** `scale`: the typical size of each state, by which the error of this
    state is divided; a number or shape `(n,)`, 1 by default.

    **Returns:** a call `loss(model, batch, key)` returns a scalar. `model` is any
    dynamics, and `batch` has the form that [`delucax.training.sysid.windows`][]
    returns.

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

        **Arguments:** `model`: the dynamics. `batch`: `(times, states, controls)` of
        windows. `key`: not used.

        **Returns:** a scalar.
        """
        check_instance(model, AbstractDynamics, "model", "PredictionError")

        def window(t, states, controls):
            def step(x, inputs):
                k, u, recorded = inputs
                x_next, _ = model.advance(t + k * model.dt, x, u, None)
                error = model.difference(x_next, recorded) / self.scale
                return x_next.astype(x.dtype), jnp.sum(error**2)

            # Steps are recomputed in the backward pass, so that only the states are
            # kept in memory.
            inputs = (jnp.arange(controls.shape[0]), controls, states[1:])
            return jnp.mean(lax.scan(jax.checkpoint(step), states[0], inputs)[1])

        return jnp.mean(jax.vmap(window)(*batch))
