"""State feedback that acts on an estimate."""

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
    """Any controller of the state, run on an estimate of it.

    At each step the estimator takes in the observation, the controller acts on the mean
    of its estimate, and the estimator predicts with the control that was really
    applied, after saturation. Steps at which its `status` is no success are
    `incidents["failed_estimate"]` of a rollout.

    **Arguments:**

    - `controller`: a controller that reads the state.
    - `estimator`: what estimates it, such as a [`delucax.estimators.KalmanFilter`][].

    **Raises:** `ValueError` if either is of the wrong kind.

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
    """

    controller: AbstractController
    estimator: AbstractEstimator

    def __check_init__(self):
        check_controller(self.controller, "controller", "OutputFeedback")
        check_instance(self.estimator, AbstractEstimator, "estimator", "OutputFeedback")

    def init(self, *, key: PRNGKey | None = None) -> PyTree:
        keys = (None, None) if key is None else jax.random.split(key)
        state = self.estimator.init(key=keys[1])
        # `applied` is not given the time, but the prediction needs it.
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
    r"""The linear-quadratic regulator on the state that a Kalman filter estimates,

    `u = u_ref - K (mean - x_ref)`,

    `mean` being the filtered estimate, the current observation included; the prediction
    takes the saturated control. Of all controllers that see `y = C x + v`,
    `v ~ N(0, V)`, of `x_next = A x + B u + E w`, `w ~ N(0, W)`, it has the least
    average cost `dx'Q dx + 2 dx'S du + du'R du`:

    `trace(P E W E') + trace(K' (R + B'PB) K Sigma)`,

    `P` being the solution of the regulator's Riccati equation and `Sigma` the
    covariance of the estimate.

    **Arguments:**

    - `dynamics`: time-invariant linear dynamics whose operating point is an
        equilibrium; of [`delucax.linearize`][], for example.
    - `Q`: state weight, shape `(n, n)`, symmetric.
    - `R`: control weight, shape `(m, m)`, symmetric.
    - `W`: covariance of the disturbance that the dynamics take, shape `(k, k)`.
    - `V`: covariance of the sensor noise, shape `(p, p)`.
    - `S`: cross weight, shape `(n, m)`; zero by default.
    - `mean`: of the first state, shape `(n,)`; `x_ref` by default.
    - `covariance`: of the first state before it is observed, shape `(n, n)`; only
        without `steady_state`, and then the identity by default.
    - `steady_state`: use the filter's gain of the steady state at all times; true by
        default.
    - `y_ref`: what is observed at the operating point, shape `(p,)`; `C x_ref` by
        default.
    - `difference`: `(x, x_ref) -> deviation`, which wraps angles of the state;
        subtraction by default.
    - `observation_difference`: likewise for observations.

    **Attributes:** `regulator`, a [`delucax.controllers.LQR`][], with `K` and `P`;
    `estimator`, a [`delucax.estimators.KalmanFilter`][], with `L`; `average_cost`, a
    scalar, of the steady state (`None` without it).

    **Raises:** `ValueError` as those two do; an error at run time if there is no
    stabilising gain or no steady state of the filter.

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
            # LQR takes dynamics that observe their state; here the filter supplies it.
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
                f"LQG: regulator.K must have shape {shape}, as the dynamics of "
                f"estimator need, got {self.regulator.K.shape}."
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
    """The cost of a step of the linear-quadratic-Gaussian regulator on average."""
    K, P, dynamics = regulator.K, regulator.P, estimator.dynamics
    # Separation: the first term is the cost with the state known, the second that of
    # the control du = -K (mean - x) which acts on the error of the estimate.
    weight = K.T @ (R + dynamics.B.T @ P @ dynamics.B) @ K
    error: Any = estimator.updated_covariance
    return xp.trace(P @ estimator._noise(dynamics)) + xp.trace(weight @ error)
