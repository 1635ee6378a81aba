"""Conversion of a gymnax environment to an `Environment`."""

import dataclasses
import inspect
import math
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from ..._check import check_keywords, check_step
from ..._module import as_float_array, parameter
from ..._results import Result, RESULTS
from ..._typing import Control, Disturbance, PRNGKey, RealScalar, Scalar, State
from ...costs import AbstractCost
from ...dynamics import AbstractDynamics
from ...environments import Environment
from .._episode import reads_first_argument


@dataclasses.dataclass(frozen=True)
class _Layout:
    """The layout of several arrays in one vector of floats.

    Integers and booleans become floats, which are exact up to 2^24 in float32. An
    unsigned number of 32 bits, such as a word of a random key, becomes two floats of 16
    bits each.
    """

    shapes: tuple[tuple[int, ...], ...]
    dtypes: tuple[Any, ...]
    dtype: Any

    def stored_shape(self, i: int) -> tuple[int, ...]:
        """The shape of array `i` in the vector."""
        return self.shapes[i] + (2,) * (self.dtypes[i] == jnp.uint32)

    def ravel(self, arrays: Sequence[Any]) -> State:
        """The vector that holds these arrays."""
        parts = []
        for array, dtype in zip(arrays, self.dtypes, strict=True):
            if dtype == jnp.uint32:
                array = lax.bitcast_convert_type(jnp.asarray(array, dtype), jnp.uint16)
            parts.append(jnp.ravel(array).astype(self.dtype))
        return jnp.concatenate(parts)

    def unravel(self, x: State) -> list[Array]:
        """The arrays that a vector holds."""
        shapes = [self.stored_shape(i) for i in range(len(self.shapes))]
        parts = jnp.split(x, np.cumsum([math.prod(shape) for shape in shapes])[:-1])
        arrays = []
        for part, shape, dtype in zip(parts, shapes, self.dtypes, strict=True):
            part = part.reshape(shape)
            if dtype == jnp.uint32:
                halves = jnp.round(part).astype(jnp.uint16)
                part = lax.bitcast_convert_type(halves, jnp.uint32)
            elif not jnp.issubdtype(dtype, jnp.inexact):
                part = jnp.round(part)
            arrays.append(part.astype(dtype))
        return arrays


def _check_protocol(env: Any, where: str) -> None:
    for name in ("reset_env", "step_env", "action_space"):
        if not callable(getattr(env, name, None)):
            raise ValueError(
                f"{where}: env must implement gymnax's protocol, but "
                f"{type(env).__name__} has no {name}."
            )


class GymnaxDynamics(AbstractDynamics):
    """Dynamics that call the step of an environment in gymnax's protocol.
    [`delucax.interop.gymnax.from_gymnax`][] makes it.

    The state is a vector with these parts, in this order:

    - the entries of all leaves of the state of the environment;
    - four numbers for a random key, if steps draw random numbers;
    - one entry that is 1 if the episode is over, otherwise 0.

    Integers and booleans are stored as floats. In float32, integers up to 2^24 are
    exact. The disturbance `w` is added to the next state.

    The dynamics are differentiable if the step of the environment is differentiable.
    Derivatives with respect to integers are 0.

    **Arguments:**

    - `env`: the environment.
    - `params`: the parameters of the environment.
    - `dt`: the duration of a step, 1 by default.

    **Raises:** `ValueError` if the environment does not implement the protocol, or `dt`
    is not positive.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp
        from delucax.interop.gymnax import GymnaxDynamics, to_gymnax

        env = to_gymnax(dlx.make("pendulum"))
        dynamics = GymnaxDynamics(env, env.default_params)
        dynamics(0.0, jnp.array([0.5, 0.0, 0.0, 0.0]), jnp.ones(1))
        ```

        ```text
        Array([0.5255, 0.5096, 1., 0.], dtype=float32)
        ```
    """

    env: Any = eqx.field(static=True)
    params: Any
    dt: Array = parameter()
    structure: Any = eqx.field(static=True)
    layout: _Layout = eqx.field(static=True)
    draws: bool = eqx.field(static=True)
    action_shape: tuple[int, ...] = eqx.field(static=True)
    discrete: bool = eqx.field(static=True)
    state_names: tuple[str, ...] = eqx.field(static=True)
    control_names: tuple[str, ...] = eqx.field(static=True)

    def __init__(self, env: Any, params: Any, dt: Any = 1.0):
        where = "from_gymnax"
        _check_protocol(env, where)
        if getattr(env, "supports_transition_gradients", False):
            env = env.with_transition_gradients()  # by default gymnax stops them
        check_step(dt, where)
        as_array = lambda x: as_float_array(x) if isinstance(x, float) else x
        self.env, self.params, self.dt = env, jax.tree.map(as_array, params), dt
        space = env.action_space(params)
        self.discrete = hasattr(space, "n")
        if not self.discrete and not hasattr(space, "low"):
            raise ValueError(
                f"{where}: the action space must be a Box or Discrete, got {space!r}."
            )
        self.action_shape = () if self.discrete else tuple(space.shape)
        size = math.prod(self.action_shape)
        several = tuple(f"action[{i}]" for i in range(size))
        self.control_names = ("action",) if size == 1 else several
        key = jr.key(0)
        reset = jax.eval_shape(lambda key: env.reset_env(key, params)[1], key)
        leaves, self.structure = jax.tree_util.tree_flatten_with_path(reset)
        for path, leaf in leaves:
            if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
                raise ValueError(
                    f"{where}: keys in the state must be raw ones "
                    "(`jax.random.PRNGKey`), got a typed key, "
                    f"{jax.tree_util.keystr(path)}."
                )
        action = jnp.zeros(self.action_shape, int if self.discrete else float)
        step = lambda key, *args: env.step_env(key, *args, params)
        self.draws = reads_first_argument(step, key, reset, action)
        name = lambda path: jax.tree_util.keystr(path).lstrip(".") or "state"
        parts = [(name(path), leaf.shape, leaf.dtype) for path, leaf in leaves]
        parts += [("key", (2,), jnp.dtype(jnp.uint32))] * self.draws
        names, shapes, dtypes = zip(*parts, ("done", (), jnp.dtype(bool)), strict=True)
        floats = [dtype for dtype in dtypes if jnp.issubdtype(dtype, jnp.inexact)]
        dtype = jnp.result_type(*floats) if floats else jnp.zeros(()).dtype
        self.layout = _Layout(shapes, dtypes, dtype)
        self.state_names = tuple(
            name + "".join(f"[{k}]" for k in index)
            for i, name in enumerate(names)
            for index in np.ndindex(self.layout.stored_shape(i))
        )

    def ravel(self, state: Any, key: PRNGKey | None = None) -> State:
        """The vector of a state, for example for `x0` of [`delucax.rollout`][].

        **Arguments:**

        - `state`: a state of the environment.
        - `key`: the random key of the steps, if steps draw random numbers;
            `jax.random.key(0)` by default.

        **Returns:** the vector, shape `(state_size,)`.
        """
        words = jr.bits(jr.key(0) if key is None else key, (2,), jnp.uint32)
        return self._ravel(state, words, False)

    def _ravel(self, state: Any, words: Any, done: Any) -> State:
        leaves, structure = jax.tree.flatten(state)
        shapes = tuple(jnp.shape(leaf) for leaf in leaves)
        expected = self.layout.shapes[: self.structure.num_leaves]
        if (structure, shapes) != (self.structure, expected):
            raise ValueError(
                f"from_gymnax: a state must be {self.structure} with leaves of shapes "
                f"{expected}, as reset_env returns it, got {structure} with leaves of "
                f"shapes {shapes}."
            )
        return self.layout.ravel([*leaves, *[words] * self.draws, done])

    def unravel(self, x: State) -> Any:
        """The state of the environment that a vector holds.

        **Arguments:** `x`: the vector, shape `(state_size,)`.

        **Returns:** a state of the environment.
        """
        leaves = self.layout.unravel(x)[: self.structure.num_leaves]
        return jax.tree.unflatten(self.structure, leaves)

    def transition(self, x: State, u: Control) -> tuple[State, Scalar]:
        """One step.

        **Arguments:** `x`: state, shape `(state_size,)`. `u`: control, shape
            `(control_size,)`.

        **Returns:** the next state, and the reward, a scalar.
        """
        *leaves, _ = self.layout.unravel(x)
        key, words = jr.key(0), None
        if self.draws:
            key, after = jr.split(jr.wrap_key_data(leaves.pop(), impl="threefry2x32"))
            words = jr.key_data(after)
        state = jax.tree.unflatten(self.structure, leaves)
        action = u.reshape(self.action_shape)
        if self.discrete:
            action = jnp.round(action).astype(int)
        _, state, reward, done, _ = self.env.step_env(key, state, action, self.params)
        x_next = self._ravel(state, words, done).astype(x.dtype)
        return x_next, jnp.reshape(reward, ()).astype(x.dtype)

    def advance(
        self, t: RealScalar, x: State, u: Control, w: Disturbance | None
    ) -> tuple[State, Result]:
        x_next, _ = self.transition(x, u)
        return x_next if w is None else x_next + w, RESULTS.successful


class _MinusReward(AbstractCost):
    dynamics: GymnaxDynamics

    def __call__(self, t: RealScalar, x: State, u: Control) -> Scalar:
        return -self.dynamics.transition(x, u)[1]


class _Start(eqx.Module):
    dynamics: GymnaxDynamics

    def __call__(self, key: PRNGKey) -> State:
        start_key, step_key = jr.split(key)
        _, state = self.dynamics.env.reset_env(start_key, self.dynamics.params)
        return self.dynamics.ravel(state, step_key)


class _Observation(eqx.Module):
    """The observation of the environment as a vector."""

    dynamics: GymnaxDynamics

    def __call__(self, x: State) -> Array:
        state, params = self.dynamics.unravel(x), self.dynamics.params
        known = dict(key=jr.key(0), state=state, action=None, params=params)
        function: Any = _observer(self.dynamics.env)
        takes = inspect.signature(function).parameters
        parts = function(**{name: known[name] for name in known if name in takes})
        leaves = [jnp.ravel(leaf).astype(x.dtype) for leaf in jax.tree.leaves(parts)]
        return jnp.concatenate(leaves)


def _observer(env: Any) -> Callable | None:
    return getattr(env, "observe", None) or getattr(env, "get_obs", None)


def _is_done(t: RealScalar, x: State) -> Array:
    return x[-1] > 0.5


def from_gymnax(
    env: Any, params: Any = None, *, dt: Any = 1.0, **environment: Any
) -> Environment:
    """Convert an environment in gymnax's protocol to a [`delucax.Environment`][].

    `env` may be any object with `reset_env`, `step_env`, `action_space`, and `observe`
    or `get_obs`, if these methods run under `jax.jit`. The environments of gymnax have
    these methods, both before and after version 1.0.

    Controllers observe the whole state as a vector, as in
    [`delucax.interop.gymnax.GymnaxDynamics`][]. The names of the entries of this vector
    come from the leaves of the state. The `encode` of the result computes, from this
    vector, the observation that `env` would return. The cost is minus the reward, and a
    step that returns `done` terminates the episode. A discrete action space becomes the
    table `actions` of the result. A control between two actions of the table is
    rounded.

    If `step_env` uses its random key, the state holds this key too. At the start of an
    episode, the key is drawn from the key of the rollout.

    The reward may depend on the next state, so `step_env` is evaluated twice: for the
    dynamics and for the cost. Both the dynamics and the cost hold a copy of `params`.
    To change the parameters, or to differentiate with respect to them, convert the
    environment again.

    Gradients pass through a step if `step_env` does not stop them with
    `jax.lax.stop_gradient`. Environments of gymnax stop gradients. In gymnax 1.0, some
    environments have a method `with_transition_gradients`, which `from_gymnax` uses if
    it exists.

    **Arguments:**

    - `env`: the environment.
    - `params`: the parameters of the environment; `env.default_params` by default.
    - `dt`: the duration of a step, 1 by default. Gymnax's protocol does not define the
        duration of a step.
    - `**environment`: other arguments of [`delucax.Environment`][], such as `encode`,
        or `horizon`, which is `params.max_steps_in_episode` by default.

    **Returns:** a [`delucax.Environment`][].

    **Raises:** `ValueError` if the environment does not implement the protocol, if its
    action space is neither a box nor discrete, if the state changes its shape in a
    step, or if the environment has no horizon or no observation.

    !!! example

        ```python
        import delucax as dlx
        import jax
        from delucax.interop.gymnax import from_gymnax, to_gymnax

        theirs = to_gymnax(dlx.make("pendulum"))  # or gymnax.make("Pendulum-v1")[0]
        env = from_gymnax(theirs, dt=0.05)
        controller = dlx.controllers.Zero(env.control_size)
        dlx.rollout(env, controller, key=jax.random.key(0)).total_cost
        ```

        ```text
        Array(1652., dtype=float32)
        ```
    """
    where = "from_gymnax"
    if params is None:
        params = getattr(env, "default_params", None)
    _check_protocol(env, where)
    check_keywords(environment, where, Environment)
    horizon = getattr(params, "max_steps_in_episode", None)
    unknown = horizon is None or isinstance(horizon, Tracer)
    if unknown and "horizon" not in environment:
        raise ValueError(
            f"{where}: horizon must be given, because params has no "
            "max_steps_in_episode, or it is traced."
        )
    if "encode" not in environment and _observer(env) is None:
        raise ValueError(
            f"{where}: encode must be given, because {type(env).__name__} has neither "
            "observe nor get_obs."
        )
    dynamics = GymnaxDynamics(env, params, dt)
    space = dynamics.env.action_space(params)
    if dynamics.discrete:
        bounds = (0.0, float(space.n - 1))
        actions = jnp.arange(float(space.n))[:, None]
    else:
        bounds = tuple(
            jnp.broadcast_to(jnp.asarray(end, float), dynamics.action_shape).ravel()
            for end in (space.low, space.high)
        )
        actions = None
    defaults: dict[str, Any] = dict(
        dynamics=dynamics,
        cost=_MinusReward(dynamics),
        initial_state=_Start(dynamics),
        control_bounds=bounds,
        terminated=_is_done,
        actions=actions,
        encode=_Observation(dynamics),
        horizon=horizon,
    )
    return Environment(**{**defaults, **environment})
