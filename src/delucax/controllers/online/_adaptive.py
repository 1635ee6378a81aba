"""A meta-learner over copies of a learner that start at different times."""

from dataclasses import KW_ONLY
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, ArrayLike, Float, Int, PyTree

from ..._check import (
    check_choice,
    check_count,
    check_instance,
    check_key,
    check_range,
    check_step,
)
from ..._controller import AbstractController, AbstractLearner
from ..._module import parameter
from ..._typing import PRNGKey, Real, RealScalar


class AdaptiveState(NamedTuple):
    """The state of an `Adaptive` controller.

    - `experts`: the states of the experts, with a leading axis of slots.
    - `weights`: the weight of each expert, 0 for an empty slot. Their sum is 1.
    - `ends`: the step at which each expert expires.
    - `step`: the number of steps so far. `t`: the time of the current one.
    - `mean`, `variance`: the mean and the variance of the recent losses.
    - `chosen`: the slot that is followed. `key`: the random key of the next choice.
        Both are `None` if the experts are mixed.
    """

    experts: PyTree
    weights: Float[Array, " slots"]
    ends: Int[Array, " slots"]
    step: Int[Array, ""]
    t: Float[Array, ""]
    mean: Float[Array, ""]
    variance: Float[Array, ""]
    chosen: Int[Array, ""] | None
    key: PRNGKey | None


class Adaptive(AbstractController):
    r"""An online learner that adapts to a plant or disturbances that change.

    Copies of `base`, the experts, run in parallel on the same observations. After each
    interval of `every` steps a new expert starts, which has learned nothing yet. The
    $i$-th expert expires after `every` $(4 \cdot 2^k + 1)$ steps, where $2^k$ is the
    largest power of two that divides $i$. So whenever the plant has changed, there is
    an expert that started shortly after the change. The first expert never expires. If
    no slot is free, the expert that would expire next is dropped.

    The weights of the experts follow their counterfactual losses:

    $$p_i \leftarrow p_i \exp(-\mathrm{rate}\, (\ell_i - \bar \ell) / \sigma)$$

    Here $\bar \ell$ is the mean of the losses, weighted by $p_i$, and $\sigma$ is the
    standard deviation of the recent mean losses. The quotient is clipped to $[-1, 1]$.
    Because of $\sigma$, the weights do not depend on the scale of the losses. Then a
    fraction `share` of the total weight is distributed evenly over all active experts,
    so that the weight of any expert can rise quickly.

    With `play="mix"` the control is $u = \sum_i p_i u_i$. With `play="switch"` the
    control comes from a single expert. At each step, another expert is drawn with a
    probability that is usually small. This probability is the fraction of its weight
    that the current expert lost in this step, relative to the weight of the best
    expert. So the expert seldom changes. With [`delucax.controllers.gpc`][] as base,
    this is AdaGPC.

    **Arguments:**

    - `base`: a [`delucax.AbstractLearner`][], for example from
        [`delucax.controllers.gpc`][].
    - `slots`: the largest number of active experts, 8 by default.
    - `every`: the number of steps between the starts of two experts, 64 by default.
    - `rate`: the factor $\mathrm{rate}$ in the formula above, which sets how fast the
        weights follow the losses; 0.5 by default.
    - `share`: the fraction of the total weight that is distributed evenly at each step,
        above 0 and at most 1; 0.02 by default.
    - `play`: `"mix"` (default) or `"switch"`.

    **Raises:** `ValueError` if `base` is not a learner or a number is out of its range;
    at run time with `"switch"`, if there is no random key.

    Source: Gradu, Hazan and Minasyan, 2020; Hazan and Seshadhri, 2009 (lifetimes);
    Herbster and Warmuth, 1998 (share); Geulen, Voecking and Winkler, 2010 (switching).

    !!! example

        ```python
        import delucax as dlx
        import jax

        push = dlx.disturbances.Constant([0.5, 0.5])
        env = dlx.make("lds", key=jax.random.key(0), disturbance=push)
        learner = dlx.controllers.gpc(env.dynamics, env.cost)
        adaptive = dlx.controllers.Adaptive(learner)
        dlx.rollout(env, adaptive, key=jax.random.key(0)).total_cost
        ```
    """

    base: AbstractLearner
    _: KW_ONLY
    slots: int = eqx.field(default=8, static=True)
    every: int = eqx.field(default=64, static=True)
    rate: Real = parameter(0.5)
    share: Real = parameter(0.02)
    play: Literal["mix", "switch"] = eqx.field(default="mix", static=True)

    def __check_init__(self):
        where = "Adaptive"
        check_instance(self.base, AbstractLearner, "base", where, " such as gpc makes")
        check_count(self.slots, "slots", where, least=2)
        check_count(self.every, "every", where)
        check_step(self.rate, where, "rate")
        check_step(self.share, where, "share")
        check_range(self.share, "share", where, 0, 1)
        check_choice(self.play, ("mix", "switch"), "play", where)

    def init(self, *, key: PRNGKey | None = None) -> PyTree:
        chosen, own, base_key = None, None, key
        if self.play == "switch":
            own, base_key = jr.split(check_key(key, "Adaptive.init"))
            chosen = jnp.zeros((), jnp.int32)
        copies = lambda leaf: jnp.broadcast_to(leaf, (self.slots, *leaf.shape))
        experts = jax.tree.map(copies, self.base.init(key=base_key))
        first, zero = jnp.arange(self.slots) == 0, jnp.zeros(())
        return AdaptiveState(
            experts,
            weights=jnp.where(first, jnp.ones(()), 0),
            ends=jnp.where(first, jnp.iinfo(jnp.int32).max, 0).astype(jnp.int32),
            step=jnp.zeros((), jnp.int32),
            t=zero,
            mean=zero,
            variance=zero,
            chosen=chosen,
            key=own,
        )

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        act = jax.vmap(self.base, in_axes=(None, None, 0))
        controls, experts = act(t, y, state.experts)
        weights = state.weights.astype(y.dtype)
        u = weights @ controls if state.chosen is None else controls[state.chosen]
        return u, state._replace(experts=experts, t=jnp.asarray(t, state.t.dtype))

    def applied(self, u: Array, cost: Array, state: PyTree) -> PyTree:
        losses = jax.vmap(self.base.loss, in_axes=(None, 0))(state.t, state.experts)
        state = self._reweighted(losses.astype(state.weights.dtype), state)
        applied = jax.vmap(self.base.applied, in_axes=(None, None, 0))
        experts = applied(u, cost, state.experts)
        return self._renewed(state._replace(experts=experts, step=state.step + 1))

    def _reweighted(
        self, losses: Float[Array, " slots"], state: AdaptiveState
    ) -> AdaptiveState:
        """The state with new weights, not normalised, and perhaps another choice."""
        old, alive = state.weights, state.weights > 0
        # The loss of an empty slot may not be finite, nor that of an expert whose
        # control would leave the domain of the cost.
        usable = alive & jnp.isfinite(losses)
        share = jnp.sum(jnp.where(usable, old, 0))
        losses, known = jnp.where(usable, losses, 0), share > 0
        played = jnp.where(known, old @ losses / jnp.where(known, share, 1), state.mean)
        # A plain mean at first, then an exponential one over about `every` steps.
        fading = 1 / jnp.minimum(state.step + 1, self.every).astype(old.dtype)
        mean = state.mean + fading * (played - state.mean)
        variance = state.variance + fading * ((played - mean) ** 2 - state.variance)
        spread = jnp.sqrt(jnp.where(variance > 0, variance, 1))
        # Clipped, to bound the decrease of a weight in one step.
        excess = jnp.clip((losses - played) / spread, -1, 1)
        excess = jnp.where(usable, excess, jnp.where(known, 1.0, 0.0))
        new = jnp.where(alive, old * jnp.exp(-self.rate * excess), 0)
        state = state._replace(mean=mean, variance=variance)
        if state.chosen is not None:
            # Relative to the best expert, so that no weight rises, as it would be with
            # losses of at least 0.
            best = jnp.min(jnp.where(alive, excess, jnp.inf))
            kept = jnp.exp(-self.rate * (excess[state.chosen] - best))
            state = self._rechosen(new, kept, state)
        return state._replace(weights=new)

    def _rechosen(
        self, weights: Array, kept: ArrayLike, state: AdaptiveState
    ) -> AdaptiveState:
        """The state with the same choice with probability `kept`, else with another."""
        assert state.key is not None and state.chosen is not None
        key, toss, draw = jr.split(state.key, 3)
        stays = jr.uniform(toss) < kept
        # An empty slot has weight 0, so its logarithm is -inf and it is never drawn.
        other = jr.categorical(draw, jnp.log(weights)).astype(state.chosen.dtype)
        return state._replace(chosen=jnp.where(stays, state.chosen, other), key=key)

    def _renewed(self, state: AdaptiveState) -> AdaptiveState:
        """The state after new experts have started and old ones expired."""
        step, ends = state.step, state.ends
        is_birth, births = step % self.every == 0, jnp.maximum(step // self.every, 1)
        # The slot that expires first. An empty one has expired before all others.
        slot = jnp.argmin(ends)
        # `births & -births` is the largest power of two that divides it. With these
        # lifetimes (Hazan and Seshadhri, 2009), about log(births) experts are active.
        life = self.every * (4 * (births & -births) + 1)
        newborn = is_birth & (jnp.arange(self.slots) == slot)
        ends = jnp.where(newborn, step + life, ends)
        old = jax.tree.map(lambda leaf: leaf[slot], state.experts)

        def renewed(leaf, before, after):
            # Only leaves that a start changes are written. Most stay the same.
            if after is before:
                return leaf
            mask = newborn.reshape((-1,) + (1,) * (leaf.ndim - 1))
            return jnp.where(mask, after, leaf)

        new = self.base.fresh(old, None)
        experts = jax.tree.map(renewed, state.experts, old, new)
        alive = ends > step
        kept = alive & ~newborn
        weights = jnp.where(kept, state.weights, 0)
        weights = weights / jnp.sum(weights)
        # No weight falls below share / (number of active experts), so a new best expert
        # leads after about log(1 / share) / rate steps (Herbster and Warmuth, 1998).
        weights = (1 - self.share) * weights + self.share * (alive / jnp.sum(alive))
        weights = weights.astype(state.weights.dtype)
        state = state._replace(experts=experts, ends=ends, weights=weights)
        if state.chosen is None:
            return state
        return self._rechosen(weights, jnp.where(kept[state.chosen], 1, 0), state)
