"""Moving-horizon estimation."""

from dataclasses import KW_ONLY
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .._check import as_bounds, check_count, check_number, check_positive, is_concrete
from .._controller import wrong_observation
from .._message import shortened
from .._module import function_field, parameter, positive
from .._results import choose, Result, RESULTS
from .._typing import Control, Difference, Observation, PRNGKey, RealOrNone, RealScalar
from ..dynamics import AbstractDynamics
from ..math._linear_solve import is_definite
from ._base import AbstractEstimator, Belief
from ._gaussian import check_dynamics, checked_model
from ._random_walk import check_walks, RandomWalk, WithParameters
from ._window import first_window, Model, moved, solved, Window


class MHE(AbstractEstimator):
    r"""Moving-horizon estimation: constrained least squares over a window of the past.

    $$x_{k+1} = F(t_k, x_k, u_k, w_k), \quad w_k \sim N(0, W), \qquad
    y_k = h(t_k, x_k) + v_k, \quad v_k \sim N(0, V)$$

    Each `update` minimises

    $$|x_0 - \bar x|^2_{P^{-1}} + \sum_{k < N-1} |w_k|^2_{W^{-1}}
    + \sum_{k < N} 2 \rho(|y_k - h(t_k, x_k)|_{V^{-1}})$$

    over the states $x_0, \dots, x_{N - 1}$ of the window, where $x_{N - 1}$ is the
    current state. Bounds on states and disturbances are respected, and parameters of
    the dynamics can be estimated together with the states. The prior $(\bar x, P)$ of
    the first state $x_0$ is computed by an extended Kalman filter that is linearised
    about the estimated states of the window. The prior is computed from the
    observations before the window only, so that no observation is used twice (the
    filtering update). For linear dynamics without active bounds, the estimate is the
    same as with a [`delucax.estimators.KalmanFilter`][], for any length of the window.

    By default, an update starts from the previous solution, shifted by one time step,
    and makes one full Gauss-Newton step (the real-time iteration). If `iterations` is
    above 1, an update makes that many Gauss-Newton steps, each with a line search. A
    Gauss-Newton step consists of a forward pass of the Kalman filter over the window
    and a backward pass. All covariances may be singular, for example for a known state,
    a constant parameter or a perfect sensor. An active bound is treated as a perfect
    observation. More passes are needed to find out which bounds are active. The
    covariance of the estimate comes from a forward pass that ignores the bounds.

    The estimate is differentiable with respect to the weights, the prior, the bounds
    and the dynamics, in forward and reverse mode. JAX differentiates the Gauss-Newton
    steps that the update made, and does not vary which bounds are active. The
    derivative jumps when a bound becomes active, or when a residual crosses the
    threshold of `robust`. Under `jax.vmap`, each estimate of the batch makes as many
    passes as the one that needs the most.

    **Arguments:**

    - `dynamics`: any dynamics. Their `observe` is the sensor $h$.
    - `W`: covariance of the disturbance `w` of the dynamics, shape `(k, k)`, symmetric,
        semidefinite.
    - `V`: covariance of the sensor noise, shape `(p, p)`, symmetric, semidefinite.
    - `window`: $N$, the number of observations in the window, at least 1.
    - `mean`: mean of the first state, shape `(n,)`; zero by default.
    - `covariance`: covariance of the first state before it is observed, shape `(n, n)`,
        symmetric, semidefinite; the identity by default.
    - `bounds`: bounds of the states, a pair `(low, high)` of numbers or vectors of
        shape `(n,)`, which may be infinite; none by default.
    - `disturbance_bounds`: bounds of the disturbance `w`, a pair of numbers or vectors
        of shape `(k,)`; none by default.
    - `parameters`: the parameters to estimate, a dictionary that maps the path of each
        parameter in the dynamics to a [`delucax.estimators.RandomWalk`][], such as
        `{"system.length": RandomWalk(0.1)}`; none by default.
    - `robust`: the size of a residual above which an observation counts as an outlier,
        in standard deviations of the sensor noise. Above this threshold, $\rho$ grows
        only linearly (Huber's penalty). Thresholds from 1.5 to 3 are usual. With a
        threshold, `V` must be positive definite. By default there is no threshold, and
        $\rho(r) = r^2 / 2$ for all residuals.
    - `iterations`: the number of Gauss-Newton steps in each update, 1 by default.
    - `observation_difference`: a function `(y, y_predicted) -> deviation`; subtraction
        by default. If some of the observations are angles, give a function that wraps
        their differences.

    If the sensor gives no observation at a step, call only `predict` at this step, and
    not `update`. If an observation is not finite, the estimator ignores it, and
    `status` reports a failure. `status` is

    - `diverged` if an observation or the solution is not finite. If the solution is not
        finite, the estimate stays as it was before the update.
    - `no_feasible_point` if no solution satisfies all bounds.
    - `inaccurate` if the bounds are violated slightly because of rounding.
    - `not_converged` if the search for the active bounds did not finish. If
        `iterations` is above 1, `status` is also `not_converged` if more iterations
        would still change the estimate.

    **Raises:** `ValueError` if `dynamics` is not an `AbstractDynamics`, a covariance is
    not symmetric and semidefinite, the sizes of the arguments do not match, bounds are
    not numbers with `low <= high`, a parameter is not finite in the dynamics, or a
    number is out of its range.

    Source: Rao, Rawlings and Mayne, 2003; Haseltine and Rawlings, 2005; Kühl et al.,
    2011 (the prior); Diehl et al., 2005 (the real-time iteration); Huber, 1964.

    !!! example

        ```python
        import delucax as dlx
        import equinox as eqx
        import jax.numpy as jnp

        pendulum = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05)
        W, V = 1e-4 * jnp.eye(2), 1e-2 * jnp.eye(2)
        mhe = dlx.estimators.MHE(pendulum, W, V, 10, bounds=([-1.0, -5.0], [1.0, 5.0]))
        state = mhe.init()
        update, predict = eqx.filter_jit(mhe.update), eqx.filter_jit(mhe.predict)
        for k in range(3):
            t = jnp.asarray(0.05 * k)  # a Python number would compile again
            state = update(t, jnp.array([0.1, 0.0]), state)
            mean, covariance = mhe.estimate(state)
            state = predict(t, jnp.zeros(1), state)
        ```
    """

    dynamics: AbstractDynamics
    W: Float[Array, "k k"] = parameter()
    V: Float[Array, "p p"] = parameter()
    window: int = eqx.field(static=True)
    _: KW_ONLY
    mean: Float[Array, " n"] = parameter(None)
    covariance: Float[Array, "n n"] = parameter(None)
    bounds: Any = None
    disturbance_bounds: Any = None
    parameters: dict[str, RandomWalk] = eqx.field(default_factory=dict)
    robust: RealOrNone = parameter(None, constraint=positive)
    iterations: int = eqx.field(default=1, static=True)
    observation_difference: Difference | None = function_field(None, of="a, b")

    def __post_init__(self):
        where = "MHE"
        check_dynamics(self.dynamics, where)
        given = self.W, self.V, self.mean, self.covariance
        self.W, self.V, self.mean, self.covariance = checked_model(
            self.dynamics, *given, where
        )
        for name, size in (
            ("bounds", self.dynamics.state_size),
            ("disturbance_bounds", self.dynamics.disturbance_size),
        ):
            setattr(self, name, as_bounds(getattr(self, name), where, name, size))

    def __check_init__(self):
        where, dynamics = "MHE", self.dynamics
        check_dynamics(dynamics, where)
        given = self.W, self.V, self.mean, self.covariance
        checked_model(dynamics, *given, where)
        as_bounds(self.bounds, where, "bounds", dynamics.state_size)
        size = dynamics.disturbance_size
        as_bounds(self.disturbance_bounds, where, "disturbance_bounds", size)
        check_walks(self.parameters, dynamics, where)
        check_count(self.window, "window", where)
        check_count(self.iterations, "iterations", where)
        if self.robust is not None:
            check_number(self.robust, "robust", where)
            check_positive(self.robust, "robust", where)
            if is_concrete(self.V) and not is_definite(self.V):
                raise ValueError(
                    f"{where}: V must be positive definite with robust, because a "
                    f"perfect sensor has no outliers, got {shortened(self.V)}."
                )

    @property
    def _walks(self) -> dict[str, RandomWalk]:
        """The parameters in the order in which JAX sorts them, because a dictionary
        comes out of `jax.jit` in this order."""
        return dict(sorted(self.parameters.items()))

    def _model(self) -> tuple[Model, Belief]:
        """The model with the parameters as states, and the prior of the first state."""
        dynamics, W, P, mean = self.dynamics, self.W, self.covariance, self.mean
        dtype = mean.dtype
        states, noise = (
            pair and tuple(end.astype(dtype) for end in pair)
            for pair in (self.bounds, self.disturbance_bounds)
        )
        if walks := tuple(self._walks.values()):
            wide = WithParameters(dynamics, tuple(self._walks))
            sizes = [value.size for value in wide.values(wide.start).values()]

            def joined(entries):
                pairs = zip(entries, sizes, strict=True)
                whole = [jnp.broadcast_to(a, (size,)) for a, size in pairs]
                return jnp.concatenate(whole).astype(dtype)

            W = _block(W, joined([walk.step for walk in walks]))
            P = _block(P, joined([walk.variance for walk in walks]))
            mean = jnp.concatenate([mean, wide.start.astype(dtype)])
            ends = [walk.bounds or (-jnp.inf, jnp.inf) for walk in walks]
            if states is not None or any(walk.bounds for walk in walks):
                states = _beside(
                    states, self.mean, map(joined, zip(*ends, strict=True))
                )
            if noise is not None:
                free = jnp.full(sum(sizes), jnp.inf, dtype)
                noise = _beside(noise, self.W[0], (-free, free))
            dynamics = wide
        weights = W.astype(dtype), self.V.astype(dtype)
        options: Any = states, noise, self.robust, self.observation_difference
        return Model(dynamics, *weights, *options), Belief(mean, P)

    def init(self, *, key: PRNGKey | None = None) -> PyTree:
        del key
        model, prior = self._model()
        pairs = (model.states, len(prior.mean)), (model.disturbances, len(model.W))
        bounded = sum(size for pair, size in pairs if pair is not None)
        return first_window(model, prior, self.window, bounded)

    def update(self, t: RealScalar, y: Observation, state: Window) -> PyTree:
        if y.shape != self.V.shape[:1]:
            raise wrong_observation(self, self.V.shape[0], y)
        model, _ = self._model()
        is_seen = jnp.all(jnp.isfinite(y))
        window = state._replace(
            t=state.t.at[-1].set(t),
            y=state.y.at[-1].set(jnp.where(is_seen, y, 0).astype(state.y.dtype)),
            is_seen=state.is_seen.at[-1].set(is_seen),
        )
        after = solved(model, window, self.iterations)
        result = choose(is_seen, after.result, RESULTS.diverged)
        return after._replace(result=result)

    def predict(self, t: RealScalar, u: Control, state: Window) -> PyTree:
        if u.shape != (self.dynamics.control_size,):
            raise ValueError(
                f"MHE.predict: u must have shape ({self.dynamics.control_size},), got "
                f"shape {u.shape}."
            )
        model, _ = self._model()
        return moved(model, t, u.astype(state.u.dtype), state)

    def estimate(self, state: Window) -> Belief:
        """The current mean and covariance of the plant's state.

        **Arguments:** `state`: the state of the estimator.

        **Returns:** a [`delucax.estimators.Belief`][], without the parameters.
        """
        n = self.dynamics.state_size
        return Belief(state.belief.mean[:n], state.belief.covariance[:n, :n])

    def estimated_parameters(self, state: Window) -> dict[str, Belief]:
        """The current mean and covariance of each parameter.

        **Arguments:** `state`: the state of the estimator.

        **Returns:** a dictionary from paths to a [`delucax.estimators.Belief`][] of the
        flattened parameter.
        """
        wide = WithParameters(self.dynamics, tuple(self._walks))
        at, out = self.dynamics.state_size, {}
        for path, value in wide.values(state.belief.mean[at:]).items():
            here = slice(at, at + value.size)
            covariance = state.belief.covariance[here, here]
            out[path] = Belief(jnp.ravel(value), covariance)
            at += value.size
        return out

    def trajectory(self, state: Window) -> tuple[Array, Array]:
        """The states and disturbances of the window, given all of its observations.

        **Arguments:** `state`: the state of the estimator.

        **Returns:** `(states, disturbances)`, shapes `(N, n)` and `(N - 1, k)`, without
        the parameters. The last rows are the newest. Until the window is full, the
        first rows are NaN.
        """
        model, _ = self._model()
        there = state.is_there[:, None]
        x = jnp.where(there, state.x, jnp.nan)[:, : self.dynamics.state_size]
        w = jnp.where(there, state.zeta @ model.W, jnp.nan)[:-1]
        return x, w[:, : self.dynamics.disturbance_size]

    def status(self, state: Window) -> Result:
        return state.result


def _block(matrix: Array, variances: Array) -> Array:
    """A covariance extended by independent entries with these variances."""
    rest = jnp.zeros((len(matrix), len(variances)), matrix.dtype)
    return jnp.block([[matrix, rest], [rest.T, jnp.diag(variances)]])


def _beside(bounds: Any, like: Array, more: Any) -> tuple[Array, Array]:
    """The bounds of the entries of `like`, extended by `more`."""
    own = (-jnp.inf, jnp.inf) if bounds is None else bounds
    pairs = zip(own, more, strict=True)
    wide = (jnp.concatenate([jnp.broadcast_to(a, like.shape), b]) for a, b in pairs)
    low, high = (a.astype(like.dtype) for a in wide)
    return low, high
