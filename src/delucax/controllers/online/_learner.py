"""Online learners of a policy that is added to a base controller."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, ArrayLike, Float, PyTree

from ..._check import check_function, check_instance, check_step, is_concrete
from ..._check_models import output_of
from ..._controller import AbstractController, AbstractLearner, Tally
from ..._jax import is_constant
from ..._module import function_field, parameter
from ..._typing import PRNGKey, Real, RealScalar
from ...dynamics import AbstractDynamics, LinearDynamics, linearize
from .._composed import Scheduled
from .._lqr import LQR
from .._output_feedback import LQG
from ._closed_loop import ClosedLoop, ClosedLoopState, in_first_responses, shift
from ._optimisers import adagrad_norm, online_newton, positive_root, projected_step
from ._policy import AbstractPolicy, FixedPolicy, LinearPolicy


DEFAULT_STEP = 0.15
"""The step of a learner, in units of the control that undoes what it has observed."""
DEFAULT_RADIUS = 50.0
"""The largest policy, in the same units."""
_PRIOR_OF_OUTPUTS = 4.0
"""The prior of what is learned from nature's outputs, in steps."""


class LearnerState(NamedTuple):
    """The state of an online learner.

    - `loop`: of the plant and the base controller.
    - `features`: of this step and those of the roll-out before it, newest first.
    - `theta`: what has been learned.
    - `optimiser`: the state of the optimiser.
    - `weighted`: the response weighted by the root of the curvature of the cost, where
      it is the same at all times.
    - `refused`: how many updates were not finite, and so were not made.
    """

    loop: ClosedLoopState
    features: Float[Array, "h+1 f"]
    theta: PyTree
    optimiser: PyTree
    weighted: Float[Array, "h+1 o m"] | None
    refused: Tally


class OnlineLearner(AbstractLearner):
    """A base controller, and what is learned online to add to it,

    `u_t = base(y_t) + policy(theta_t, features_t)`,

    where the features are filters of a signal that does not depend on what was added:
    the past disturbances, or nature's output. Before it acts, theta takes a step
    against the gradient of a counterfactual loss, the cost of this step had theta been
    held during a roll-out,

    `loss_t(theta) = c(t, y_t(theta), u_t(theta))`,
    `y_t(theta) = y_t + sum_{j < horizon} G_j (v_{t-1-j}(theta) - v_{t-1-j})`,

    with `G_j` the closed loop's response to an impulse j steps ago, `v_s(theta)` what
    theta would have added at step s and `v_s` what was added, saturation included; and
    likewise for the control. The responses are those of linear dynamics, or of any
    dynamics linearised along the way.

    [`delucax.controllers.gpc`][], [`delucax.controllers.drc`][],
    [`delucax.controllers.sfc`][] and [`delucax.controllers.neural_gpc`][] make it.

    **Attributes:**

    - `loop`: the model with its base controller: `loop.base`; `loop.horizon`, the
        length of the roll-out; `loop.response`, the G_j, if they are always the same;
        `loop.memory` and `loop.filters`, what the features are.
    - `cost`: the stage cost.
    - `policy`: the family of policies; `policy.start`, the first theta, is trainable.
    - `learning_rate`: an array that scales the optimiser's step; it can be
        differentiated.
    - `optimiser`: an Optax transformation. It is given, as extra arguments, the
        `learning_rate` and a function that returns the `curvature` of the loss.

    The state that `init` makes and a run carries along has `theta`, what has been
    learned, and `loop.signal`, the last values of the signal, newest first.

    !!! example

        ```python
        import delucax as dlx
        import jax

        env = dlx.make("lds", key=jax.random.key(0))
        learner = dlx.controllers.gpc(env.dynamics, env.cost)
        dlx.rollout(env, learner, key=jax.random.key(0)).total_cost
        ```
    """

    loop: ClosedLoop
    cost: Callable[..., Array] = function_field()
    policy: AbstractPolicy
    learning_rate: Real = parameter()
    optimiser: optax.GradientTransformation = eqx.field(static=True)

    def __check_init__(self):
        where, dynamics, policy = "OnlineLearner", self.loop.dynamics, self.policy
        check_step(self.learning_rate, where, "learning_rate")
        check_scalar_cost(self.cost, dynamics, where)
        size, m = self.loop.feature_size, dynamics.control_size
        added = lambda policy: policy(policy.init(), jnp.zeros(size))
        try:
            got = eqx.filter_eval_shape(added, policy).shape
        except TypeError:  # matrices that do not fit
            got = None
        if got != (m,):
            raise ValueError(
                f"{where}: policy must take {size} features and give {m} controls, got "
                f"{type(policy).__name__} that does not."
            )

    def init(self, *, key: PRNGKey | None = None) -> PyTree:
        loop, theta = self.loop, self.policy.init()
        inner, h = loop.init(key, loop.horizon), loop.horizon
        weighted = None
        with_extra = optax.GradientTransformationExtraArgs
        if isinstance(self.optimiser, with_extra) and loop.response is not None:
            root = self._constant_root()
            weighted = None if root is None else self._weighted(root, inner)
        return LearnerState(
            inner,
            features=jnp.zeros((h + 1, loop.feature_size), loop.dtype),
            theta=theta,
            optimiser=self.optimiser.init(theta),
            weighted=weighted,
            refused=Tally("refused_update"),
        )

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        before = lambda features: self.policy(state.theta, features)
        features, _, loop = self.loop.act(self, t, y, state.loop, before)
        state = state._replace(loop=loop, features=shift(features, state.features))
        gradient = jax.grad(self._loss)(state.theta, state)
        curvature = lambda: self._curvature(state)
        after = projected_step(self, gradient, state, curvature=curvature)
        # By the new theta: the loss of this step needs y_t alone, which is known before
        # the control is chosen.
        v = self.policy(after.theta, features)
        return (loop.u_base + v).astype(y.dtype), after

    def applied(self, u: Array, cost: Array, state: PyTree) -> PyTree:
        return state._replace(loop=self.loop.applied(u, cost, state.loop))

    def loss(self, t: RealScalar, state: PyTree) -> Array:
        del t
        return self._loss(state.theta, state)

    def fresh(self, state: PyTree, key: PRNGKey | None) -> PyTree:
        del key
        theta = self.policy.init()
        return state._replace(theta=theta, optimiser=self.optimiser.init(theta))

    def fixed(self, theta: Any = None) -> FixedPolicy:
        """The same controller, no longer learning.

        **Arguments:** `theta`: what it has learned, from its state; by default what it
        starts with.

        **Returns:** a controller, `u_t = base(y_t) + policy(theta, features_t)`. Its
        `policy.start` is theta, trainable; its `loop` is the learner's.
        """
        policy = self.policy if theta is None else self.policy.at(theta)
        return FixedPolicy(self.loop, policy)

    def _outcome(self, theta, state):
        # Theta is held constant during the roll-out. As it moves slowly, regret in
        # these losses bounds that of the run (Anava, Hazan and Mannor, 2015; Agarwal et
        # al., 2019).
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
        # What is added now changes the control of this step, and no observation yet.
        direct = jnp.eye(p + m, m, -p, past.dtype)
        response = jnp.concatenate([direct[None], past])
        return jnp.einsum("ok,hom->hkm", root, response)

    def _root(self, t, z):
        p = self.loop.dynamics.observation_size
        cost = lambda z: self.cost(t, z[:p], z[p:])  # noqa: E731
        # Gauss and Newton: the curvature by theta is J' H J, as outcomes are linear in
        # theta.
        return positive_root(jax.hessian(cost)(z))

    def _constant_root(self):
        """`None` if it depends on where or when it is taken."""
        dynamics, dtype = self.loop.dynamics, self.loop.dtype
        size = dynamics.observation_size + dynamics.control_size
        here = jnp.zeros((), dtype), jnp.zeros(size, dtype)
        return self._root(*here) if is_constant(self._root, *here) else None


def linear_learner(
    where: str,
    dynamics: AbstractDynamics,
    cost: Callable[..., Array],
    base: AbstractController | None,
    horizon: int | None,
    learning_rate: ArrayLike | None,
    optimiser: optax.GradientTransformation | None,
    radius: ArrayLike | None,
    **signal: Any,
) -> OnlineLearner:
    """A learner of a linear map from features to control; `signal` says what the
    features are, as to a `ClosedLoop`."""
    base = base_for(dynamics, cost, base, where)
    loop = ClosedLoop(dynamics, base, horizon, where, **signal)
    start = jnp.zeros((dynamics.control_size, loop.feature_size), loop.dtype)
    scale = functools.partial(in_first_responses, loop, where)
    ball = scale(radius, "radius", DEFAULT_RADIUS)
    rate = scale(learning_rate, "learning_rate", DEFAULT_STEP)
    if optimiser is None:
        # Newton's step where gradients alone are slow: nature's outputs are much alike
        # from step to step, and gradients by a response that varies change direction.
        if loop.nature:
            optimiser = online_newton(_PRIOR_OF_OUTPUTS)
        else:
            optimiser = online_newton() if loop.response is None else adagrad_norm()
    return OnlineLearner(loop, cost, LinearPolicy(start, ball), rate, optimiser)


def base_for(
    dynamics: AbstractDynamics,
    cost: Callable[..., Array],
    base: AbstractController | None,
    where: str,
) -> AbstractController:
    """The base of a learner with this model and cost, which are checked: as given, or
    by default the regulator for the curvature of the cost at the operating point.

    For each time of time-varying dynamics it is the one that would be best if they
    stayed as they are; where not the state but `C x` is observed, it acts on the
    estimate of a Kalman filter for disturbances and sensor noise of unit covariance.
    """
    hint = (
        ", the model that it learns with (`delucax.controllers.Explore` identifies one)"
    )
    check_instance(dynamics, AbstractDynamics, "dynamics", where, hint)
    of = " of (t, y, u), such as one of delucax.costs"
    check_function(cost, "cost", where, of)
    check_scalar_cost(cost, dynamics, where)
    if base is not None:
        return base
    try:
        x, u = dynamics.equilibrium()
    except ValueError as error:
        raise ValueError(
            f"{where}: base must be given, for dynamics that define no equilibrium to "
            "design one at."
        ) from error
    Q, R, S = _weights(dynamics, cost, x, u, where)
    if not isinstance(dynamics, LinearDynamics):
        model = linearize(dynamics, jnp.zeros((), x.dtype), x, u)
        return LQR(model, Q, R, S, difference=dynamics.difference)
    if not dynamics.is_time_varying:
        if dynamics.observes_state:
            return LQR(dynamics, Q, R, S)
        p, k = dynamics.observation_size, dynamics.disturbance_size
        eye = lambda n: jnp.eye(n, dtype=x.dtype)  # noqa: E731
        return LQG(dynamics, Q, R, eye(k), eye(p), S)
    times = jnp.arange(dynamics.A.shape[0]) * dynamics.dt
    design = eqx.filter_vmap(lambda t: LQR(dynamics.at(t), Q, R, S))
    return Scheduled(design(times), dynamics.dt)


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
    got = getattr(value, "shape", None)
    if got != ():
        got = type(value).__name__ if got is None else f"an array of shape {got}"
        raise ValueError(f"{where}: cost must give a scalar, got {got}.")


@eqx.filter_jit
def _curvature(dynamics, cost, x, u):
    """Half of the second derivatives of the cost, and its blocks `Q`, `R` and `S`."""
    t, n = jnp.zeros((), x.dtype), x.shape[0]
    y = dynamics.observe(t, x)

    def charged(z):
        # Gauss and Newton in the observation: the curvature of the sensor, which could
        # make the cost concave, is left out.
        y_here = y + jax.jvp(lambda x: dynamics.observe(t, x), (x,), (z[:n],))[1]
        return cost(t, y_here, u + z[n:])

    # c = dx'Q dx + ...
    H = jax.hessian(charged)(jnp.zeros(n + u.shape[0], x.dtype)) / 2
    return H, (H[:n, :n], H[n:, n:], H[:n, n:])


def _weights(dynamics, cost, x, u, where):
    """The curvature of the cost as weights of a regulator, if it has one."""
    H, (Q, R, S) = _curvature(dynamics, cost, x, u)
    if is_concrete(H):
        H = np.asarray(H, float)
        # Above the rounding of a Hessian in float32.
        slack = 1e-6 * np.max(np.abs(H), initial=0)
        curved = np.all(np.linalg.eigvalsh(H) >= -slack)
        if not (curved and np.all(np.linalg.eigvalsh(np.asarray(R)) > slack)):
            raise ValueError(
                f"{where}: base must be given, for a cost that is not convex, and "
                "strictly so in u, at the operating point."
            )
    return Q, R, S
