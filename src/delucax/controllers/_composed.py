"""Controllers made of other controllers."""

from collections.abc import Callable
from dataclasses import KW_ONLY
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from .._check import check_count, check_instance, check_step
from .._controller import AbstractController, check_controller
from .._module import function_field, parameter
from .._typing import PRNGKey, RealScalar
from ..math._steps import row_at, step_at
from ._network import features_of


class _Told(NamedTuple):
    inner: PyTree
    step: Array  # of the last call, because `applied` gets no time


class Scheduled(AbstractController):
    r"""A controller for each time step, $u_k = \pi_k(t_k, y_k)$.

    At time `t`, the controller with index `round(t / dt)` acts. After the end of the
    sequence, the last controller continues to act. At a time before the first
    controller, the control is NaN, and a rollout reports this. Each controller passes
    its state to the next controller, so the state must have the same structure and
    meaning for all controllers.

    **Arguments:**

    - `controllers`: one controller module whose arrays have a leading time axis, with
        one entry for each time step. `eqx.filter_vmap` makes such a module.
    - `dt`: the time for which each controller acts.

    **Raises:** `ValueError` if `controllers` is not a controller, if the leading axes
    of its arrays are missing or differ in length, or if `dt` is not positive.

    !!! example

        ```python
        import delucax as dlx
        import equinox as eqx
        import jax
        import jax.numpy as jnp

        A, B = jnp.array([[1.0, 1.0], [0.0, 1.0]]), jnp.array([[0.0], [1.0]])
        strength = jnp.linspace(1.0, 2.0, 50)[:, None, None]
        dynamics = dlx.LinearDynamics(jnp.tile(A, (50, 1, 1)), strength * B)

        gains = jnp.array([[0.4, 1.2]]) / strength
        feedback = eqx.filter_vmap(dlx.controllers.Linear)(gains)
        base = dlx.controllers.Scheduled(feedback, dt=1.0)
        env = dlx.Environment(dynamics, dlx.costs.Quadratic(jnp.eye(2), jnp.eye(1)))
        x0 = jnp.ones(2)
        dlx.rollout(env, base, key=jax.random.key(0), horizon=50, x0=x0).total_cost
        ```

        ```text
        Array(12.31, dtype=float32)
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

    @property
    def _listens(self) -> bool:
        """Whether the controllers override `applied`."""
        return type(self.controllers).applied is not AbstractController.applied

    def _step(self, t: Any) -> Array:
        arrays = jax.tree.leaves(eqx.filter(self.controllers, eqx.is_array))
        count = len(arrays[0])
        # Only the end is clipped: row -1, before the start, is NaN on purpose.
        return jnp.minimum(step_at(t, self.dt, count, "Scheduled"), count - 1)

    def _at(self, k: Array) -> AbstractController:
        arrays, rest = eqx.partition(self.controllers, eqx.is_array)
        return eqx.combine(row_at(arrays, k), rest)

    def init(self, *, key: PRNGKey | None = None) -> PyTree:
        first = jnp.zeros((), int)
        inner = self._at(first).init(key=key)
        return _Told(inner, first) if self._listens else inner

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        k, listens = self._step(t), self._listens
        u, inner = self._at(k)(t, y, state.inner if listens else state)
        return u, _Told(inner, k) if listens else inner

    def applied(self, u: Array, cost: Array, state: PyTree) -> PyTree:
        if not self._listens:
            return state
        inner = self._at(state.step).applied(u, cost, state.inner)
        return state._replace(inner=inner)


class _Past(NamedTuple):
    base: PyTree
    observations: Array
    controls: Array
    started: Array


class History(AbstractController):
    r"""A controller that acts on a window of past observations and controls.

    $$u_t = \pi(t, (z_t, z_{t-1}, \dots, z_{t-n}, u_{t-1}, \dots, u_{t-n})),
    \qquad z_t = \phi(y_t)$$

    The past controls in the window are the controls after clipping, which the plant
    received. At the start of an episode, all past controls in the window are zero, and
    all past observations are equal to the first observation.

    **Arguments:**

    - `base`: the controller $\pi$ that acts on the window. The observation of `base` is
        a vector with `size * (n + 1) + controls * n` entries.
    - `size`: the size of the features $z$.
    - `controls`: the number of controls.
    - `length`: the number $n$ of past steps in the window; 1 by default.
    - `features`: the function $\phi$ that computes the features of an observation, such
        as `env.encode`. By default the features are the observation itself.

    **Raises:** `ValueError` if `base` is not a controller or a size is below 1; at run
    time, if the features do not have `size` entries.

    !!! example

        ```python
        import delucax as dlx
        import jax

        env = dlx.make("pendulum")
        angle = lambda y: env.encode(y)[:2]
        size = 2 * (3 + 1) + 3
        base = dlx.controllers.MLP(size, 1, width=8, depth=1, key=jax.random.key(0))
        blind = dlx.controllers.History(base, 2, 1, length=3, features=angle)
        dlx.rollout(
            env, blind, key=jax.random.key(1), horizon=10, x0=[0.1, 0.0]
        ).total_cost
        ```

        ```text
        Array(0.172, dtype=float32)
        ```
    """

    base: AbstractController
    size: int = eqx.field(static=True)
    controls: int = eqx.field(static=True)
    length: int = eqx.field(default=1, static=True)
    _: KW_ONLY
    features: Callable[[Array], Array] | None = function_field(None, of="y")

    def __check_init__(self):
        check_controller(self.base, "base", "History")
        for name in ("size", "controls", "length"):
            check_count(getattr(self, name), name, "History")

    def init(self, *, key: PRNGKey | None = None) -> PyTree:
        return _Past(
            self.base.init(key=key),
            jnp.zeros((self.length, self.size)),
            jnp.zeros((self.length, self.controls)),
            jnp.zeros((), bool),
        )

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        z = features_of(self, y, self.size).astype(state.observations.dtype)
        # The first observation fills the window: zeros would look like motion.
        past = jnp.where(state.started, state.observations, z)
        window = jnp.concatenate([z, past.ravel(), state.controls.ravel()])
        u, base = self.base(t, window.astype(y.dtype), state.base)
        observations = jnp.concatenate([z[None], past[:-1]])
        return u, _Past(base, observations, state.controls, jnp.ones((), bool))

    def applied(self, u: Array, cost: Array, state: PyTree) -> PyTree:
        u = u.astype(state.controls.dtype)
        return state._replace(
            base=self.base.applied(u, cost, state.base),
            controls=jnp.concatenate([u[None], state.controls[:-1]]),
        )
