"""Dynamics around others: dead times, and an adversary that acts on the state."""

from dataclasses import KW_ONLY

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._check import as_matrix, as_vector, check_count, check_instance, check_positive
from .._module import parameter
from .._results import Result
from .._typing import Control, Numbers, Observation, Real, RealScalar, State, Time
from ..math import matvec
from ..math._norms import within_ball
from ._base import AbstractDynamics, AbstractWrapper


class Delayed(AbstractWrapper):
    """Dynamics with an input delay, an output delay or both, in whole steps,

    `x_next = F(t, x, u[k - controls], w)`, `y = observe(t, x)[k - sensor]`.

    Pending controls and observations are part of the state: `(x, u[k - 1], ...,
    u[k - controls], y[k - 1], ..., y[k - sensor])`. It is a true transport delay,
    differentiable like any other state. For a fraction of a step use a first-order lag
    or a Padé approximation in the system.

    **Arguments:**

    - `dynamics`: the plant.
    - `controls`: steps until a control acts, 0 by default.
    - `sensor`: steps until an observation is read, 0 by default.

    **Raises:** `ValueError` if `dynamics` is not an `AbstractDynamics`, or a delay is
    not a whole number of at least 0.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        plant = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05)
        late = dlx.dynamics.Delayed(plant, controls=2)
        x0 = late.filled(jnp.array([0.1, 0.0]))
        dlx.open_loop(late, x0, jnp.ones((5, 1)))
        ```
    """

    dynamics: AbstractDynamics
    controls: int = eqx.field(default=0, static=True)
    sensor: int = eqx.field(default=0, static=True)

    def __check_init__(self):
        check_count(self.controls, "controls", "Delayed", least=0)
        check_count(self.sensor, "sensor", "Delayed", least=0)

    @property
    def state_names(self) -> tuple[str, ...]:
        inner, ages = self.dynamics, range(self.controls)
        late = [f"{name}[-{k + 1}]" for k in ages for name in inner.control_names]
        outputs = range(inner.observation_size if self.sensor else 0)
        late += [f"y{i}[-{k + 1}]" for k in range(self.sensor) for i in outputs]
        return (*inner.state_names, *late)

    def _cut(self, x: Array) -> tuple[Array, Array, Array]:
        """The plant's own state, the pending controls and the pending observations."""
        n = self.dynamics.state_size
        m = n + self.controls * self.dynamics.control_size
        return x[:n], x[n:m], x[m:]

    def inner(self, x: Array) -> Array:
        """The plant's own state.

        **Arguments:** `x`: the state.

        **Returns:** its first entries.
        """
        return self._cut(x)[0]

    def filled(self, x: Numbers, u: Numbers | None = None) -> Array:
        """The state of a plant that has rested.

        **Arguments:**

        - `x`: the plant's own state.
        - `u`: the pending control, zero by default.

        **Returns:** the state, in which every pending control is `u` and every pending
        observation that of `x`.

        **Raises:** `ValueError` on a wrong shape.
        """
        inner, where = self.dynamics, "Delayed.filled"
        x = as_vector(x, inner.state_size, "x", where)
        u = [0.0] * inner.control_size if u is None else u
        u = as_vector(u, inner.control_size, "u", where)
        return self._filled(x, u)

    @eqx.filter_jit
    def _filled(self, x: Array, u: Array) -> Array:
        y = self.dynamics.observe(0.0, x)
        late = [jnp.tile(u, self.controls), jnp.tile(y, self.sensor)]
        return jnp.concatenate([x, *late]).astype(x.dtype)

    def advance(
        self, t: RealScalar, x: Array, u: Array, w: Array | None
    ) -> tuple[Array, Result]:
        own, controls, observed = self._cut(x)
        acting, late = u, []
        # The newest comes first, and the oldest acts, or is read. Slices of no entries
        # are left out, so that the state stays one of components.
        if self.controls:
            m = u.shape[0]
            acting = controls[-m:]
            late = [u.astype(x.dtype)]
            late += [controls[:-m]] if self.controls > 1 else []
        if self.sensor:
            y = self.dynamics.observe(t, own).astype(x.dtype)
            late += [y, observed[: -y.shape[0]]] if self.sensor > 1 else [y]
        after, result = self.dynamics.advance(t, own, acting, w)
        return jnp.concatenate([after, *late]), result

    @property
    def observes_state(self) -> bool:
        """True if there is no delay and the plant observes its state."""
        delayed = self.controls or self.sensor
        return not delayed and self.dynamics.observes_state

    def observe(self, t: Time, x: State) -> Observation:
        own, _, observed = self._cut(x)
        if not self.sensor:
            return self.dynamics.observe(t, own)
        # The oldest observation is the last block.
        return observed[-(observed.shape[0] // self.sensor) :]

    def difference(self, x: State, x_ref: State) -> State:
        # Angles wrap in the plant's own state alone.
        n = self.dynamics.state_size
        own = self.dynamics.difference(x[:n], x_ref[:n])
        return jnp.concatenate([own, x[n:] - x_ref[n:]])

    def equilibrium(self) -> tuple[State, Control]:
        x, u = self.dynamics.equilibrium()
        return self.filled(x, u), u


class WorstCase(AbstractWrapper):
    """Dynamics with an adversary that measures the state and adds to the disturbance,

    `x_next = F(t, x, u, w + L difference(x, x_ref))`,

    about the operating point that the dynamics define. With the `L` of
    [`delucax.controllers.HInfinity`][] or of [`delucax.riccati.hinf_dare`][] it is the
    worst disturbance of the H-infinity game; a `bound` keeps it within what a
    disturbance can be.

    **Arguments:**

    - `dynamics`: the plant, which defines an equilibrium.
    - `L`: the adversary's gain, shape `(k, n)`.
    - `bound`: what it adds is scaled back to this Euclidean norm; none by default.

    **Raises:** `ValueError` if `dynamics` is not an `AbstractDynamics` or defines no
    equilibrium, `L` does not fit it, or `bound` is not positive.

    Source: Basar and Bernhard, 1995.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        A, B = jnp.array([[1.0, 1.0], [0.0, 1.0]]), jnp.array([[0.0], [1.0]])
        dynamics = dlx.LinearDynamics(A, B)
        robust = dlx.controllers.HInfinity(dynamics, jnp.eye(2), jnp.eye(1))
        attacked = dlx.dynamics.WorstCase(dynamics, 0.9 * robust.L, bound=1.0)
        env = dlx.Environment(attacked, dlx.costs.Quadratic(jnp.eye(2), jnp.eye(1)))
        x0 = jnp.ones(2)
        dlx.rollout(env, robust, key=jax.random.key(0), x0=x0, horizon=50).total_cost
        ```
    """

    dynamics: AbstractDynamics
    L: Float[Array, "k n"] = parameter()
    _: KW_ONLY
    bound: Real | None = parameter(None)

    def __check_init__(self):
        where, dynamics = "WorstCase", self.dynamics
        check_instance(dynamics, AbstractDynamics, "dynamics", where)
        dynamics.equilibrium()  # raises where there is none
        as_matrix(self.L, "L", where)
        shape = dynamics.disturbance_size, dynamics.state_size
        if self.L.shape != shape:
            raise ValueError(
                f"{where}: L must have shape {shape}, a row for each disturbance and a "
                f"column for each state, got shape {self.L.shape}."
            )
        if self.bound is not None:
            check_positive(self.bound, "bound", where)

    def attack(self, x: Array) -> Array:
        """The adversary's part of the disturbance.

        **Arguments:** `x`: the state.

        **Returns:** shape `(k,)`.
        """
        x_ref, _ = self.dynamics.equilibrium()
        added = matvec(self.L, self.dynamics.difference(x, x_ref)).astype(x.dtype)
        if self.bound is None:
            return added
        return within_ball(added, self.bound)

    def advance(
        self, t: RealScalar, x: Array, u: Array, w: Array | None
    ) -> tuple[Array, Result]:
        added = self.attack(x)
        # Added to the environment's own disturbance, which the adversary does not
        # replace.
        return self.dynamics.advance(t, x, u, added if w is None else w + added)
