"""The window of moving-horizon estimation, its linearisation and its iterations."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax

from .._jax import value_and_jacobians
from .._results import choose, Result, RESULTS
from .._typing import Array, BoolScalar, Difference, RealScalar
from ..dynamics import AbstractDynamics
from ..math._linear_solve import full_precision, symmetric
from ._base import Belief
from ._window_bounds import Limits, smoothed_between
from ._window_smoother import independent, observed, Rows, Smoothed, smoothed, Steps


_LENGTHS = tuple(2.0**-i for i in range(12))
"""The lengths of a step that the line search tries."""
_DECREASE = 1e-4
"""The share of the predicted decrease that a step must reach (Armijo)."""


class Window(NamedTuple):
    """The state of the estimator. The newest stage is the last one. Until the window is
    full, its first stages are unused."""

    t: Array  # (N,)
    u: Array  # (N, m), the control after each stage; the last one is not known yet
    y: Array  # (N, p)
    is_seen: Array  # (N,), whether the stage has an observation
    count: Array  # the number of stages in use
    prior: Belief  # of the first state, without the observations of the window
    x: Array  # (N, n)
    zeta: Array  # (N, k), the disturbances are `w = W zeta`
    sides: Array  # (N, q), the active bounds
    belief: Belief  # of the last state
    result: Result

    @property
    def is_there(self) -> Array:
        """Whether each stage is in use."""
        size = len(self.t)
        return jnp.arange(size) >= size - self.count


class Model(eqx.Module):
    """The model of the estimator. Estimated parameters are states of `dynamics`."""

    dynamics: AbstractDynamics
    W: Array
    V: Array
    states: tuple[Array, Array] | None
    disturbances: tuple[Array, Array] | None
    threshold: Array | None
    difference: Difference | None

    def advanced(self, t: RealScalar, x: Array, u: Array, w: Array) -> Array:
        """The next state; NaN if the solver fails."""
        after, result = self.dynamics.advance(t, x, u, w)
        if result is RESULTS.successful:
            return after
        return jnp.where(result == RESULTS.successful, after, jnp.nan)

    def step(self, t: RealScalar, x: Array, u: Array, w: Array) -> Any:
        """The next state, and its derivatives with respect to state and disturbance."""
        after, (A, E) = value_and_jacobians(
            lambda x, w: self.advanced(t, x, u, w), x, w
        )
        return after, A, E

    def missed(self, t: RealScalar, x: Array, y: Array) -> Array:
        """The residual of an observation: its difference from the predicted one."""
        expected = self.dynamics.observe(t, x)
        if self.difference is None:
            return y - expected
        return self.difference(y, expected)

    def sensor(self, t: RealScalar, x: Array, y: Array) -> tuple[Array, Array]:
        """The residual of an observation, and the derivative of the predicted one."""
        error, (C,) = value_and_jacobians(lambda x: self.missed(t, x, y), x)
        return error, -C

    def rows(self, t: Array, x: Array, y: Array, is_seen: Array) -> tuple[Rows, Array]:
        """The observations of the stages as rows, and their penalties.

        With a threshold, an observation with a large residual has less weight.
        """
        error, C = jax.vmap(self.sensor)(t, x, y)
        error = jnp.where(is_seen[:, None], error, 0)
        C = jnp.where(is_seen[:, None, None], C, 0)
        variance, C, error = independent(self.V, C, error)
        share, penalty = self.weighed(variance, error)
        return Rows(C, variance / share[:, None], error), penalty

    def weighed(self, variance: Array, error: Array) -> tuple[Array, Array]:
        """The least-squares weights of the observations, and their penalties."""
        square = jnp.sum(error**2 / jnp.where(variance > 0, variance, 1), axis=1)
        if self.threshold is None:
            return jnp.ones_like(square), square / 2
        # Huber's penalty has the slope r up to the threshold, and a constant slope
        # beyond. In least squares this is a weight of threshold / r.
        limit = self.threshold
        is_far = square > limit**2
        r = jnp.sqrt(jnp.where(is_far, square, 1))
        share = jnp.where(is_far, limit / r, 1)
        return share, jnp.where(is_far, limit * (r - limit / 2), square / 2)


def first_window(model: Model, prior: Belief, size: int, bounded: int) -> Window:
    """The window before the first observation."""
    dynamics, dtype = model.dynamics, prior.mean.dtype
    zeros = lambda *shape: jnp.zeros((size, *shape), dtype)
    return Window(
        zeros(),
        zeros(dynamics.control_size),
        zeros(len(model.V)),
        jnp.zeros(size, bool),
        jnp.ones((), int),
        prior,
        jnp.tile(prior.mean, (size, 1)),
        zeros(len(model.W)),
        jnp.zeros((size, bounded), int),
        prior,
        choose(jnp.asarray(True), RESULTS.successful, RESULTS.diverged),
    )


@full_precision
def moved(model: Model, t: RealScalar, u: Array, window: Window) -> Window:
    """The window a step later. If it is full, the first stage goes into the prior."""
    dtype = window.x.dtype
    us, ts = window.u.at[-1].set(u), window.t.at[-1].set(t)
    ends = jnp.array([0, -1])
    w = (window.zeta[0] @ model.W) * jnp.array([[1.0], [0.0]], dtype)
    w = w.astype(dtype)
    after, A, E = jax.vmap(model.step)(ts[ends], window.x[ends], us[ends], w)

    def predicted(covariance, k):
        return symmetric(A[k] @ covariance @ A[k].T + E[k] @ model.W @ E[k].T)

    # One step of the Kalman filter on the first stage, linearised about the state that
    # the window has for it now.
    rows, _ = model.rows(ts[:1], window.x[:1], window.y[:1], window.is_seen[:1])
    first = window.x[0]
    d = model.dynamics.difference(window.prior.mean, first)
    d, P, _ = observed(d, window.prior.covariance, Rows(*(a[0] for a in rows)))
    mean = after[0] + jnp.sum(A[0] * d, axis=1) - jnp.sum(E[0] * w[0], axis=1)
    is_full = window.count == len(window.t)
    prior = jax.tree.map(
        lambda a, b: jnp.where(is_full, a, b),
        Belief(mean, predicted(P, 0)),
        window.prior,
    )
    belief = Belief(after[1], predicted(window.belief.covariance, 1))
    if len(window.t) == 1:
        # A window of one stage is the Kalman filter.
        belief = prior
    push = lambda a, new: jnp.concatenate([a[1:], new[None].astype(a.dtype)])
    nothing = lambda a: push(a, jnp.zeros_like(a[0]))
    finite = jnp.all(jnp.isfinite(belief.mean)) & prior.is_finite
    return Window(
        push(ts, ts[-1] + model.dynamics.dt),
        nothing(us),
        nothing(window.y),
        nothing(window.is_seen),
        jnp.minimum(window.count + 1, len(window.t)),
        prior,
        push(window.x, belief.mean),
        nothing(window.zeta),
        nothing(window.sides),
        belief,
        choose(finite, RESULTS.successful, RESULTS.diverged),
    )


class Point(NamedTuple):
    """An iterate: the states, the disturbances `w = W zeta`, and `rho`, by which the
    first state is `mean + covariance rho`."""

    x: Array
    zeta: Array
    rho: Array


class Linear(NamedTuple):
    """The window linearised about a point, with the penalties at the point."""

    steps: Steps
    rows: Rows
    start: Belief
    penalty: Array
    defects: Array


@full_precision
def solved(model: Model, window: Window, iterations: int) -> Window:
    """The window with its least-squares estimate after `iterations` steps."""
    point = Point(window.x, window.zeta, jnp.zeros_like(window.prior.mean))
    if model.states is not None:
        point = point._replace(x=jnp.clip(point.x, *model.states))
    if iterations == 1:
        linear = _linear(model, window, point)
        given = model, window, window.sides, point, linear
        point, sides, belief, result, _ = _stepped(*given)
    else:

        def again(carry, _):
            point, sides, *_ = carry
            return _searched(model, window, sides, point), None

        once = _searched(model, window, window.sides, point)
        carry, _ = lax.scan(again, once, length=iterations - 1)
        point, sides, belief, result = carry
    finite = belief.is_finite & jnp.all(jnp.isfinite(point.x))
    pick = lambda a, b: jnp.where(finite, a, b)
    result = choose(finite, result, RESULTS.diverged)
    solution = point.x, point.zeta, sides, belief
    before = window.x, window.zeta, window.sides, window.belief
    x, zeta, sides, belief = jax.tree.map(pick, solution, before)
    return window._replace(x=x, zeta=zeta, sides=sides, belief=belief, result=result)


def _linear(model: Model, window: Window, point: Point) -> Linear:
    """The window linearised about a point, in deviations from the point."""
    there, x = window.is_there, point.x
    (size, n), k = x.shape, len(model.W)
    w = point.zeta @ model.W
    A, E = jnp.zeros((0, n, n), x.dtype), jnp.zeros((0, n, k), x.dtype)
    defects = jnp.zeros((0, n), x.dtype)
    if size > 1:
        after, A, E = jax.vmap(model.step)(window.t[:-1], x[:-1], window.u[:-1], w[:-1])
        defects = jax.vmap(model.dynamics.difference)(after, x[1:])
    is_step = there[:-1]
    A = jnp.where(is_step[:, None, None], A, jnp.eye(n, dtype=x.dtype))
    E = jnp.where(is_step[:, None, None], E, 0)
    defects = jnp.where(is_step[:, None], defects, 0)
    b = defects - jnp.sum(E * w[:-1, None], axis=2)
    # After the last stage and before the first one in use, the state stays constant.
    stays = jnp.eye(n, dtype=x.dtype)[None], jnp.zeros((1, n, k), x.dtype)
    ends = *stays, jnp.zeros((1, n), x.dtype)
    pairs = zip((A, E, b), ends, strict=True)
    steps = Steps(*(jnp.concatenate(pair).astype(x.dtype) for pair in pairs))
    rows, penalty = model.rows(window.t, x, window.y, window.is_seen & there)
    d = model.dynamics.difference(window.prior.mean, x[size - window.count])
    return Linear(steps, rows, Belief(d, window.prior.covariance), penalty, defects)


def _limits(model: Model, window: Window, point: Point) -> Limits | None:
    """The bounds of the deviations and of the disturbances, or `None`."""
    n, k = point.x.shape[1], len(model.W)
    there = window.is_there
    is_step = there.at[-1].set(False)
    parts, entries = [], ()
    for pair, at, on, first, size in (
        (model.states, point.x, there, 0, n),
        (model.disturbances, jnp.zeros((len(there), k)), is_step, n, k),
    ):
        if pair is not None:
            low, high = (end - at.astype(point.x.dtype) for end in pair)
            low = jnp.where(on[:, None], low, -jnp.inf)
            parts.append((low, jnp.where(on[:, None], high, jnp.inf)))
            entries += tuple(range(first, first + size))
    if not entries:
        return None
    low, high = (jnp.concatenate(ends, axis=1) for ends in zip(*parts, strict=True))
    return Limits(low, high, entries)


def _stepped(
    model: Model, window: Window, sides: Array, point: Point, linear: Linear
) -> tuple[Point, Array, Belief, Result, Smoothed]:
    """One full step: the new point, its active bounds, the belief of the current state,
    the status, and the solution of the linear window."""
    limits = _limits(model, window, point)
    if limits is None:
        free = solution = smoothed(linear.steps, linear.rows, linear.start, model.W)
        result = choose(jnp.asarray(True), RESULTS.successful, RESULTS.diverged)
    else:
        given = linear.steps, linear.rows, limits, linear.start, model.W
        solution, free, sides, result = smoothed_between(*given, sides)
    there = window.is_there[:, None]
    x = jnp.where(there, point.x + solution.d, point.x)
    if model.states is not None:
        # The solution violates the bounds by rounding only.
        x = jnp.where(there, jnp.clip(x, *model.states), point.x)
    after = Point(x, solution.zeta, solution.rho[0])
    belief = Belief(x[-1], free.last.covariance)
    return after, sides, belief, result, solution


def _searched(
    model: Model, window: Window, sides: Array, point: Point
) -> tuple[Point, Array, Belief, Result]:
    """One step with a line search on an exact penalty function."""
    linear = _linear(model, window, point)
    full, after, belief, result, solution = _stepped(
        model, window, sides, point, linear
    )
    fixed = lax.stop_gradient((model, window, point, full, linear, solution))
    length, near = _length(*fixed)
    blend = lambda a, b: a + length * (b - a)
    point = jax.tree.map(blend, point, full)
    belief = belief._replace(mean=point.x[-1])
    result = choose(near, result, RESULTS.not_converged)
    return point, after, belief, result


def _length(
    model: Model,
    window: Window,
    point: Point,
    full: Point,
    linear: Linear,
    solution: Smoothed,
) -> tuple[Array, BoolScalar]:
    """The first step length that lowers the penalty function enough, and whether the
    point is near the minimum."""
    count = linear.rows.c.shape[1]
    n, P, W = point.x.shape[1], window.prior.covariance, model.W
    exact = linear.rows.variance == 0
    # The penalty is exact if its weights exceed the multipliers (Han, 1977).
    price = 2 * jnp.max(jnp.abs(solution.rho), axis=0)
    row_price = 2 * jnp.max(jnp.abs(solution.u[:, :count]), axis=0)

    def form(M, a):
        return jnp.sum(a * (a @ M)) / 2

    def total(at: Point, defects, off, error, penalty):
        value = form(P, at.rho) + form(W, at.zeta) + jnp.sum(penalty)
        value = value + jnp.sum(price * (jnp.sum(jnp.abs(defects), axis=0)))
        value = value + jnp.sum(price * jnp.abs(off))
        return value + jnp.sum(jnp.where(exact, row_price * jnp.abs(error), 0))

    def off_start(at):
        first = at.x[len(at.x) - window.count]
        d = model.dynamics.difference(window.prior.mean, first)
        return d + P @ at.rho

    def value(length):
        at = jax.tree.map(lambda a, b: a + length * (b - a), point, full)
        defects = jnp.zeros((0, n), at.x.dtype)
        if len(at.x) > 1:
            w = at.zeta @ W
            given = window.t[:-1], at.x[:-1], window.u[:-1], w[:-1]
            reached = jax.vmap(model.advanced)(*given)
            defects = jax.vmap(model.dynamics.difference)(reached, at.x[1:])
        defects = jnp.where(window.is_there[:-1, None], defects, 0)
        seen = (window.is_seen & window.is_there)[:, None]
        error = jax.vmap(model.missed)(window.t, at.x, window.y)
        variance, error = independent(model.V, jnp.where(seen, error, 0))
        _, penalty = model.weighed(variance, error)
        return total(at, defects, off_start(at), error, penalty)

    now = total(
        point, linear.defects, off_start(point), linear.rows.target, linear.penalty
    )
    # The penalty function that the linear model predicts for the full step.
    rows = linear.rows
    left = rows.target - jnp.sum(rows.c * solution.d[:, None, :], axis=2)
    variance, _ = independent(model.V, left)
    _, penalty = model.weighed(variance, left)
    promised = total(full, jnp.zeros_like(linear.defects), 0.0, 0 * left, penalty)
    gain = now - promised
    lengths = jnp.array(_LENGTHS, point.x.dtype)
    values = jax.vmap(value)(lengths)
    slack = 100 * jnp.finfo(point.x.dtype).eps * (1 + jnp.abs(now))
    lower = values <= now - _DECREASE * lengths * gain + slack
    length = jnp.where(jnp.any(lower), lengths[jnp.argmax(lower)], lengths[-1])
    near = gain <= jnp.finfo(point.x.dtype).eps ** 0.5 * (1 + jnp.abs(now))
    return length, near
