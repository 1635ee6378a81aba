"""Running any estimator over a record."""

from typing import Any

import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from .._check import as_rows, check_at_most, check_finite, check_instance, check_number
from .._module import as_float_array, shown
from .._results import first_of, raise_on_failure, Result, RESULTS
from ..dynamics import AbstractDynamics
from ._base import AbstractEstimator, Belief
from ._mhe import MHE


class Estimated(eqx.Module):
    """The result of `run_estimator`."""

    predicted: Belief
    updated: Belief
    states: PyTree
    results: Result
    result: Result

    __repr__ = shown

    def _facts(self) -> str:
        failed = np.asarray(self.results != RESULTS.successful)
        return f"At observation {failed.argmax()}." if failed.ndim == 1 else ""


def run_estimator(
    estimator: AbstractEstimator,
    observations: Any,
    controls: Any = None,
    *,
    t0: Any = 0.0,
    throw: bool = True,
) -> Estimated:
    r"""Run any estimator over a record.

    At step k, with $t_k = t_0 + k\, dt$, `run_estimator` calls `update` with
    `observations[k]`, then `predict` with `controls[k]`. For a Kalman filter, you can
    use [`delucax.estimators.run_filter`][] instead, which also computes the likelihood
    of the observations.

    **Arguments:**

    - `estimator`: a [`delucax.estimators.AbstractEstimator`][] with a field `dynamics`,
        such as [`delucax.estimators.MHE`][].
    - `observations`: shape `(T, p)`, for example `trajectory.observations`. The window
        of a moving-horizon estimator must not be longer than T.
    - `controls`: the controls that were applied, shape `(T, m)`; zero by default.
    - `t0`: the time of the first observation, 0 by default.
    - `throw`: whether to raise an error if an update fails; true by default. If `throw`
        is false, check `result`.

    **Returns:** an object with

    - `predicted`: the belief of each state before it is observed, and of the state
        after the last control; a [`delucax.estimators.Belief`][] with a leading axis of
        size `T + 1`;
    - `updated`: the belief of each state after it is observed, with a leading axis of
        size `T`;
    - `states`: the state of the estimator after each update, with a leading axis of
        size `T`;
    - `results`: the status of each update. `result` is the first status that reports a
        failure, or success if there is none.

    **Raises:** `ValueError` if an argument has the wrong type or shape or is not
    finite, or if the window is longer than the record. An error at run time if `throw`
    is true and an update fails.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        dynamics = dlx.LinearDynamics(0.9 * jnp.eye(1), jnp.ones((1, 1)))
        y = jnp.sin(jnp.arange(20.0))[:, None]
        mhe = dlx.estimators.MHE(dynamics, jnp.eye(1), jnp.eye(1), 5, bounds=(0.0, 1.0))
        dlx.estimators.run_estimator(mhe, y).updated.mean[:4, 0]
        ```

        ```text
        Array([0.    , 0.4916, 0.7205, 0.3455], dtype=float32)
        ```
    """
    where = "run_estimator"
    check_instance(estimator, AbstractEstimator, "estimator", where, "")
    dynamics: Any = getattr(estimator, "dynamics", None)
    check_instance(dynamics, AbstractDynamics, "dynamics of estimator", where)
    y = as_rows(observations, dynamics.observation_size, "observations", where)
    check_finite(y, "observations", where)
    u = jnp.zeros((len(y), dynamics.control_size), y.dtype)
    if controls is not None:
        u = as_rows(controls, dynamics.control_size, "controls", where, len(y))
    check_finite(u, "controls", where)
    check_number(t0, "t0", where)
    if isinstance(estimator, MHE):
        of = "observations of the record"
        check_at_most(estimator.window, len(y), "window", where, of)
    times = as_float_array(t0) + jnp.arange(len(y)) * dynamics.dt
    run = _run(estimator, y, u, times.astype(y.dtype))
    return raise_on_failure(run, where, throw, "the estimates", run._facts)


@eqx.filter_jit
def _run(estimator: Any, y: Array, u: Array, times: Array) -> Estimated:
    first = estimator.init()

    def step(state, inputs):
        t, y, u = inputs
        after = estimator.update(t, y, state)
        moved = estimator.predict(t, u, after)
        beliefs = estimator.estimate(after), estimator.estimate(moved)
        return moved, (*beliefs, after, estimator.status(after))

    _, (updated, moved, states, results) = lax.scan(step, first, (times, y, u))
    joined = (
        jnp.concatenate([a[None].astype(b.dtype), b])
        for a, b in zip(estimator.estimate(first), moved, strict=True)
    )
    return Estimated(Belief(*joined), updated, states, results, first_of(results))
