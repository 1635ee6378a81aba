"""Filters and smoothers of a whole record."""

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
        """The log-likelihood of the whole record, or of each record of a batch."""
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
    r"""Run a Kalman filter over a record.

    At each step k, with `t_k = t0 + k dt`: the measurement update with `y_k`, then the
    time update with `u_k`. The log-likelihood of the record,

    `sum over k of log N(y_k - y_k_predicted; 0, C Sigma_k C' + V)`,

    is differentiable with respect to every array leaf of the estimator: noise levels
    and constants of the physics can be fitted to it.

    **Arguments:**

    - `estimator`: a [`delucax.estimators.KalmanFilter`][],
        [`delucax.estimators.ExtendedKalmanFilter`][] or
        [`delucax.estimators.UnscentedKalmanFilter`][].
    - `observations`: shape `(T, p)`; `trajectory.observations`, for example.
    - `controls`: those that were applied, shape `(T, m)`; zero by default.
    - `t0`: the time of the first observation, 0 by default.
    - `throw`: raise if a belief or the likelihood is not finite (default); if false,
        look at `result`.

    **Returns:** an object with

    - `predicted`: the belief of each state before it is observed, and at the end that
        of the state after the last control: a [`delucax.estimators.Belief`][] with a
        leading axis of `T + 1`;
    - `updated`: the belief once it is observed, with a leading axis of `T`;
    - `log_likelihoods`: the log-density of each observation given those before it,
        shape `(T,)`, and `log_likelihood`, their sum, that of the record;
    - `result`: one of `delucax.RESULTS`, `diverged` where a belief is not finite, and
        `ill_posed` where only the likelihood is not, as the covariance of an
        observation is not definite. After a step that diverges all is NaN.

    **Raises:** `ValueError` on an argument of the wrong kind or shape, or that is not
    finite; an error at run time as `throw` says.

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
    r"""The estimate of each state from the whole record, by the smoother of Rauch, Tung
    and Striebel.

    The backward recursion is, with `G_k = P_k A' Sigma_{k+1}^-1`, the filter's belief
    being `N(mu_k, Sigma_k)` before `y_k` and `N(m_k, P_k)` after it:

    `mean_k = m_k + G_k (mean_{k+1} - mu_{k+1})`,
    `covariance_k = P_k + G_k (covariance_{k+1} - Sigma_{k+1}) G_k'`,

    the latter in a form that stays semidefinite. Of a nonlinear filter, `P_k A'` is the
    covariance of the state with the next one, as that filter finds it. Covariances may
    be singular: a first state that is known, or noise in some states alone.

    **Arguments:**

    - `estimator`, `observations`, `controls`, `t0`, `throw`: as for
        [`delucax.estimators.run_filter`][].

    **Returns:** an object with

    - `mean`: of each state, given the whole record, shape `(T, n)`;
    - `covariance`: likewise, shape `(T, n, n)`;
    - `filtered`: the pass of the filter, as `run_filter` returns it;
    - `result`: success, or why not; one of `delucax.RESULTS`.

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
        dlx.estimators.smooth(ekf, run.observations, run.controls).mean
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
    # A product, and no running sum, whose rounding would grow along the record.
    times = as_float_array(t0) + jnp.arange(len(y)) * estimator.dynamics.dt
    return y, u, times.astype(y.dtype)


@eqx.filter_jit
def _filter(estimator, y, u, times) -> Filtered:
    first = estimator.init()

    def step(carry, inputs):
        belief, ok = carry
        t, y, u = inputs
        # First y_k, then u_k, which a controller chooses once it has seen y_k. The
        # density is that of the innovation, given all y before: by the chain rule these
        # sum up to the likelihood of the record (Schweppe, 1965).
        expected = estimator._innovation(t, y, belief)
        density = estimator._log_density(belief, *expected)
        updated = estimator._corrected(belief, *expected)
        after = estimator.predict(t, u, updated)
        ok &= updated.is_finite & after.is_finite
        # After a failure go on from the first belief, and mask the steps at the end: no
        # NaN of one member of a batch may get into the derivative of the others.
        after = jax.tree.map(lambda a, b: jnp.where(ok, a, b), after, first)
        return (after, ok), (updated, after, density, ok)

    start = first, first.is_finite
    _, (updated, after, densities, ok) = lax.scan(step, start, (times, y, u))
    # The first belief is a prediction, too, before any data: there is one more.
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
    # Steps that failed are run back over the first belief, and masked at the end.
    kept = lambda a, b: _masked(ok, a, b)
    updated = jax.tree.map(kept, filtered.updated, estimator.init())

    def back(after, inputs):
        t, u, belief = inputs
        # The prediction from each belief is made again: to keep it would take the
        # covariance of the state with the next one at all steps.
        belief = estimator._smoothed(t, u, belief, after)
        return belief, belief

    # The last state has no later data: its smoothed belief is the filter's.
    last = jax.tree.map(lambda a: a[-1], updated)
    inputs = jax.tree.map(lambda a: a[:-1], (times, u, updated))
    _, smoothed = lax.scan(back, last, inputs, reverse=True)
    whole = jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), smoothed, last)
    # A smoothed state is of all that the filter made of later steps: where it failed at
    # one, none is known.
    filter_ok = filtered.result == RESULTS.successful
    result = choose(whole.is_finite | ~filter_ok, filtered.result, RESULTS.diverged)
    whole = jax.tree.map(lambda a: jnp.where(filter_ok, a, jnp.nan), whole)
    return Smoothed(whole.mean, whole.covariance, filtered, result)


def _masked(ok: Array, values: Array, otherwise: Any = jnp.nan) -> Array:
    return jnp.where(ok.reshape(-1, *(1,) * (values.ndim - 1)), values, otherwise)
