"""Learners that start anew, each followed for as long as it does well."""

from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array

from ..._check import check_count, check_instance, check_key, check_range, check_step
from ..._controller import AbstractController, AbstractLearner
from ..._module import parameter


class AdaptiveState(NamedTuple):
    """What is remembered of the experts.

    - `experts`: their states, with a leading axis of slots.
    - `weights`: of each, 0 in an empty slot; they add up to 1.
    - `ends`: the step at which each dies.
    - `step`: how many steps were made, and `t`, the time of the current one.
    - `mean`, `variance`: of the losses lately.
    - `chosen`: the slot that is followed, and `key`, of the next choice; `None` where
      all are mixed.
    """

    experts: Any
    weights: Array
    ends: Array
    step: Array
    t: Array
    mean: Array
    variance: Array
    chosen: Any
    key: Any


class Adaptive(AbstractController):
    """An online learner made to keep up with a plant or disturbances that change.

    Copies of `base`, the experts, run side by side on the same observations. Every
    `every` steps a new one is born that has learned nothing; the i-th lives for
    `every (4 2^k + 1)` steps, 2^k being the largest power of two that divides i, so
    that there is at all times one that began shortly after any change. The first lives
    for ever. If no slot is free, the one that would die next makes room.

    The weights follow the counterfactual losses,
    `p_i <- p_i exp(-rate (loss_i - mean loss) / spread)`, `spread` being the standard
    deviation of the losses lately, so that their scale does not matter; then a part
    `share` is dealt out evenly to all that live, so that each can rise quickly.

    What is played is the mixture `u = sum_i p_i u_i`; or the control of one expert,
    chosen anew only with the probability by which its weight has fallen, so that it is
    seldom exchanged. With [`delucax.controllers.gpc`][] as base it is AdaGPC.

    **Arguments:**

    - `base`: an [`delucax.AbstractLearner`][], such as one of
        [`delucax.controllers.gpc`][].
    - `slots`: the number of experts alive at once, 8 by default.
    - `every`: steps between births, 64 by default.
    - `rate`: of the weights, 0.5 by default.
    - `share`: dealt out evenly at each step, above 0 and at most 1; 0.02 by default.
    - `play`: `"mix"` (default) or `"switch"`.

    **Raises:** `ValueError` if `base` is not a learner or a number is out of its range;
    when it is run with `"switch"`, if there is no key.

    Source: Gradu, Hazan and Minasyan, 2020; Hazan and Seshadhri, 2009 (lifetimes);
    Herbster and Warmuth, 1998 (share); Geulen, Voecking and Winkler, 2010 (switching).

    !!! example

        ```python
        import delucax as dlx
        import jax

        env = dlx.make("lds", key=jax.random.key(0))
        learner = dlx.controllers.gpc(env.dynamics, env.cost)
        adaptive = dlx.controllers.Adaptive(learner)
        dlx.rollout(env, adaptive, key=jax.random.key(0)).total_cost
        ```
    """

    base: AbstractLearner
    rate: Array = parameter()
    share: Array = parameter()
    slots: int = eqx.field(static=True)
    every: int = eqx.field(static=True)
    play: Literal["mix", "switch"] = eqx.field(static=True)

    def __init__(
        self,
        base: AbstractLearner,
        *,
        slots: int = 8,
        every: int = 64,
        rate: Any = 0.5,
        share: Any = 0.02,
        play: Literal["mix", "switch"] = "mix",
    ):
        where = "Adaptive"
        if play not in ("mix", "switch"):
            raise ValueError(f"{where}: play must be 'mix' or 'switch', got {play!r}.")
        self.base, self.play = base, play
        self.slots = check_count(slots, "slots", where, least=2)
        self.every = check_count(every, "every", where)
        self.rate, self.share = rate, share

    def __check_init__(self):
        where = "Adaptive"
        check_instance(self.base, AbstractLearner, "base", where, " such as gpc makes")
        check_step(self.rate, where, "rate")
        check_step(self.share, where, "share")
        check_range(self.share, "share", where, 0, 1)

    def init(self, *, key=None):
        switches = self.play == "switch"
        if switches:
            key, base_key = jr.split(check_key(key, "Adaptive.init"))
        else:
            base_key = key
        one = self.base.init(key=base_key)
        experts = jax.tree.map(
            lambda leaf: jnp.broadcast_to(leaf, (self.slots, *leaf.shape)), one
        )
        first = jnp.arange(self.slots) == 0
        zero = jnp.zeros(())
        return AdaptiveState(
            experts,
            weights=jnp.where(first, jnp.ones(()), 0),
            ends=jnp.where(first, jnp.iinfo(jnp.int32).max, 0).astype(jnp.int32),
            step=jnp.zeros((), jnp.int32),
            t=zero,
            mean=zero,
            variance=zero,
            chosen=jnp.zeros((), jnp.int32) if switches else None,
            key=key if switches else None,
        )

    def __call__(self, t, y, state):
        act = jax.vmap(self.base, in_axes=(None, None, 0))
        controls, experts = act(t, y, state.experts)
        if state.chosen is None:
            u = state.weights.astype(y.dtype) @ controls
        else:
            u = controls[state.chosen]
        t = jnp.asarray(t, state.t.dtype)
        return u, state._replace(experts=experts, t=t)

    def applied(self, u, cost, state):
        losses = jax.vmap(self.base.loss, in_axes=(None, 0))(state.t, state.experts)
        state = self._judge(losses.astype(state.weights.dtype), state)
        told = jax.vmap(self.base.applied, in_axes=(None, None, 0))
        state = state._replace(
            experts=told(u, cost, state.experts), step=state.step + 1
        )
        return self._renew(state)

    def _judge(self, losses: Array, state: AdaptiveState) -> AdaptiveState:
        """New weights, up to a factor, and perhaps another choice, after a step."""
        old, alive = state.weights, state.weights > 0
        losses = jnp.where(alive, losses, 0)
        played = old @ losses
        fading = 1 / jnp.minimum(state.step + 1, self.every).astype(old.dtype)
        mean = state.mean + fading * (played - state.mean)
        variance = state.variance + fading * ((played - mean) ** 2 - state.variance)
        spread = jnp.sqrt(jnp.where(variance > 0, variance, 1))
        # None falls by more than a factor at once, however bad it was.
        excess = jnp.clip((losses - played) / spread, -1, 1)
        new = jnp.where(alive, old * jnp.exp(-self.rate * excess), 0)
        state = state._replace(mean=mean, variance=variance)
        if state.chosen is not None:
            # Normalised so that no weight rises, as costs of at least 0 would have it.
            best = jnp.min(jnp.where(alive, excess, jnp.inf))
            kept = jnp.exp(-self.rate * (excess[state.chosen] - best))
            state = self._choose(new, kept, state)
        return state._replace(weights=new)

    def _choose(self, weights: Array, kept: Array, state: AdaptiveState) -> Any:
        """Keep the expert that is followed with probability `kept`."""
        key, toss, draw = jr.split(state.key, 3)
        stays = jr.uniform(toss) < kept
        other = jr.categorical(draw, jnp.log(weights)).astype(state.chosen.dtype)
        return state._replace(chosen=jnp.where(stays, state.chosen, other), key=key)

    def _renew(self, state: AdaptiveState) -> AdaptiveState:
        """Births and deaths."""
        step, ends = state.step, state.ends
        born, birth = step % self.every == 0, jnp.maximum(step // self.every, 1)
        divisor = birth & -birth
        slot = jnp.argmin(ends)
        life = self.every * (4 * divisor + 1)
        newborn = born & (jnp.arange(self.slots) == slot)
        ends = jnp.where(newborn, step + life, ends)
        old = jax.tree.map(lambda leaf: leaf[slot], state.experts)
        new = self.base.fresh(old, None)

        def replaced(leaf, before, after):
            # What a birth leaves as it is is not written: most of the state.
            if after is before:
                return leaf
            mask = newborn.reshape((-1,) + (1,) * (leaf.ndim - 1))
            return jnp.where(mask, after, leaf)

        experts = jax.tree.map(replaced, state.experts, old, new)
        alive = ends > step
        kept = alive & ~newborn
        weights = jnp.where(kept, state.weights, 0)
        weights = weights / jnp.sum(weights)
        dealt = alive / jnp.sum(alive)
        weights = (1 - self.share) * weights + self.share * dealt
        state = state._replace(experts=experts, ends=ends)
        state = state._replace(weights=weights.astype(state.weights.dtype))
        if state.chosen is None:
            return state
        gone = ~kept[state.chosen]
        return self._choose(weights, jnp.where(gone, 0, 1), state)
