"""An online learner that observes only the cost."""

import functools
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
import optax
from jaxtyping import Array, ArrayLike, Float, PyTree

from ..._check import check_count, check_instance, check_key, check_step
from ..._controller import AbstractController, Tally
from ..._module import parameter
from ..._typing import PRNGKey, Real, RealScalar
from ...dynamics import AbstractDynamics
from ...math._norms import safe_norm
from ._closed_loop import ClosedLoop, ClosedLoopState, in_first_responses, shift
from ._learner import DEFAULT_RADIUS
from ._optimisers import adagrad_norm, projected_step
from ._policy import LinearPolicy


class BPCState(NamedTuple):
    """The state of a `BPC`.

    - `loop`: the state of the plant and the base controller.
    - `theta`: what has been learned. `optimiser`: the state of the optimiser.
    - `tried`: the last unit directions in which theta was moved, newest first.
    - `level`: the mean of the costs so far. `steps`: their number.
    - `key`: the random key of the next direction.
    - `refused`: the number of updates that were refused, because they were not finite.
    """

    loop: ClosedLoopState
    theta: Float[Array, "m f"]
    optimiser: PyTree
    tried: Float[Array, "window m f"]
    level: Float[Array, ""]
    steps: Float[Array, ""]
    key: PRNGKey
    refused: Tally


class BPC(AbstractController):
    r"""The bandit perturbation controller, which learns from observed costs alone.

    $$u_t = \mathrm{base}(y_t) + (\theta_t + \delta e_t)\, s_t$$

    The direction $e_t$ is uniform on the unit sphere. The signal $s_t$ consists of the
    last `memory` disturbances, or of nature's outputs if the state is not observed.
    After each step, theta moves against

    $$g_t = \frac{d}{\delta} (c_t - \bar c_t) \sum_{i < \mathrm{horizon}} e_{t-i}$$

    The vector $g_t$ estimates the gradient of the cost with respect to theta, as if
    theta had been constant in the past. Here $d$ is the number of entries of theta, and
    $\bar c_t$ is the mean of the previous costs. Subtracting this mean reduces the
    variance of the estimate, and does not change its expectation. The regret grows as
    $T^{3/4}$.

    **Arguments:**

    - `dynamics`: the model, from which the disturbances are computed.
    - `base`: a controller that stabilises the dynamics, such as an
        [`delucax.controllers.LQR`][].
    - `memory`: the number of past values of the signal, 5 by default. A longer memory
        gives theta more entries, so the search has more dimensions.
    - `horizon`: the number of past directions $e_{t-i}$ in the gradient estimate, 5 by
        default.
    - `delta`: $\delta$, the size of the random perturbation of theta. By default it is
        0.2 divided by the norm of the first nonzero response of the observation to a
        unit impulse of the control.
    - `learning_rate`: the scale of the optimiser's step; by default 0.05 divided by the
        same norm as for `delta`.
    - `optimiser`: an Optax transformation; [`delucax.controllers.adagrad_norm`][] by
        default.
    - `radius`: the largest Frobenius norm of theta; by default 50 divided by the same
        norm as for `delta`.

    **Attributes:** `policy.start`, the initial theta, trainable; zero at first.

    **Raises:** `ValueError` if `base` does not stabilise the dynamics or does not fit
    them, or a number is out of its range; at run time, if there is no random key.

    Source: Gradu, Hallman and Hazan, 2020.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        A, B = jnp.array([[0.8, 0.5], [0.0, 0.8]]), jnp.array([[0.0], [0.8]])
        push = dlx.disturbances.Sinusoid(jnp.full(2, 0.3), frequency=0.16)
        env = dlx.make("lds", A=A, B=B, disturbance=push)
        base = dlx.controllers.LQR(env.dynamics, jnp.eye(2), jnp.eye(1))
        learner = dlx.controllers.BPC(env.dynamics, base)
        dlx.rollout(env, learner, key=jax.random.key(0), horizon=1000).total_cost
        ```

        ```text
        Array(230., dtype=float32)
        ```
    """

    loop: ClosedLoop
    policy: LinearPolicy
    delta: Real = parameter()
    learning_rate: Real = parameter()
    optimiser: optax.GradientTransformation = eqx.field(static=True)
    window: int = eqx.field(static=True)

    def __init__(
        self,
        dynamics: AbstractDynamics,
        base: AbstractController,
        *,
        memory: int = 5,
        horizon: int = 5,
        delta: ArrayLike | None = None,
        learning_rate: ArrayLike | None = None,
        optimiser: optax.GradientTransformation | None = None,
        radius: ArrayLike | None = None,
    ):
        where = "BPC"
        check_instance(dynamics, AbstractDynamics, "dynamics", where)
        memory = check_count(memory, "memory", where)
        # After `state_size` steps, a control can have reached any state.
        loop = ClosedLoop(dynamics, base, dynamics.state_size, where, memory=memory)
        scale = functools.partial(in_first_responses, loop, where)
        start = jnp.zeros((dynamics.control_size, loop.feature_size), loop.dtype)
        self.loop = loop
        self.policy = LinearPolicy(start, scale(radius, "radius", DEFAULT_RADIUS))
        self.delta = scale(delta, "delta", 0.2)
        self.learning_rate = scale(learning_rate, "learning_rate", 0.05)
        self.optimiser = adagrad_norm() if optimiser is None else optimiser
        self.window = check_count(horizon, "horizon", where)

    def __check_init__(self):
        check_step(self.delta, "BPC", "delta")
        check_step(self.learning_rate, "BPC", "learning_rate")

    @property
    def learns_from_cost(self) -> bool:
        """True: the controller learns from the cost alone."""
        return True

    def init(self, *, key: PRNGKey | None = None) -> PyTree:
        own, base_key = jr.split(check_key(key, "BPC.init"))
        theta, dtype = self.policy.init(), self.loop.dtype
        return BPCState(
            self.loop.init(base_key, 0),
            theta=theta,
            optimiser=self.optimiser.init(theta),
            tried=jnp.zeros((self.window, *theta.shape), dtype),
            level=jnp.zeros((), dtype),
            steps=jnp.zeros((), dtype),
            key=own,
            refused=Tally("refused_update"),
        )

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        key, now = jr.split(state.key)
        direction = jr.normal(now, state.theta.shape, self.loop.dtype)
        # A normal vector divided by its length is uniform on the sphere (Muller, 1959).
        direction = direction / safe_norm(direction, axis=None)
        theta = state.theta + self.delta * direction
        policy = lambda features: self.policy(theta, features)
        _, v, loop = self.loop.act(self, t, y, state.loop, policy)
        tried = shift(direction, state.tried)
        state = state._replace(loop=loop, tried=tried, key=key)
        return (loop.u_base + v).astype(y.dtype), state

    def applied(self, u: Array, cost: Array, state: PyTree) -> PyTree:
        cost = cost.astype(state.level.dtype)
        # A cost that is not finite gives no update, and is forgotten.
        finite = jnp.isfinite(cost)
        steps = state.steps + finite
        # There is no mean to compare the first cost with.
        off = jnp.where(state.steps > 0, cost - state.level, 0)
        size = state.theta.size
        # The one-point estimate of Flaxman, Kalai and McMahan (2005): the mean of
        # (d / delta) c(theta + delta e) e over the sphere is the gradient of c smoothed
        # over the ball. The cost depends on all directions of the last steps.
        gradient = size / self.delta * off * jnp.sum(state.tried, axis=0)
        return projected_step(self, gradient.astype(state.theta.dtype), state)._replace(
            loop=self.loop.applied(u, cost, state.loop),
            level=jnp.where(
                finite, state.level + (cost - state.level) / steps, state.level
            ),
            steps=steps.astype(state.steps.dtype),
        )
