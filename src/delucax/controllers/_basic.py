"""The simplest controllers."""

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, PyTree

from .._check import (
    as_entries,
    as_matrix,
    check_count,
    check_key,
    check_range,
    check_real,
    check_vector,
)
from .._controller import AbstractController, wrong_observation
from .._module import parameter, weight
from .._typing import PRNGKey, RealScalar
from ..math import matvec


class Zero(AbstractController):
    """A controller whose control is always zero, $u = 0$. Use it as a baseline.

    **Arguments:** `control_size`: the number of controls $m$.

    **Raises:** `ValueError` if `control_size` is below 0.

    !!! example

        ```python
        import delucax as dlx
        import jax

        zero = dlx.controllers.Zero(1)
        env = dlx.make("pendulum")
        dlx.rollout(env, zero, key=jax.random.key(0), x0=[0.1, 0.0]).total_cost
        ```

        ```text
        Array(519., dtype=float32)
        ```
    """

    control_size: int = eqx.field(static=True)

    def __check_init__(self):
        check_count(self.control_size, "control_size", "Zero", least=0)

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        return jnp.zeros(self.control_size, y.dtype), state


class Constant(AbstractController):
    """A constant control, $u = v$.

    **Arguments:** `value`: the control $v$, shape `(m,)`; trainable.

    **Raises:** `ValueError` if `value` is not a finite vector.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        push = dlx.controllers.Constant(jnp.array([0.5]))
        env = dlx.make("pendulum")
        dlx.rollout(env, push, key=jax.random.key(0), x0=[0.1, 0.0]).total_cost
        ```

        ```text
        Array(1192., dtype=float32)
        ```
    """

    value: Array = weight()

    def __check_init__(self):
        check_vector(self.value, "value", "Constant")

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        return self.value.astype(y.dtype), state


class Random(AbstractController):
    r"""Random controls for exploration, drawn independently at each step.

    $$u \sim N(\mu, \operatorname{diag}(\sigma^2))$$

    **Arguments:**

    - `std`: the standard deviation $\sigma$, shape `(m,)`.
    - `mean`: the mean $\mu$, a number or an array of shape `(m,)`; 0 by default.

    **Raises:** `ValueError` if `std` is not a vector of finite numbers that are not
    negative, or `mean` has the wrong shape; at run time, if `init` did not get a random
    key.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        explore = dlx.controllers.Random(jnp.array([1.0]))
        env = dlx.make("pendulum")
        dlx.rollout(env, explore, key=jax.random.key(0), x0=[0.1, 0.0]).total_cost
        ```

        ```text
        Array(841., dtype=float32)
        ```
    """

    std: Array = parameter()
    mean: Array = parameter(0.0)

    def __check_init__(self):
        check_vector(self.std, "std", "Random")
        check_range(self.std, "std", "Random")
        as_entries(self.mean, len(self.std), "mean", "Random")

    def init(self, *, key: PRNGKey | None = None) -> PyTree:
        return check_key(key, "Random.init")

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        state, now = jr.split(state)
        u = self.mean + self.std * jr.normal(now, self.std.shape, y.dtype)
        return u.astype(y.dtype), state


class Linear(AbstractController):
    """Linear feedback, $u = -K y$.

    **Arguments:** `K`: the gain, shape `(m, p)`; trainable.

    **Raises:** `ValueError` if `K` is not a finite matrix, or does not fit the
    observation.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        feedback = dlx.controllers.Linear(jnp.array([[20.0, 5.0]]))
        env = dlx.make("pendulum")
        dlx.rollout(env, feedback, key=jax.random.key(0), x0=[0.1, 0.0]).total_cost
        ```

        ```text
        Array(0.0736, dtype=float32)
        ```
    """

    K: Array = weight()

    def __check_init__(self):
        as_matrix(self.K, "K", "Linear")

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        if y.shape != self.K.shape[1:]:
            raise wrong_observation(self, self.K.shape[1], y)
        return -matvec(self.K, y).astype(y.dtype), state


class OpenLoop(AbstractController):
    """Open-loop control by a given sequence, $u_k = v_k$.

    After the last step of the sequence, the controller keeps applying the last control.

    **Arguments:** `values`: the sequence $v$ of controls, shape `(steps, m)`;
    trainable.

    **Raises:** `ValueError` if `values` is not a matrix of finite numbers with at least
    one row.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        replay = dlx.controllers.OpenLoop(0.5 * jnp.ones((20, 1)))
        env = dlx.make("pendulum")
        dlx.rollout(env, replay, key=jax.random.key(0), x0=[0.1, 0.0]).total_cost
        ```

        ```text
        Array(1192., dtype=float32)
        ```
    """

    values: Array = weight()

    def __check_init__(self):
        as_matrix(self.values, "values", "OpenLoop")
        check_real(self.values, "values", "OpenLoop")
        if self.values.shape[0] == 0:
            raise ValueError("OpenLoop: values must have at least one row, got none.")

    def init(self, *, key: PRNGKey | None = None) -> PyTree:
        return jnp.zeros((), jnp.int32)

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        u = self.values[jnp.minimum(state, self.values.shape[0] - 1)]
        return u.astype(y.dtype), state + 1
