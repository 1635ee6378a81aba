"""The simplest controllers."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array

from .._check import (
    as_matrix,
    check_count,
    check_instance,
    check_key,
    check_range,
    check_real,
    check_step,
    check_vector,
)
from .._controller import AbstractController, wrong_observation
from .._module import parameter, weight
from ..math import matvec
from ..math._steps import row_at, step_at


class Zero(AbstractController):
    """`u = 0`, the baseline.

    **Arguments:** `control_size`: the number of controls.

    **Raises:** `ValueError` if it is below 0.

    !!! example

        ```python
        import delucax as dlx
        import jax

        zero = dlx.controllers.Zero(1)
        dlx.rollout(dlx.make("pendulum"), zero, key=jax.random.key(0)).total_cost
        ```
    """

    control_size: int = eqx.field(static=True)

    def __check_init__(self):
        check_count(self.control_size, "control_size", "Zero", least=0)

    def __call__(self, t, y, state):
        return jnp.zeros(self.control_size, y.dtype), state


class Constant(AbstractController):
    """`u = value`.

    **Arguments:** `value`: a vector, one entry per control.

    **Raises:** `ValueError` if `value` is not a finite vector.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        push = dlx.controllers.Constant(jnp.array([0.5]))
        dlx.rollout(dlx.make("pendulum"), push, key=jax.random.key(0)).total_cost
        ```
    """

    value: Array = weight()

    def __check_init__(self):
        check_vector(self.value, "value", "Constant")

    def __call__(self, t, y, state):
        return self.value.astype(y.dtype), state


class Random(AbstractController):
    """Independent normal controls, `u ~ N(mean, std^2)`, for exploration.

    **Arguments:**

    - `std`: standard deviation, a vector with one entry per control.
    - `mean`: a number or vector, 0 by default.

    **Raises:** `ValueError` if `std` is not a vector; or, when it is run, if there is
    no key.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        explore = dlx.controllers.Random(jnp.array([1.0]))
        dlx.rollout(dlx.make("pendulum"), explore, key=jax.random.key(0)).total_cost
        ```
    """

    std: Array = parameter()
    mean: Array = parameter(0.0)

    def __check_init__(self):
        check_vector(self.std, "std", "Random")
        check_range(self.std, "std", "Random")
        if jnp.shape(self.mean) not in ((), self.std.shape):
            raise ValueError(
                f"Random: mean must be a number or have shape {self.std.shape}, got "
                f"{jnp.shape(self.mean)}."
            )

    def init(self, *, key=None):
        return check_key(key, "Random.init")

    def __call__(self, t, y, state):
        state, now = jr.split(state)
        u = self.mean + self.std * jr.normal(now, self.std.shape, y.dtype)
        return u.astype(y.dtype), state


class Linear(AbstractController):
    """Linear feedback, `u = -K y`.

    **Arguments:** `K`: the gain, shape `(m, p)`; trainable.

    **Raises:** `ValueError` if `K` is not a finite matrix, or does not fit the
    observation.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        feedback = dlx.controllers.Linear(jnp.array([[20.0, 5.0]]))
        dlx.rollout(dlx.make("pendulum"), feedback, key=jax.random.key(0)).total_cost
        ```
    """

    K: Array = weight()

    def __check_init__(self):
        as_matrix(self.K, "K", "Linear")

    def __call__(self, t, y, state):
        if y.shape != self.K.shape[1:]:
            raise wrong_observation(self, self.K.shape[1], y)
        return -matvec(self.K, y).astype(y.dtype), state


class OpenLoop(AbstractController):
    """Open-loop control by a given sequence.

    `u_k = values[k]`; the last is held after the end.

    **Arguments:** `values`: shape `(steps, m)`; trainable.

    **Raises:** `ValueError` if `values` is not a matrix of finite numbers with at least
    one row.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        replay = dlx.controllers.OpenLoop(0.5 * jnp.ones((20, 1)))
        dlx.rollout(dlx.make("pendulum"), replay, key=jax.random.key(0)).total_cost
        ```
    """

    values: Array = weight()

    def __check_init__(self):
        as_matrix(self.values, "values", "OpenLoop")
        check_real(self.values, "values", "OpenLoop")
        if self.values.shape[0] == 0:
            raise ValueError("OpenLoop: values must have at least one row, got none.")

    def init(self, *, key=None):
        return jnp.zeros((), jnp.int32)

    def __call__(self, t, y, state):
        u = self.values[jnp.minimum(state, self.values.shape[0] - 1)]
        return u.astype(y.dtype), state + 1


class Scheduled(AbstractController):
    """A controller for each time step, `u_k = controllers[k](t_k, y_k)`.

    The last one is used after the end; before the start the control is NaN, which a
    rollout reports. All share one state, which must have the same structure and meaning
    for each of them.

    **Arguments:**

    - `controllers`: controllers of one kind, with a leading axis of time in each of
        their arrays, as `eqx.filter_vmap` makes them.
    - `dt`: the step between two of them.

    **Raises:** `ValueError` if `controllers` is not a controller, its arrays do not
    share a leading axis, or `dt` is not positive.

    !!! example

        ```python
        import delucax as dlx
        import equinox as eqx
        import jax
        import jax.numpy as jnp

        A = jnp.array([[1.0, 1.0], [0.0, 1.0]])
        B = jnp.array([[0.0], [1.0]]) * jnp.linspace(1.0, 2.0, 50)[:, None, None]
        dynamics = dlx.LinearDynamics(jnp.tile(A, (50, 1, 1)), B)

        def design(t):
            return dlx.controllers.LQR(dynamics.at(t), jnp.eye(2), jnp.eye(1))

        times = jnp.arange(50.0)
        base = dlx.controllers.Scheduled(eqx.filter_vmap(design)(times), dt=1.0)
        env = dlx.Environment(dynamics, dlx.costs.Quadratic(jnp.eye(2), jnp.eye(1)))
        x0 = jnp.ones(2)
        dlx.rollout(env, base, key=jax.random.key(0), horizon=50, x0=x0).total_cost
        ```
    """

    controllers: AbstractController
    dt: Array = parameter()

    def __check_init__(self):
        where, hint = "Scheduled", " whose arrays have a leading axis"
        controllers = self.controllers
        check_instance(controllers, AbstractController, "controllers", where, hint)
        check_step(self.dt, "Scheduled")
        arrays = jax.tree.leaves(eqx.filter(controllers, eqx.is_array))
        lengths = {array.shape[:1] for array in arrays}
        if len(lengths) != 1 or () in lengths:
            raise ValueError(
                "Scheduled: controllers must have arrays with one leading axis in "
                f"common, got lengths {sorted(lengths)}."
            )

    def _at(self, t: Any) -> AbstractController:
        arrays, rest = eqx.partition(self.controllers, eqx.is_array)
        count = len(jax.tree.leaves(arrays)[0])
        k = step_at(t, self.dt, count, "Scheduled")
        # Held after the end; row -1, of times before the start, is NaN.
        return eqx.combine(row_at(arrays, jnp.minimum(k, count - 1)), rest)

    def init(self, *, key=None):
        return self._at(0.0).init(key=key)

    def __call__(self, t, y, state):
        return self._at(t)(t, y, state)
