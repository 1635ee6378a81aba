"""Kalman filters: linear, extended and unscented."""

from dataclasses import KW_ONLY
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .._check import (
    as_vector,
    check_bool,
    check_instance,
    check_number,
    check_positive,
    is_concrete,
)
from .._check_models import check_time_invariant
from .._jax import host_unless_traced, jacobian, value_and_jacobians, xp
from .._module import function_field, parameter, positive, weight
from .._results import raise_on_failure, RESULTS
from .._typing import Array, Difference, Numbers, Real
from ..dynamics import AbstractDynamics, LinearDynamics
from ..math._linear_solve import full_precision, symmetric
from ..riccati import filter_dare
from ._gaussian import (
    AbstractGaussianFilter,
    check_dynamics,
    congruence,
    Joint,
    noise_of_state,
    square_root,
)


class KalmanFilter(AbstractGaussianFilter):
    r"""The Kalman filter: the optimal estimate for linear dynamics with normal noise.

    $$x_{k+1} = x_\mathrm{next} + A (x_k - x_\mathrm{ref}) + B (u_k - u_\mathrm{ref})
    + E w_k, \quad w_k \sim N(0, W)$$

    $$y_k = y_\mathrm{ref} + C (x_k - x_\mathrm{ref}) + v_k, \quad v_k \sim N(0, V)$$

    The measurement update adds $L (y - \hat y)$ to the mean, with the gain
    $L = \Sigma C^T (C \Sigma C^T + V)^{-1}$. The measurement update changes the
    covariance from $\Sigma$ to $P = (I - L C) \Sigma (I - L C)^T + L V L^T$ (Joseph's
    form). The time update changes the covariance from $P$ to $A P A^T + E W E^T$. In
    the steady state of the filter, $\Sigma$ and $L$ are constant.
    [`delucax.riccati.filter_dare`][] computes $\Sigma$ of the steady state.

    **Arguments:**

    - `dynamics`: linear dynamics, time-invariant or time-varying.
    - `W`: covariance of the disturbance `w`, shape `(k, k)`, symmetric, semidefinite.
        If the dynamics have no `E`, the time update adds `W` itself to the covariance
        of the state.
    - `V`: covariance of the sensor noise, shape `(p, p)`, symmetric, semidefinite.
    - `mean`: mean of the first state, shape `(n,)`; `x_ref` by default.
    - `covariance`: covariance of the first state before it is observed, shape `(n, n)`,
        symmetric, semidefinite; the identity by default. Do not give `covariance`
        together with `steady_state`, which computes the covariance.
    - `steady_state`: whether to use the constant gain of the steady state from the
        first step on; false by default.
    - `y_ref`: the observation at the operating point, shape `(p,)`; `C x_ref` by
        default. Give `y_ref` if a nonlinear sensor was linearised, because its reading
        at the operating point is not `C x_ref`.
    - `observation_difference`: a function `(y, y_predicted) -> deviation`; subtraction
        by default. If some of the observations are angles, give a function that wraps
        their differences.

    **Attributes:** the arguments. If `steady_state` is true, there are also `L`, the
    constant gain, shape `(n, p)`, which is trainable, and `updated_covariance`, the
    constant covariance after the measurement update, shape `(n, n)`. Both are `None` if
    `steady_state` is false.

    **Raises:** `ValueError` if `dynamics` is not linear, a covariance is not symmetric
    and semidefinite, or the sizes of the arguments do not match. `ValueError` also if
    `steady_state` is combined with time-varying dynamics or with `covariance`. With
    `steady_state`, an error at run time if the filter has no steady state.

    Source: Kalman, 1960; Bucy and Joseph, 1968.

    !!! example

        ```python
        import delucax as dlx
        import equinox as eqx
        import jax.numpy as jnp

        A, B = jnp.array([[1.0, 1.0], [0.0, 1.0]]), jnp.array([[0.0], [1.0]])
        dynamics = dlx.LinearDynamics(A, B, C=jnp.array([[1.0, 0.0]]))
        kalman = dlx.estimators.KalmanFilter(dynamics, 0.1 * jnp.eye(2), jnp.eye(1))
        belief = eqx.filter_jit(kalman.update)(0.0, jnp.array([0.5]), kalman.init())
        belief = eqx.filter_jit(kalman.predict)(0.0, jnp.zeros(1), belief)
        belief.mean
        ```

        ```text
        Array([0.25, 0.  ], dtype=float32)
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
    observation_difference: Difference | None = function_field(of="a, b")

    def __init__(
        self,
        dynamics: LinearDynamics,
        W: Numbers,
        V: Numbers,
        *,
        mean: Numbers | None = None,
        covariance: Numbers | None = None,
        steady_state: bool = False,
        y_ref: Numbers | None = None,
        observation_difference: Difference | None = None,
    ):
        where = "KalmanFilter"
        _check_linear(dynamics)
        steady_state = check_bool(steady_state, "steady_state", where)
        self.dynamics, self.observation_difference = dynamics, observation_difference
        x_ref = dynamics.at(0.0).x_ref
        x_ref = x_ref.astype(jnp.result_type(x_ref, dynamics.A))
        given: Any = W, V, mean, covariance
        self.W, self.V, self.mean, self.covariance = given
        self.W, self.V, self.mean, self.covariance = self._model(x_ref)
        self.y_ref = self.L = self.updated_covariance = None
        if y_ref is not None:
            self.y_ref = as_vector(y_ref, self.V.shape[0], "y_ref", where)
        if not steady_state:
            return
        check_time_invariant(dynamics, "dynamics with steady_state", where)
        if covariance is not None:
            raise ValueError(
                f"{where}: covariance must not be given with steady_state, because the "
                "steady state determines it."
            )
        self.covariance, self.L, self.updated_covariance = _steady_state(
            dynamics.A, dynamics.C, dynamics.E, self.W, self.V, self.mean
        )

    def __check_init__(self):
        _check_linear(self.dynamics)
        if self.L is not None:
            named = "dynamics with steady_state"
            check_time_invariant(self.dynamics, named, "KalmanFilter")
        if self.y_ref is not None:
            size = self.dynamics.observation_size
            as_vector(self.y_ref, size, "y_ref", "KalmanFilter")

    @property
    def _C(self) -> Array:
        if self.dynamics.C is not None:
            return self.dynamics.C
        return jnp.eye(self.dynamics.state_size, dtype=self.dynamics.A.dtype)

    def _noise(self, here: LinearDynamics) -> Array:
        """The covariance that a step adds to the covariance of the state."""
        return noise_of_state(here.E, self.W)

    def _observation(self, t, belief):
        dynamics = self.dynamics
        if self.y_ref is None:
            mean = dynamics.observe(t, belief.mean)
        else:
            # y_ref + C (x - x_ref). `observe` is linear, so on a deviation it is C.
            deviation = belief.mean - dynamics.at(t).x_ref
            mean = self.y_ref + dynamics.observe(t, deviation)
        known = dict(known_gain=self.L, known_remainder=self.updated_covariance)
        return Joint(mean, None, self._C, belief.covariance, self.V, **known)

    def _transition(self, t, u, belief):
        here = self.dynamics.at(t)
        # The mean of w is zero; its covariance is the noise.
        mean, _ = here.advance(t, belief.mean, u, None)
        # In the steady state, A P A' + E W E' is Sigma again.
        known = None if self.L is None else self.covariance
        P, noise = belief.covariance, self._noise(here)
        return Joint(mean, None, here.A, P, noise, known_covariance=known)


def _check_linear(dynamics: Any) -> None:
    hint = " (ExtendedKalmanFilter and UnscentedKalmanFilter take any)"
    check_instance(dynamics, LinearDynamics, "dynamics", "KalmanFilter", hint)


@host_unless_traced
def _steady_state(A, C, E, W, V, mean) -> tuple[Array, Array, Array]:
    """The covariance before an observation, the gain, and the covariance after it."""
    C = xp.eye(len(A), dtype=A.dtype) if C is None else C
    # X is the covariance before the observation, P_{k|k-1} in textbooks. L is the gain
    # of the measurement update, not A L, the gain of the predictor.
    solution = filter_dare(A, C, noise_of_state(E, W), V, throw=False)
    what = "KalmanFilter: there is no steady state. For A' and C' in place of A and B"
    solution = raise_on_failure(solution, what, it=None, facts=solution._facts)
    covariance = symmetric(solution.X).astype(mean.dtype)
    joint = Joint(C @ mean, None, C, covariance, V)
    L = joint.gain()
    return covariance, L, joint.remainder(L)


class _AbstractNonlinearFilter(AbstractGaussianFilter):
    """A filter for any dynamics. The disturbance counts to first order."""

    def __post_init__(self):
        check_dynamics(self.dynamics, type(self).__name__)
        self.W, self.V, self.mean, self.covariance = self._model()

    def __check_init__(self):
        check_dynamics(self.dynamics, type(self).__name__)

    def _advanced(self, t, x, u, w=None):
        """The next state; NaN if the solver fails, which the caller's loop reports."""
        x_next, result = self.dynamics.advance(t, x, u, w)
        if result is RESULTS.successful:
            return x_next
        return jnp.where(result == RESULTS.successful, x_next, jnp.nan)


class ExtendedKalmanFilter(_AbstractNonlinearFilter):
    r"""The extended Kalman filter: the dynamics are linearised about the estimate.

    $$x_{k+1} = F(t_k, x_k, u_k, w_k), \quad w_k \sim N(0, W), \qquad
    y_k = h(t_k, x_k) + v_k, \quad v_k \sim N(0, V)$$

    This filter has the equations of the [`delucax.estimators.KalmanFilter`][] with
    $A = \partial F / \partial x$, $E = \partial F / \partial w$ and
    $C = \partial h / \partial x$, computed at each step by automatic differentiation.
    For linear dynamics, the extended Kalman filter is the same as the Kalman filter.

    **Arguments:**

    - `dynamics`: any dynamics. Their `observe` is the sensor $h$. Smoothers also use
        their `difference`.
    - `W`: covariance of the disturbance `w` of the dynamics, shape `(k, k)`, symmetric,
        semidefinite. If the dynamics come from a stochastic differential equation (a
        system with a `diffusion`), `w` holds the increments of the Brownian motion.
    - `V`: covariance of the sensor noise, shape `(p, p)`, symmetric, semidefinite.
    - `mean`: mean of the first state, shape `(n,)`; zero by default.
    - `covariance`: covariance of the first state before it is observed, shape `(n, n)`,
        symmetric, semidefinite; the identity by default.
    - `observation_difference`: a function `(y, y_predicted) -> deviation`; subtraction
        by default. If some of the observations are angles, give a function that wraps
        their differences. If the observation is the whole state, use
        `dynamics.difference`.

    **Raises:** `ValueError` if `dynamics` is not an `AbstractDynamics`, a covariance is
    not symmetric and semidefinite, or the sizes of the arguments do not match.

    Source: Schmidt, 1966; Jazwinski, 1970.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        pendulum = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05)
        W, V = 1e-4 * jnp.eye(2), 1e-2 * jnp.eye(2)
        ekf = dlx.estimators.ExtendedKalmanFilter(
            pendulum, W, V, observation_difference=pendulum.difference
        )

        @jax.jit
        def step(t, y, u, belief):
            return ekf.predict(t, u, ekf.update(t, y, belief))

        step(0.0, jnp.array([0.1, 0.0]), jnp.zeros(1), ekf.init()).mean
        ```

        ```text
        Array([0.1009, 0.0746], dtype=float32)
        ```
    """

    dynamics: AbstractDynamics
    W: Float[Array, "k k"] = parameter()
    V: Float[Array, "p p"] = parameter()
    _: KW_ONLY
    mean: Float[Array, " n"] = parameter(None)
    covariance: Float[Array, "n n"] = parameter(None)
    observation_difference: Difference | None = function_field(None, of="a, b")

    def _observation(self, t, belief):
        observe = lambda x: self.dynamics.observe(t, x)
        # Linearised about the prediction, the best estimate before y. An iterated
        # filter would linearise again about the updated mean (Jazwinski, 1970).
        C = jacobian(observe)(belief.mean)
        return Joint(observe(belief.mean), None, C, belief.covariance, self.V)

    def _transition(self, t, u, belief):
        # A is used for the covariance only; the mean is moved by F itself.
        # E is the derivative at w = 0, the mean of the disturbance.
        w = jnp.zeros(len(self.W), belief.mean.dtype)
        mean, (A, E) = value_and_jacobians(
            lambda x, w: self._advanced(t, x, u, w), belief.mean, w
        )
        return Joint(mean, None, A, belief.covariance, congruence(E, self.W))


class UnscentedKalmanFilter(_AbstractNonlinearFilter):
    r"""The unscented Kalman filter, which passes sigma points through the dynamics.

    $$x_{k+1} = F(t_k, x_k, u_k, w_k), \quad w_k \sim N(0, W), \qquad
    y_k = h(t_k, x_k) + v_k, \quad v_k \sim N(0, V)$$

    The $2 n + 1$ sigma points are the mean, and the mean plus and minus each column of
    $\sqrt{c}\, \mathrm{chol}(\mathrm{covariance})$, with $c = \alpha^2 (n + \kappa)$.
    After the sigma points have passed through the dynamics or the sensor, weighted sums
    of the results give the new mean and covariance. The first point, which is the mean,
    has the weight $1 - n / c$ in the sum for the mean and
    $2 - n / c - \alpha^2 + \beta$ in the sum for the covariance. Each other point has
    the weight $1 / (2 c)$ in both sums. The sigma points are computed again before each
    measurement update and before each time update.

    The effect of the disturbance is linearised: the time update adds $E W E^T$ to the
    covariance, with $E = \partial F / \partial w$ at the mean. This linearisation is
    exact if the disturbance is additive. For linear dynamics, the unscented filter
    gives the same result as the [`delucax.estimators.KalmanFilter`][].

    With the default `alpha`, `beta` and `kappa` no weight is negative, so covariances
    stay semidefinite. A small `alpha`, such as the common 1e-3, gives weights of size
    $1 / \alpha^2$ with opposite signs. Their large terms cancel in the sums, so digits
    are lost to rounding. If the variance of a state is zero, the filter treats this
    state as known, and the result has no derivative with respect to this variance.

    **Arguments:**

    - `dynamics`, `W`, `V`, `mean`, `covariance`, `observation_difference`: as for
        [`delucax.estimators.ExtendedKalmanFilter`][]. In the time update, the filter
        computes the deviations of the sigma points from each other with the
        `difference` of the dynamics.
    - `alpha`: $\alpha$, the spread of the sigma points about the mean, a positive
        number; 1 by default.
    - `beta`: $\beta$, a number that is added to the weight of the first sigma point in
        the sum for the covariance; 2 by default, which is optimal for a normal
        distribution.
    - `kappa`: $\kappa$, a second parameter of the spread of the sigma points (see $c$
        above), a number above `-n`; 0 by default.

    **Raises:** `ValueError` if `dynamics` is not an `AbstractDynamics`, a covariance is
    not symmetric and semidefinite, a number is out of its range, or the sizes of the
    arguments do not match.

    Source: Julier and Uhlmann, 1997; Wan and van der Merwe, 2000.

    !!! example

        ```python
        import delucax as dlx
        import equinox as eqx
        import jax.numpy as jnp

        dynamics = dlx.make("pendulum").dynamics
        noise, tilted = 1e-3 * jnp.eye(2), jnp.array([0.1, 0.0])
        ukf = dlx.estimators.UnscentedKalmanFilter(dynamics, noise, noise, kappa=1.0)
        eqx.filter_jit(ukf.update)(0.0, tilted, ukf.init()).mean
        ```

        ```text
        Array([0.0999, 0.    ], dtype=float32)
        ```
    """

    dynamics: AbstractDynamics
    W: Float[Array, "k k"] = parameter()
    V: Float[Array, "p p"] = parameter()
    _: KW_ONLY
    mean: Float[Array, " n"] = parameter(None)
    covariance: Float[Array, "n n"] = parameter(None)
    alpha: Real = parameter(1.0, constraint=positive)
    beta: Real = parameter(2.0)
    kappa: Real = parameter(0.0)
    observation_difference: Difference | None = function_field(None, of="a, b")

    def __check_init__(self):
        where = "UnscentedKalmanFilter"
        for name in ("alpha", "beta", "kappa"):
            check_number(getattr(self, name), name, where)
        check_positive(self.alpha, "alpha", where)
        n, kappa = self.dynamics.state_size, self.kappa
        if is_concrete(kappa) and not np.asarray(kappa) > -n:
            raise ValueError(
                f"{where}: kappa must be above -n = {-n}, where n is the size of the "
                f"state, got {kappa}."
            )

    def _observation(self, t, belief):
        observe = lambda x: self.dynamics.observe(t, x)
        return self._sampled(observe, self.observation_difference, belief, self.V)

    def _transition(self, t, u, belief):
        advance = lambda x, w=None: self._advanced(t, x, u, w)
        # E is the derivative at w = 0, the mean of the disturbance.
        w = jnp.zeros(len(self.W), belief.mean.dtype)
        noise = congruence(jacobian(lambda w: advance(belief.mean, w))(w), self.W)
        return self._sampled(advance, self.dynamics.difference, belief, noise)

    @full_precision
    def _sampled(self, function, difference, belief, noise):
        mean, (n,) = belief.mean, belief.mean.shape
        # In textbooks this is n + lambda, with lambda = alpha^2 (n + kappa) - n.
        spread = self.alpha**2 * (n + self.kappa)
        # Any square root would do. The triangular root needs no eigenvalues, whose
        # derivative is infinite if two of them are equal.
        columns = jnp.sqrt(spread) * square_root(belief.covariance)
        dx = jnp.concatenate([jnp.zeros((1, n)), columns.T, -columns.T])
        dx = dx.astype(mean.dtype)
        z = jax.vmap(function)(mean + dx)
        # Deviations from the middle point, so that angles are averaged across the wrap.
        middle = z[0]
        if difference is None:
            dz = z - middle
        else:
            dz = jax.vmap(difference, in_axes=(0, None))(z, middle)
        # 1 / (2 (n + lambda)). With it X W X' = P exactly, because each column of the
        # root counts twice.
        outer = jnp.full(2 * n, 1 / (2 * spread), mean.dtype)
        # The deviation of the middle point is 0, so its weight 1 - n / c, which is huge
        # for a small alpha, is not needed for the mean.
        shift = outer @ dz[1:]
        # This is lambda / (n + lambda) + 1 - alpha^2 + beta (Wan and van der Merwe,
        # 2000).
        inner = 2 - n / spread - self.alpha**2 + self.beta
        weights = jnp.concatenate([jnp.reshape(inner, 1).astype(mean.dtype), outer])
        # Deviations from the mean: the middle point is -shift away, so it counts here.
        return Joint(middle + shift, dx.T, (dz - shift).T, weights, noise)
