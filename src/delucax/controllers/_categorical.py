"""Controls drawn from a table."""

from typing import Any, NamedTuple

import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, Float, PyTree

from .._check import as_matrix, check_instance, check_key
from .._controller import (
    AbstractController,
    AbstractStochasticPolicy,
    check_controller,
    has_state,
)
from .._module import parameter
from .._typing import PRNGKey, RealScalar


class _State(NamedTuple):
    base: PyTree
    key: PRNGKey


class Categorical(AbstractStochasticPolicy):
    r"""One of several controls, drawn with the probabilities that a base gives,

    `u = actions[i]` with probability `softmax(base(t, y))[i]`.

    The draw has no derivative: it is trained by its log-probability
    ([`delucax.training.LikelihoodRatio`][], [`delucax.training.PPO`][]).

    **Arguments:**

    - `base`: a controller whose outputs are the logits, one an action; such as a
        [`delucax.controllers.MLP`][].
    - `actions`: the table, shape `(actions, m)`, such as `env.actions`.

    **Raises:** `ValueError` if `base` is not a controller or `actions` no matrix; when
    it is run, if there is no key or the base gives another number of logits.

    Source: Williams, 1992.

    !!! example

        ```python
        import delucax as dlx
        import jax

        env = dlx.make("pendulum")
        logits = dlx.controllers.MLP(2, 3, width=8, depth=1, key=jax.random.key(0))
        policy = dlx.controllers.Categorical(logits, [[-2.0], [0.0], [2.0]])
        dlx.rollout(env, policy, key=jax.random.key(1), horizon=10).controls
        ```
    """

    base: AbstractController
    actions: Float[Array, "actions m"] = parameter()

    def __init__(self, base: AbstractController, actions: Any):
        self.base = base
        self.actions = actions

    def __check_init__(self):
        check_controller(self.base, "base", "Categorical")
        as_matrix(self.actions, "actions", "Categorical")

    def init(self, *, key=None):
        key, base_key = jr.split(check_key(key, "Categorical.init"))
        return _State(self.base.init(key=base_key), key)

    def _logits(self, t, y, state):
        logits, base = self.base(t, y, state.base)
        if logits.shape != self.actions.shape[:1]:
            raise ValueError(
                f"Categorical: base must give a logit for each of the "
                f"{self.actions.shape[0]} actions, got shape {logits.shape}."
            )
        return jax.nn.log_softmax(logits), base

    def __call__(self, t, y, state):
        logits, base = self._logits(t, y, state)
        key, now = jr.split(state.key)
        u = self.actions[jr.categorical(now, logits)]
        return u.astype(y.dtype), _State(base, key)

    def applied(self, u, cost, state):
        return state._replace(base=self.base.applied(u, cost, state.base))

    def log_prob(self, t: RealScalar, y: Array, state: PyTree, u: Array) -> Array:
        """The log-probability with which `__call__(t, y, state)` gives `u`.

        **Arguments:**

        - `t`: time, a scalar.
        - `y`: observation, a vector.
        - `state`: the controller's state, before the call.
        - `u`: a control, shape `(m,)`; it counts as the nearest one of the table.

        **Returns:** a scalar.
        """
        logits, _ = self._logits(t, y, state)
        away = jnp.sum((lax.stop_gradient(self.actions) - u) ** 2, axis=1)
        return logits[jnp.argmin(away)]

    @property
    def has_memory(self) -> bool:
        """Whether `base` has a state, on which the logits depend."""
        return has_state(self.base)

    def entropy(self, t: RealScalar, y: Array, state: PyTree) -> Array:
        """The entropy of the draw, `-sum_i p_i log p_i`.

        **Arguments:**

        - `t`: time, a scalar.
        - `y`: observation, a vector.
        - `state`: the controller's state, before the call.

        **Returns:** a scalar.
        """
        logits, _ = self._logits(t, y, state)
        return -jnp.sum(jnp.exp(logits) * logits)


class Likeliest(AbstractController):
    """The control that a [`delucax.controllers.Categorical`][] gives most often.

    **Arguments:** `policy`: the controller that draws.

    **Raises:** `ValueError` if it is not a `Categorical`.

    !!! example

        ```python
        import delucax as dlx
        import jax

        logits = dlx.controllers.MLP(2, 3, width=8, depth=1, key=jax.random.key(0))
        policy = dlx.controllers.Categorical(logits, [[-2.0], [0.0], [2.0]])
        best = dlx.controllers.Likeliest(policy)
        env = dlx.make("pendulum")
        dlx.rollout(env, best, key=jax.random.key(1), horizon=10).controls
        ```
    """

    policy: Categorical

    def __check_init__(self):
        check_instance(self.policy, Categorical, "policy", "Likeliest")

    def init(self, *, key=None):
        return self.policy.base.init(key=key)

    def __call__(self, t, y, state):
        logits, state = self.policy.base(t, y, state)
        return self.policy.actions[jnp.argmax(logits)].astype(y.dtype), state

    def applied(self, u, cost, state):
        return self.policy.base.applied(u, cost, state)
