"""A policy and an estimate of its cost to go."""

from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array

from .._check import check_choice, check_instance, check_key
from .._controller import AbstractController, check_controller
from .._module import parameter
from .._typing import PRNGKey, RealScalar
from ..controllers import Categorical, MLP, mlp_policy, Standardise
from ..environments import Environment


class ActorCritic(eqx.Module):
    """A policy with an estimate of its discounted cost to go,

    `V(t, y) = shift + scale * critic(t, y)`.

    **Arguments:**

    - `policy`: a controller; for [`delucax.training.PPO`][] one that draws, as
        [`delucax.controllers.Gaussian`][] and [`delucax.controllers.Categorical`][] do.
    - `critic`: a controller without a memory whose one output is the estimate, such as
        a [`delucax.controllers.MLP`][].
    - `shift`, `scale`: 0 and 1 by default; training sets them, so that the network's
        own output has mean 0 and standard deviation 1.

    **Raises:** `ValueError` if one is not a controller, or the critic has a memory.

    !!! example

        ```python
        import delucax as dlx
        import jax

        env = dlx.make("pendulum")
        policy_key, critic_key = jax.random.split(jax.random.key(0))
        policy = dlx.controllers.mlp_policy(env, head="gaussian", key=policy_key)
        critic = dlx.controllers.MLP(3, 1, features=env.encode, key=critic_key)
        model = dlx.training.ActorCritic(policy, critic)
        model.value(0.0, env.reset(critic_key))
        ```
    """

    policy: AbstractController
    critic: AbstractController
    shift: Array = parameter(0.0)
    scale: Array = parameter(1.0)

    def __check_init__(self):
        for name in ("policy", "critic"):
            check_controller(getattr(self, name), name, "ActorCritic")
        if jax.tree.leaves(self.critic.init()):
            raise ValueError(
                "ActorCritic: critic must have no memory, got "
                f"{type(self.critic).__name__}."
            )

    def value(self, t: RealScalar, y: Array) -> Array:
        """The estimated cost to go.

        **Arguments:** `t`: time. `y`: an observation, a vector.

        **Returns:** a scalar.
        """
        return self.shift + self.scale * self.raw(t, y)

    def raw(self, t: RealScalar, y: Array) -> Array:
        """The output of the critic, before shift and scale.

        **Arguments:** `t`: time. `y`: an observation, a vector.

        **Returns:** a scalar.
        """
        output, _ = self.critic(t, y, None)
        if output.shape != (1,):
            raise ValueError(
                f"ActorCritic: critic must give one output, got shape {output.shape}."
            )
        return output[0]


def actor_critic(
    environment: Environment,
    width: int = 64,
    depth: int = 2,
    *,
    head: Literal["deterministic", "gaussian", "categorical"] = "gaussian",
    actions: Any = None,
    key: PRNGKey,
) -> ActorCritic:
    """Two fully connected networks made to fit an environment: policy and critic.

    Both are given `environment.encode(y)`, standardised by what training sees. The last
    layers begin a hundred times smaller than usual: that of the policy near the middle
    of the bounds, and that of the critic flat, because the slope of an
    estimate that has learned nothing would lead a policy that follows it astray.

    **Arguments:**

    - `environment`: the environment.
    - `width`: units in a hidden layer, 64 by default.
    - `depth`: hidden layers, 2 by default.
    - `head`: `"gaussian"` (default), `"deterministic"` (for
        [`delucax.training.SHAC`][]), or `"categorical"`.
    - `actions`: the table of a categorical head, shape `(actions, m)`; that of the
        environment by default.
    - `key`: a random key, for the first weights.

    **Returns:** a [`delucax.training.ActorCritic`][].

    **Raises:** `ValueError` if `environment` is not an environment, `head` is unknown,
    a size is below 1, there is no key, or a categorical head has no table.

    Source: Andrychowicz et al., 2021 (the small last layer of the policy).

    !!! example

        ```python
        import delucax as dlx
        import jax

        env = dlx.make("pendulum")
        model = dlx.training.actor_critic(env, width=8, depth=1, key=jax.random.key(0))
        dlx.rollout(env, model.policy, key=jax.random.key(1), horizon=10).total_cost
        ```
    """
    where = "actor_critic"
    check_instance(environment, Environment, "environment", where)
    check_choice(head, ("deterministic", "gaussian", "categorical"), "head", where)
    policy_key, critic_key = jr.split(check_key(key, where))
    size = environment.feature_size
    features = Standardise(jnp.zeros(size), features=environment.encode)
    sizes: Any = dict(width=width, depth=depth)
    network_of = lambda policy: policy if head == "deterministic" else policy.base
    if head == "categorical":
        table = environment.actions if actions is None else actions
        if table is None:
            raise ValueError(
                f"{where}: a categorical head must have a table of actions, got none."
            )
        base = MLP(size, len(table), **sizes, features=features, key=policy_key)
        policy: Any = Categorical(base, table)
    else:
        policy = mlp_policy(environment, **sizes, head=head, key=policy_key)
        policy = eqx.tree_at(lambda p: network_of(p).features, policy, features)
    critic = MLP(size, 1, **sizes, features=features, key=critic_key)

    def last_layers(both):
        networks = network_of(both[0]).network, both[1].network
        return [network.layers[-1].weight for network in networks]

    smaller = lambda weight: 0.01 * weight
    return ActorCritic(*eqx.tree_at(last_layers, (policy, critic), replace_fn=smaller))
