"""A controller that reacts to a signal in a fixed way."""

from ..._controller import AbstractController
from ._closed_loop import ClosedLoop
from ._policy import AbstractPolicy


class FixedPolicy(AbstractController):
    """What an online learner learns about, without the learning,

    `u_t = base(y_t) + policy(theta, features_t)`.

    It is the policy that a learner has come to, or the best one in hindsight
    ([`delucax.controllers.best_in_hindsight`][]). `learner.fixed(theta)` makes it.

    **Attributes:** `loop`, the model with its base controller and the features of its
    signal; `policy`, the family of policies, whose `policy.start` is theta, trainable.

    !!! example

        ```python
        import delucax as dlx
        import jax

        env = dlx.make("lds", key=jax.random.key(0))
        policy = dlx.controllers.gpc(env.dynamics, env.cost).fixed()
        dlx.rollout(env, policy, key=jax.random.key(0)).total_cost
        ```
    """

    loop: ClosedLoop
    policy: AbstractPolicy

    def init(self, *, key=None):
        return self.loop.init(key, 0)

    def __call__(self, t, y, state):
        policy = lambda features: self.policy(self.policy.init(), features)
        _, v, state = self.loop.act(self, t, y, state, policy)
        return (state.u_base + v).astype(y.dtype), state

    def applied(self, u, cost, state):
        return self.loop.applied(u, cost, state)
