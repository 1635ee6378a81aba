"""A controller for each time."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._check import check_instance, check_step
from .._controller import AbstractController
from .._module import parameter
from ..math._steps import row_at, step_at


class Scheduled(AbstractController):
    """A controller for each time step, `u_k = controllers[k](t_k, y_k)`.

    The last one is used after the end; before the start the control is NaN, which a
    rollout reports. They share one state, so that it must mean the
    same to each of them.

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
        return eqx.combine(row_at(arrays, jnp.minimum(k, count - 1)), rest)

    def init(self, *, key=None):
        return self._at(0.0).init(key=key)

    def __call__(self, t, y, state):
        return self._at(t)(t, y, state)
