"""The engine of online control: learning what to add to a base controller's control."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jax.interpreters import partial_eval
from jaxtyping import Array

from ..._check import check_step, output_of
from ..._controller import AbstractLearner, Tally
from ..._module import function_field, parameter
from ...dynamics import AbstractDynamics
from ._features import Features
from ._fixed import FixedPolicy
from ._loop import Loop, LoopState, shift
from ._newton import positive_root
from ._policy import AbstractPolicy


class LearnerState(NamedTuple):
    """What an online learner remembers.

    - `loop`: of the plant and the base controller.
    - `signal`: its last values, newest first.
    - `features`: of this step and those of the roll-out before it, newest first.
    - `theta`: what has been learned.
    - `optimiser`: the state of the optimiser.
    - `weighted`: the response weighted by the root of the curvature of the cost, where
        it is the same at all times.
    - `refused`: how many updates were not finite, and so were not made.
    """

    loop: LoopState
    signal: Array
    features: Array
    theta: Any
    optimiser: Any
    weighted: Any
    refused: Tally


def accepted(new: Any, old: Any, refused: Tally) -> tuple[Any, Tally]:
    """What was learned, or what was known before if that is not finite."""
    floats = jax.tree.leaves(eqx.filter(new, eqx.is_inexact_array))
    fine = jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in floats]))
    kept = jax.tree.map(lambda a, b: jnp.where(fine, a, b), new, old)
    return kept, refused.add(~fine)


class OnlineLearner(AbstractLearner):
    """A base controller, and what is learned online to add to it,

    `u_t = base(y_t) + policy(theta_t, features_t)`,

    where the features are filters of a signal that does not depend on what was added:
    the past disturbances, or nature's output. Before it acts, theta moves against the
    gradient of what this step would have cost had it been in use all along a roll-out,

    `loss_t(theta) = c(t, y_t(theta), u_t(theta))`,
    `y_t(theta) = y_t + sum_{j < horizon} G_j (v_{t-1-j}(theta) - v_{t-1-j})`,

    with `G_j` the closed loop's response to an impulse j steps ago, `v_s(theta)` what
    theta would have added at step s and `v_s` what was added, saturation included; and
    likewise for the control. The responses are those of linear dynamics, or of any
    dynamics linearised along the way.

    [`delucax.controllers.gpc`][], [`delucax.controllers.drc`][],
    [`delucax.controllers.sfc`][], [`delucax.controllers.dsc`][] and
    [`delucax.controllers.neural_gpc`][] make it.

    **Attributes:**

    - `loop`: the model with its base controller: `loop.base`; `loop.horizon`, the
        length of the roll-out; `loop.response`, the G_j, if they are always the same.
    - `cost`: the stage cost.
    - `features`: the filters, and which signal they are of.
    - `policy`: the family of policies; `policy.start`, the first theta, is trainable.
    - `learning_rate`: an array that scales the optimiser's step; it can be
        differentiated.
    - `optimiser`: an Optax transformation. It is given, as extra arguments, the
        `learning_rate` and a function that returns the `curvature` of the loss.

    The state that `init` makes and a run carries along has `theta`, what has been
    learned, and `signal`, the last values of the signal, newest first.

    !!! example

        ```python
        import delucax as dlx
        import jax

        env = dlx.make("lds", key=jax.random.key(0))
        learner = dlx.controllers.gpc(env.dynamics, env.cost)
        dlx.rollout(env, learner, key=jax.random.key(0)).total_cost
        ```
    """

    loop: Loop
    cost: Callable[..., Array] = function_field()
    features: Features
    policy: AbstractPolicy
    learning_rate: Array = parameter()
    optimiser: optax.GradientTransformation = eqx.field(static=True)

    def __check_init__(self):
        where, dynamics, policy = "OnlineLearner", self.loop.dynamics, self.policy
        check_step(self.learning_rate, where, "learning_rate")
        check_scalar_cost(self.cost, dynamics, where)
        features, m = jnp.zeros(self.features.size), dynamics.control_size
        added = lambda policy: policy(policy.init(), features)
        try:
            got = eqx.filter_eval_shape(added, policy).shape
        except TypeError:  # matrices that do not fit
            got = None
        if got != (m,):
            raise ValueError(
                f"{where}: policy must take {self.features.size} features and give "
                f"{m} controls, got {type(policy).__name__} that does not."
            )

    def init(self, *, key=None):
        loop, features = self.loop, self.features
        theta, dtype = self.policy.init(), loop.dtype
        asks = isinstance(self.optimiser, optax.GradientTransformationExtraArgs)
        known = asks and loop.response is not None
        same = self._constant_root() if known else None
        inner = loop.init(key, loop.horizon)
        return LearnerState(
            inner,
            signal=features.init(dtype),
            features=jnp.zeros((loop.horizon + 1, features.size), dtype),
            theta=theta,
            optimiser=self.optimiser.init(theta),
            weighted=None if same is None else self._weighted(same, inner),
            refused=Tally("refused_update"),
        )

    def __call__(self, t, y, state):
        loop, before = self.loop, state.loop.base
        moved = loop.act(self, t, y, state.loop)
        signal = self.features.observe(loop, moved, state.signal)
        features = shift(self.features(signal), state.features)
        moved = loop.linearised(self.policy(state.theta, features[0]), before, moved)
        state = state._replace(loop=moved, signal=signal, features=features)
        old = state.theta, state.optimiser
        (theta, optimiser), refused = accepted(self._learn(state), old, state.refused)
        v = self.policy(theta, features[0])
        state = state._replace(theta=theta, optimiser=optimiser, refused=refused)
        return (moved.u_base + v).astype(y.dtype), state

    def applied(self, u, cost, state):
        return state._replace(loop=self.loop.applied(u, cost, state.loop))

    def loss(self, t, state):
        del t
        return self._loss(state.theta, state)

    def fresh(self, state, key):
        del key
        theta = self.policy.init()
        return state._replace(theta=theta, optimiser=self.optimiser.init(theta))

    def fixed(self, theta: Any = None) -> "FixedPolicy":
        """The same controller, no longer learning.

        **Arguments:** `theta`: what it has learned, from its state; by default what it
        starts with.

        **Returns:** a controller whose `policy.start` is trainable.
        """
        policy = self.policy if theta is None else self.policy.at(theta)
        return FixedPolicy(self.loop, self.features, policy)

    def _learn(self, state):
        rate = self.learning_rate
        gradient = jax.grad(self._loss)(state.theta, state)
        optimiser = optax.with_extra_args_support(self.optimiser)
        direction, optimiser = optimiser.update(
            gradient,
            state.optimiser,
            state.theta,
            # For those that ask.
            curvature=lambda: self._curvature(state),
            learning_rate=rate,
        )
        theta = jax.tree.map(
            lambda old, step: old + (rate * step).astype(old.dtype),
            state.theta,
            direction,
        )
        return self.policy.project(theta), optimiser

    def _outcome(self, theta, state):
        v = jax.vmap(self.policy, in_axes=(None, 0))(theta, state.features)
        return self.loop.counterfactual(v[0], v[1:], state.loop)

    def _loss(self, theta, state):
        return self.cost(state.loop.t, *self._outcome(theta, state))

    def _curvature(self, state):
        """`J' L`, with J the derivative of observation and control by theta, and `L L'`
        the curvature of the cost."""
        weighted = state.weighted
        if weighted is None:
            z = jnp.concatenate(self._outcome(state.theta, state))
            weighted = self._weighted(self._root(state.loop.t, z), state.loop)
        return self.policy.pull_back(state.theta, weighted, state.features).T

    def _weighted(self, root, loop):
        """`L'` times the response of observation and control to what is added now and
        at each step of the roll-out, newest first, shape (horizon + 1, p + m, m)."""
        past = self.loop.past(loop)
        p, m = loop.y.shape[0], past.shape[2]
        direct = jnp.eye(p + m, m, -p, past.dtype)
        response = jnp.concatenate([direct[None], past])
        return jnp.einsum("ok,hom->hkm", root, response)

    def _root(self, t, z):
        p = self.loop.dynamics.observation_size
        cost = lambda z: self.cost(t, z[:p], z[p:])  # noqa: E731
        return positive_root(jax.hessian(cost)(z))

    def _constant_root(self):
        """`None` if it depends on where or when it is taken."""
        dynamics, dtype = self.loop.dynamics, self.loop.dtype
        size = dynamics.observation_size + dynamics.control_size
        here = jnp.zeros((), dtype), jnp.zeros(size, dtype)
        traced = jax.make_jaxpr(self._root)(*here)
        _, used = partial_eval.dce_jaxpr(traced.jaxpr, [True])
        return None if any(used) else self._root(*here)


def check_scalar_cost(cost: Any, dynamics: AbstractDynamics, where: str) -> None:
    """Raise unless a cost of what `dynamics` show is a scalar."""
    y, u = (dynamics.observation_size,), (dynamics.control_size,)
    try:
        value = output_of(cost, (), y, u)
    except ValueError as error:
        raise ValueError(
            f"{where}: cost must take the observation, of shape {y}, where a state is "
            f"asked for, and a control of shape {u}: {error}"
        ) from error
    if getattr(value, "shape", None) != ():
        got = getattr(value, "shape", None)
        got = type(value).__name__ if got is None else f"an array of shape {got}"
        raise ValueError(f"{where}: cost must give a scalar, got {got}.")
