"""Kalman filters and smoothers over a record."""

from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._check import as_rows, check_finite, check_instance, check_number
from .._module import as_float_array, shown
from .._results import choose, raise_on_failure, Result, RESULTS
from ..math._linear_solve import full_precision
from ._base import Belief
from ._gaussian import AbstractGaussianFilter


class Filtered(eqx.Module):
    """The result of `run_filter`."""

    predicted: Belief
    updated: Belief
    log_likelihoods: Array
    result: Result

    __repr__ = shown

    @property
    def log_likelihood(self) -> Array:
        """The log-likelihood of the record, or of each record of a batch."""
        return jnp.sum(self.log_likelihoods, axis=-1)

    def _facts(self) -> str:
        finite = np.isfinite(self.log_likelihoods)
        return "" if finite.all() else f"At observation {finite.argmin()}."


class Smoothed(eqx.Module):
    """The result of `smooth`."""

    mean: Array
    covariance: Array
    filtered: Filtered
    result: Result

    __repr__ = shown


def run_filter(
    estimator: AbstractGaussianFilter,
    observations: Any,
    controls: Any = None,
    *,
    t0: Any = 0.0,
    throw: bool = True,
) -> Filtered:
    r"""Run a Kalman filter over recorded observations and controls.

    At step k, with $t_k = t_0 + k\, dt$, the filter makes the measurement update with
    `observations[k]`, then the time update with `controls[k]`. It also computes the
    log-likelihood of the record,

    $$\sum_k \log N(y_k - \hat y_k;\; 0,\; C \Sigma_k C^T + V).$$

    The log-likelihood is differentiable with respect to every array leaf of the
    estimator. You can therefore fit noise levels and physical parameters to a record.

    **Arguments:**

    - `estimator`: a [`delucax.estimators.KalmanFilter`][],
        [`delucax.estimators.ExtendedKalmanFilter`][] or
        [`delucax.estimators.UnscentedKalmanFilter`][].
    - `observations`: shape `(T, p)`, for example `trajectory.observations`.
    - `controls`: the controls that were applied, shape `(T, m)`; zero by default.
    - `t0`: the time of the first observation, 0 by default.
    - `throw`: whether to raise an error if a mean, a covariance or the likelihood is
        not finite; true by default. If `throw` is false, check `result`.

    **Returns:** an object with

    - `predicted`: the belief of each state before it is observed, and of the state
        after the last control; a [`delucax.estimators.Belief`][] with a leading axis of
        size `T + 1`;
    - `updated`: the belief of each state after it is observed, with a leading axis of
        size `T`;
    - `log_likelihoods`: the log-density of each observation given those before it,
        shape `(T,)`, and `log_likelihood`, their sum;
    - `result`: one of `delucax.RESULTS`. The result is `diverged` if the mean or the
        covariance of a step is not finite; all means, covariances and densities from
        this step on are NaN. The result is `ill_posed` if only the likelihood is not
        finite, because the covariance of a predicted observation is not positive
        definite.

    **Raises:** `ValueError` if an argument has the wrong type or shape or is not
    finite. An error at run time if `throw` is true and a mean, a covariance or the
    likelihood is not finite.

    Source: Kalman, 1960; Schweppe, 1965 (the likelihood).

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        dynamics = dlx.LinearDynamics(0.9 * jnp.eye(1), jnp.ones((1, 1)))
        y = jnp.sin(jnp.arange(20.0))[:, None]

        def log_likelihood(noise):
            V = jnp.exp(noise) * jnp.eye(1)
            kalman = dlx.estimators.KalmanFilter(dynamics, jnp.eye(1), V)
            return dlx.estimators.run_filter(kalman, y).log_likelihood

        jax.jit(jax.grad(log_likelihood))(0.0)
        ```

        ```text
        Array(-4.3515, dtype=float32, weak_type=True)
        ```
    """
    where = "run_filter"
    filtered = _filter(
        estimator, *_record(estimator, observations, controls, t0, where)
    )
    return raise_on_failure(filtered, where, throw, "the beliefs", filtered._facts)


def smooth(
    estimator: AbstractGaussianFilter,
    observations: Any,
    controls: Any = None,
    *,
    t0: Any = 0.0,
    throw: bool = True,
) -> Smoothed:
    r"""Estimate each state from the whole record, by the Rauch-Tung-Striebel smoother.

    The belief of the filter is $N(\mu_k, \Sigma_k)$ before the observation $y_k$ and
    $N(m_k, P_k)$ after it. The smoother goes backwards:

    $$\mathrm{mean}_k = m_k + G_k (\mathrm{mean}_{k+1} - \mu_{k+1}),$$

    $$\mathrm{covariance}_k = P_k
    + G_k (\mathrm{covariance}_{k+1} - \Sigma_{k+1}) G_k^T,$$

    where $G_k = P_k A^T \Sigma_{k+1}^{-1}$.

    The covariance is computed in a form that stays semidefinite. For a nonlinear
    filter, $P_k A^T$ is replaced by the cross-covariance of the states at steps $k$ and
    $k + 1$, which the filter computes. Covariances may be singular, for example because
    the first state is known, or because noise acts on only some of the states. If
    covariances are singular, the smoothed covariances lose digits to rounding, so
    compute in float64.

    **Arguments:**

    - `estimator`, `observations`, `controls`, `t0`, `throw`: as for
        [`delucax.estimators.run_filter`][].

    **Returns:** an object with

    - `mean`: the mean of each state given the whole record, shape `(T, n)`;
    - `covariance`: the covariance of each state, shape `(T, n, n)`;
    - `filtered`: the result of the filter, as `run_filter` returns it;
    - `result`: success, or the reason for a failure; one of `delucax.RESULTS`.

    **Raises:** as `run_filter`.

    Source: Rauch, Tung and Striebel, 1965; Sarkka, 2008 (unscented).

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        env = dlx.make("pendulum")
        zero = dlx.controllers.Zero(1)
        run = dlx.rollout(env, zero, key=jax.random.key(0), x0=[0.1, 0.0])
        ekf = dlx.estimators.ExtendedKalmanFilter(
            env.dynamics, 1e-6 * jnp.eye(2), 1e-2 * jnp.eye(2)
        )
        dlx.estimators.smooth(ekf, run.observations, run.controls).mean[0]
        ```

        ```text
        Array([0.09998, 0.00007], dtype=float32)
        ```
    """
    where = "smooth"
    smoothed = _smooth(
        estimator, *_record(estimator, observations, controls, t0, where)
    )
    facts = smoothed.filtered._facts
    return raise_on_failure(smoothed, where, throw, "the beliefs", facts)


def _record(estimator, observations, controls, t0, where):
    """The observations, controls and times, checked."""
    hint = ": a KalmanFilter, ExtendedKalmanFilter or UnscentedKalmanFilter"
    check_instance(estimator, AbstractGaussianFilter, "estimator", where, hint)
    m = estimator.dynamics.control_size
    y = as_rows(observations, estimator.V.shape[0], "observations", where)
    check_finite(y, "observations", where)
    u = jnp.zeros((len(y), m), y.dtype)
    if controls is not None:
        u = as_rows(controls, m, "controls", where, len(y))
    check_finite(u, "controls", where)
    check_number(t0, "t0", where)
    # A product, because the rounding of a running sum would grow along the record.
    times = as_float_array(t0) + jnp.arange(len(y)) * estimator.dynamics.dt
    return y, u, times.astype(y.dtype)


@eqx.filter_jit
def _filter(estimator, y, u, times) -> Filtered:
    first = estimator.init()

    def step(carry, inputs):
        belief, ok = carry
        t, y, u = inputs
        # y_k comes first, because a controller chooses u_k after it has seen y_k. The
        # log-densities of the innovations, each given all earlier observations, sum to
        # the log-likelihood of the record (Schweppe, 1965).
        expected = estimator._innovation(t, y, belief)
        density = estimator._log_density(belief, *expected)
        updated = estimator._corrected(belief, *expected)
        after = estimator.predict(t, u, updated)
        ok &= updated.is_finite & after.is_finite
        # After a failure, continue from the first belief, and mask the results at the
        # end. So a NaN in one member of a batch does not reach the derivative of the
        # others.
        after = jax.tree.map(lambda a, b: jnp.where(ok, a, b), after, first)
        return (after, ok), (updated, after, density, ok)

    start = first, first.is_finite
    _, (updated, after, densities, ok) = lax.scan(step, start, (times, y, u))
    # The first belief is a prediction too, so there are T + 1.
    joined = lambda a, b: jnp.concatenate([a[None], _masked(ok, b)])
    predicted = jax.tree.map(joined, first, after)
    definite = jnp.all(jnp.isfinite(densities))
    result = choose(definite, RESULTS.successful, RESULTS.ill_posed)
    result = choose(jnp.all(ok), result, RESULTS.diverged)
    updated = jax.tree.map(lambda a: _masked(ok, a), updated)
    return Filtered(predicted, updated, _masked(ok, densities), result)


@eqx.filter_jit
@full_precision
def _smooth(estimator, y, u, times) -> Smoothed:
    filtered = _filter(estimator, y, u, times)
    ok = jnp.isfinite(filtered.log_likelihoods)
    # For steps that failed, the backward pass uses the first belief; they are masked at
    # the end.
    kept = lambda a, b: _masked(ok, a, b)
    updated = jax.tree.map(kept, filtered.updated, estimator.init())

    def back(after, inputs):
        t, u, belief = inputs
        # The prediction is computed again, because keeping it would need memory for the
        # joint covariances of all steps.
        belief = estimator._smoothed(t, u, belief, after)
        return belief, belief

    # There are no data after the last state, so its smoothed belief is the filter's.
    last = jax.tree.map(lambda a: a[-1], updated)
    inputs = jax.tree.map(lambda a: a[:-1], (times, u, updated))
    _, smoothed = lax.scan(back, last, inputs, reverse=True)
    whole = jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), smoothed, last)
    # A smoothed state depends on all later steps of the filter. If one of them failed,
    # all smoothed states are masked.
    filter_ok = filtered.result == RESULTS.successful
    result = choose(whole.is_finite | ~filter_ok, filtered.result, RESULTS.diverged)
    whole = jax.tree.map(lambda a: jnp.where(filter_ok, a, jnp.nan), whole)
    return Smoothed(whole.mean, whole.covariance, filtered, result)


def _masked(ok: Array, values: Array, otherwise: Any = jnp.nan) -> Array:
    return jnp.where(ok.reshape(-1, *(1,) * (values.ndim - 1)), values, otherwise)
