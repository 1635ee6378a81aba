"""Online learners with different features: a signal's last values, or filters."""

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
    r"""The gradient perturbation controller, which learns from past disturbances.

    $$u_t = \mathrm{base}(x_t) + \sum_{i=1}^{\mathrm{memory}} E_i w_{t-i}, \qquad
    w_{t-1} = x_t - F(t-1, x_{t-1}, u_{t-1})$$

    The disturbances $w$ are computed from the states, with the controls that were
    applied. At each step, the matrices $E$ move against the gradient of a
    counterfactual cost. This is the cost that the step would have had if the same
    matrices had always been used: see [`delucax.controllers.OnlineLearner`][]. Compared
    with the best fixed $E$ in hindsight, the regret over $T$ steps is at most of the
    order $\sqrt T$ for a linear plant and a convex cost, whatever the disturbances.

    The dynamics may be linear (time-invariant or time-varying) or nonlinear, and the
    state must be observed. Nonlinear dynamics are linearised along the run. For
    nonlinear dynamics, the disturbance is the difference between the state and its
    prediction by the nonlinear model.

    **Arguments:**

    - `dynamics`: the model, a [`delucax.AbstractDynamics`][] that observes its state.
    - `cost`: the stage cost, a differentiable function of `(t, x, u)` such as
        `env.cost`.
    - `base`: a controller that stabilises the dynamics; by default a
        [`delucax.controllers.LQR`][] whose weights are the curvature of the cost at the
        operating point.
    - `memory`: the number of past disturbances. By default the smallest $h$ from 10 to
        50 with $\rho^h \le 0.1$, where $\rho$ is the spectral radius of the closed
        loop. The default is 10 if `dynamics` are nonlinear or time-varying, or if you
        call `gpc` inside a JAX transformation, because in these cases $\rho$ is not
        known.
    - `horizon`: the number of past steps that the counterfactual cost takes into
        account. By default it is the smallest $h$ from 10 to 1000 with
        $\rho^h \le 0.03$.
    - `learning_rate`: the scale of the optimiser's step. For Newton's method,
        `learning_rate` is the length of the longest allowed step. By default it is
        $0.15 / |B|$, where $|B|$ is the Frobenius norm of the matrix that maps a
        control to the change of the state in one step.
    - `optimiser`: an Optax transformation. By default
        [`delucax.controllers.adagrad_norm`][] if `dynamics` are linear and
        time-invariant, otherwise [`delucax.controllers.online_newton`][]. With both
        optimisers, the steps do not depend on the scale of the cost. `online_newton`
        learns faster, but computing a step takes ten times as long.
    - `radius`: the largest Frobenius norm of $E$, $50 / |B|$ by default.

    **Returns:** a [`delucax.controllers.OnlineLearner`][]. The state of the learner has
    the disturbances in `loop.signal`, and the matrices $E$ side by side in `theta`,
    shape `(m, memory n)`.

    **Raises:** `ValueError` if `base` does not stabilise the dynamics or has the wrong
    sizes, if there is no default for it, if the cost is not a scalar or the state is
    not observed, or if a number is out of its range.

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

        ```text
        Array(0.0739, dtype=float32)
        ```
    """
    given = dynamics, cost, base, horizon, learning_rate, optimiser, radius
    learner = linear_learner("gpc", *given, memory=memory, nature=False)
    if not learner.loop.observed:
        raise ValueError(
            "gpc: dynamics must observe their state, got "
            f"{dynamics.observation_size} outputs of {dynamics.state_size} states. Use "
            "drc, which learns from outputs."
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
    r"""The disturbance response controller, for a state that is not observed.

    $$u_t = \mathrm{base}(y_t) + \sum_{j=0}^{\mathrm{memory} - 1} M_j\, \eta_{t-j},
    \qquad \eta_t = y_t - G(v)_t$$

    $\eta_t$ is nature's output: the observation that the closed loop would have given
    if nothing had been added to the control of the base. $G(v)$ is the response of the
    closed loop to all controls that were added, after clipping. At each step, the
    matrices $M$ move against the gradient of a counterfactual cost. This is the cost
    that the step would have had if the same matrices had been used in the past too: see
    [`delucax.controllers.OnlineLearner`][]. The regret against the best fixed $M$ in
    hindsight is at most of the order $\sqrt T$ for a linear plant and a convex cost.

    With a `base` whose control is zero, `drc` is the gradient response controller. A
    base such as [`delucax.controllers.LQG`][] gives good control from the start, and
    stabilises unstable plants.

    **Arguments:**

    - `dynamics`: the model. The model must be linear and time-invariant if the state is
        not observed.
    - `cost`: the stage cost, a differentiable function of `(t, y, u)`, where `y` is the
        observation.
    - `base`: a controller that stabilises the dynamics. By default it is a
        [`delucax.controllers.LQG`][] whose weights are the curvature of the cost, for
        disturbances and sensor noise of unit covariance. If the state is observed, it
        is a [`delucax.controllers.LQR`][] with these weights.
    - `memory`: the number of values $\eta_t, \eta_{t-1}, \dots$ of nature's output that
        the control uses, 10 by default.
    - `horizon`: the number of past steps that the counterfactual cost takes into
        account. By default it is the smallest $h$ from 10 to 1000 with
        $\rho^h \le 0.03$, where $\rho$ is the spectral radius of the closed loop.
    - `learning_rate`: the scale of the optimiser's step. For Newton's method,
        `learning_rate` is the length of the longest allowed step. By default it is 0.15
        divided by the norm of the first nonzero response of the observation to a unit
        impulse of the control.
    - `optimiser`: an Optax transformation; by default
        [`delucax.controllers.online_newton`][] with a prior of 4 steps.
    - `radius`: the largest Frobenius norm of $M$; by default 50 divided by the same
        norm as for `learning_rate`.

    **Returns:** a [`delucax.controllers.OnlineLearner`][]. The state of the learner has
    nature's outputs in `loop.signal`, and the matrices $M$ side by side in `theta`,
    shape `(m, memory p)`.

    **Raises:** `ValueError` if `base` does not stabilise the dynamics or has the wrong
    sizes, if there is no default for it, if the cost is not a scalar, or if a number is
    out of its range.

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

        ```text
        Array(181.6, dtype=float32)
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
    r"""The spectral filtering controller, which learns from a few filters of the long
    past.

    $$u_t = \mathrm{base}(y_t) + M_0 s_t + \sum_i M_i f_i(s_{t-1}, \dots,
    s_{t-\mathrm{memory}}), \qquad f_i(s) = \sigma_i^{1/4} \sum_k \phi_i(k)\, s_{t-k}$$

    The signal $s$ is the last disturbance if the state is observed, and nature's output
    otherwise. $\sigma_i$ and $\phi_i$ are the largest eigenvalues, with their
    eigenvectors, of the matrix

    $$H_{jk} = \frac{(1 - \mathrm{margin})^{j + k - 1}}{j + k - 1}$$

    For a long memory, [`delucax.controllers.gpc`][] and [`delucax.controllers.drc`][]
    need one matrix for each past step, but `sfc` needs only one matrix for each filter.
    So `sfc` has fewer weights to learn if the closed loop is slow and needs a long
    memory. The filters depend only on the memory and the margin, not on the plant.

    The double spectral controller, for a state that is not observed, also adds

    $$\sum_i M'_i f_i(s_t, \dots) + \sum_{i \le j} M''_{ij} (f_i * f_j)(s_t, \dots)$$

    where $f_i * f_j$ applies one filter after the other. With these terms, the
    controller can also represent an observer, because an observer filters the past
    outputs.

    **Arguments:**

    - `dynamics`, `cost`, `base`, `horizon`, `learning_rate`, `optimiser`, `radius`: as
        in [`delucax.controllers.drc`][].
    - `filters`: the number of filters, 5 by default.
    - `memory`: the number of past values of the signal that the filters use, 30 by
        default.
    - `margin`: the stability margin, between 0 and 1, 0.2 by default. The filters are
        accurate if the effect of a value $k$ steps ago fades as
        $(1 - \mathrm{margin})^k$ or faster.
    - `double`: whether to use the double spectral controller; false by default.

    **Returns:** a [`delucax.controllers.OnlineLearner`][]. In the state of the learner,
    `loop.signal` holds the last `memory + 1` values of the signal (`2 memory` values
    with `double`), and `theta` holds the matrices $M$ side by side.

    **Raises:** `ValueError` for the same reasons as [`delucax.controllers.drc`][], or
    if `filters` is larger than `memory`, or `margin` is not between 0 and 1.

    Source: Brahmbhatt, Buzaglo, Druchyna and Hazan, 2025 (spectral control).

    !!! example

        ```python
        import delucax as dlx
        import jax

        push = dlx.disturbances.Constant([0.5, 0.5])
        env = dlx.make("lds", key=jax.random.key(0), disturbance=push)
        learner = dlx.controllers.sfc(env.dynamics, env.cost)
        dlx.rollout(env, learner, key=jax.random.key(0)).total_cost
        ```

        ```text
        Array(9.52, dtype=float32)
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

    # The first row is s_t itself. The filters start at s_{t-1}.
    rows = [np.eye(1, length), padded(bank, 1)]
    if double:
        # f_i * f_j equals f_j * f_i, so one matrix per unordered pair.
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
    r"""The gradient perturbation controller with a neural network in place of the
    matrices of [`delucax.controllers.gpc`][].

    $$u_t = \mathrm{base}(y_t) + \mathrm{network}(s_t, \dots, s_{t-\mathrm{memory}+1})$$

    The signal $s$ is the last disturbance if the state is observed, and nature's output
    otherwise. The output of the network is zero until the first learning step. The
    regret has no known bound. Use `neural_gpc` for costs and plants for which a linear
    map of the past is not enough.

    **Arguments:**

    - `dynamics`, `cost`, `base`, `memory`, `horizon`: as in
        [`delucax.controllers.gpc`][] and [`delucax.controllers.drc`][].
    - `width`, `depth`: the number of units in a hidden layer, 32 by default, and the
        number of hidden layers, 1 by default.
    - `learning_rate`: the scale of the optimiser's step, 1e-3 by default.
    - `optimiser`: an Optax transformation; [`delucax.controllers.adagrad_norm`][] by
        default.
    - `key`: a random key for the initial weights.

    **Returns:** a [`delucax.controllers.OnlineLearner`][], whose `theta` holds the
    weights of the network.

    **Raises:** `ValueError` for the same reasons as [`delucax.controllers.gpc`][], or
    if there is no random key.

    Source: Chen, Minasyan, Lee and Hazan, 2022.

    !!! example

        ```python
        import delucax as dlx
        import jax

        push = dlx.disturbances.Constant([0.5, 0.5])
        env = dlx.make("lds", key=jax.random.key(0), disturbance=push)
        key, run_key = jax.random.split(jax.random.key(0))
        learner = dlx.controllers.neural_gpc(env.dynamics, env.cost, key=key)
        dlx.rollout(env, learner, key=run_key).total_cost
        ```

        ```text
        Array(104.6, dtype=float32)
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
    # Only the last layer is zero, so that its gradient is not zero.
    network = eqx.tree_at(last, network, [0 * leaf for leaf in last(network)])
    optimiser = adagrad_norm() if optimiser is None else optimiser
    return OnlineLearner(loop, cost, NetworkPolicy(network), learning_rate, optimiser)


@functools.lru_cache
def spectral_filters(memory: int, count: int, margin: float) -> np.ndarray:
    """The filters of `sfc`, shape `(count, memory)`, newest value first.

    Source: Hazan, Singh and Zhang, 2017.
    """
    index = np.arange(1, memory + 1)
    total = index[:, None] + index[None, :] - 1.0
    # In float64 always: the eigenvalues of this Hankel matrix decay exponentially, and
    # float32 would lose the small ones.
    values, vectors = np.linalg.eigh((1 - margin) ** total / total)
    values, vectors = values[::-1][:count], vectors[:, ::-1][:, :count]
    # The sign of an eigenvector is arbitrary, and depends on the version of LAPACK.
    sign = np.where(vectors.sum(axis=0) < 0, -1.0, 1.0)
    # The bound on the regret has the factor sigma^(1/4). The smallest eigenvalues may
    # round to below zero.
    return (np.maximum(values, 0.0) ** 0.25 * sign * vectors).T
