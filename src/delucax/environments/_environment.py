"""The environment: a control task."""

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
    check_function,
    check_parameters,
    function_field,
    parameter,
    shown,
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
from ..disturbances import AbstractDisturbance
from ..dynamics import AbstractDynamics, OperatingPoint, trim
from ..math import clip
from ._environment_checks import check_noise, check_signal, default_disturbance


class Step(NamedTuple):
    """The outcome of one step of an environment.

    - `state`: the next state, shape `(n,)`.
    - `control`: the control that was applied, after clipping to the bounds, shape
        `(m,)`.
    - `cost`: the stage cost at the current state and the applied control, a scalar.
    - `terminated`: whether the next state ends the episode, a boolean.
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


def _identity(y: Any) -> Any:
    """The observation `y` itself."""
    return y


class Environment(eqx.Module):
    """A control task: dynamics, a cost, disturbances, bounds, an initial state and a
    condition of termination.

    [`delucax.make`][] makes one of the ready-made tasks. [`delucax.rollout`][]
    simulates a controller in it.

    **Arguments:**

    - `dynamics`: the discrete-time dynamics, a [`delucax.AbstractDynamics`][].
    - `cost`: the stage and final cost, a [`delucax.AbstractCost`][]. A cost is minus a
        reward.
    - `disturbance`: a [`delucax.AbstractDisturbance`][]. By default, dynamics with a
        diffusion get Brownian increments, and all other dynamics get no disturbance.
        A disturbance that you pass replaces the Brownian increments.
    - `sensor_noise`: a [`delucax.AbstractDisturbance`][] that is added to the
        observation; none by default.
    - `initial_state`: the first state, shape `(n,)`, or a function that draws the first
        state from a random key; zero by default.
    - `control_bounds`: `(low, high)`, the bounds to which controls are clipped; each
        bound is a number or has shape `(m,)`. None by default.
    - `horizon`: the number of steps of an episode, 200 by default.
    - `terminated`: a function `(t, x) -> bool` that says whether a state ends the
        episode; by default no state does.
    - `actions`: the controls that the integer actions 0, 1, ... stand for, shape
        `(actions, m)`; by default there are no integer actions.
    - `encode`: a function of an observation that returns the features for networks and
        for Gymnasium, such as the cosine and sine of an angle; the identity by default.
        Controllers get the observation itself.
    - `observation_bounds`: the bounds `(low, high)` of `encode(y)`, each a number or a
        vector. They define the observation space for Gymnasium. These bounds are not
        enforced. None by default.

    **Raises:** `ValueError` if sizes do not fit each other, or `low` is above `high`.

    !!! note

        `jax.jit(env.step)` raises "unhashable", because `env` holds arrays. Use
        `eqx.filter_jit(env.step)`, or pass the environment as an argument,
        `jax.jit(Environment.step)(env, ...)`. `vmap` and `scan` need neither. The same
        holds for the methods of all other Equinox modules: compile them in one of these
        two ways.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dynamics = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05)
        cost = dlx.costs.Quadratic(jnp.eye(2), 0.1 * jnp.eye(1))
        env = dlx.Environment(dynamics, cost, control_bounds=(-2.0, 2.0))
        step = env.step(0.0, jnp.array([0.1, 0.0]), jnp.array([5.0]))
        step.state, step.control, step.cost
        ```

        ```text
        (Array([0.109, 0.377], dtype=float32),
         Array([2.], dtype=float32),
         Array(0.41, dtype=float32))
        ```
    """

    dynamics: AbstractDynamics
    cost: AbstractCost
    # `__post_init__` replaces these defaults of None, as the dynamics need it.
    disturbance: AbstractDisturbance | None = eqx.field(default=None)
    sensor_noise: AbstractDisturbance | None = None
    initial_state: Any = eqx.field(default=None, converter=_as_start)
    control_bounds: BoundsOrNone = bounds_field(
        "Environment", "control_bounds", default=None
    )
    horizon: int = eqx.field(static=True, default=200, converter=_as_horizon)
    terminated: Callable[[Time, State], Array] | None = function_field(None, of="t, x")
    actions: RealOrNone = parameter(None)
    encode: Callable[[Observation], Vector] = function_field(_identity, of="y")
    observation_bounds: BoundsOrNone = bounds_field(
        "Environment", "observation_bounds", default=None
    )

    __repr__ = shown

    def __post_init__(self):
        check_instance(self.dynamics, AbstractDynamics, "dynamics", "Environment")
        if self.disturbance is None:
            self.disturbance = default_disturbance(self.dynamics)
        if self.initial_state is None:
            self.initial_state = jnp.array(np.zeros(self.dynamics.state_size))

    def __check_init__(self):
        where, dynamics = "Environment", self.dynamics
        check_instance(dynamics, AbstractDynamics, "dynamics", where)
        check_noise(dynamics, where)
        n, m = dynamics.state_size, dynamics.control_size
        check_instance(self.cost, AbstractCost, "cost", where)
        check_cost_sizes(self.cost, (n, m), "cost", where)
        check_signal(self.disturbance, dynamics.disturbance_size, "disturbance")
        if self.sensor_noise is not None:
            check_signal(self.sensor_noise, dynamics.observation_size, "sensor_noise")
        check_parameters(self)
        check_function(self.encode, "encode", where, "y")
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
        """The fields of `before` that still have the default for its old dynamics, with
        the default for the new ones."""
        old, new, x0 = before.dynamics, self.dynamics, before.initial_state
        if not isinstance(new, AbstractDynamics):
            return {}
        fields: dict[str, Any] = {}
        if eqx.tree_equal(before.disturbance, default_disturbance(old)):
            fields["disturbance"] = default_disturbance(new)
        n = new.state_size
        # A state that is not zero was given by the user.
        if n != old.state_size and not callable(x0) and is_concrete(x0):
            if x0.shape == (old.state_size,) and not np.any(x0):
                fields["initial_state"] = jnp.zeros(n, x0.dtype)
        return fields

    @property
    def dt(self) -> Array:
        """The control interval, in units of time."""
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
        """The size of the disturbance `w`."""
        return self.dynamics.disturbance_size

    @property
    def observation_size(self) -> int:
        """The size of the observation that a controller gets."""
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
        """The operating point of the task, which [`delucax.trim`][] finds.

        The initial guess is the `targets` of the cost if the cost has both a target
        state and a target control. Otherwise the guess is the equilibrium of the
        dynamics. If the dynamics define no equilibrium, the guess is the one target
        that the cost has, with zeros for the other one.

        **Arguments:** `fix`, `throw`: as in [`delucax.trim`][].

        **Returns:** a [`delucax.dynamics.OperatingPoint`][].

        **Raises:** `ValueError` if neither the cost nor the dynamics define a guess.
        The method also raises the errors of [`delucax.trim`][].

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
                "Environment: trim needs a cost with targets, or dynamics with an "
                "equilibrium. Without them, use `delucax.trim(env.dynamics, x=..., "
                "u=...)`."
            )
        x, u = point
        return trim(self.dynamics, x=x, u=u, fix=fix, throw=throw)

    @staticmethod
    def split_key(key: PRNGKey) -> tuple[PRNGKey, PRNGKey, PRNGKey, PRNGKey]:
        """Split a random key for an episode, as [`delucax.rollout`][] does.

        **Arguments:** `key`: a random key.

        **Returns:** four keys: for the first state, the disturbance, the sensor noise
        and the controller.
        """
        start, disturbance, noise, controller = jr.split(key, 4)
        return start, disturbance, noise, controller

    def reset(self, key: PRNGKey) -> State:
        """The first state of an episode, drawn at random if `initial_state` is a
        function.

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
        """Clip a control to `control_bounds`. An integer action is first replaced by
        its row of `actions`.

        **Arguments:** `u`: a control, shape `(m,)`; or an integer action, a scalar, if
            the environment has `actions`.

        **Returns:** the control, shape `(m,)`.

        **Raises:** `ValueError` if `u` has another shape or is an unknown action.
        """
        try:
            control = jnp.asarray(u)
        except (TypeError, ValueError):  # not a number, or a ragged list
            raise ValueError(
                "Environment: u (the control) must have shape "
                f"({self.control_size},), got {shortened(u)}."
            ) from None
        check_real(control, "u (the control)", "Environment")
        if self.actions is not None and jnp.issubdtype(control.dtype, jnp.integer):
            if control.ndim != 0:
                raise ValueError(
                    "Environment: u must be one integer action (a scalar) or a control "
                    f"of floating-point numbers of shape ({self.control_size},), got "
                    f"integers of shape {control.shape}."
                )
            count = len(self.actions)
            if is_concrete(control) and not 0 <= int(control) < count:
                raise ValueError(
                    f"Environment: u must be an action from 0 to {count - 1}, got {u}."
                )
            # NaN for an unknown action, so that a compiled rollout fails.
            row = self.actions.at[control]
            control = row.get(mode="fill", wrap_negative_indices=False)
        # Before the bounds, against which a wrong shape could be broadcast.
        control = as_vector(
            control, self.control_size, "u (the control)", "Environment"
        )
        if self.control_bounds is None:
            return control
        low, high = self.control_bounds
        # Whole numbers become floats, because bounds need not be whole.
        control = as_float_array(control)
        return clip(control, low, high).astype(control.dtype)

    def step(
        self, t: Time, x: ArrayLike, u: ArrayLike, w: ArrayLike | None = None
    ) -> Step:
        """One step: clip the control, charge the stage cost, advance the state.

        `result` says only whether the solver succeeded. The next state is not checked:
        it is NaN if the state or the control is NaN, and a huge state may overflow,
        although `result` is a success. [`delucax.rollout`][], losses and adapters check
        for states that are not finite.

        **Arguments:**

        - `t`: time, a scalar.
        - `x`: state, shape `(state_size,)`.
        - `u`: control, shape `(control_size,)`; or an integer action, if the
            environment has `actions`.
        - `w`: disturbance, shape `(disturbance_size,)`; `None` (default) for zero.

        **Returns:** a [`delucax.environments.Step`][].

        **Raises:** `ValueError` on a wrong shape or kind.
        """
        x = as_vector(x, self.state_size, "x (the state)", "Environment.step")
        if w is not None:
            size = self.disturbance_size
            w = as_vector(w, size, "w (the disturbance)", "Environment.step")
        return self._advance(t, x, self._applied(u), w)

    def _applied(self, u: Any) -> Control:
        """The control or integer action `u`, as a control within the bounds."""
        return self.saturate(as_float_array(u) if self.actions is None else u)

    def _advance(self, t: Time, x: State, u: Control, w: Disturbance) -> Step:
        """A step with arguments that are already checked."""
        step, *_ = self._advance_by(self.dynamics.advance, t, x, u, w)
        return step

    def _advance_by(
        self, advance: Callable[..., Any], t: Time, x: State, u: Control, w: Disturbance
    ) -> tuple[Any, ...]:
        """The step by a method of the dynamics, and what else this method returns."""
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
