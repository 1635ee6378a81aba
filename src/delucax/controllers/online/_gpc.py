"""Learners by their features: the last values of a signal, or filters of them."""

import functools
import itertools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import numpy as np
import optax
from jaxtyping import Array

from ..._check import check_bool, check_count, check_key, check_positive
from ..._controller import AbstractController
from ..._message import shortened
from ..._module import mlp
from ..._typing import PRNGKey
from ...dynamics import AbstractDynamics
from ._closed_loop import ClosedLoop
from ._learner import base_for, linear_learner, OnlineLearner
from ._optimisers import adagrad_norm
from ._policy import NetworkPolicy


def gpc(
    dynamics: AbstractDynamics,
    cost: Callable[..., Array],
    *,
    base: AbstractController | None = None,
    memory: int | None = None,
    horizon: int | None = None,
    learning_rate: Any = None,
    optimiser: optax.GradientTransformation | None = None,
    radius: Any = None,
) -> OnlineLearner:
    """The gradient perturbation controller,

    `u_t = base(x_t) + sum_{i=1..memory} E_i w_{t-i}`,

    with `w_{t-1} = x_t - F(t-1, x_{t-1}, u_{t-1})`, the disturbances so far, recovered
    with the control that was applied. E follows the gradient of what each step would
    have cost under it: see [`delucax.controllers.OnlineLearner`][]. Against the best
    fixed E in hindsight its regret over T steps grows as `sqrt(T)`, whatever the
    disturbances are.

    The dynamics are linear, time-varying or not, or any others that observe their
    state; those are linearised along the way, and the disturbance is the residual of
    the nonlinear map.

    **Arguments:**

    - `dynamics`: the model, an [`delucax.AbstractDynamics`][] that observes its state.
    - `cost`: the stage cost, a differentiable function of `(t, x, u)` such as
        `env.cost`.
    - `base`: a controller that stabilises the dynamics; by default the
        [`delucax.controllers.LQR`][] for the curvature of the cost at the operating
        point.
    - `memory`: the number of past disturbances; by default the least h, of 10 at least
        and 50 at most, with `rho^h <= 0.1`, rho being the spectral radius of the closed
        loop. It is 10 where dynamics are not linear and time-invariant, and inside a
        transformation of JAX, where the loop cannot be seen.
    - `horizon`: the length of the roll-out; by default the least h, of 10 at least and
        1000 at most, with `rho^h <= 0.03`, rho being the spectral radius of the closed
        loop.
    - `learning_rate`: scales the optimiser's step; of Newton's method, the longest
        step. By default `0.15 / |B|_F`, with `|B|` the size of what a unit of control
        does to the state in a step.
    - `optimiser`: an Optax transformation; by default
        [`delucax.controllers.adagrad_norm`][] where dynamics are linear and
        time-invariant, and otherwise [`delucax.controllers.online_newton`][]. Neither
        needs a scale of the cost; the second learns faster, and a step of it takes ten
        times as long.
    - `radius`: E is kept inside this ball in the Frobenius norm, `50 / |B|_F` by
        default.

    **Returns:** a [`delucax.controllers.OnlineLearner`][]. In its state `loop.signal`
    has the disturbances and `theta`, shape `(m, memory n)`, the matrices E side by
    side.

    **Raises:** `ValueError` if the base does not stabilise the dynamics, does not fit
    them or cannot be designed, the cost is not a scalar, the state is not observed, or
    a number is out of its range.

    Source: Agarwal, Bullins, Hazan, Kakade and Singh, 2019.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        A, B = jnp.array([[1.0, 1.0], [0.0, 1.0]]), jnp.array([[0.0], [1.0]])
        dynamics = dlx.LinearDynamics(A, B)
        cost = dlx.costs.Quadratic(jnp.eye(2), jnp.eye(1))
        push = dlx.disturbances.Constant(jnp.ones(2))
        env = dlx.Environment(dynamics, cost, disturbance=push)

        run = lambda c: dlx.rollout(env, c, key=jax.random.key(0), horizon=1000)
        learner = dlx.controllers.gpc(dynamics, cost)
        regulator = dlx.controllers.LQR(dynamics, jnp.eye(2), jnp.eye(1))
        run(learner).total_cost / run(regulator).total_cost
        ```
    """
    given = dynamics, cost, base, horizon, learning_rate, optimiser, radius
    learner = linear_learner("gpc", *given, memory=memory, nature=False)
    if not learner.loop.observed:
        raise ValueError(
            "gpc: dynamics must observe their state (drc learns from outputs), got "
            f"{dynamics.observation_size} outputs of {dynamics.state_size} states."
        )
    return learner


def drc(
    dynamics: AbstractDynamics,
    cost: Callable[..., Array],
    *,
    base: AbstractController | None = None,
    memory: int = 10,
    horizon: int | None = None,
    learning_rate: Any = None,
    optimiser: optax.GradientTransformation | None = None,
    radius: Any = None,
) -> OnlineLearner:
    """The disturbance response controller, for a state that is not observed,

    `u_t = base(y_t) + sum_{j=0..memory-1} M_j nature_{t-j}`,

    where nature's output, `nature_t = y_t - G(v)_t`, is what the closed loop would have
    shown had nothing been added to the base's control; `G(v)` is the loop's response to
    all that was added, saturation included. M follows the gradient of what each step
    would have cost under it, in the past too: see
    [`delucax.controllers.OnlineLearner`][]. Its regret against the best fixed M in
    hindsight grows as `sqrt(T)`.

    With `base` zero it is the gradient response controller; a base such as
    [`delucax.controllers.LQG`][] gives its performance at the start, and stabilises
    plants that are unstable.

    **Arguments:**

    - `dynamics`: the model; linear and time-invariant where the state is not observed.
    - `cost`: the stage cost, a differentiable function of `(t, y, u)`: of the
        observation, which is all that it is given.
    - `base`: a controller that stabilises the dynamics; by default the
        [`delucax.controllers.LQG`][] for the curvature of the cost and for disturbances
        and sensor noise of unit covariance ([`delucax.controllers.LQR`][] where the
        state is observed).
    - `memory`: the number of outputs, 10 by default.
    - `horizon`: the length of the roll-out; by default the least h, of 10 at least and
        1000 at most, with `rho^h <= 0.03`, rho being the spectral radius of the closed
        loop.
    - `learning_rate`: scales the optimiser's step; of Newton's method, the longest
        step. By default 0.15 over the size of the first response of the output to a
        unit of control.
    - `optimiser`: an Optax transformation; [`delucax.controllers.online_newton`][] with
        a prior of 4 steps by default.
    - `radius`: M is kept inside this ball in the Frobenius norm; by default 50 over the
        same size.

    **Returns:** a [`delucax.controllers.OnlineLearner`][]. In its state `loop.signal`
    has nature's outputs and `theta`, shape `(m, memory p)`, the matrices M side by
    side.

    **Raises:** `ValueError` if the base does not stabilise the dynamics, does not fit
    them or cannot be designed, the cost is not a scalar, or a number is out of its
    range.

    Source: Simchowitz, Singh and Hazan, 2020.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        A, B = jnp.array([[0.9, 0.5], [0.0, 0.9]]), jnp.array([[0.0], [1.0]])
        C = jnp.array([[1.0, 0.0]])
        push = dlx.disturbances.Constant(0.3 * jnp.ones(2))
        cost = dlx.costs.Quadratic(C.T @ C, jnp.eye(1))
        env = dlx.make("lds", A=A, B=B, C=C, cost=cost, disturbance=push)
        cost = dlx.costs.Quadratic(jnp.eye(1), jnp.eye(1))  # of the observation
        learner = dlx.controllers.drc(env.dynamics, cost)
        dlx.rollout(env, learner, key=jax.random.key(0), horizon=1000).total_cost
        ```
    """
    memory = check_count(memory, "memory", "drc")
    given = dynamics, cost, base, horizon, learning_rate, optimiser, radius
    return linear_learner("drc", *given, memory=memory, nature=True)


def sfc(
    dynamics: AbstractDynamics,
    cost: Callable[..., Array],
    *,
    base: AbstractController | None = None,
    filters: int = 5,
    memory: int = 30,
    margin: float = 0.2,
    double: bool = False,
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
    [`delucax.controllers.drc`][] need a matrix per step for: there is less to learn
    where the closed loop is slow. They depend on the memory and the margin alone, not
    on the plant.

    The double spectral controller, for a state that is not observed, also adds

    `sum_i M'_i f_i(s_t, ...) + sum_{i <= j} M''_ij (f_i * f_j)(s_t, ...)`,

    `f_i * f_j` being one filter after the other, which represents what an observer,
    itself a filter, makes of the past.

    **Arguments:**

    - `dynamics`, `cost`, `base`, `horizon`, `learning_rate`, `optimiser`, `radius`: as
        for [`delucax.controllers.drc`][].
    - `filters`: how many, 5 by default.
    - `memory`: the number of past values that are filtered, 30 by default.
    - `margin`: the stability margin, between 0 and 1: memories that fade as
        `(1 - margin)^k` or faster are well represented. 0.2 by default.
    - `double`: the double spectral controller; false by default.

    **Returns:** a [`delucax.controllers.OnlineLearner`][]. In its state `loop.signal`
    has the last `memory + 1` values, or `2 memory` with `double`, and `theta` the
    matrices M side by side.

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
    where = "sfc"
    memory = check_count(memory, "memory", where)
    filters = check_count(filters, "filters", where)
    if filters > memory:
        raise ValueError(
            f"{where}: filters must be at most memory, {memory}, got {filters}."
        )
    number = isinstance(margin, int | float) and not isinstance(margin, bool)
    if not number or not 0 < margin < 1:
        raise ValueError(
            f"{where}: margin must be a number between 0 and 1, "
            f"got {shortened(margin)}."
        )
    bank = spectral_filters(memory, filters, float(margin))
    length = 2 * memory if check_bool(double, "double", where) else memory + 1

    def padded(rows, first):
        return np.pad(rows, ((0, 0), (first, length - first - rows.shape[1])))

    # s_t by itself, and the filters on what is before it: phi_i(k) is for s_{t-k}.
    rows = [np.eye(1, length), padded(bank, 1)]
    if double:
        # f_i * f_j is f_j * f_i: a matrix for each pair.
        pairs = itertools.combinations_with_replacement(bank, 2)
        twice = np.stack([np.convolve(first, second) for first, second in pairs])
        rows += [padded(bank, 0), padded(twice, 0)]
    given = dynamics, cost, base, horizon, learning_rate, optimiser, radius
    return linear_learner(where, *given, filters=np.concatenate(rows))


def neural_gpc(
    dynamics: AbstractDynamics,
    cost: Callable[..., Array],
    *,
    base: AbstractController | None = None,
    memory: int | None = None,
    width: int = 32,
    depth: int = 1,
    horizon: int | None = None,
    learning_rate: Any = 1e-3,
    optimiser: optax.GradientTransformation | None = None,
    key: PRNGKey,
) -> OnlineLearner:
    """A network in place of the matrices of [`delucax.controllers.gpc`][],

    `u_t = base(y_t) + network(s_t, ..., s_{t-memory+1})`,

    where the signal s is the last disturbance if the state is observed, nature's output
    otherwise. The network starts by adding nothing. There is no bound on its regret;
    it is for costs and plants that a linear map of the past does not suit.

    **Arguments:**

    - `dynamics`, `cost`, `base`, `memory`, `horizon`: as for
        [`delucax.controllers.gpc`][] and [`delucax.controllers.drc`][].
    - `width`, `depth`: of the hidden layers, 32 units in 1 layer by default.
    - `learning_rate`: scales the optimiser's step, 1e-3 by default.
    - `optimiser`: an Optax transformation; [`delucax.controllers.adagrad_norm`][] by
        default.
    - `key`: a random key, for the first weights.

    **Returns:** a [`delucax.controllers.OnlineLearner`][], whose `theta` are the
    network's weights.

    **Raises:** `ValueError` as [`delucax.controllers.gpc`][].

    Source: Chen, Minasyan, Lee and Hazan, 2022.

    !!! example

        ```python
        import delucax as dlx
        import jax

        env = dlx.make("lds", key=jax.random.key(0))
        key, run_key = jax.random.split(jax.random.key(0))
        learner = dlx.controllers.neural_gpc(env.dynamics, env.cost, key=key)
        dlx.rollout(env, learner, key=run_key).total_cost
        ```
    """
    where = "neural_gpc"
    base = base_for(dynamics, cost, base, where)
    loop = ClosedLoop(dynamics, base, horizon, where, memory=memory)
    check_key(key, where)
    check_positive(learning_rate, "learning_rate", where)
    width = check_count(width, "width", where)
    depth = check_count(depth, "depth", where)
    sizes = loop.feature_size, dynamics.control_size, width, depth
    network = mlp(*sizes, dtype=loop.dtype, key=key)
    last = lambda net: [net.layers[-1].weight, net.layers[-1].bias]
    # The last layer alone is zero: the layers before give it features, and so a
    # gradient.
    network = eqx.tree_at(last, network, [0 * leaf for leaf in last(network)])
    optimiser = adagrad_norm() if optimiser is None else optimiser
    return OnlineLearner(loop, cost, NetworkPolicy(network), learning_rate, optimiser)


@functools.lru_cache
def spectral_filters(memory: int, count: int, margin: float) -> np.ndarray:
    """The filters, shape `(count, memory)`, newest first.

    Source: Hazan, Singh and Zhang, 2017.
    """
    index = np.arange(1, memory + 1)
    total = index[:, None] + index[None, :] - 1.0
    # In float64 whatever JAX computes in: the eigenvalues of this Hankel matrix fall
    # off exponentially (Hazan, Singh and Zhang, 2017), so that a few filters suffice,
    # and float32 would lose the small ones in rounding.
    values, vectors = np.linalg.eigh((1 - margin) ** total / total)
    values, vectors = values[::-1][:count], vectors[:, ::-1][:, :count]
    # The sign of an eigenvector is arbitrary: LAPACK's choice depends on its version.
    sign = np.where(vectors.sum(axis=0) < 0, -1.0, 1.0)
    # sigma^(1/4) lets a filter count by what it explains, as in the bound on the
    # regret; the least eigenvalues may round to below zero.
    return (np.maximum(values, 0.0) ** 0.25 * sign * vectors).T
