"""The cost of closed loops as a loss to train on."""

from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array

from .._check import check_count, check_key
from .._controller import AbstractController
from .._module import as_float_array
from ..environments import Environment
from ..simulation import rollout, Trajectory
from ..simulation._answer import begun
from ..simulation._horizon import as_number
from ..simulation._rollout import Checkpoint


class _ExpectedCost(eqx.Module):
    """A loss; a module rather than a closure, so that the plant is not a constant."""

    environment: Environment
    gradient_decay: Array | None
    batch: int = eqx.field(static=True)
    horizon: int = eqx.field(static=True)
    checkpoint: Checkpoint = eqx.field(static=True)
    truncate: int | None = eqx.field(static=True)

    def __call__(self, controller, key):
        check_key(key, "expected_cost")

        def total(key):
            trajectory = rollout(
                self.environment,
                controller,
                key=key,
                horizon=self.horizon,
                keep=(),
                checkpoint=self.checkpoint,
                gradient_decay=(
                    1.0 if self.gradient_decay is None else self.gradient_decay
                ),
                truncate=self.truncate,
                throw=False,
            )
            return _cost_or_nan(trajectory)

        if self.batch == 1:
            return total(key)
        return jnp.mean(jax.vmap(total)(jr.split(key, self.batch)))


def expected_cost(
    environment: Environment,
    *,
    batch: int,
    horizon: int | None = None,
    checkpoint: Checkpoint = "step",
    gradient_decay: Any = 1.0,
    truncate: int | None = None,
) -> Any:
    """The loss of a controller: its mean total cost over fresh starts.

    `loss(controller, key) = 1/B sum_i J(controller; x0_i, w_i)`, the starts,
    disturbances and noise drawn anew with each key. A rollout that diverges, or whose
    solver fails, makes the loss NaN or infinite, which [`delucax.training.fit`][]
    reports with its step.

    **Arguments:**

    - `environment`: the environment.
    - `batch`: the number B of rollouts, all at once under `jax.vmap`.
    - `horizon`: steps a rollout; the environment's own by default.
    - `checkpoint`: what the gradient stores, as in [`delucax.rollout`][]; `"step"` by
        default.
    - `gradient_decay`: damping of the gradient through time, as in
        [`delucax.rollout`][]; 1, the true gradient, by default.
    - `truncate`: steps after which the gradient is cut, as in [`delucax.rollout`][];
        never by default.

    **Returns:** a function `loss(controller, key)` to a scalar.

    **Raises:** `ValueError` if `batch`, `horizon` or `truncate` is below 1,
    `environment` is not an environment, `checkpoint` is none of the above, or
    `gradient_decay` is not a finite number.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp
        import optax

        loss = dlx.training.expected_cost(dlx.make("pendulum"), batch=16, horizon=50)
        fitted = dlx.training.fit(
            loss,
            dlx.controllers.Linear(jnp.array([[20.0, 5.0]])),
            optax.adam(0.1),
            steps=10,
            key=jax.random.key(0),
        )
        fitted.model.K, fitted.history.loss
        ```
    """
    where = "expected_cost"
    _check_environment(environment, where)
    if checkpoint not in ("step", "sqrt", None):
        raise ValueError(
            f"{where}: checkpoint must be 'step', 'sqrt' or None, got {checkpoint!r}."
        )
    decay = as_float_array(as_number(gradient_decay, "gradient_decay", where))
    is_one = isinstance(gradient_decay, int | float) and gradient_decay == 1
    return _ExpectedCost(
        environment=environment,
        gradient_decay=None if is_one else decay,
        batch=check_count(batch, "batch", where),
        horizon=check_count(
            environment.horizon if horizon is None else horizon, "horizon", where
        ),
        checkpoint=checkpoint,
        truncate=None if truncate is None else check_count(truncate, "truncate", where),
    )


class _Replayed(AbstractController):
    """A controller whose episode draws with a key known beforehand."""

    base: AbstractController
    key: Any

    def init(self, *, key=None):
        del key
        return self.base.init(key=self.key)

    def __call__(self, t, y, state):
        return self.base(t, y, state)

    def applied(self, u, cost, state):
        return self.base.applied(u, cost, state)


class _ScoredCost(eqx.Module):
    environment: Environment
    horizon: int = eqx.field(static=True)

    def __call__(self, controller, key):
        check_key(key, "scored_cost")
        if not hasattr(controller, "log_prob"):
            raise ValueError(
                "scored_cost: the controller must draw its controls and have "
                "log_prob(t, y, state, u), got "
                f"{type(controller).__name__}."
            )
        run_key, controller_key = jr.split(key)
        trajectory = rollout(
            self.environment,
            _Replayed(controller, controller_key),
            key=run_key,
            horizon=self.horizon,
            keep=("observations", "controls", "costs"),
            throw=False,
        )

        # What was drawn depends on the weights, but the score is that of the weights
        # for a draw held fixed. So the controller is run again on what it was given:
        # its memory may depend on the weights, and keeps its gradient; the
        # observations, the controls and the costs do not.
        def replay(state, inputs):
            k, t, y, applied, cost = inputs
            u, after = controller(t, y, state)
            score = controller.log_prob(t, y, state, lax.stop_gradient(u))
            after = controller.applied(applied, cost, after)
            return after, jnp.where(k < trajectory.length, score, 0)

        inputs = lax.stop_gradient(
            (
                jnp.arange(self.horizon),
                trajectory.times[:-1],
                trajectory.observations,
                trajectory.controls,
                trajectory.costs,
            )
        )
        first, static = eqx.partition(begun(controller, controller_key), eqx.is_array)

        def body(state, inputs):
            after, score = replay(eqx.combine(state, static), inputs)
            return eqx.filter(after, eqx.is_array), score

        _, scores = lax.scan(body, first, inputs)
        return _cost_or_nan(trajectory), {"log_prob": jnp.sum(scores)}


def scored_cost(environment: Environment, *, horizon: int | None = None) -> Any:
    """The loss of a controller that draws: one episode's cost, and its log-probability.

    `loss(controller, key) = (J, {"log_prob": sum_k log p(u_k | t_k, y_k, s_k)})`, with
    the observations and the drawn controls held fixed in the log-probability. It is
    what [`delucax.training.LikelihoodRatio`][] asks for; the other estimators take it
    too.

    **Arguments:**

    - `environment`: the environment.
    - `horizon`: steps; the environment's own by default.

    **Returns:** a function `loss(controller, key)` to a scalar and a dictionary. The
    controller must have a method `log_prob(t, y, state, u)`: the log-probability with
    which `controller(t, y, state)` draws `u`.

    **Raises:** `ValueError` if `horizon` is below 1 or `environment` is not an
    environment; when it is called, if the controller has no `log_prob`.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp
        from jaxtyping import Array

        class Dithered(dlx.AbstractController):
            gain: Array = dlx.weight(20.0)

            def init(self, *, key=None):
                return key

            def __call__(self, t, y, state):
                state, now = jax.random.split(state)
                return -self.gain * y[:1] + jax.random.normal(now, (1,), y.dtype), state

            def log_prob(self, t, y, state, u):
                return -0.5 * jnp.sum((u + self.gain * y[:1]) ** 2)

        loss = dlx.training.scored_cost(dlx.make("pendulum"), horizon=20)
        estimator = dlx.training.LikelihoodRatio(samples=32)
        value, gradient = estimator(loss, Dithered(), jax.random.key(0))
        ```
    """
    where = "scored_cost"
    _check_environment(environment, where)
    horizon = environment.horizon if horizon is None else horizon
    return _ScoredCost(environment, check_count(horizon, "horizon", where))


def _check_environment(environment: Any, where: str) -> None:
    if not isinstance(environment, Environment):
        raise ValueError(
            f"{where}: environment must be an Environment, got "
            f"{type(environment).__name__}."
        )


def _cost_or_nan(trajectory: Trajectory) -> Array:
    """The total cost, NaN where the run failed: a failed solve may look finite."""
    ok = ~trajectory.failed
    cost = trajectory.total_cost
    return jnp.where(ok | ~jnp.isfinite(cost), cost, jnp.nan)
