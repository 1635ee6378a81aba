"""Stochastic policies around a controller that gives their mean or logits."""

from dataclasses import KW_ONLY
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.random as jr
from jax.scipy.special import log_ndtr
from jaxtyping import Array, Float, PyTree

from .._check import (
    as_bounds,
    as_entries,
    as_matrix,
    bounds_field,
    check_instance,
    check_key,
)
from .._controller import (
    AbstractController,
    AbstractStochasticPolicy,
    check_controller,
    initial_state,
    replay,
)
from .._module import parameter, weight
from .._typing import PRNGKey, Real, RealScalar
from ..math import clip
from ..simulation import Trajectory


class _State(NamedTuple):
    base: PyTree
    key: PRNGKey


class _AroundBase(AbstractStochasticPolicy):
    """A policy whose distribution is a function of the output of `base`."""

    base: eqx.AbstractVar[AbstractController]

    def init(self, *, key: PRNGKey | None = None) -> PyTree:
        key, base_key = jr.split(check_key(key, f"{type(self).__name__}.init"))
        return _State(self.base.init(key=base_key), key)

    def applied(self, u: Array, cost: Array, state: PyTree) -> PyTree:
        return state._replace(base=self.base.applied(u, cost, state.base))

    @property
    def has_memory(self) -> bool:
        """Whether the distribution depends on `state`, because `base` has one."""
        start = lambda: eqx.filter(initial_state(self.base, jr.key(0)), eqx.is_array)
        return bool(jax.tree.leaves(jax.eval_shape(start)))


class Gaussian(_AroundBase):
    r"""A policy that adds Gaussian noise to the control of another controller.

    $$u = \operatorname{clip}(\mu + \sigma e, \mathrm{low}, \mathrm{high}), \qquad
    e \sim N(0, I)$$

    The mean $\mu$ is the control of `base`. For a deterministic evaluation use
    `gaussian.base`. You can differentiate the drawn control with respect to $\mu$ and
    $\sigma$, with the noise $e$ held fixed.

    The log-probability is that of the control after clipping. Between the bounds, the
    log-probability is the log of the normal density. At a bound, it is the log of the
    probability of all draws that are clipped to that bound. So if you pass the bounds
    of the environment, `log_prob` gives the log-probability of the controls that a
    [`delucax.Trajectory`][] records.

    **Arguments:**

    - `base`: the controller whose control is the mean.
    - `log_std`: $\log \sigma$, a number or a vector with an entry for each control;
        trainable.
    - `bounds`: `(low, high)`, each a number or a vector, such as `env.control_bounds`;
        none by default.

    **Raises:** `ValueError` if `base` is not a controller or the sizes of the arguments
    do not fit each other; at run time, if there is no random key.

    Source: Williams, 1992; Fujita and Maeda, 2018 (clipped controls).

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        env = dlx.make("pendulum")
        mean = dlx.controllers.Linear(jnp.array([[20.0, 5.0]]))
        policy = dlx.controllers.Gaussian(mean, -1.0, bounds=env.control_bounds)
        trajectory = dlx.rollout(env, policy, key=jax.random.key(0), x0=[0.1, 0.0])
        policy.total_log_prob(trajectory)
        ```

        ```text
        Array(-91., dtype=float32)
        ```
    """

    base: AbstractController
    log_std: Real = weight()
    _: KW_ONLY
    bounds: tuple[Array, Array] | None = bounds_field("Gaussian", default=None)

    def __check_init__(self):
        where = "Gaussian"
        check_controller(self.base, "base", where)
        as_entries(self.log_std, None, "log_std", where, "control")
        as_bounds(self.bounds, where)

    def _mean(self, t, y, state):
        mean, base = self.base(t, y, state.base)
        if self.log_std.shape not in ((), mean.shape):
            raise ValueError(
                f"Gaussian: log_std must be a number or have shape {mean.shape}, like "
                f"the control of base, got shape {self.log_std.shape}."
            )
        return mean, base

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        mean, base = self._mean(t, y, state)
        key, now = jr.split(state.key)
        u = mean + jnp.exp(self.log_std) * jr.normal(now, mean.shape, mean.dtype)
        u = u if self.bounds is None else clip(u, *self.bounds)
        return u.astype(mean.dtype), _State(base, key)

    def log_prob(self, t: RealScalar, y: Array, state: PyTree, u: Array) -> Array:
        """The log-probability with which `__call__(t, y, state)` returns `u`.

        **Arguments:** `t`, `y`, `state`: as in a call. `u`: a control, shape `(m,)`. A
        control beyond a bound counts as a control at that bound.

        **Returns:** a scalar. It is the log of a product: a density for the controls
        between their bounds, times a probability for the controls at a bound.
        """
        mean, _ = self._mean(t, y, state)
        return self._log_prob(mean, u)

    def entropy(self, t: RealScalar, y: Array, state: PyTree) -> Array:
        r"""The entropy of the normal distribution, before clipping.

        $$\sum_i \left( \log \sigma_i + \tfrac12 \log(2 \pi e) \right)$$

        **Arguments:** `t`, `y`, `state`: as in a call.

        **Returns:** a scalar.
        """
        mean, _ = self._mean(t, y, state)
        each = jnp.broadcast_to(self.log_std, mean.shape)
        return jnp.sum(each + 0.5 * jnp.log(2 * jnp.pi * jnp.e)).astype(mean.dtype)

    def _log_prob(self, mean, u):
        std = jnp.exp(self.log_std)
        z = (u - mean) / std
        each = -0.5 * z**2 - self.log_std - 0.5 * jnp.log(2 * jnp.pi)
        if self.bounds is not None:
            low, high = self.bounds
            # Without these, an infinite bound would give NaN gradients, even if the
            # `jnp.where` below does not choose it.
            near_low = jnp.where(jnp.isinf(low), 0, low)
            near_high = jnp.where(jnp.isinf(high), 0, high)
            # P(mean + std e >= high) = Phi((mean - high) / std). Its logarithm does not
            # underflow far out in the tail.
            below = (near_low - mean) / std
            above = (mean - near_high) / std
            # A clipped draw has positive probability at a bound (Fujita and Maeda).
            each = jnp.where(u >= high, log_ndtr(above), each)
            each = jnp.where(u <= low, log_ndtr(below), each)
        return jnp.sum(each).astype(mean.dtype)

    def total_log_prob(self, trajectory: Trajectory) -> Array:
        r"""The log-probability of all controls of a recorded run.

        $$\sum_{k < \mathrm{length}} \log p(u_k \mid t_k, y_k, s_k)$$

        Derivatives with respect to the weights hold the recorded observations, controls
        and costs fixed. The state of `base` is computed again, and the gradient
        includes the derivatives of this state. A stochastic `base` is not supported,
        because it would draw other random numbers than in the run.

        **Arguments:** `trajectory`: one run of this controller, with its observations,
        controls and costs. Use `jax.vmap` for a batch. The bounds of this controller
        must be within the environment's bounds, otherwise the recorded controls are not
        the controls that this controller drew.

        **Returns:** a scalar.

        **Raises:** `ValueError` if the trajectory lacks its observations, controls or
        costs, or is a batch.
        """
        where = "Gaussian.total_log_prob"
        if trajectory.batch_shape:
            raise ValueError(
                f"{where}: trajectory must be one run (use jax.vmap over a batch), got "
                f"a batch of shape {trajectory.batch_shape}."
            )
        record: Any = (trajectory.observations, trajectory.controls, trajectory.costs)
        if any(part is None for part in record):
            raise ValueError(
                f"{where}: trajectory must keep observations, controls and costs, got "
                f"keep={trajectory.keep}."
            )
        record = lax.stop_gradient((trajectory.times[:-1], *record))

        def act(t, y, state, u):
            mean, state = self.base(t, y, state)
            return self._log_prob(mean, u), state

        scores = replay(self.base, initial_state(self.base, None), record, act)
        # Steps after termination are padding.
        alive = jnp.arange(trajectory.steps) < trajectory.length
        return jnp.sum(jnp.where(alive, scores, 0))


class Categorical(_AroundBase):
    r"""A policy that draws one of several given controls at random.

    $$P(u = a_i) = \operatorname{softmax}(\ell)_i, \qquad \ell = \mathrm{base}(t, y)$$

    The draw has no derivative. Train the policy by its log-probability, for example
    with [`delucax.training.LikelihoodRatio`][] or [`delucax.training.PPO`][].

    **Arguments:**

    - `base`: a controller that returns the logits $\ell$, one per action, such as a
        [`delucax.controllers.MLP`][].
    - `actions`: the controls $a_i$, shape `(actions, m)`, such as `env.actions`.

    **Raises:** `ValueError` if `base` is not a controller or `actions` is not a matrix;
    at run time, if there is no random key or `base` does not give one logit per action.

    Source: Williams, 1992.

    !!! example

        ```python
        import delucax as dlx
        import jax

        env = dlx.make("pendulum")
        logits = dlx.controllers.MLP(2, 3, width=8, depth=1, key=jax.random.key(0))
        policy = dlx.controllers.Categorical(logits, [[-2.0], [0.0], [2.0]])
        run = dlx.rollout(
            env, policy, key=jax.random.key(1), horizon=10, x0=[0.1, 0.0]
        )
        run.controls[:, 0]
        ```

        ```text
        Array([ 2.,  2.,  0.,  2.,  2., -2.,  0., -2.,  0., -2.], dtype=float32)
        ```
    """

    base: AbstractController
    actions: Float[Array, "actions m"] = parameter()

    def __check_init__(self):
        check_controller(self.base, "base", "Categorical")
        as_matrix(self.actions, "actions", "Categorical")

    @property
    def greedy(self) -> AbstractController:
        """The deterministic controller that takes the most likely action."""
        return _Greedy(self)

    def _logits(self, t, y, state):
        logits, base = self.base(t, y, state.base)
        if logits.shape != self.actions.shape[:1]:
            raise ValueError(
                f"Categorical: base must give a logit for each of the "
                f"{self.actions.shape[0]} actions, got shape {logits.shape}."
            )
        return jax.nn.log_softmax(logits), base

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        logits, base = self._logits(t, y, state)
        key, now = jr.split(state.key)
        u = self.actions[jr.categorical(now, logits)]
        return u.astype(y.dtype), _State(base, key)

    def log_prob(self, t: RealScalar, y: Array, state: PyTree, u: Array) -> Array:
        """The log-probability with which `__call__(t, y, state)` returns `u`.

        **Arguments:** `t`, `y`, `state`: as in a call. `u`: a control, shape `(m,)`.
        The control `u` is replaced by the nearest of the `actions`.

        **Returns:** a scalar.
        """
        logits, _ = self._logits(t, y, state)
        # The nearest, because the controls of a record may be rounded.
        away = jnp.sum((lax.stop_gradient(self.actions) - u) ** 2, axis=1)
        return logits[jnp.argmin(away)]

    def entropy(self, t: RealScalar, y: Array, state: PyTree) -> Array:
        r"""The entropy of the distribution, $-\sum_i p_i \log p_i$.

        **Arguments:** `t`, `y`, `state`: as in a call.

        **Returns:** a scalar.
        """
        logits, _ = self._logits(t, y, state)
        return -jnp.sum(jnp.exp(logits) * logits)


class _Greedy(AbstractController):
    """The most likely action of a `Categorical`."""

    policy: Categorical

    def __check_init__(self):
        check_instance(self.policy, Categorical, "policy", "greedy")

    def init(self, *, key: PRNGKey | None = None) -> PyTree:
        return self.policy.base.init(key=key)

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        logits, state = self.policy.base(t, y, state)
        return self.policy.actions[jnp.argmax(logits)].astype(y.dtype), state

    def applied(self, u: Array, cost: Array, state: PyTree) -> PyTree:
        return self.policy.base.applied(u, cost, state)
