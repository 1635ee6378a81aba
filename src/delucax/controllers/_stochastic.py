"""Stochastic policies whose mean or logits another controller gives."""

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
    """A policy whose distribution is a function of what `base` gives."""

    base: eqx.AbstractVar[AbstractController]

    def init(self, *, key: PRNGKey | None = None) -> PyTree:
        key, base_key = jr.split(check_key(key, f"{type(self).__name__}.init"))
        return _State(self.base.init(key=base_key), key)

    def applied(self, u: Array, cost: Array, state: PyTree) -> PyTree:
        return state._replace(base=self.base.applied(u, cost, state.base))

    @property
    def has_memory(self) -> bool:
        """Whether `base` has a state, on which the distribution depends."""
        start = lambda: eqx.filter(initial_state(self.base, jr.key(0)), eqx.is_array)
        return bool(jax.tree.leaves(jax.eval_shape(start)))


class Gaussian(_AroundBase):
    r"""Independent normal controls around those of another controller,

    `u = clip(mean + std e, low, high)`, `e ~ N(0, I)`,

    with `mean` the control of `base`, which alone is the deterministic evaluation:
    `gaussian.base`. The draw is differentiable as it is written, so that analytic
    gradients pass through it with the noise held fixed.

    The log-probability is that of the control which comes out: its normal density
    between the bounds, and at a bound the probability of all that is clipped to it.
    Given the bounds of the environment, it therefore is the log-probability of the
    controls that a [`delucax.Trajectory`][] records, and that of a run follows from its
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
        trajectory = dlx.rollout(env, policy, key=jax.random.key(0), x0=[0.1, 0.0])
        policy.total_log_prob(trajectory)
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
                f"Gaussian: log_std must be a number or have shape {mean.shape}, as "
                f"the controls of its base have, got shape {self.log_std.shape}."
            )
        return mean, base

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        mean, base = self._mean(t, y, state)
        key, now = jr.split(state.key)
        u = mean + jnp.exp(self.log_std) * jr.normal(now, mean.shape, mean.dtype)
        u = u if self.bounds is None else clip(u, *self.bounds)
        return u.astype(mean.dtype), _State(base, key)

    def log_prob(self, t: RealScalar, y: Array, state: PyTree, u: Array) -> Array:
        """The log-probability with which `__call__(t, y, state)` gives `u`.

        **Arguments:** `t`, `y`, `state`: as of a call. `u`: a control, shape `(m,)`;
            beyond the bounds it counts as clipped to them.

        **Returns:** a scalar: a density over the controls that are between their
        bounds, a probability over those that are at one.
        """
        mean, _ = self._mean(t, y, state)
        return self._log_prob(mean, u)

    def entropy(self, t: RealScalar, y: Array, state: PyTree) -> Array:
        """The entropy of the normal draw, before the bounds,

        `sum_i log std_i + log(2 pi e) / 2`.

        **Arguments:** `t`, `y`, `state`: as of a call.

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
            # The double-where trick: an infinite bound has a NaN gradient even where
            # `jnp.where` does not choose it.
            near_low = jnp.where(jnp.isinf(low), 0, low)
            near_high = jnp.where(jnp.isinf(high), 0, high)
            # P(mean + std e >= high) = Phi((mean - high) / std), in logarithms, which
            # do not underflow far out in the tail.
            below = (near_low - mean) / std
            above = (mean - near_high) / std
            # A clipped draw has an atom at each bound (Fujita and Maeda, 2018).
            each = jnp.where(u >= high, log_ndtr(above), each)
            each = jnp.where(u <= low, log_ndtr(below), each)
        return jnp.sum(each).astype(mean.dtype)

    def total_log_prob(self, trajectory: Trajectory) -> Array:
        """The log-probability of the controls of a recorded run,

        `sum over k < length of log p(u_k | t_k, y_k, s_k)`.

        The record is data: it is held fixed when this is differentiated with respect to
        the weights, while the state of `base` is recomputed and keeps its gradient.
        A stochastic `base` is not supported: it would draw anew.

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
        # Steps after termination are padding.
        alive = jnp.arange(trajectory.steps) < trajectory.length
        return jnp.sum(jnp.where(alive, scores, 0))


class Categorical(_AroundBase):
    r"""One of several controls, drawn with the probabilities that a base gives,

    `u = actions[i]` with probability `softmax(base(t, y))[i]`.

    The draw has no derivative: it is trained by its log-probability
    ([`delucax.training.LikelihoodRatio`][], [`delucax.training.PPO`][]).

    **Arguments:**

    - `base`: a controller whose outputs are the logits, one per action; such as a
        [`delucax.controllers.MLP`][].
    - `actions`: the table, shape `(actions, m)`, such as `env.actions`.

    **Raises:** `ValueError` if `base` is not a controller or `actions` no matrix; when
    it is run, if there is no key or the base gives another number of logits.

    Source: Williams, 1992.

    !!! example

        ```python
        import delucax as dlx
        import jax

        env = dlx.make("pendulum")
        logits = dlx.controllers.MLP(2, 3, width=8, depth=1, key=jax.random.key(0))
        policy = dlx.controllers.Categorical(logits, [[-2.0], [0.0], [2.0]])
        dlx.rollout(
            env, policy, key=jax.random.key(1), horizon=10, x0=[0.1, 0.0]
        ).controls
        ```
    """

    base: AbstractController
    actions: Float[Array, "actions m"] = parameter()

    def __check_init__(self):
        check_controller(self.base, "base", "Categorical")
        as_matrix(self.actions, "actions", "Categorical")

    @property
    def greedy(self) -> AbstractController:
        """The deterministic controller that gives the likeliest of the controls."""
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
        """The log-probability with which `__call__(t, y, state)` gives `u`.

        **Arguments:** `t`, `y`, `state`: as of a call. `u`: a control, shape `(m,)`; it
            counts as the nearest one of the table.

        **Returns:** a scalar.
        """
        logits, _ = self._logits(t, y, state)
        # Controls of a record may be rounded: the nearest row is the one that was
        # drawn.
        away = jnp.sum((lax.stop_gradient(self.actions) - u) ** 2, axis=1)
        return logits[jnp.argmin(away)]

    def entropy(self, t: RealScalar, y: Array, state: PyTree) -> Array:
        """The entropy of the draw, `-sum_i p_i log p_i`.

        **Arguments:** `t`, `y`, `state`: as of a call.

        **Returns:** a scalar.
        """
        logits, _ = self._logits(t, y, state)
        return -jnp.sum(jnp.exp(logits) * logits)


class _Greedy(AbstractController):
    """The control that a `Categorical` gives most often."""

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
