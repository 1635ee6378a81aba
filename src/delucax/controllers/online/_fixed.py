"""A controller that reacts to a signal in a fixed way."""

from typing import NamedTuple

from jaxtyping import Array

from ..._controller import AbstractController
from ._features import Features
from ._loop import Loop, LoopState
from ._policy import AbstractPolicy


class FixedState(NamedTuple):
    """What a fixed policy remembers: the loop, and the signal, newest first."""

    loop: LoopState
    signal: Array


class FixedPolicy(AbstractController):
    """What an online learner learns about, without the learning,

    `u_t = base(y_t) + policy(theta, features_t)`.

    It is the policy that a learner has come to, or the best one in hindsight
    ([`delucax.controllers.best_in_hindsight`][]). `learner.fixed(theta)` makes it.

    **Attributes:** `loop`, the model with its base controller; `features`, the filters
    and which signal they are of; `policy`, the family of policies, whose
    `policy.start` is theta, trainable.

    !!! example

        ```python
        import delucax as dlx
        import jax

        env = dlx.make("lds", key=jax.random.key(0))
        policy = dlx.controllers.gpc(env.dynamics, env.cost).fixed()
        dlx.rollout(env, policy, key=jax.random.key(0)).total_cost
        ```
    """

    loop: Loop
    features: Features
    policy: AbstractPolicy

    def init(self, *, key=None):
        return FixedState(self.loop.init(key, 0), self.features.init(self.loop.dtype))

    def __call__(self, t, y, state):
        loop, before = self.loop, state.loop.base
        moved = loop.act(self, t, y, state.loop)
        signal = self.features.observe(loop, moved, state.signal)
        v = self.policy(self.policy.init(), self.features(signal))
        moved = loop.linearised(v, before, moved)
        return (moved.u_base + v).astype(y.dtype), FixedState(moved, signal)

    def applied(self, u, cost, state):
        return state._replace(loop=self.loop.applied(u, cost, state.loop))
