"""The base classes of controllers, a counter of incidents, and helpers."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from ._check import check_instance
from ._message import shortened
from ._module import check_parameters, parts_of, shown
from ._typing import PRNGKey, RealScalar


class AbstractController(eqx.Module):
    r"""A controller: a feedback law with a state.

    $$(u_k, s_{k+1}) = \pi(t_k, y_k, s_k)$$

    Subclass it and write `__call__`. Trained weights are fields. Everything that the
    controller learns or remembers during an episode is in its state $s$, a pytree of
    arrays. `init` returns the state at the start of an episode.

    At each step, [`delucax.rollout`][] first calls `__call__` with the observation.
    Then the environment clips the control and takes a step. Finally
    [`delucax.rollout`][] calls `applied` with the clipped control and the cost of this
    control.

    A controller that draws random numbers at each step keeps a random key in its state.
    `init` stores the key in the state, and each call splits the key. A controller that
    wraps other controllers gives each of them its own key.

    **Raises:** `ValueError` at construction if a [`delucax.parameter`][] or
    [`delucax.weight`][] is not finite or violates its constraint.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp
        from jaxtyping import Array

        class Damper(dlx.AbstractController):
            gain: Array = dlx.weight(1.0)

            def __call__(self, t, y, state):
                return -self.gain * y[1:], state

        Damper()(0.0, jnp.array([0.1, 2.0]), None)
        ```

        ```text
        (Array([-2.], dtype=float32), None)
        ```

    !!! example "A controller that draws random numbers"

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        class Dither(dlx.AbstractController):
            def init(self, *, key=None):
                return key

            def __call__(self, t, y, state):
                state, now = jax.random.split(state)
                return jax.random.normal(now, (1,), y.dtype), state

        state = Dither().init(key=jax.random.key(0))
        u, state = Dither()(0.0, jnp.zeros(2), state)
        u.shape
        ```

        ```text
        (1,)
        ```
    """

    __repr__ = shown

    def __check_init__(self):
        check_parameters(self)

    def init(self, *, key: PRNGKey | None = None) -> PyTree:
        """The state at the start of an episode; `None` by default.

        **Arguments:** `key`: a random key for controllers that draw random numbers, or
            `None`.

        **Returns:** a pytree of arrays.
        """
        del key
        return None

    @abc.abstractmethod
    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        """The control for an observation.

        **Arguments:**

        - `t`: time, a scalar.
        - `y`: observation, shape `(p,)`.
        - `state`: the controller's state.

        **Returns:** `(u, state)`: the control, shape `(m,)`, and the new state.
        """

    def applied(self, u: Array, cost: Array, state: PyTree) -> PyTree:
        """The state after a step, given the control that was applied and its cost.

        By default the state does not change.

        **Arguments:**

        - `u`: the control after clipping, shape `(m,)`.
        - `cost`: its stage cost, a scalar.
        - `state`: the controller's state.

        **Returns:** the new state.
        """
        del u, cost
        return state

    @property
    def learns_from_cost(self) -> bool:
        """Whether `applied` learns from the cost.

        By default, a controller learns from the cost if one of the controllers in its
        fields does. [`delucax.simulate`][] has no cost, so it raises an error for a
        controller that learns from the cost.
        """
        return any(p.learns_from_cost for p in parts_of(self, AbstractController))


class AbstractLearner(AbstractController):
    """A controller that learns online, with a counterfactual loss of its policy.

    The counterfactual loss is the cost that the past steps would have had if the
    current policy had already acted in them. Meta-controllers such as
    [`delucax.controllers.Adaptive`][] call `loss` and `fresh`. [`delucax.rollout`][]
    does not.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        class ScaledGuess(dlx.AbstractLearner):
            def init(self, *, key=None):
                return jnp.zeros(())

            def __call__(self, t, y, state):
                return -state * y[:1], state

            def loss(self, t, state):
                return state**2

            def fresh(self, state, key):
                return jnp.zeros(())

        ScaledGuess().loss(0.0, jnp.ones(()))
        ```

        ```text
        Array(1., dtype=float32)
        ```
    """

    @abc.abstractmethod
    def loss(self, t: RealScalar, state: PyTree) -> Array:
        """The counterfactual loss of the policy in `state`.

        **Arguments:** `t`: time, a scalar. `state`: the learner's state.

        **Returns:** a scalar.
        """

    @abc.abstractmethod
    def fresh(self, state: PyTree, key: PRNGKey | None) -> PyTree:
        """A state with the observations of `state`, but without anything learned.

        **Arguments:** `state`: the learner's state. `key`: a random key, or `None`.

        **Returns:** the new state.
        """


class AbstractStochasticPolicy(AbstractController):
    """A stochastic policy that can compute the log-probability of its controls.

    [`delucax.training.PPO`][], [`delucax.training.LikelihoodRatio`][] and
    [`delucax.training.scored_cost`][] train stochastic policies.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp
        from jaxtyping import Array

        class Coin(dlx.AbstractStochasticPolicy):
            logit: Array = dlx.weight(0.0)

            def init(self, *, key=None):
                return key

            def __call__(self, t, y, key):
                key, now = jax.random.split(key)
                heads = jax.random.bernoulli(now, jax.nn.sigmoid(self.logit))
                return jnp.where(heads, jnp.ones(1), -jnp.ones(1)), key

            def log_prob(self, t, y, key, u):
                return jax.nn.log_sigmoid(self.logit * u[0])

        Coin().log_prob(0.0, jnp.zeros(2), None, jnp.ones(1))
        ```

        ```text
        Array(-0.693, dtype=float32)
        ```
    """

    @abc.abstractmethod
    def log_prob(self, t: RealScalar, y: Array, state: PyTree, u: Array) -> Array:
        """The log-probability (density) with which `__call__(t, y, state)` returns `u`.

        **Arguments:**

        - `t`: time, a scalar.
        - `y`: observation, shape `(p,)`.
        - `state`: the controller's state, before the call.
        - `u`: a control, shape `(m,)`.

        **Returns:** a scalar.
        """

    def entropy(self, t: RealScalar, y: Array, state: PyTree) -> Array | None:
        """The entropy of the control's distribution.

        **Arguments:**

        - `t`: time, a scalar.
        - `y`: observation, shape `(p,)`.
        - `state`: the controller's state, before the call.

        **Returns:** a scalar, or `None` (the default) if the entropy has no closed
        form. If it is `None`, callers estimate the entropy by `-log_prob` of the drawn
        control.
        """
        del t, y, state
        return None

    @property
    def has_memory(self) -> bool:
        """Whether the distribution depends on `state`; true by default."""
        return True


class Tally(eqx.Module):
    """A counter of incidents in a controller, such as failed plans.

    Keep it in the controller's state. After each step, [`delucax.rollout`][] finds all
    tallies in the state of the controller, so a controller that wraps another one need
    not pass them on. `trajectory.incidents` records at which steps the count of a tally
    increased.

    **Arguments:**

    - `name`: the name of the incident that is counted, in the singular, for example
      `"failed_plan"`.

    **Attributes:**

    - `count`: an integer scalar, 0 at first.

    **Raises:** `ValueError` for the name `"clipped_control"`, because a rollout counts
    clipped controls itself.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        class Cautious(dlx.AbstractController):
            def init(self, *, key=None):
                return dlx.controllers.Tally("large_angle")

            def __call__(self, t, y, tally):
                return -y[1:], tally.add(jnp.abs(y[0]) > 0.5)

        env = dlx.make("pendulum")
        trajectory = dlx.rollout(env, Cautious(), key=jax.random.key(0), x0=[0.1, 0.0])
        trajectory.incident_counts
        ```

        ```text
        {'clipped_control': Array(23, dtype=int32),
         'large_angle': Array(185, dtype=int32)}
        ```
    """

    name: str = eqx.field(static=True)
    count: Array

    def __init__(self, name: str):
        if name == "clipped_control":
            raise ValueError(
                "Tally: name must not be 'clipped_control', which a rollout counts "
                "itself."
            )
        self.name, self.count = name, jnp.zeros((), jnp.int32)

    def __repr__(self):
        return f"Tally({self.name!r}, count={shortened(self.count)})"

    def add(self, happened: Array) -> "Tally":
        """The tally, one higher if an incident happened.

        **Arguments:** `happened`: a boolean scalar.

        **Returns:** the new tally.
        """
        return eqx.tree_at(lambda tally: tally.count, self, self.count + happened)


def initial_state(controller: AbstractController, key: PRNGKey | None) -> PyTree:
    """The first state of a controller, with JAX arrays in place of NumPy arrays."""

    def as_array(leaf):
        return jnp.asarray(leaf) if isinstance(leaf, np.ndarray | np.generic) else leaf

    return jax.tree.map(as_array, controller.init(key=key))


def replay(
    controller: AbstractController,
    state: PyTree,
    record: tuple[Array, ...],
    act: Callable[..., tuple[PyTree, PyTree]],
) -> PyTree:
    """Run a controller along a record, and measure something at each step.

    `record` holds times, observations, applied controls and costs, and more arguments
    of `act`. At each step, `measured, state = act(t, y, state, u, ...)` calls the
    controller, starting from `state`; then `applied` gets the control and the cost.

    **Returns:** what `act` measured at each step.
    """
    state, static = eqx.partition(state, eqx.is_array)

    def step(arrays, inputs):
        t, y, u, cost, *rest = inputs
        measured, after = act(t, y, eqx.combine(arrays, static), u, *rest)
        after = controller.applied(u, cost, after)
        return eqx.filter(after, eqx.is_array), measured

    return lax.scan(step, state, record)[1]


def tallies(state: PyTree) -> dict[str, Array]:
    """The counts in a controller's state, by name. Tallies of one name are summed."""
    counts: dict[str, Any] = {}
    for tally in parts_of([state], Tally):
        counts[tally.name] = counts.get(tally.name, 0) + jnp.sum(tally.count)
    return counts


def wrong_observation(controller: Any, expected: int, y: Array) -> ValueError:
    """The error for an observation of the wrong size."""
    return ValueError(
        f"{type(controller).__name__}: the observation must have size {expected}, got "
        f"size {y.shape[0] if y.ndim else 0}. If the controller was made for encoded "
        "observations, pass features=env.encode when you make it."
    )


def check_stochastic(policy: Any, name: str, where: str) -> AbstractStochasticPolicy:
    """`policy`, or an error unless it is an `AbstractStochasticPolicy`."""
    if isinstance(policy, AbstractStochasticPolicy):
        return policy
    raise ValueError(
        f"{where}: the {name} must be a delucax.AbstractStochasticPolicy, which has "
        f"log_prob(t, y, state, u), got {type(policy).__name__}."
    )


def check_controller(value: Any, name: str, where: str) -> None:
    """Raise unless `value` is a controller."""
    check_instance(value, AbstractController, name, where)
