"""Learners whose features are spectral filters of the past."""

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import optax
from jaxtyping import Array

from ..._check import check_count
from ..._controller import AbstractController
from ..._message import shortened
from ...dynamics import AbstractDynamics
from ._closed_loop import ClosedLoop
from ._learner import base_for, linear_learner, OnlineLearner


def sfc(
    dynamics: AbstractDynamics,
    cost: Callable[..., Array],
    *,
    base: AbstractController | None = None,
    filters: int = 5,
    memory: int = 30,
    margin: float = 0.2,
    horizon: int | None = None,
    learning_rate: Any = None,
    optimiser: optax.GradientTransformation | None = None,
    radius: Any = None,
) -> OnlineLearner:
    """The spectral filtering controller,

    `u_t = base(y_t) + M_0 s_t + sum_i M_i f_i(s_{t-1}, ..., s_{t-memory})`,

    where the signal s is the last disturbance if the state is observed, nature's output
    otherwise, and `f_i(s) = sigma_i^(1/4) sum_k phi_i(k) s_{t-k}` with
    `(sigma_i, phi_i)` the largest eigenvalues and eigenvectors of the matrix
    `H_jk = (1 - margin)^(j + k - 1) / (j + k - 1)`.

    A few such filters do for a long memory what [`delucax.controllers.gpc`][] and
    [`delucax.controllers.drc`][] need a matrix a step for: there is less to learn where
    the closed loop is slow. They depend on the memory and the margin alone, not on the
    plant.

    **Arguments:**

    - `dynamics`, `cost`, `base`, `horizon`, `learning_rate`, `optimiser`, `radius`: as
        for [`delucax.controllers.drc`][].
    - `filters`: how many, 5 by default.
    - `memory`: the number of past values that are filtered, 30 by default.
    - `margin`: the stability margin, between 0 and 1: memories that fade as
        `(1 - margin)^k` or faster are well represented. 0.2 by default.

    **Returns:** a [`delucax.controllers.OnlineLearner`][]. In its state `loop.signal`
    has the last `memory + 1` values and `theta` the matrices M side by side.

    **Raises:** `ValueError` as [`delucax.controllers.drc`][]; and if there are more
    filters than the memory has room for, or the margin is not between 0 and 1.

    Source: Brahmbhatt, Buzaglo, Druchyna and Hazan, 2025 (spectral control).

    !!! example

        ```python
        import delucax as dlx
        import jax

        env = dlx.make("lds", key=jax.random.key(0))
        learner = dlx.controllers.sfc(env.dynamics, env.cost)
        dlx.rollout(env, learner, key=jax.random.key(0)).total_cost
        ```
    """
    bank = _bank(filters, memory, margin, "sfc")
    rows = np.concatenate([np.eye(1, memory + 1), np.pad(bank, ((0, 0), (1, 0)))])
    base = base_for(dynamics, cost, base, "sfc")
    loop = ClosedLoop(dynamics, base, horizon, "sfc", filters=rows)
    return linear_learner(loop, cost, learning_rate, optimiser, radius, "sfc")


def dsc(
    dynamics: AbstractDynamics,
    cost: Callable[..., Array],
    *,
    base: AbstractController | None = None,
    filters: int = 5,
    memory: int = 30,
    margin: float = 0.2,
    horizon: int | None = None,
    learning_rate: Any = None,
    optimiser: optax.GradientTransformation | None = None,
    radius: Any = None,
) -> OnlineLearner:
    """The double spectral controller, for a state that is not observed,

    `u_t = base(y_t) + M_0 s_t + sum_i M_i f_i(s_{t-1}, ...)`
    `    + sum_i M'_i f_i(s_t, ...) + sum_{i <= j} M''_ij (f_i * f_j)(s_t, ...)`,

    with the signal s and the filters f of [`delucax.controllers.sfc`][]; `f_i * f_j` is
    one filter after the other, which represents what an observer, itself a filter,
    makes of the past.

    **Arguments:** `dynamics`, `cost`, `base`, `filters`, `memory`, `margin`, `horizon`,
    `learning_rate`, `optimiser`, `radius`: as for [`delucax.controllers.sfc`][].

    **Returns:** a [`delucax.controllers.OnlineLearner`][]. In its state `loop.signal`
    has the last `2 memory` values and `theta` the matrices M side by side.

    **Raises:** `ValueError` as [`delucax.controllers.sfc`][].

    Source: Brahmbhatt, Buzaglo, Druchyna and Hazan, 2025 (double spectral control).

    !!! example

        ```python
        import delucax as dlx
        import jax

        env = dlx.make("lds", key=jax.random.key(0))
        learner = dlx.controllers.dsc(env.dynamics, env.cost)
        dlx.rollout(env, learner, key=jax.random.key(0)).total_cost
        ```
    """
    bank = _bank(filters, memory, margin, "dsc")
    length = 2 * memory

    def padded(rows, first):
        return np.pad(rows, ((0, 0), (first, length - first - rows.shape[1])))

    # f_i * f_j is f_j * f_i: a matrix for each pair.
    pairs = [(i, j) for i in range(filters) for j in range(i, filters)]
    twice = np.stack([np.convolve(bank[i], bank[j]) for i, j in pairs])
    rows = [np.eye(1, length), padded(bank, 1), padded(bank, 0), padded(twice, 0)]
    rows = np.concatenate(rows)
    base = base_for(dynamics, cost, base, "dsc")
    loop = ClosedLoop(dynamics, base, horizon, "dsc", filters=rows)
    return linear_learner(loop, cost, learning_rate, optimiser, radius, "dsc")


def _bank(filters: int, memory: int, margin: float, where: str) -> np.ndarray:
    memory = check_count(memory, "memory", where)
    filters = check_count(filters, "filters", where)
    if filters > memory:
        raise ValueError(
            f"{where}: filters must be at most memory, {memory}, got {filters}."
        )
    number = isinstance(margin, int | float) and not isinstance(margin, bool)
    if not number or not (math.isfinite(margin) and 0 < margin < 1):
        raise ValueError(
            f"{where}: margin must be a number between 0 and 1, "
            f"got {shortened(margin)}."
        )
    return spectral_filters(memory, filters, float(margin))


@functools.lru_cache
def spectral_filters(memory: int, count: int, margin: float) -> np.ndarray:
    """The filters, shape `(count, memory)`, newest first.

    Source: Hazan, Singh and Zhang, 2017.
    """
    index = np.arange(1, memory + 1)
    total = index[:, None] + index[None, :] - 1.0
    # In float64 whatever JAX computes in: the matrix is all but singular.
    values, vectors = np.linalg.eigh((1 - margin) ** total / total)
    values, vectors = values[::-1][:count], vectors[:, ::-1][:, :count]
    sign = np.where(vectors.sum(axis=0) < 0, -1.0, 1.0)
    return (np.maximum(values, 0.0) ** 0.25 * sign * vectors).T
