"""Environments: dynamics, a cost, disturbances, bounds and an initial state."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array, ArrayLike

from .._check import (
    as_bounds,
    as_vector,
    bounds_field,
    check_count,
    check_finite,
    check_instance,
    check_key,
    check_real,
    is_concrete,
)
from .._check_models import check_cost_sizes, output_of
from .._message import shortened
from .._module import (
    as_float_array,
    as_module,
    check_parameters,
    function_field,
    parameter,
    parts_of,
)
from .._results import Result
from .._typing import (
    BoolScalar,
    BoundsOrNone,
    Control,
    Disturbance,
    Observation,
    PRNGKey,
    RealOrNone,
    Scalar,
    State,
    Time,
    Vector,
)
from ..costs import AbstractCost
from ..disturbances import AbstractDisturbance, Brownian, Zero
from ..dynamics import AbstractDynamics, OperatingPoint, trim
from ..math import clip
from ..systems import AbstractPlant


class Step(NamedTuple):
    """The outcome of one step of an environment.

    - `state`: the next state.
    - `control`: the control that was applied, after the bounds.
    - `cost`: the stage cost at the current state and the applied control.
    - `terminated`: whether the next state ends the episode.
    - `result`: the status of the step, one of `delucax.RESULTS`.
    """

    state: State
    control: Control
    cost: Scalar
    terminated: BoolScalar
    result: Result


def _as_start(value: Any) -> Any:
    return as_module(value) if callable(value) else as_float_array(value)


def _as_horizon(value: Any) -> int:
    return check_count(value, "horizon", "Environment")


class Environment(eqx.Module):
    """A control task: dynamics, a cost, disturbances, bounds, an initial state and a
    condition of termination.

    **Arguments:**

    - `dynamics`: the discrete-time dynamics.
    - `cost`: the stage and final cost; minus the reward.
    - `disturbance`: the disturbances; by default none, or the Brownian increments of
        dynamics that have a diffusion.
    - `sensor_noise`: disturbances added to what is observed; none by default.
    - `initial_state`: a vector, or a function of a key to one; zero by default.
    - `control_bounds`: `(low, high)`, each a number or a vector; controls are clipped
        to them. None by default.
    - `horizon`: steps per episode, 200 by default.
    - `terminated`: `(t, x) -> bool`; never by default.
    - `actions`: the table behind integer actions, shape `(actions, m)`; none by
        default.
    - `encode`: features of an observation for networks and Gymnasium users (cosine and
        sine of an angle, for example): a function of a vector to a vector; the identity
        by default. Controllers are given the observation itself.
    - `observation_bounds`: `(low, high)`, each a number or a vector: bounds of
        `encode(y)`, the observation space of a Gymnasium user. Informational only: they
        are not enforced. None by default.

    **Raises:** `ValueError` if sizes do not fit each other or bounds cross.

    !!! note

        `jax.jit(env.step)` raises "unhashable", as does a method of any module that
        holds arrays: use `eqx.filter_jit(env.step)`, or pass the environment as an
        argument, `jax.jit(Environment.step)(env, ...)`. `vmap` and `scan` need neither.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dynamics = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05)
        cost = dlx.costs.Quadratic(jnp.eye(2), 0.1 * jnp.eye(1))
        env = dlx.Environment(dynamics, cost, control_bounds=(-2.0, 2.0))
        step = env.step(0.0, jnp.array([0.1, 0.0]), jnp.zeros(1), None)
        ```
    """

    dynamics: AbstractDynamics
    cost: AbstractCost
    # What is None by default follows from the dynamics, in `__post_init__`.
    disturbance: AbstractDisturbance | None = eqx.field(default=None)
    sensor_noise: AbstractDisturbance | None = None
    initial_state: Any = eqx.field(default=None, converter=_as_start)
    control_bounds: BoundsOrNone = bounds_field(
        "Environment", "control_bounds", default=None
    )
    horizon: int = eqx.field(static=True, default=200, converter=_as_horizon)
    terminated: Callable[[Time, State], Array] | None = function_field(None)
    actions: RealOrNone = parameter(None)
    encode: Callable[[Observation], Vector] = function_field(None)
    observation_bounds: BoundsOrNone = bounds_field(
        "Environment", "observation_bounds", default=None
    )

    def __post_init__(self):
        check_instance(self.dynamics, AbstractDynamics, "dynamics", "Environment")
        if self.disturbance is None:
            self.disturbance = _default_disturbance(self.dynamics)
        if self.initial_state is None:
            self.initial_state = jnp.array(np.zeros(self.dynamics.state_size))
        if self.encode is None:
            self.encode = _identity

    def __check_init__(self):
        where, dynamics = "Environment", self.dynamics
        check_instance(dynamics, AbstractDynamics, "dynamics", where)
        _check_noise(dynamics, where)
        n, m = dynamics.state_size, dynamics.control_size
        check_instance(self.cost, AbstractCost, "cost", where)
        check_cost_sizes(self.cost, (n, m), "cost", where)
        _check_signal(self.disturbance, dynamics.disturbance_size, "disturbance")
        if self.sensor_noise is not None:
            _check_signal(self.sensor_noise, dynamics.observation_size, "sensor_noise")
        check_parameters(self)
        if not callable(self.initial_state):
            x0 = as_vector(self.initial_state, n, "initial_state", where)
            check_finite(x0, "initial_state", where)
        as_bounds(self.control_bounds, where, "control_bounds", m)
        if self.observation_bounds is not None:
            size = self.feature_size
            as_bounds(self.observation_bounds, where, "observation_bounds", size)
        shape = (1, m) if self.actions is None else self.actions.shape
        if len(shape) != 2 or shape[1] != m:
            raise ValueError(
                f"{where}: actions must have shape (actions, {m}), got {shape}."
            )

    def __replaced__(self, before: "Environment") -> dict[str, Any]:
        """New defaults in place of those that `before` had from its dynamics."""
        old, new, x0 = before.dynamics, self.dynamics, before.initial_state
        if not isinstance(new, AbstractDynamics):
            return {}
        fields: dict[str, Any] = {}
        if eqx.tree_equal(before.disturbance, _default_disturbance(old)):
            fields["disturbance"] = _default_disturbance(new)
        n = new.state_size
        # Only zeros can have been the default; another state is the user's.
        if n != old.state_size and not callable(x0) and is_concrete(x0):
            if x0.shape == (old.state_size,) and not np.any(x0):
                fields["initial_state"] = jnp.zeros(n, x0.dtype)
        return fields

    @property
    def dt(self) -> Array:
        """The control interval."""
        return self.dynamics.dt

    @property
    def state_size(self) -> int:
        """The number of states."""
        return self.dynamics.state_size

    @property
    def control_size(self) -> int:
        """The number of controls."""
        return self.dynamics.control_size

    @property
    def disturbance_size(self) -> int:
        """The size of `w`."""
        return self.dynamics.disturbance_size

    @property
    def observation_size(self) -> int:
        """The size of the observation that a controller is given."""
        return self.dynamics.observation_size

    @property
    def feature_size(self) -> int:
        """The size of `encode(y)`."""
        shape = jnp.shape(output_of(self.encode, (self.observation_size,)))
        if len(shape) != 1:
            raise ValueError(
                "Environment: encode must return a vector, got an array of shape "
                f"{shape}."
            )
        return shape[0]

    def trim(self, *, fix: Any = (), throw: bool = True) -> OperatingPoint:
        """The operating point of the task: that of [`delucax.trim`][] from the
        `targets` of its cost if they give both a state and a control, else from the
        equilibrium of its dynamics, else from the target that is given and zeros.

        **Arguments:** `fix`, `throw`: as in [`delucax.trim`][].

        **Returns:** [`delucax.dynamics.OperatingPoint`][].

        **Raises:** `ValueError` if neither cost nor dynamics define a point, and as
        [`delucax.trim`][] does.

        !!! example

            ```python
            import delucax as dlx
            import jax.numpy as jnp

            env = dlx.make("cstr", concentration=0.4)
            Q, R = jnp.diag(jnp.array([10.0, 0.01])), 0.01 * jnp.eye(1)
            dlx.controllers.LQR(env.dynamics, Q, R, point=env.trim(fix="concentration"))
            ```
        """
        point = self.cost.set_point(self.dynamics)
        if point is None:
            raise ValueError(
                "Environment: trim needs a cost with targets or dynamics that define "
                "an equilibrium; use `delucax.trim(env.dynamics, x=..., u=...)`."
            )
        x, u = point
        return trim(self.dynamics, x=x, u=u, fix=fix, throw=throw)

    @staticmethod
    def split_key(key: PRNGKey) -> tuple[PRNGKey, PRNGKey, PRNGKey, PRNGKey]:
        """The keys of an episode, as [`delucax.rollout`][] splits the one it is given.

        **Arguments:** `key`: a random key.

        **Returns:** keys for the first state, the disturbance, the sensor noise and the
        controller.
        """
        start, disturbance, noise, controller = jr.split(key, 4)
        return start, disturbance, noise, controller

    def reset(self, key: PRNGKey) -> State:
        """A first state.

        **Arguments:** `key`: a random key.

        **Returns:** the state, shape `(state_size,)`.
        """
        check_key(key, "Environment.reset")
        if callable(self.initial_state):
            return as_vector(
                self.initial_state(key), self.state_size, "initial_state", "Environment"
            )
        return self.initial_state

    def saturate(self, u: ArrayLike) -> Array:
        """Clip a control to `control_bounds`, or look up an integer action.

        **Arguments:** `u`: a control, shape `(m,)`; or an integer action, a scalar,
            where there is a table of `actions`.

        **Returns:** shape `(m,)`.
        """
        try:
            control = jnp.asarray(u)
        except (TypeError, ValueError):  # no number, or ragged
            raise ValueError(
                "Environment: u (the control) must have shape "
                f"({self.control_size},), got {shortened(u)}."
            ) from None
        check_real(control, "u (the control)", "Environment")
        if self.actions is not None and jnp.issubdtype(control.dtype, jnp.integer):
            if control.ndim != 0:
                raise ValueError(
                    "Environment: u must be one integer action (a scalar) or a control "
                    f"of shape ({self.control_size},), got shape {control.shape}."
                )
            count = len(self.actions)
            if is_concrete(control) and not 0 <= int(control) < count:
                raise ValueError(
                    f"Environment: u must be an action from 0 to {count - 1}, got {u}."
                )
            control = self.actions[control]
        if self.control_bounds is None:
            return control
        low, high = self.control_bounds
        return clip(control, low, high).astype(control.dtype)

    def step(
        self, t: Time, x: ArrayLike, u: ArrayLike, w: ArrayLike | None = None
    ) -> Step:
        """One step: clip the control, charge the stage cost, advance the state.

        **Arguments:**

        - `t`: time, a scalar.
        - `x`: state, shape `(state_size,)`.
        - `u`: control, shape `(control_size,)`; or an integer where there is a table of
            `actions`.
        - `w`: disturbance, shape `(disturbance_size,)`; `None` for zero.

        A step does not check its numbers, and `result` is that of the solver alone: NaN
        in the state or the control gives NaN, and a state that is finite but huge may
        overflow to infinity or NaN, while `result` is a success.
        [`delucax.rollout`][], losses and adapters check for states that are not finite.

        **Returns:** a [`delucax.environments.Step`][].

        **Raises:** `ValueError` on a wrong shape or kind.
        """
        x = as_vector(x, self.state_size, "x (the state)", "Environment.step")
        if w is not None:
            size = self.disturbance_size
            w = as_vector(w, size, "w (the disturbance)", "Environment.step")
        return self._advance(t, x, self._applied(u), w)

    def _applied(self, u: Any) -> Control:
        """The control or action `u` as a control within the bounds."""
        u = self.saturate(as_float_array(u) if self.actions is None else u)
        return as_vector(u, self.control_size, "u (the control)", "Environment.step")

    def _advance(self, t: Time, x: State, u: Control, w: Disturbance) -> Step:
        """A step with arguments that were checked."""
        step, *_ = self._advance_by(self.dynamics.advance, t, x, u, w)
        return step

    def _advance_by(
        self, advance: Callable[..., Any], t: Time, x: State, u: Control, w: Disturbance
    ) -> tuple[Any, ...]:
        """The step by a method of the dynamics, and what else that returns."""
        cost = jnp.asarray(self.cost(t, x, u))
        if cost.shape != ():
            raise ValueError(
                f"{type(self.cost).__name__}: the stage cost must be a scalar, got an "
                f"array of shape {cost.shape}."
            )
        x_next, result, *events = advance(t, x, u, w)
        if self.terminated is None:
            terminated = jnp.zeros((), bool)
        else:
            terminated = jnp.asarray(self.terminated(t + self.dt, x_next))
            if terminated.shape != () or terminated.dtype != bool:
                raise ValueError(
                    "Environment: terminated must return one boolean, got shape "
                    f"{terminated.shape} and dtype {terminated.dtype}."
                )
        return Step(x_next, u, cost, terminated, result), *events


def _identity(y: Any) -> Any:
    return y


def _check_signal(signal: Any, size: int, name: str) -> None:
    """Raise unless `signal` is a disturbance with entries of that size."""
    check_instance(signal, AbstractDisturbance, name, "Environment")
    if signal.size != size:
        raise ValueError(
            f"Environment: {name} has size {signal.size} where {size} is expected."
        )


def _default_disturbance(dynamics: AbstractDynamics) -> AbstractDisturbance:
    k, count = dynamics.disturbance_size, dynamics.increments
    return Brownian(k // count, substeps=count) if count else Zero(k)


def _check_noise(plant: AbstractPlant, where: str) -> None:
    """Raise unless `plant`, and each plant that it wraps, forwards the Brownian noise
    of the plants inside."""
    name, noise = type(plant).__name__, plant.noise
    if isinstance(plant, AbstractDynamics):
        if (plant.increments > 0) != (noise == "brownian"):
            raise ValueError(
                f"{where}: {name} has noise = {noise!r} and increments = "
                f"{plant.increments}, but increments must be at least 1 where w is "
                "Brownian, and 0 where it is not. A subclass of "
                "delucax.dynamics.AbstractWrapper forwards both."
            )
    for part in parts_of(plant, AbstractPlant):
        _check_noise(part, where)
        try:
            is_brownian = part.noise == "brownian"
        except (TypeError, ValueError):  # a batch; a plant without noise does not fail
            is_brownian = True
        if is_brownian and not plant.declares_noise():
            raise ValueError(
                f"{where}: {name} does not forward `noise` of the "
                f"{type(part).__name__} that it wraps. Derive it from "
                f"delucax.dynamics.AbstractWrapper, or define `noise` in {name}: that "
                "of the wrapped plant, or None if w is not Brownian."
            )
