"""Model predictive control."""

import inspect
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array

from .._check import (
    as_bounds,
    check_bool,
    check_count,
    check_finite,
    check_instance,
    check_key,
)
from .._controller import AbstractController, Tally, wrong_observation
from .._message import shortened
from .._module import (
    as_float_array,
    as_module,
    function_field,
    parameter,
    StaticFunction,
)
from .._results import Result, RESULTS
from ..costs import AbstractCost
from ..costs._base import check_cost
from ..dynamics import AbstractDynamics
from ..math import matvec
from ..planning import default_start, ilqr, Start
from ..planning._start import as_start, controls_of


_OURS = ("dynamics", "cost", "x0", "controls", "t0", "w", "bounds", "key", "throw")
"""Arguments of a planner that `MPC` gives itself."""


class MPCState(NamedTuple):
    """What [`delucax.controllers.MPC`][] remembers.

    **Attributes:** `controls`, shape `(T, m)`, `states`, shape `(T+1, n)`, and `gains`,
    shape `(T, m, n)`, of the last plan a step later, from which the next one starts;
    `result`, that of the last plan; `failures`, a [`delucax.controllers.Tally`][] of
    the plans that did not succeed; `iterations`, how many the last plan took; `key`,
    for planners that draw.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dynamics = dlx.LinearDynamics(jnp.eye(1), jnp.eye(1))
        cost = dlx.costs.Quadratic([1.0], [1.0])
        mpc = dlx.controllers.MPC(dynamics, cost, 5)
        u, state = mpc(0.0, jnp.ones(1), mpc.init())
        state.failures.count
        ```
    """

    controls: Array
    states: Array
    gains: Array
    result: Result
    failures: Tally
    iterations: Array
    key: Any


class MPC(AbstractController):
    """Model predictive control: plan from where the plant is, apply the first control,
    and plan again.

    `u_k` is the first control of the plan over `T` steps from `y_k` at `t_k`. It works
    with every planner of [`delucax.planning`][delucax.planning.ilqr], and with a cost
    that depends on time, such as a reference to follow.

    Each plan starts from the cheapest of a few trajectories from `y_k`, which are
    computed together between the bounds:

    1. the last plan a step later, under its gains, its last control held,
    2. the LQR about an operating point,
    3. the control of that point, held.

    The second one keeps an unstable plant where the model is worth something, and a
    plan of [`delucax.planning.ilqr`][] without constraints costs at most as much as
    each of them. It is computed when the controller is made, about the point that
    [`delucax.planning.default_start`][] chooses: the targets of the cost, or the
    equilibrium of the dynamics, or zero where neither names one, as with
    [`delucax.costs.Function`][] or [`delucax.costs.Tracking`][] over dynamics of your
    own. An unstable plant needs a `start` where it is to be held far from that point,
    and where there is no LQR: the second derivative of the cost with respect to the
    control is not positive definite there, no gain stabilises the plant, or the
    dynamics cannot be differentiated.

    What became of a plan is in the controller's state: `result`, and how often it was
    no success, `failures`, which are `incidents["failed_plan"]` of a rollout. A plan
    that ran out of iterations or found no descent is used as it is, the best so far.
    Where there is none to use, since every start diverges or the constraints cannot
    hold, `throw` says what happens.

    Derivatives are those of the planner: of [`delucax.planning.ilqr`][] by the implicit
    function theorem, NaN where a plan did not converge. Of a planner that samples they
    go through the start that was taken; which one that is, is held.

    **Arguments:**

    - `dynamics`: the model, which observes its state; around an estimator see
        [`delucax.controllers.OutputFeedback`][].
    - `cost`: the stage and final cost. A final cost that bounds what comes after the
        horizon lets this be short.
    - `horizon`: the steps `T` of a plan.
    - `planner`: [`delucax.planning.ilqr`][] by default, [`delucax.planning.mppi`][],
        [`delucax.planning.cem`][], or any function with their arguments, the fourth of
        which is a [`delucax.planning.Start`][].
    - `bounds`: `(low, high)` of the controls, each a number or of shape `(m,)`; none by
        default.
    - `start`: what each plan may start from besides the last one:
        [`delucax.planning.default_start`][] by default, the second and third above;
        controls in place of the third, shape `(T, m)`; or a
        [`delucax.planning.Start`][] in place of both, such as another stabilising law,
        or controls alone.
    - `throw`: raise at run time where there is no plan to use (default). If false, the
        last plan is followed for one more step, under its gains, and forgotten; if
        there is no plan in the next step either, the first one of `start`, by default
        the LQR, is applied.
    - `**options`: other arguments of the planner, such as `max_iterations`, `samples`
        or `constraints`. Floating-point numbers among them can be differentiated and
        changed without compiling again. With `states` each plan starts from these, and
        from the controls of the last plan, alone.

    **Raises:** `ValueError` on arguments of the wrong kind or shape, or options that
    the planner does not have; an error at run time as `throw` says.

    Source: Richalet, Rault, Testud and Papon, 1978; Diehl, Bock and Schloeder, 2005
    (warm start).

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        env = dlx.make("pendulum", dt=0.02)
        cost = dlx.costs.Quadratic([1.0, 0.1], [0.1], final=[20.0, 5.0])
        mpc = dlx.controllers.MPC(env.dynamics, cost, 20, bounds=(-2.0, 2.0))
        x0 = jnp.array([0.3, 0.0])
        run = dlx.rollout(env, mpc, key=jax.random.key(0), x0=x0, horizon=30)
        run.total_cost
        ```
    """

    dynamics: AbstractDynamics
    cost: AbstractCost
    start: Start
    low: Array | None = parameter()
    high: Array | None = parameter()
    planner: Callable[..., Any] = function_field()
    options: dict[str, Any]
    settings: tuple[tuple[str, Any], ...] = eqx.field(static=True)
    draws: bool = eqx.field(static=True)
    throw: bool = eqx.field(static=True)

    def __init__(
        self,
        dynamics: AbstractDynamics,
        cost: AbstractCost,
        horizon: int,
        *,
        planner: Callable[..., Any] = ilqr,
        bounds: Any = None,
        start: Any = None,
        throw: bool = True,
        **options: Any,
    ):
        where = "MPC"
        check_instance(dynamics, AbstractDynamics, "dynamics", where)
        check_cost(cost, "cost", where)
        horizon = check_count(horizon, "horizon", where)
        self.draws = "key" in _known(planner, options, where)
        ends = as_bounds(bounds, where)
        m = dynamics.control_size
        if isinstance(start, Start):
            start = as_start(start, dynamics.state_size, m, "start", where)
            if controls_of(start).shape[0] != horizon:
                raise ValueError(
                    f"{where}: start must have {horizon} steps, as the horizon, got "
                    f"{controls_of(start).shape[0]}."
                )
        else:
            if start is not None:
                start = as_float_array(start)
                if not eqx.is_inexact_array(start) or start.shape != (horizon, m):
                    array = eqx.is_array(start)
                    got = f"shape {start.shape}" if array else shortened(start)
                    raise ValueError(
                        f"{where}: start must have shape (horizon, controls) = "
                        f"({horizon}, {m}), got {got}."
                    )
                check_finite(start, "start", where)
            start = default_start(dynamics, cost, horizon, controls=start)
        self.dynamics, self.cost = dynamics, cost
        self.start = _stacked(start, dynamics.state_size)
        self.low, self.high = (None, None) if ends is None else ends
        self.planner = planner
        self.throw = check_bool(throw, "throw", where)
        kept, fixed = {}, []
        for name, value in sorted(options.items()):
            # The spacing of differences is part of the planner's program.
            whole = isinstance(value, bool | int | str | None | np.integer)
            if whole or name == "finite_difference":
                fixed.append((name, value))
            else:
                kept[name] = as_module(as_float_array(value))
        self.options, self.settings = kept, tuple(fixed)

    def __check_init__(self):
        where, dynamics = "MPC", self.dynamics
        check_instance(dynamics, AbstractDynamics, "dynamics", where)
        n, m = dynamics.state_size, dynamics.control_size
        check_cost(self.cost, "cost", where, (n, m))
        planner: Any = self.planner
        planner = planner.function if isinstance(planner, StaticFunction) else planner
        options = self.options | dict(self.settings)
        if self.draws != ("key" in _known(planner, options, where)):
            raise ValueError(
                f"{where}: planner must draw if the old one did, and must not if it "
                "did not; build the controller anew."
            )
        if not isinstance(self.start, Start):
            raise ValueError(
                f"{where}: start must be a delucax.planning.Start, got "
                f"{type(self.start).__name__}."
            )
        shape = self.start.controls.shape
        if len(shape) != 3:
            raise ValueError(
                f"{where}: start.controls must have shape (c, horizon, {m}), got "
                f"{shape}."
            )
        c, T, _ = shape
        rows = dict(controls=(c, T, m), states=(c, T + 1, n), gains=(c, T, m, n))
        for name, row in rows.items():
            got = getattr(getattr(self.start, name), "shape", None)
            if got != row:
                raise ValueError(
                    f"{where}: start.{name} must have shape {row}, got {got}."
                )
        if self.low is None and self.high is None:
            return
        for end in as_bounds((self.low, self.high), where) or ():
            if end.shape not in ((), (m,)):
                raise ValueError(
                    f"{where}: bounds must be numbers or vectors of {m} entries, one "
                    f"for each control, got shape {end.shape}."
                )

    def init(self, *, key=None):
        if self.draws:
            check_key(key, "MPC.init")
        result = jax.tree.map(jnp.asarray, RESULTS.successful)
        zero = jnp.zeros((), int)
        first = jax.tree.map(lambda a: a[0], self.start)
        return MPCState(
            first.controls,
            first.states,
            first.gains,
            result,
            Tally("failed_plan"),
            zero,
            key if self.draws else None,
        )

    def __call__(self, t, y, state):
        size = self.dynamics.state_size
        if y.shape != (size,):
            raise wrong_observation(self, size, y)
        options: dict[str, Any] = dict(self.options) | dict(self.settings)
        key = state.key
        if self.draws:
            key, options["key"] = jr.split(key)
        bounds = None if self.low is None else (self.low, self.high)
        last = Start(state.controls, state.states, state.gains)
        starts = state.controls
        if "states" not in self.options:
            join = lambda a, b: jnp.concatenate([a[None], b])
            starts = jax.tree.map(join, last, self.start)
        plan = self.planner(
            self.dynamics,
            self.cost,
            y,
            starts,
            t0=t,
            bounds=bounds,
            throw=False,
            **options,
        )
        lost = (plan.result == RESULTS.diverged) | (plan.result == RESULTS.infeasible)
        lost = lost | ~jnp.all(jnp.isfinite(plan.controls))
        u = jnp.where(lost, self._followed(y, state), plan.controls[0])
        if self.throw:
            u = plan.result.error_if(u, lost)
        shift = lambda a: jnp.concatenate([a[1:], a[-1:]])
        later = Start(*(shift(a) for a in (plan.controls, plan.states, plan.gains)))
        renewed = lambda new, old: jnp.where(lost, old[0], new).astype(old.dtype)
        later = jax.tree.map(renewed, later, self.start)
        failed = plan.result != RESULTS.successful
        after = MPCState(
            later.controls,
            later.states,
            later.gains,
            plan.result,
            state.failures.add(failed),
            jnp.asarray(plan.iterations, state.iterations.dtype),
            key,
        )
        return u.astype(y.dtype), after

    def _followed(self, y: Array, last: MPCState) -> Array:
        """The control of the last plan, or of the first start where there is none."""
        difference = self.options.get("difference")
        x = last.states[0]
        e = y - x if difference is None else difference(y, x)
        u = last.controls[0]
        tried = u - matvec(last.gains[0], e)
        u = jnp.where(jnp.isfinite(tried), tried, u)
        if self.low is not None and self.high is not None:
            u = jnp.minimum(jnp.maximum(u, self.low), self.high)
        return u


def _known(planner: Any, options: Mapping[str, Any], where: str) -> tuple[str, ...]:
    """The names of a planner's arguments, among which those of `options` are."""
    if not callable(planner):
        raise ValueError(
            f"{where}: planner must be a function such as delucax.planning.ilqr, got "
            f"{planner!r}."
        )
    known = tuple(inspect.signature(planner).parameters)
    for name in options:
        if name not in known or name in _OURS:
            raise ValueError(
                f"{where}: {name} is no option of the planner; it has "
                f"{', '.join(k for k in known if k not in _OURS)}."
            )
    return known


def _stacked(start: Start, n: int) -> Start:
    """One start or several as several, with states and gains."""
    if start.controls.ndim == 2:
        start = jax.tree.map(lambda a: a[None], start)
    controls, states, gains = start.controls, start.states, start.gains
    c, T, m = controls.shape
    if states is None or gains is None:
        states = jnp.zeros((c, T + 1, n), controls.dtype)
        gains = jnp.zeros((c, T, m, n), controls.dtype)
    return Start(controls, states, gains)
