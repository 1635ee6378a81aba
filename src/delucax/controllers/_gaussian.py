"""Controls drawn from a normal distribution around another controller's."""

from typing import Any, NamedTuple

import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import jax.random as jr
from jax.scipy.special import log_ndtr
from jaxtyping import Array, Float, PyTree

from .._check import as_bounds, bounds_field, check_key
from .._controller import (
    AbstractController,
    AbstractStochasticPolicy,
    check_controller,
    has_state,
    replay,
)
from .._message import shortened
from .._module import weight
from .._typing import PRNGKey, RealScalar
from ..math import clip
from ..simulation import Trajectory


class _State(NamedTuple):
    base: PyTree
    key: PRNGKey


class Gaussian(AbstractStochasticPolicy):
    r"""Independent normal controls around those of another controller,

    `u = clip(mean + std e, low, high)`, `e ~ N(0, I)`,

    with `mean` the control of `base`, which alone is the deterministic evaluation:
    `gaussian.base`. The draw is differentiable as it is written, so that analytic
    gradients pass through it with the noise held fixed.

    The log-probability is that of the control which comes out: its normal density
    between the bounds, and at a bound the probability of all that is clipped to it.
    Given the bounds of the environment, it therefore is the log-probability of the
    controls that a [`delucax.Trajectory`][] records, and that of a run is had from its
    record, without the draws.

    **Arguments:**

    - `base`: the controller whose control is the mean.
    - `log_std`: the logarithm of the standard deviation, a number or a vector with an
        entry for each control. Trainable.
    - `bounds`: `(low, high)`, each a number or a vector, such as `env.control_bounds`;
        none by default.

    **Raises:** `ValueError` if `base` is not a controller or sizes do not fit; when it
    is run, if there is no key.

    Source: Williams, 1992; Fujita and Maeda, 2018 (clipped controls).

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        env = dlx.make("pendulum")
        mean = dlx.controllers.Linear(jnp.array([[20.0, 5.0]]))
        policy = dlx.controllers.Gaussian(mean, -1.0, bounds=env.control_bounds)
        trajectory = dlx.rollout(env, policy, key=jax.random.key(0))
        policy.total_log_prob(trajectory)
        ```
    """

    base: AbstractController
    log_std: Float[Array, "..."] = weight()
    bounds: tuple[Array, Array] | None = bounds_field("Gaussian")

    def __init__(self, base: AbstractController, log_std: Any, *, bounds: Any = None):
        self.base, self.log_std = base, log_std
        self.bounds = bounds

    def __check_init__(self):
        where = "Gaussian"
        check_controller(self.base, "base", where)
        log_std = self.log_std
        if not eqx.is_inexact_array(log_std) or log_std.ndim > 1:
            raise ValueError(
                f"{where}: log_std must be a number or a vector with an entry for each "
                f"control, got {shortened(log_std)}."
            )
        as_bounds(self.bounds, where)

    def init(self, *, key=None):
        key, base_key = jr.split(check_key(key, "Gaussian.init"))
        return _State(self.base.init(key=base_key), key)

    def _mean(self, t, y, state):
        mean, base = self.base(t, y, state.base)
        if self.log_std.shape not in ((), mean.shape):
            raise ValueError(
                f"Gaussian: log_std must be a number or have shape {mean.shape}, as "
                f"the controls of its base have, got shape {self.log_std.shape}."
            )
        return mean, base

    def __call__(self, t, y, state):
        mean, base = self._mean(t, y, state)
        key, now = jr.split(state.key)
        u = mean + jnp.exp(self.log_std) * jr.normal(now, mean.shape, mean.dtype)
        u = u if self.bounds is None else clip(u, *self.bounds)
        return u.astype(mean.dtype), _State(base, key)

    def applied(self, u, cost, state):
        return state._replace(base=self.base.applied(u, cost, state.base))

    def log_prob(self, t: RealScalar, y: Array, state: PyTree, u: Array) -> Array:
        """The log-probability with which `__call__(t, y, state)` gives `u`.

        **Arguments:**

        - `t`: time, a scalar.
        - `y`: observation, a vector.
        - `state`: the controller's state, before the call.
        - `u`: a control, shape `(m,)`; beyond the bounds it counts as clipped to them.

        **Returns:** a scalar: a density over the controls that are between their
        bounds, a probability over those that are at one.
        """
        mean, _ = self._mean(t, y, state)
        return self._log_prob(mean, u)

    @property
    def has_memory(self) -> bool:
        """Whether `base` has a state, on which the mean depends."""
        return has_state(self.base)

    def entropy(self, t: RealScalar, y: Array, state: PyTree) -> Array:
        """The entropy of the normal draw, before the bounds,

        `sum_i log std_i + log(2 pi e) / 2`.

        **Arguments:**

        - `t`: time, a scalar.
        - `y`: observation, a vector.
        - `state`: the controller's state, before the call.

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
            # Finite stand-ins for what is not reached: an infinity has no gradient,
            # even where it is not chosen.
            near_low = jnp.where(jnp.isinf(low), 0, low)
            near_high = jnp.where(jnp.isinf(high), 0, high)
            below = (near_low - mean) / std
            above = (mean - near_high) / std
            each = jnp.where(u >= high, log_ndtr(above), each)
            each = jnp.where(u <= low, log_ndtr(below), each)
        return jnp.sum(each).astype(mean.dtype)

    def total_log_prob(self, trajectory: Trajectory) -> Array:
        """The log-probability of the controls of a recorded run,

        `sum over k < length of log p(u_k | t_k, y_k, s_k)`.

        The record is data: it is held fixed when this is differentiated with respect to
        the weights, while the state of `base` is followed anew and keeps its gradient.
        So a stochastic `base` is not followed as it was.

        **Arguments:** `trajectory`: one run of this controller, with its observations,
            controls and costs; for a batch, use `jax.vmap`. The bounds of this
            controller must be within those of the environment, or what is recorded is
            not what was drawn.

        **Returns:** a scalar.

        **Raises:** `ValueError` if something was not kept, or on a batch.
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
                f"{where}: trajectory must keep observations, controls and costs; "
                "got one that was rolled out with keep= and lacks some."
            )
        record = lax.stop_gradient((trajectory.times[:-1], *record))

        def act(t, y, state, u):
            mean, state = self.base(t, y, state)
            return self._log_prob(mean, u), state

        scores = replay(self.base, self.base.init(), record, act)
        alive = jnp.arange(trajectory.steps) < trajectory.length
        return jnp.sum(jnp.where(alive, scores, 0))
