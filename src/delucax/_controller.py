"""The protocols of controllers, the counter of incidents, and how to call both."""

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
from ._module import check_parameters, parts_of
from ._typing import PRNGKey, RealScalar


class AbstractController(eqx.Module):
    """A feedback law with a state of its own.

    [`delucax.rollout`][] makes the calls, in this order at each step: `__call__` acts
    on the observation; the environment saturates and steps; `applied` gets the control
    that was really applied, and its cost. Trained weights are fields; what is learned
    or remembered along the way lives in the state, a pytree of arrays.

    A controller that draws at each step keeps a random key in its state: `init` puts
    it there, and each call splits it. A wrapper gives each part a key of its own.

    !!! example

        ```python
        import delucax as dlx
        from jaxtyping import Array

        class Damper(dlx.AbstractController):
            gain: Array = dlx.weight(1.0)

            def __call__(self, t, y, state):
                return -self.gain * y[1:], state

        import jax
        env = dlx.make("pendulum")
        dlx.rollout(env, Damper(), key=jax.random.key(0), x0=[0.1, 0.0]).total_cost
        ```

    !!! example "One that draws"

        ```python
        import delucax as dlx
        import jax

        class Dither(dlx.AbstractController):
            def init(self, *, key=None):
                return key

            def __call__(self, t, y, state):
                state, now = jax.random.split(state)
                return jax.random.normal(now, (1,), y.dtype), state

        env = dlx.make("pendulum")
        dlx.rollout(env, Dither(), key=jax.random.key(0), x0=[0.1, 0.0]).total_cost
        ```
    """

    def __check_init__(self):
        check_parameters(self)

    def init(self, *, key: PRNGKey | None = None) -> PyTree:
        """The state at the start of an episode; none by default.

        **Arguments:** `key`: a random key, for controllers that draw.

        **Returns:** a pytree of arrays.
        """
        del key
        return None

    @abc.abstractmethod
    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        """The control for an observation.

        **Arguments:**

        - `t`: time, a scalar.
        - `y`: observation, a vector.
        - `state`: the controller's state.

        **Returns:** `(u, state)`, `u` a vector of the control's size.
        """

    def applied(self, u: Array, cost: Array, state: PyTree) -> PyTree:
        """The state after the step, given the saturated control and its cost; by
        default the state as it is.

        **Arguments:**

        - `u`: the control that was applied.
        - `cost`: its stage cost.
        - `state`: the controller's state.

        **Returns:** the new state.
        """
        del u, cost
        return state

    @property
    def learns_from_cost(self) -> bool:
        """Whether `applied` learns from the cost, which [`delucax.simulate`][] does not
        know; by default whether a controller among its fields does."""
        return any(p.learns_from_cost for p in parts_of(self, AbstractController))


class AbstractLearner(AbstractController):
    """A controller that learns online from a counterfactual loss.

    `loss` and `fresh` are for meta-controllers such as
    [`delucax.controllers.Adaptive`][]; [`delucax.rollout`][] does not call them.

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
    """

    @abc.abstractmethod
    def loss(self, t: RealScalar, state: PyTree) -> Array:
        """The counterfactual loss of the policy held in `state`.

        **Arguments:** `t`: time. `state`: the learner's state.

        **Returns:** a scalar.
        """

    @abc.abstractmethod
    def fresh(self, state: PyTree, key: PRNGKey | None) -> PyTree:
        """A state that shares what `state` has observed, but has learned nothing.

        **Arguments:** `state`: the learner's state. `key`: a random key, or `None`.

        **Returns:** the new state.
        """


class AbstractStochasticPolicy(AbstractController):
    """A stochastic policy whose log-probability can be computed.

    [`delucax.training.PPO`][], [`delucax.training.LikelihoodRatio`][] and
    [`delucax.training.scored_cost`][] train such controllers.

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
    """

    @abc.abstractmethod
    def log_prob(self, t: RealScalar, y: Array, state: PyTree, u: Array) -> Array:
        """The log-probability with which `__call__(t, y, state)` gives `u`.

        **Arguments:**

        - `t`: time, a scalar.
        - `y`: observation, a vector.
        - `state`: the controller's state, before the call.
        - `u`: a control, shape `(m,)`.

        **Returns:** a scalar.
        """

    def entropy(self, t: RealScalar, y: Array, state: PyTree) -> Array | None:
        """The entropy of the draw.

        **Arguments:**

        - `t`: time, a scalar.
        - `y`: observation, a vector.
        - `state`: the controller's state, before the call.

        **Returns:** a scalar; or `None` (the default) where there is no closed form.
        Callers then take `-log_prob` of the control that was drawn.
        """
        del t, y, state
        return None

    @property
    def has_memory(self) -> bool:
        """Whether the distribution depends on `state`; true by default."""
        return True


class Tally(eqx.Module):
    """How often something went wrong in a controller, kept in the controller's state.

    [`delucax.rollout`][] reads every tally in the state, however deep, after each step:
    the steps at which one rose are in `trajectory.incidents`. Wrappers need not forward
    them.

    **Attributes:**

    - `name`: what is counted, in the singular, such as `"failed_plan"`.
    - `count`: a whole number, 0 at first.

    **Raises:** `ValueError` for the name `"clipped_control"`, which a rollout counts
    itself.

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
        """The tally, one higher if something happened.

        **Arguments:** `happened`: a boolean.

        **Returns:** the new tally.
        """
        return eqx.tree_at(lambda tally: tally.count, self, self.count + happened)


def initial_state(controller: AbstractController, key: PRNGKey | None) -> PyTree:
    """The state that a controller begins with; arrays of NumPy become JAX's."""

    def as_array(leaf):
        return jnp.asarray(leaf) if isinstance(leaf, np.ndarray | np.generic) else leaf

    return jax.tree.map(as_array, controller.init(key=key))


def replay(
    controller: AbstractController,
    state: PyTree,
    record: tuple[Array, ...],
    act: Callable[..., tuple[PyTree, PyTree]],
) -> PyTree:
    """The measurements of `act` at each step of a recorded run.

    `measured, state = act(t, y, state, u, ...)` calls the controller, from `state` on
    and along `record`: the times, observations, applied controls and costs, and what
    else `act` takes. Then its `applied` is called with the control and the cost.
    """
    state, static = eqx.partition(state, eqx.is_array)

    def step(arrays, inputs):
        t, y, u, cost, *rest = inputs
        measured, after = act(t, y, eqx.combine(arrays, static), u, *rest)
        after = controller.applied(u, cost, after)
        return eqx.filter(after, eqx.is_array), measured

    return lax.scan(step, state, record)[1]


def tallies(state: PyTree) -> dict[str, Array]:
    """The sum of the tallies of each name in a controller's state."""
    counts: dict[str, Any] = {}
    for tally in parts_of([state], Tally):
        counts[tally.name] = counts.get(tally.name, 0) + jnp.sum(tally.count)
    return counts


def wrong_observation(controller: Any, expected: int, y: Array) -> ValueError:
    """The error for an observation of the wrong size."""
    return ValueError(
        f"{type(controller).__name__}: expects an observation of size {expected}, got "
        f"size {y.shape[0] if y.ndim else 0}. If it was made for the encoded "
        "observation, give it features=env.encode."
    )


def check_stochastic(policy: Any, name: str, where: str) -> AbstractStochasticPolicy:
    """`policy`, if it knows the probability of what it draws, or an error."""
    if isinstance(policy, AbstractStochasticPolicy):
        return policy
    raise ValueError(
        f"{where}: the {name} must draw its controls and have "
        "log_prob(t, y, state, u), as a delucax.AbstractStochasticPolicy, got "
        f"{type(policy).__name__}."
    )


def check_controller(value: Any, name: str, where: str) -> None:
    """Raise unless `value` is a controller."""
    check_instance(value, AbstractController, name, where)
