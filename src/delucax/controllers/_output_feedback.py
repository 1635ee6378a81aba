"""State feedback on the estimate of an estimator."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import ArrayLike, Float, PyTree

from .._check import check_instance
from .._controller import AbstractController, check_controller, Tally
from .._jax import host_unless_traced, xp
from .._module import as_float_array, parameter
from .._results import RESULTS
from .._typing import Array, Difference, Numbers, PRNGKey, RealScalar
from ..dynamics import LinearDynamics
from ..estimators import AbstractEstimator, KalmanFilter
from ._lqr import LQR


class _State(NamedTuple):
    controller: PyTree
    estimator: PyTree
    time: Array
    failures: Tally


class OutputFeedback(AbstractController):
    """A state-feedback controller that acts on an estimate of the state.

    At each step the estimator updates its estimate with the observation, and the
    controller acts on the mean of the estimate. Then the estimator predicts the next
    state with the control that was applied, after clipping.

    In a rollout, `incidents["failed_estimate"]` is true at the steps at which the
    `status` of the estimator is not successful.

    **Arguments:**

    - `controller`: a controller that observes the state.
    - `estimator`: the estimator of the state, such as a
        [`delucax.estimators.KalmanFilter`][].

    **Raises:** `ValueError` if `controller` or `estimator` has the wrong type.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        env = dlx.make("pendulum")
        noise = dlx.disturbances.Gaussian(0.1, size=2)
        env = dlx.replace(env, {"sensor_noise": noise})
        regulator = dlx.controllers.LQR(
            dlx.linearize(env.dynamics), jnp.eye(2), jnp.eye(1)
        )
        ekf = dlx.estimators.ExtendedKalmanFilter(
            env.dynamics, 1e-6 * jnp.eye(2), 1e-2 * jnp.eye(2)
        )
        controller = dlx.controllers.OutputFeedback(regulator, ekf)
        dlx.rollout(env, controller, key=jax.random.key(0), x0=[0.1, 0.0]).total_cost
        ```

        ```text
        Array(0.502, dtype=float32)
        ```
    """

    controller: AbstractController
    estimator: AbstractEstimator

    def __check_init__(self):
        check_controller(self.controller, "controller", "OutputFeedback")
        check_instance(self.estimator, AbstractEstimator, "estimator", "OutputFeedback")

    def init(self, *, key: PRNGKey | None = None) -> PyTree:
        keys = (None, None) if key is None else jax.random.split(key)
        state = self.estimator.init(key=keys[1])
        # The prediction needs the time, which `applied` does not get.
        time = jnp.zeros((), self.estimator.estimate(state).mean.dtype)
        memory = self.controller.init(key=keys[0])
        return _State(memory, state, time, Tally("failed_estimate"))

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        after = self.estimator.update(t, y, state.estimator)
        mean = self.estimator.estimate(after).mean.astype(y.dtype)
        u, memory = self.controller(t, mean, state.controller)
        time = jnp.asarray(t, state.time.dtype)
        return u, _State(memory, after, time, self._counted(after, state))

    def applied(self, u: Array, cost: Array, state: PyTree) -> PyTree:
        memory = self.controller.applied(u, cost, state.controller)
        after = self.estimator.predict(state.time, u, state.estimator)
        return _State(memory, after, state.time, self._counted(after, state))

    def _counted(self, after: PyTree, state: _State) -> Tally:
        return state.failures.add(self.estimator.status(after) != RESULTS.successful)


class LQG(AbstractController):
    r"""The linear-quadratic-Gaussian regulator: LQR on a Kalman filter's estimate.

    $$u = u_\mathrm{ref} - K (\hat x - x_\mathrm{ref})$$

    Here $\hat x$ is the filtered estimate, which includes the current observation. The
    filter predicts the next state with the control that was applied, after clipping.

    For the plant

    $$x_{k+1} = A x_k + B u_k + E w_k, \qquad y_k = C x_k + v_k, \qquad
    w_k \sim N(0, W), \quad v_k \sim N(0, V)$$

    no other controller that acts on the observations has a lower average cost, where
    the cost per step is

    $$\delta x^\top Q\, \delta x + 2\, \delta x^\top S\, \delta u +
    \delta u^\top R\, \delta u$$

    and $\delta x$ and $\delta u$ are the deviations from the operating point. The
    average is

    $$\operatorname{tr}(P E W E^\top) +
    \operatorname{tr}(K^\top (R + B^\top P B) K \Sigma)$$

    Here $P$ is the solution of the regulator's Riccati equation, and $\Sigma$ is the
    covariance of the filtered estimate.

    **Arguments:**

    - `dynamics`: time-invariant linear dynamics whose operating point is an
        equilibrium, for example from [`delucax.linearize`][].
    - `Q`: state weight, shape `(n, n)`, symmetric.
    - `R`: control weight, shape `(m, m)`, symmetric.
    - `W`: covariance of the disturbance, shape `(k, k)`.
    - `V`: covariance of the sensor noise, shape `(p, p)`.
    - `S`: cross weight, shape `(n, m)`; zero by default.
    - `mean`: mean of the first state, shape `(n,)`; `x_ref` by default.
    - `covariance`: covariance of the first state, before the first observation, shape
        `(n, n)`; the identity by default. Only without `steady_state`.
    - `steady_state`: use the steady-state gain of the filter at all times; true by
        default.
    - `y_ref`: the observation at the operating point, shape `(p,)`; `C x_ref` by
        default.
    - `difference`: a function `(x, x_ref) -> deviation` that replaces the subtraction
        of states in the regulator, for example to wrap angles. The filter predicts with
        the linear model, which does not wrap angles. So each angle should begin less
        than half a turn from the operating point.
    - `observation_difference`: the same for observations.

    **Attributes:** `regulator`, a [`delucax.controllers.LQR`][], with `K` and `P`;
    `estimator`, a [`delucax.estimators.KalmanFilter`][], with `L`; `average_cost`, the
    average cost per step in the steady state, a scalar (`None` without `steady_state`).

    **Raises:** `ValueError` for the same reasons as [`delucax.controllers.LQR`][] and
    [`delucax.estimators.KalmanFilter`][]; an error at run time if there is no
    stabilising gain or the filter has no steady state.

    Source: Åström, 1970.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        A, B = jnp.array([[1.0, 1.0], [0.0, 1.0]]), jnp.array([[0.0], [1.0]])
        env = dlx.make(
            "lds",
            A=A,
            B=B,
            C=jnp.array([[1.0, 0.0]]),
            disturbance=dlx.disturbances.Gaussian(0.1, size=2),
            sensor_noise=dlx.disturbances.Gaussian(0.5, size=1),
        )
        lqg = dlx.controllers.LQG(
            env.dynamics, jnp.eye(2), jnp.eye(1), 0.01 * jnp.eye(2), 0.25 * jnp.eye(1)
        )
        trajectory = dlx.rollout(env, lqg, key=jax.random.key(0))
        trajectory.total_cost / 200, lqg.average_cost
        ```

        ```text
        (Array(0.662, dtype=float32), Array(0.704, dtype=float32))
        ```
    """

    regulator: LQR
    estimator: KalmanFilter
    average_cost: Float[Array, ""] | None = parameter()

    def __init__(
        self,
        dynamics: LinearDynamics,
        Q: Numbers,
        R: Numbers,
        W: Numbers,
        V: Numbers,
        S: Numbers | None = None,
        *,
        mean: ArrayLike | None = None,
        covariance: ArrayLike | None = None,
        steady_state: bool = True,
        y_ref: Numbers | None = None,
        difference: Difference | None = None,
        observation_difference: Difference | None = None,
    ):
        plant: Any = dynamics
        if isinstance(dynamics, LinearDynamics) and dynamics.C is not None:
            # LQR accepts only an observed state; here the filter provides the state.
            plant = eqx.tree_at(lambda d: d.C, dynamics, None)
        self.regulator = LQR(plant, Q, R, S, difference=difference)
        start: Any = dict(mean=mean, covariance=covariance, steady_state=steady_state)
        sensor: Any = dict(y_ref=y_ref, observation_difference=observation_difference)
        self.estimator = KalmanFilter(dynamics, W, V, **start, **sensor)
        self.average_cost = None
        if self.estimator.updated_covariance is not None:
            designed = self.regulator, self.estimator
            self.average_cost = _average_cost(*designed, as_float_array(R))

    def __check_init__(self):
        check_instance(self.regulator, LQR, "regulator", "LQG")
        check_instance(self.estimator, KalmanFilter, "estimator", "LQG")
        dynamics = self.estimator.dynamics
        shape = dynamics.control_size, dynamics.state_size
        if self.regulator.K.shape != shape:
            raise ValueError(
                f"LQG: regulator.K must have shape {shape} to fit the dynamics of "
                f"the estimator, got {self.regulator.K.shape}."
            )

    @property
    def _feedback(self) -> OutputFeedback:
        return OutputFeedback(self.regulator, self.estimator)

    def init(self, *, key: PRNGKey | None = None) -> PyTree:
        return self._feedback.init(key=key)

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        return self._feedback(t, y, state)

    def applied(self, u: Array, cost: Array, state: PyTree) -> PyTree:
        return self._feedback.applied(u, cost, state)


@host_unless_traced
def _average_cost(regulator: LQR, estimator: KalmanFilter, R: Array) -> Array:
    """The average cost per step of the LQG regulator in the steady state."""
    K, P, dynamics = regulator.K, regulator.P, estimator.dynamics
    # Separation principle: the first term is the cost if the state is known, the
    # second is the cost of the control -K (mean - x) due to the estimation error.
    weight = K.T @ (R + dynamics.B.T @ P @ dynamics.B) @ K
    error: Any = estimator.updated_covariance
    return xp.trace(P @ estimator._noise(dynamics)) + xp.trace(weight @ error)
