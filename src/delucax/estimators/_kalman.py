"""The Kalman filter."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._check import as_vector, check_bool, check_instance
from .._module import function_field, parameter, weight
from ..dynamics import LinearDynamics
from ..math._linear_solve import symmetric
from ..riccati import filter_dare
from ..riccati._solution import checked
from ._gaussian import AbstractGaussianFilter, gaussian_model
from ._moments import congruence, LinearJoint


class KalmanFilter(AbstractGaussianFilter):
    r"""The optimal estimate of the state of linear dynamics with normal noise,

    `x_next = x_ref_next + A (x - x_ref) + B (u - u_ref) + E w`, `w ~ N(0, W)`,
    `y = y_ref + C (x - x_ref) + v`, `v ~ N(0, V)`.

    The measurement update is `mean + L (y - y_predicted)` with the gain
    `L = Sigma C' (C Sigma C' + V)^-1`, and takes the covariance from `Sigma` to
    `(I - L C) Sigma (I - L C)' + L V L'` (Joseph's form); the time update takes it from
    `P` to `A P A' + E W E'`. In the steady state `Sigma` and `L` are constant: the
    former is that of [`delucax.riccati.filter_dare`][].

    **Arguments:**

    - `dynamics`: linear dynamics, time-invariant or time-varying.
    - `W`: covariance of the disturbance that the dynamics take, shape `(k, k)`,
        symmetric, semidefinite. It counts in the space of `w`, and `E W E'` in that of
        the state: where the dynamics have no `E`, the two are the same.
    - `V`: covariance of the sensor noise, shape `(p, p)`, symmetric, semidefinite.
    - `mean`: of the first state, shape `(n,)`; `x_ref` by default.
    - `covariance`: of the first state before it is observed, shape `(n, n)`, symmetric,
        semidefinite; the identity by default, and that of the steady state with
        `steady_state`.
    - `steady_state`: use the gain of the steady state at all times; false by default.
    - `y_ref`: what is observed at the operating point, shape `(p,)`; `C x_ref` by
        default. Needed where a nonlinear sensor was linearised, whose reading there is
        not `C x_ref`.
    - `observation_difference`: `(y, y_predicted) -> deviation`, which wraps angles
        among the observations; subtraction by default.

    **Attributes:** those above, and in the steady state `L`, the gain, trainable, shape
    `(n, p)`; `updated_covariance`, that of the state once it is observed, shape
    `(n, n)`.

    **Raises:** `ValueError` if `dynamics` is not linear, if a covariance is not one or
    sizes do not fit, or if a steady state is asked for with time-varying dynamics or a
    `covariance`; an error at run time if there is no steady state.

    Source: Kalman, 1960; Bucy and Joseph, 1968.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A, B = jnp.array([[1.0, 1.0], [0.0, 1.0]]), jnp.array([[0.0], [1.0]])
        dynamics = dlx.LinearDynamics(A, B, C=jnp.array([[1.0, 0.0]]))
        kalman = dlx.estimators.KalmanFilter(dynamics, 0.1 * jnp.eye(2), jnp.eye(1))
        belief = kalman.update(0.0, jnp.array([0.5]), kalman.init())
        belief = kalman.predict(0.0, jnp.zeros(1), belief)
        ```
    """

    dynamics: LinearDynamics
    W: Float[Array, "k k"] = parameter()
    V: Float[Array, "p p"] = parameter()
    mean: Float[Array, " n"] = parameter()
    covariance: Float[Array, "n n"] = parameter()
    y_ref: Float[Array, " p"] | None = parameter()
    L: Float[Array, "n p"] | None = weight()
    updated_covariance: Float[Array, "n n"] | None = parameter()
    observation_difference: Callable[[Array, Array], Array] | None = function_field()

    def __init__(
        self,
        dynamics: LinearDynamics,
        W: Any,
        V: Any,
        *,
        mean: Any = None,
        covariance: Any = None,
        steady_state: bool = False,
        y_ref: Any = None,
        observation_difference: Callable[[Array, Array], Array] | None = None,
    ):
        where = "KalmanFilter"
        _check_linear(dynamics)
        steady_state = check_bool(steady_state, "steady_state", where)
        self.dynamics, self.observation_difference = dynamics, observation_difference
        x_ref = dynamics.at(0.0).x_ref
        x_ref = x_ref.astype(jnp.result_type(x_ref, dynamics.A))
        self.W, self.V, self.mean, self.covariance = gaussian_model(
            dynamics, W, V, mean, covariance, x_ref, where
        )
        self.y_ref = self.L = self.updated_covariance = None
        if y_ref is not None:
            self.y_ref = as_vector(y_ref, self.V.shape[0], "y_ref", where)
        if not steady_state:
            return
        _check_time_invariant(dynamics)
        if covariance is not None:
            raise ValueError(
                f"{where}: covariance must not be given with steady_state, of which it "
                "follows."
            )
        C, noise = self._C, self._noise(dynamics)
        solution = filter_dare(dynamics.A, C, noise, self.V, throw=False)
        what = f"{where}: there is no steady state. Of A', C' in the places of A, B"
        covariance = symmetric(checked(solution, what, True).X)
        self.covariance = covariance.astype(self.mean.dtype)
        joint = LinearJoint(C @ self.mean, self.covariance, C, self.V)
        self.L = joint.gain()
        self.updated_covariance = joint.remainder(self.L)

    def __check_init__(self):
        _check_linear(self.dynamics)
        if self.L is not None:
            _check_time_invariant(self.dynamics)
        if self.y_ref is not None:
            size = self.dynamics.observation_size
            as_vector(self.y_ref, size, "y_ref", "KalmanFilter")

    @property
    def _C(self) -> Array:
        if self.dynamics.C is not None:
            return self.dynamics.C
        return jnp.eye(self.dynamics.state_size, dtype=self.dynamics.A.dtype)

    def _noise(self, here: LinearDynamics) -> Array:
        """The covariance that a step adds to that of the state."""
        return self.W if here.E is None else congruence(here.E, self.W)

    def _observation(self, t, belief):
        dynamics = self.dynamics
        if self.y_ref is None:
            mean = dynamics.observe(t, belief.mean)
        else:
            deviation = belief.mean - dynamics.at(t).x_ref
            mean = self.y_ref + dynamics.observe(t, deviation)
        return LinearJoint(
            mean,
            belief.covariance,
            self._C,
            self.V,
            known_gain=self.L,
            known_remainder=self.updated_covariance,
        )

    def _transition(self, t, u, belief):
        here = self.dynamics.at(t)
        mean, _ = here.advance(t, belief.mean, u, None)
        known = None if self.L is None else self.covariance
        P, noise = belief.covariance, self._noise(here)
        return LinearJoint(mean, P, here.A, noise, known_covariance=known)


def _check_linear(dynamics: Any) -> None:
    hint = " (ExtendedKalmanFilter and UnscentedKalmanFilter take any)"
    check_instance(dynamics, LinearDynamics, "dynamics", "KalmanFilter", hint)


def _check_time_invariant(dynamics: LinearDynamics) -> None:
    if dynamics.is_time_varying:
        raise ValueError(
            "KalmanFilter: steady_state needs time-invariant dynamics, got matrices at "
            f"{dynamics.A.shape[0]} times."
        )
