"""A policy and an estimate of its cost to go, and what they are trained on."""

from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array

from .._check import check_key
from .._controller import AbstractController
from .._module import parameter
from .._typing import PRNGKey, RealScalar
from ..controllers import Categorical, Deep, Gaussian, MLP, Standardise
from ..environments import Environment
from ..simulation import rollout, Trajectory


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
        policy = dlx.controllers.Deep(env, head="gaussian", key=policy_key)
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
            given = getattr(self, name)
            if not isinstance(given, AbstractController):
                raise ValueError(
                    f"ActorCritic: {name} must be an AbstractController, got "
                    f"{type(given).__name__}."
                )
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
        found, _ = self.critic(t, y, None)
        if found.shape != (1,):
            raise ValueError(
                f"ActorCritic: critic must give one output, got shape {found.shape}."
            )
        return found[0]


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
    of the bounds, and that of the critic flat, for the slope of an estimate that has
    seen nothing would lead a policy that follows it astray.

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
    check_environment(environment, where)
    if head not in ("deterministic", "gaussian", "categorical"):
        raise ValueError(
            f"{where}: head must be 'deterministic', 'gaussian' or 'categorical', got "
            f"{head!r}."
        )
    policy_key, critic_key = jr.split(check_key(key, where))
    size = environment.feature_size
    features = Standardise(jnp.zeros(size), features=environment.encode)
    sizes: Any = dict(width=width, depth=depth)
    if head == "categorical":
        table = environment.actions if actions is None else actions
        if table is None:
            raise ValueError(
                f"{where}: a categorical head must have a table of actions, got none."
            )
        base = MLP(size, len(table), **sizes, features=features, key=policy_key)
        policy: Any = Categorical(base, table)
        where_base = lambda policy: policy.base  # noqa: E731
    else:
        policy = Deep(environment, **sizes, head=head, key=policy_key)
        where_base = lambda p: p.base if head == "gaussian" else p  # noqa: E731
        policy = eqx.tree_at(lambda p: where_base(p).features, policy, features)
    critic = MLP(size, 1, **sizes, features=features, key=critic_key)

    def last(both):
        networks = where_base(both[0]).network, both[1].network
        return [network.layers[-1].weight for network in networks]

    smaller = lambda weight: 0.01 * weight  # noqa: E731
    return ActorCritic(*eqx.tree_at(last, (policy, critic), replace_fn=smaller))


class Moments(NamedTuple):
    """The running mean and sum of squares of vectors that were seen."""

    count: Array
    mean: Array
    squares: Array

    @staticmethod
    def none(like: Array) -> "Moments":
        """Of nothing, yet."""
        zero = jnp.zeros_like(like)
        return Moments(jnp.zeros((), like.dtype), zero, zero)

    def joined(self, values: Array, valid: Array) -> "Moments":
        """With more rows, of which some count."""
        known = valid.reshape(-1, *(1,) * (values.ndim - 1))
        n = jnp.sum(valid).astype(self.count.dtype)
        mean = jnp.sum(jnp.where(known, values, 0), 0) / jnp.maximum(n, 1)
        squares = jnp.sum(jnp.where(known, (values - mean) ** 2, 0), 0)
        total = jnp.maximum(self.count + n, 1)
        gap = mean - self.mean
        return Moments(
            self.count + n,
            self.mean + gap * n / total,
            self.squares + squares + gap**2 * self.count * n / total,
        )

    @property
    def std(self) -> Array:
        """The standard deviation, 1 where there is none to speak of."""
        variance = self.squares / jnp.maximum(self.count, 1)
        some = variance > 1e-8
        return jnp.where(some, jnp.sqrt(jnp.where(some, variance, 1)), 1)


class Seen(NamedTuple):
    """What was seen: the moments of each `Standardise` of a model, and of targets."""

    features: list[Moments]
    targets: Moments


def standardisers(model: ActorCritic) -> list[Standardise]:
    """Each `Standardise` in a model, in the order of its leaves."""
    is_one = lambda node: isinstance(node, Standardise)  # noqa: E731
    return [node for node in jax.tree.leaves(model, is_leaf=is_one) if is_one(node)]


def nothing_seen(model: ActorCritic, like: Array) -> Seen:
    """At the beginning."""
    features = [Moments.none(one.mean) for one in standardisers(model)]
    return Seen(features, Moments.none(jnp.zeros((), like.dtype)))


def more_seen(
    model: ActorCritic, seen: Seen, observations: Array, targets: Array, valid: Array
) -> Seen:
    """With more observations and targets: rows, of which some count."""
    moments = [
        old.joined(jax.vmap(one.of)(observations), valid)
        for one, old in zip(standardisers(model), seen.features, strict=True)
    ]
    return Seen(moments, seen.targets.joined(targets, valid))


def as_seen(model: ActorCritic, seen: Seen) -> ActorCritic:
    """The model with its standardisation by what was seen."""
    statistics = [
        value for moments in seen.features for value in (moments.mean, moments.std)
    ]
    targets = seen.targets

    def places(model):
        found = standardisers(model)
        each = [leaf for one in found for leaf in (one.mean, one.std)]
        return (*each, model.shift, model.scale)

    new = (*statistics, targets.mean, targets.std)
    new = [n.astype(o.dtype) for n, o in zip(new, places(model), strict=True)]
    return eqx.tree_at(places, model, tuple(lax.stop_gradient(new)))


class Episodes(NamedTuple):
    """What a batch of episodes leaves behind, each array `(batch, horizon, ...)`."""

    times: Array
    observations: Array
    controls: Array
    costs: Array
    valid: Array
    values: Array
    """V at each observation."""
    following: Array
    """What follows each step: V at the next observation, or what ended the episode."""
    going: Array
    """Whether something follows each step that was acted upon."""
    total_cost: Array


KEPT = ("states", "observations", "controls", "costs", "terminated")


def episode(
    environment: Environment,
    model: ActorCritic,
    key: PRNGKey,
    *,
    horizon: int,
    bootstrap: bool,
    truncate: int | None = None,
    gradient_decay: Any = 1.0,
) -> tuple[Episodes, Trajectory]:
    """One episode from a fresh start, and its record."""
    options: Any = dict(gradient_decay=gradient_decay, keep=KEPT, throw=False)
    cut: Any = dict(horizon=horizon, truncate=truncate)
    run: Any = rollout(environment, model.policy, key=key, **cut, **options)
    ok = ~run.failed
    costs = jnp.where(ok | ~jnp.isfinite(run.total_cost), run.costs, jnp.nan)
    # What is recorded of a cut rollout has lost its derivative at the cuts, where the
    # value of a state is asked for; so it is observed again, with the noise it had.
    seen = jax.vmap(environment.dynamics.observe)(run.times, run.states)
    noise = lax.stop_gradient(run.observations - seen[:-1])
    seen = seen + jnp.concatenate([noise, jnp.zeros_like(noise[:1])])
    values = jax.vmap(model.value)(run.times, seen)
    following, values = values[1:], values[:-1]
    if not bootstrap:
        following = following.at[-1].set(run.final_cost)
    following = jnp.where(run.terminated, run.final_cost, following)
    steps = jnp.arange(horizon)
    going = ~run.terminated & (bootstrap | (steps < horizon - 1))
    valid = steps < run.length
    record = Episodes(
        times=run.times[:-1],
        observations=run.observations,
        controls=run.controls,
        costs=costs,
        valid=valid,
        values=values,
        following=following,
        going=going,
        total_cost=run.total_cost,
    )
    return record, run


def advantages(record: Episodes, discount: Array, decay: Array) -> Array:
    """The generalised advantage estimate of each step of one episode,

    `A_k = c_k + g V_{k+1} - V_k + g lambda A_{k+1}`, nothing following an end.
    """
    excess = record.costs + discount * record.following - record.values

    def back(later, inputs):
        excess, going = inputs
        now = excess + discount * decay * jnp.where(going, later, 0)
        return now, now

    excess = jnp.where(record.valid, excess, 0)
    start = jnp.zeros((), excess.dtype)
    return lax.scan(back, start, (excess, record.going), reverse=True)[1]


def check_environment(environment: Any, where: str) -> None:
    """Raise unless it is one."""
    if not isinstance(environment, Environment):
        raise ValueError(
            f"{where}: environment must be an Environment, got "
            f"{type(environment).__name__}."
        )


def check_model(model: Any, environment: Environment, where: str, drawn: bool) -> None:
    """Raise unless a model is an actor and critic that can be trained so."""
    if not isinstance(model, ActorCritic):
        raise ValueError(
            f"{where}: model must be an ActorCritic, got {type(model).__name__}."
        )
    policy = model.policy
    if drawn and not hasattr(policy, "log_prob"):
        raise ValueError(
            f"{where}: the policy must draw its controls and have "
            f"log_prob(t, y, state, u), got {type(policy).__name__}."
        )
    unbounded = isinstance(policy, Gaussian) and policy.bounds is None
    if drawn and unbounded and environment.control_bounds is not None:
        raise ValueError(
            f"{where}: the policy must have the bounds of the environment, or its "
            "log-probability is not that of what is applied: "
            "Gaussian(..., bounds=env.control_bounds)."
        )
