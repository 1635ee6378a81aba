"""Online learners of a policy that adds to the control of a base controller."""

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
"""The step of a learner, in units of the control that undoes a unit of observation."""
DEFAULT_RADIUS = 50.0
"""The largest policy, in the same units."""
_PRIOR_OF_OUTPUTS = 4.0
"""The prior of a learner from nature's outputs, in steps."""


class LearnerState(NamedTuple):
    """The state of an online learner.

    - `loop`: the state of the plant and the base controller.
    - `features`: the features of this step and of the roll-out before it, newest first.
    - `theta`: what has been learned.
    - `optimiser`: the state of the optimiser.
    - `weighted`: the response times the root of the curvature of the cost, if it is the
        same at all times.
    - `refused`: the number of updates that were refused, because they were not finite.
    """

    loop: ClosedLoopState
    features: Float[Array, "h+1 f"]
    theta: PyTree
    optimiser: PyTree
    weighted: Float[Array, "h+1 o m"] | None
    refused: Tally


class OnlineLearner(AbstractLearner):
    r"""A base controller plus a policy that is learned online, during the run.

    $$u_t = \mathrm{base}(y_t) + \mathrm{policy}(\theta_t, \phi_t)$$

    The features $\phi_t$ are filtered values of a signal. This signal is the past
    disturbances, or nature's output; it does not depend on the added control. Before it
    computes a control, the learner moves $\theta$ against the gradient of a
    counterfactual loss. This loss is the cost that the current step would have if
    $\theta$ had been used in the last $h$ steps too, where $h$ is the `horizon`.

    $$\begin{aligned}
    \ell_t(\theta) &= c(t, y_t(\theta), u_t(\theta)) \\
    y_t(\theta) &= y_t + \sum_{j < h} G_j\, (v_{t-1-j}(\theta) - v_{t-1-j})
    \end{aligned}$$

    Here $G_j$ is the response of the closed loop to an impulse $j$ steps ago. The
    control that $\theta$ would have added at step $s$ is $v_s(\theta)$, and the control
    that was added there, after clipping, is $v_s$. The control $u_t(\theta)$ is
    computed like $y_t(\theta)$. Nonlinear dynamics are linearised along the run.

    [`delucax.controllers.gpc`][], [`delucax.controllers.drc`][],
    [`delucax.controllers.sfc`][] and [`delucax.controllers.neural_gpc`][] make online
    learners.

    **Attributes:**

    - `loop`: the model with its base controller. `loop.base` is the base controller,
        `loop.horizon` is the length $h$ of the counterfactual roll-out, and
        `loop.response` holds the $G_j$ if they are the same at all times. `loop.memory`
        and `loop.filters` define the features.
    - `cost`: the stage cost.
    - `policy`: the family of policies. `policy.start`, the initial $\theta$, is
        trainable.
    - `learning_rate`: the scale of the optimiser's step, an array. You can
        differentiate with respect to `learning_rate`.
    - `optimiser`: an Optax transformation. The `update` function of the optimiser gets
        two extra arguments: `learning_rate`, and `curvature`, a function that returns a
        square root $L$ of the curvature $L L^\top$ of the loss.

    The state of the controller has `theta`, the learned weights, and `loop.signal`, the
    last values of the signal, newest first.

    !!! example

        ```python
        import delucax as dlx
        import jax

        push = dlx.disturbances.Constant([0.5, 0.5])
        env = dlx.make("lds", key=jax.random.key(0), disturbance=push)
        learner = dlx.controllers.gpc(env.dynamics, env.cost)
        dlx.rollout(env, learner, key=jax.random.key(0)).total_cost
        ```

        ```text
        Array(9.56, dtype=float32)
        ```
    """

    loop: ClosedLoop
    cost: Callable[..., Array] = function_field(of="t, y, u")
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
                f"a {type(policy).__name__} that does not."
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
        # With the new theta, because the loss of this step needs only y_t, which is
        # known before the control.
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
        """The same controller without learning.

        **Arguments:** `theta`: the learned weights, from the state of the controller;
        the initial theta by default.

        **Returns:** a controller. Its `policy.start` is theta, trainable. Its `loop` is
        the `loop` of the learner.
        """
        policy = self.policy if theta is None else self.policy.at(theta)
        return FixedPolicy(self.loop, policy)

    def _outcome(self, theta, state):
        # Theta is constant during the roll-out. It moves slowly, so the regret in these
        # losses bounds the regret of the run (Anava, Hazan and Mannor, 2015).
        v = jax.vmap(self.policy, in_axes=(None, 0))(theta, state.features)
        return self.loop.counterfactual(v[0], v[1:], state.loop)

    def _loss(self, theta, state):
        return self.cost(state.loop.t, *self._outcome(theta, state))

    def _curvature(self, state):
        """The matrix `J' L`, which is a root of the curvature of the loss by theta.

        `J` is the derivative of observation and control by theta, and `L L'` the
        curvature of the cost.
        """
        weighted = state.weighted
        if weighted is None:
            z = jnp.concatenate(self._outcome(state.theta, state))
            weighted = self._weighted(self._root(state.loop.t, z), state.loop)
        return self.policy.pull_back(state.theta, weighted, state.features).T

    def _weighted(self, root, loop):
        """The response to a control added at each step of the roll-out, times `L'`.

        **Returns:** the weighted response of observation and control, newest step
        first, shape `(horizon + 1, p + m, m)`.
        """
        past = self.loop.past(loop)
        p, m = loop.y.shape[0], past.shape[2]
        # A control added now changes the control of this step, but not its observation.
        direct = jnp.eye(p + m, m, -p, past.dtype)
        response = jnp.concatenate([direct[None], past])
        return jnp.einsum("ok,hom->hkm", root, response)

    def _root(self, t, z):
        p = self.loop.dynamics.observation_size
        cost = lambda z: self.cost(t, z[:p], z[p:])  # noqa: E731
        # Gauss-Newton: for outcomes that are linear in theta, its curvature is J' H J.
        return positive_root(jax.hessian(cost)(z))

    def _constant_root(self):
        """The root of the curvature, or `None` if it depends on time or place."""
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
    """A learner of a linear map from features to controls.

    `signal` holds arguments of `ClosedLoop` that define the features.
    """
    base = base_for(dynamics, cost, base, where)
    loop = ClosedLoop(dynamics, base, horizon, where, **signal)
    start = jnp.zeros((dynamics.control_size, loop.feature_size), loop.dtype)
    scale = functools.partial(in_first_responses, loop, where)
    ball = scale(radius, "radius", DEFAULT_RADIUS)
    rate = scale(learning_rate, "learning_rate", DEFAULT_STEP)
    if optimiser is None:
        # Newton's method if gradient steps are slow: nature's outputs are similar from
        # step to step, and a response that varies turns the gradients.
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
    """The base of a learner, by default the regulator for the curvature of the cost.

    The curvature is taken at the operating point. For time-varying dynamics, the
    regulator of each time is the one for dynamics that stay as they are at that time.
    If `C x` is observed and not the state, the regulator acts on the estimate of a
    Kalman filter, for disturbances and sensor noise of unit covariance.
    """
    hint = (
        ", the model that it learns with (`delucax.controllers.Explore` identifies one)"
    )
    check_instance(dynamics, AbstractDynamics, "dynamics", where, hint)
    check_function(cost, "cost", where, "t, y, u")
    check_scalar_cost(cost, dynamics, where)
    if base is not None:
        return base
    try:
        x, u = dynamics.equilibrium()
    except ValueError as error:
        raise ValueError(
            f"{where}: base must be given, because dynamics define no equilibrium at "
            "which to design one."
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
    """Raise unless the cost of an observation and a control is a scalar."""
    y, u = (dynamics.observation_size,), (dynamics.control_size,)
    try:
        value = output_of(cost, (), y, u)
    except ValueError as error:
        raise ValueError(
            f"{where}: cost must take the observation, of shape {y}, in place of the "
            f"state, and a control of shape {u}: {error}"
        ) from error
    got = getattr(value, "shape", None)
    if got != ():
        got = type(value).__name__ if got is None else f"an array of shape {got}"
        raise ValueError(f"{where}: cost must give a scalar, got {got}.")


@eqx.filter_jit
def _curvature(dynamics, cost, x, u):
    """Half of the second derivatives of the cost, and their blocks `Q`, `R` and `S`."""
    t, n = jnp.zeros((), x.dtype), x.shape[0]
    y = dynamics.observe(t, x)

    def charged(z):
        # Gauss-Newton: without the curvature of the sensor, which could make the cost
        # concave.
        y_here = y + jax.jvp(lambda x: dynamics.observe(t, x), (x,), (z[:n],))[1]
        return cost(t, y_here, u + z[n:])

    H = jax.hessian(charged)(jnp.zeros(n + u.shape[0], x.dtype)) / 2
    return H, (H[:n, :n], H[n:, n:], H[:n, n:])


def _weights(dynamics, cost, x, u, where):
    """The curvature of the cost as weights of a regulator, or an error."""
    H, (Q, R, S) = _curvature(dynamics, cost, x, u)
    if is_concrete(H):
        H = np.asarray(H, float)
        # The rounding of a Hessian in float32.
        slack = 1e-6 * np.max(np.abs(H), initial=0)
        curved = np.all(np.linalg.eigvalsh(H) >= -slack)
        if not (curved and np.all(np.linalg.eigvalsh(np.asarray(R)) > slack)):
            raise ValueError(
                f"{where}: base must be given, because the cost is not convex, and "
                "strictly convex in u, at the operating point."
            )
    return Q, R, S
