"""A policy with a critic, and the base class of the losses that train it."""

from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, Bool, Float

from .._check import (
    check_bool,
    check_choice,
    check_count,
    check_instance,
    check_key,
    check_range,
)
from .._controller import AbstractController, check_controller
from .._module import parameter, parts_of, shown
from .._typing import PRNGKey, RealScalar
from ..controllers import Categorical, MLP, mlp_policy, Standardise
from ..environments import Environment
from ..simulation import rollout
from ._costs import nan_if_failed
from ._steps import AbstractSurrogate


class ActorCritic(eqx.Module):
    r"""A policy, and a critic that estimates the discounted cost to go of the policy.

    $$V(t, y) = a + b\, c(t, y)$$

    Here $c$ is the output of the critic. [`delucax.training.PPO`][] and
    [`delucax.training.SHAC`][] train an `ActorCritic`.

    **Arguments:**

    - `policy`: a controller. For PPO the policy must draw its controls at random, as
        [`delucax.controllers.Gaussian`][] and [`delucax.controllers.Categorical`][] do.
    - `critic`: a controller without a memory and with one output, such as a
        [`delucax.controllers.MLP`][].
    - `shift`, `scale`: $a$ and $b$, 0 and 1 by default. Training sets `shift` and
        `scale` such that the targets for the output $c$ have mean 0 and standard
        deviation 1.

    **Raises:** `ValueError` if `policy` or `critic` is not a controller, or the critic
    has a memory. `value` and `raw` raise a `ValueError` if the critic does not have
    exactly one output.

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

        ```text
        Array(0.1865, dtype=float32)
        ```
    """

    policy: AbstractController
    critic: AbstractController
    shift: Array = parameter(0.0)
    scale: Array = parameter(1.0)

    __repr__ = shown

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

        **Arguments:** `t`: time, a scalar. `y`: an observation, shape `(p,)`.

        **Returns:** a scalar.
        """
        return self.shift + self.scale * self.raw(t, y)

    def raw(self, t: RealScalar, y: Array) -> Array:
        """The output of the critic, before shift and scale.

        **Arguments:** `t`: time, a scalar. `y`: an observation, shape `(p,)`.

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
    """A policy and a critic for an environment: two fully connected networks.

    The input of both networks is `environment.encode(y)`, standardised with the
    statistics that training collects. The last layers of both networks start with
    weights a hundred times smaller than usual. Therefore the controls of an untrained
    policy are near the middle of their bounds. An untrained critic is kept nearly
    constant, because its gradient would mislead the policy.

    **Arguments:**

    - `environment`: the environment.
    - `width`: units in a hidden layer, 64 by default.
    - `depth`: hidden layers, 2 by default.
    - `head`: the kind of policy: `"gaussian"` (default), `"deterministic"` (for
        [`delucax.training.SHAC`][]), or `"categorical"`.
    - `actions`: the table of actions of a categorical head, shape `(actions, m)`; the
        `actions` of the environment by default.
    - `key`: a random key, for the initial weights.

    **Returns:** a [`delucax.training.ActorCritic`][].

    **Raises:** `ValueError` if `environment` is not an environment, `head` is unknown,
    a size is below 1, there is no key, or a categorical head has no table of actions.

    Source: Andrychowicz et al., 2021 (the small last layer of the policy).

    !!! example

        ```python
        import delucax as dlx
        import jax

        env = dlx.make("pendulum")
        model = dlx.training.actor_critic(env, width=8, depth=1, key=jax.random.key(0))
        dlx.rollout(
            env, model.policy, key=jax.random.key(1), horizon=10, x0=[0.1, 0.0]
        ).total_cost
        ```

        ```text
        Array(0.6999, dtype=float32)
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
                f"{where}: a categorical head must have a table of actions, got none. "
                "Pass actions, or give the environment a table."
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


class Episodes(NamedTuple):
    """A batch of episodes. A field that a loss does not use is `None`."""

    times: Float[Array, "*batch steps"]
    observations: Float[Array, "*batch steps p"]
    controls: Float[Array, "*batch steps m"]
    costs: Float[Array, "*batch steps"]
    valid: Bool[Array, "*batch steps"]
    """True for the steps before the end of the episode."""
    continues: Any
    """False for the last step of an episode."""
    following: Any
    """The cost to go after each step, estimated or, at the end, the final cost."""
    advantages: Float[Array, "*batch steps"]
    total_cost: Any
    targets: Float[Array, "*batch steps"]
    """The regression targets of the critic."""
    log_prob: Any = None


class AbstractActorCriticLoss(AbstractSurrogate):
    """A loss of a [`delucax.training.ActorCritic`][], from episodes of its policy."""

    environment: eqx.AbstractVar[Environment]
    batch: eqx.AbstractVar[int]
    horizon: eqx.AbstractVar[int]
    discount: eqx.AbstractVar[RealScalar]
    decay: eqx.AbstractVar[RealScalar]
    value_weight: eqx.AbstractVar[RealScalar]
    bootstrap: eqx.AbstractVar[bool]

    def __post_init__(self):
        if self.horizon is None and isinstance(self.environment, Environment):
            self.horizon = self.environment.horizon  # pyright: ignore

    def __check_init__(self):
        where = type(self).__name__
        check_instance(self.environment, Environment, "environment", where)
        for name in ("batch", "horizon"):
            check_count(getattr(self, name), name, where)
        for name in ("discount", "decay"):
            check_range(getattr(self, name), name, where, 0, 1)
        check_range(self.value_weight, "value_weight", where)
        check_bool(self.bootstrap, "bootstrap", where)

    def finished(self, model: ActorCritic, memory: Any) -> ActorCritic:
        return memory.statistics.applied_to(model)

    def _episodes(
        self, model: ActorCritic, key: PRNGKey, truncate: int | None = None
    ) -> Episodes:
        """A batch of episodes from newly drawn initial states.

        Backpropagation through time is cut every `truncate` steps.
        """
        one = lambda key: self._episode(model, key, truncate)
        return jax.vmap(one)(jr.split(key, self.batch))

    def _value_errors(
        self, model: ActorCritic, runs: Episodes
    ) -> Float[Array, "*batch steps"]:
        """The errors of the critic's own output, before shift and scale."""
        # Before the scale, so that the learning rate does not depend on the scale of
        # the cost.
        raw = jax.vmap(jax.vmap(model.raw))(runs.times, runs.observations)
        return raw - (runs.targets - model.shift) / model.scale

    def _episode(self, model, key, truncate) -> Episodes:
        env, horizon = self.environment, self.horizon
        keep = ("states", "observations", "controls", "costs", "terminated")
        options: Any = dict(horizon=horizon, truncate=truncate, keep=keep, throw=False)
        run: Any = rollout(env, model.policy, key=key, **options)
        costs = nan_if_failed(run, run.costs)
        # A truncated rollout records observations without derivatives at the cuts, and
        # that is where V is evaluated. So we observe the states again, and add the same
        # noise.
        observed = jax.vmap(env.dynamics.observe)(run.times, run.states)
        noise = lax.stop_gradient(run.observations - observed[:-1])
        observed = observed + jnp.concatenate([noise, jnp.zeros_like(noise[:1])])
        values = jax.vmap(model.value)(run.times, observed)
        following, values = values[1:], values[:-1]
        # After termination only the final cost follows. After truncation V estimates
        # the rest.
        if not self.bootstrap:
            following = following.at[-1].set(run.final_cost)
        following = jnp.where(run.terminated, run.final_cost, following)
        steps = jnp.arange(horizon)
        continues = ~run.terminated & (self.bootstrap | (steps < horizon - 1))
        valid = steps < run.length
        # Generalised advantage estimation (Schulman et al., 2016) with costs:
        # A_k = delta_k + discount decay A_{k+1}, where delta_k is the
        # temporal-difference error c_k + discount V_{k+1} - V_k.
        errors = costs + self.discount * following - values
        errors = jnp.where(valid, errors, 0)

        def backward(later, inputs):
            error, continues = inputs
            now = error + self.discount * self.decay * jnp.where(continues, later, 0)
            return now, now

        zero = jnp.zeros((), errors.dtype)
        _, advantages = lax.scan(backward, zero, (errors, continues), reverse=True)
        record = run.times[:-1], run.observations, run.controls, costs
        record = *record, valid, continues, following
        # A + V is the return of TD(lambda), the regression target of the critic.
        return Episodes(*record, advantages, run.total_cost, advantages + values)


class Moments(NamedTuple):
    """The running mean and sum of squares of vectors."""

    count: Array
    mean: Array
    squares: Array

    @staticmethod
    def empty(like: Array) -> "Moments":
        """The moments of no vectors."""
        zero = jnp.zeros_like(like)
        return Moments(jnp.zeros((), like.dtype), zero, zero)

    def joined(self, values: Array, valid: Array) -> "Moments":
        """The moments after more vectors: the rows of `values` that are `valid`."""
        known = valid.reshape(-1, *(1,) * (values.ndim - 1))
        n = jnp.sum(valid).astype(self.count.dtype)
        mean = jnp.sum(jnp.where(known, values, 0), 0) / jnp.maximum(n, 1)
        squares = jnp.sum(jnp.where(known, (values - mean) ** 2, 0), 0)
        total = jnp.maximum(self.count + n, 1)
        # The update of Chan, Golub and LeVeque, 1983. It never subtracts two large sums
        # of squares.
        gap = mean - self.mean
        return Moments(
            self.count + n,
            self.mean + gap * n / total,
            self.squares + squares + gap**2 * self.count * n / total,
        )

    @property
    def std(self) -> Array:
        """The standard deviations, 1 for an entry that is nearly constant."""
        variance = self.squares / jnp.maximum(self.count, 1)
        # A deviation of the size of rounding would only amplify rounding.
        rounding = 16 * jnp.finfo(variance.dtype).eps * jnp.abs(self.mean)
        some = variance > rounding**2
        return jnp.where(some, jnp.sqrt(jnp.where(some, variance, 1)), 1)


class Statistics(NamedTuple):
    """The moments of the features of each `Standardise`, and of the V targets."""

    features: list[Moments]
    targets: Moments

    @staticmethod
    def empty(model: ActorCritic, dtype: Any) -> "Statistics":
        """The statistics of no observations."""
        features = [Moments.empty(one.mean) for one in parts_of(model, Standardise)]
        return Statistics(features, Moments.empty(jnp.zeros((), dtype)))

    def updated(self, model: ActorCritic, runs: Episodes) -> "Statistics":
        """The statistics after more episodes."""
        rows = runs.observations.reshape(-1, runs.observations.shape[-1])
        valid, targets = runs.valid.reshape(-1), runs.targets.reshape(-1)
        parts = zip(parts_of(model, Standardise), self.features, strict=True)
        features = [old.joined(jax.vmap(one.of)(rows), valid) for one, old in parts]
        return Statistics(features, self.targets.joined(targets, valid))

    def applied_to(self, model: ActorCritic) -> ActorCritic:
        """The model with these moments in its `Standardise` parts, shift and scale."""

        def places(model):
            each = [(part.mean, part.std) for part in parts_of(model, Standardise)]
            return [
                leaf for pair in (*each, (model.shift, model.scale)) for leaf in pair
            ]

        new = [v for m in (*self.features, self.targets) for v in (m.mean, m.std)]
        new = [n.astype(o.dtype) for n, o in zip(new, places(model), strict=True)]
        return eqx.tree_at(places, model, lax.stop_gradient(new))
