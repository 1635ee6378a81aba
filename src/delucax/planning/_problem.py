"""The planning problem: dynamics, cost and constraints, and their trajectories."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._jax import by_components, join_state, split_state, stack_steps
from .._module import shown
from .._results import choose, first_of, or_none, Result, RESULTS
from ..costs import AbstractCost
from ..dynamics import AbstractDynamics
from ..math import matvec
from ..math._small import products_whole
from ._constraints import Constraints, Values, values_of
from ._plan import Plan


_SPLIT_UP_TO = 6
"""Larger states are carried as one array: this is as fast, and the program is shorter.
"""


class Augmentation(NamedTuple):
    """The augmentation of the cost: Lagrange multipliers of the constraints at each
    step and at the end, and the penalty weight."""

    stage: Array  # (T, p)
    final: Array  # (q,)
    rho: Array


def augmented(c: Array, y: Array, rho: Array, equal: Array) -> Array:
    """The terms that constraints with values `c` and multipliers `y` add to the cost:
    `y c + rho c^2 / 2` for an equality, `(max(0, y + rho c)^2 - y^2) / (2 rho)` for an
    inequality.

    Source: Hestenes, 1969; Powell, 1969; Rockafellar, 1973 (inequalities).
    """
    # For an active inequality the two formulas agree. At the switch the first
    # derivative is continuous, and the second one jumps. With rho = 0 the sum with the
    # cost is the Lagrangian.
    active = equal | (y + rho * c > 0)
    safe = jnp.where(rho > 0, rho, 1)
    return jnp.sum(jnp.where(active, c * (y + rho * c / 2), -(y**2) / (2 * safe)))


def updated(c: Array, y: Array, rho: Array, equal: Array) -> Array:
    """The multipliers after a minimisation of the augmented Lagrangian."""
    return jnp.where(equal, y + rho * c, jnp.maximum(y + rho * c, 0))


def violated(c: Array, y: Array, rho: Array, equal: Array) -> Array:
    """The error of each constraint: its violation, and that of complementarity."""
    # max(c, -y / rho) is zero exactly if c <= 0, y >= 0 and y c = 0. It has the unit of
    # the constraint.
    slack = jnp.maximum(c, -y / rho)
    return jnp.where(equal, jnp.abs(c), jnp.abs(slack))


class FreeStart(eqx.Module):
    """The unknown entries of the first state, with their bounds (maybe infinite)."""

    low: Array
    high: Array
    entries: tuple[int, ...] = eqx.field(static=True)


class Problem(eqx.Module):
    """A planning problem: minimise a cost along a trajectory of the dynamics.

    [`delucax.planning.AbstractPlanner`][] passes the problem to the method `solve` of a
    planner. The arguments of this problem are already checked, and its arrays all have
    the same precision. You can differentiate with respect to every array of the
    problem.

    **Attributes:**

    - `dynamics`: the discrete-time dynamics.
    - `cost`: the stage and final cost.
    - `x0`: the first state, shape `(n,)`.
    - `t0`: the time of the first state.
    - `w`: known disturbances, shape `(T, k)`; `None` for zero.
    - `bounds`: the bounds `(low, high)` of the controls, each of shape `(m,)`; `None`
        without bounds.
    - `difference`: the function `(x, x_ref) -> deviation` that computes the deviation
        of a state from a reference; `None` for subtraction.
    - `constraints`: [`delucax.planning.Constraints`][]; `None` without constraints.
    - `multipliers`: the multipliers and the weight of the augmented Lagrangian. If
        multipliers are given, the costs of the problem include the terms of the
        augmented Lagrangian. `None` otherwise.
    - `unknowns`: [`delucax.planning.Unknowns`][]; `None` without unknowns.
    - `free`: the entries of the first state that are unknown. `x0` then holds guesses
        of them. `free` is `None` if the whole first state is given.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        env, x0 = dlx.make("pendulum"), jnp.array([0.5, 0.0])
        problem = dlx.planning.Problem(env.dynamics, env.cost, x0, jnp.zeros(()))
        states, controls, cost = problem.roll_out(jnp.zeros((10, 1)))
        problem.plan(states, controls, cost).result
        ```

        ```text
        <RESULTS.successful>
        ```
    """

    dynamics: AbstractDynamics
    cost: AbstractCost
    x0: Array
    t0: Array
    w: Array | None = None
    bounds: tuple[Array, Array] | None = None
    difference: Callable[[Array, Array], Array] | None = None
    constraints: Constraints | None = None
    multipliers: Augmentation | None = None
    unknowns: Any = None
    free: FreeStart | None = None

    __repr__ = shown

    def deviation(self, x: Array, x_ref: Array) -> Array:
        """The deviation of `x` from `x_ref`: `difference(x, x_ref)`, or `x - x_ref`.

        **Arguments:** `x`, `x_ref`: states, shape `(n,)`.
        """
        return x - x_ref if self.difference is None else self.difference(x, x_ref)

    def missed_start(self, x: Array) -> Array:
        """The deviation of the given first state from `x`; zero in the free entries."""
        missed = self.deviation(self.x0, x)
        if self.free is None:
            return missed
        return missed.at[np.array(self.free.entries)].set(0)

    def times(self, horizon: int) -> Array:
        """The times of the states, shape `(T+1,)`.

        **Arguments:** `horizon`: the number of steps `T`.
        """
        # Products, because rounding would accumulate in a sum.
        steps = jnp.arange(horizon + 1)
        return (self.t0 + steps * self.dynamics.dt).astype(self.x0.dtype)

    def clip(self, u: Array) -> Array:
        """The control, clipped to the bounds.

        **Arguments:** `u`: a control, shape `(m,)`.
        """
        if self.bounds is None:
            return u
        low, high = self.bounds
        return jnp.minimum(jnp.maximum(u, low), high)

    def room(self, controls: Array) -> tuple[Array, Array] | None:
        """The bounds of a change that is added to `controls`; `None` without bounds."""
        if self.bounds is None:
            return None
        low, high = self.bounds
        return low - controls, high - controls

    def step(self, t: Array, x: Array, u: Array, w: Array | None) -> Array:
        """The next state.

        **Arguments:** `t`: time. `x`: state, shape `(n,)`. `u`: control, shape `(m,)`.
            `w`: disturbance, shape `(k,)`, or `None`.
        """
        return self.dynamics.advance(t, x, u, w)[0].astype(x.dtype)

    def failure(self, states: Array, controls: Array) -> Result:
        """The first failure of the steps along a trajectory, or success.

        **Arguments:** `states`: shape `(T+1, n)`. `controls`: shape `(T, m)`.
        """
        # If all steps succeed statically, nothing is computed.
        of = lambda t, x, u, w: or_none(self.dynamics.advance(t, x, u, w)[1])
        times = self.times(controls.shape[0])
        return first_of(jax.vmap(of)(times[:-1], states[:-1], controls, self.w))

    def stage_constraints(self, t: Array, x: Array, u: Array) -> Values:
        """The values of the constraints of a step, at `t`, `x` and `u`."""
        assert self.constraints is not None
        return values_of(self.constraints, False, (t, x, u), x.dtype)

    def final_constraints(self, t: Array, x: Array) -> Values:
        """The values of the constraints at the end, at `t` and `x`."""
        assert self.constraints is not None
        return values_of(self.constraints, True, (t, x), x.dtype)

    def constraints_along(self, states: Array, controls: Array) -> tuple[Any, Any]:
        """The stage and final constraint functions along a trajectory, `states` and
        `controls`."""
        times = self.times(controls.shape[0])
        stage = jax.vmap(self.stage_constraints)(times[:-1], states[:-1], controls)
        return stage, self.final_constraints(times[-1], states[-1])

    def with_multipliers(self, multipliers: Augmentation | None) -> "Problem":
        """The same problem, with the augmented Lagrangian for `multipliers` as its
        cost."""
        return dataclasses.replace(self, multipliers=multipliers)

    def stage_cost(self, t: Array, x: Array, u: Array, y: Array | None) -> Array:
        """The cost of a step at time `t` with state `x` and control `u`, plus the terms
        of its constraints for multipliers `y`."""
        cost = self.cost(t, x, u)
        if self.multipliers is None or y is None:
            # `+ 0.0`, because an integer has no gradient.
            return jnp.asarray(cost + 0.0)
        c, equal = self.stage_constraints(t, x, u)
        return cost + augmented(c, y, self.multipliers.rho, equal)

    def final_cost(self, t: Array, x: Array) -> Array:
        """The final cost at `t` and `x`, plus the terms of the final constraints."""
        cost = jnp.asarray(self.cost.final(t, x) + 0.0)
        if self.multipliers is None:
            return cost
        c, equal = self.final_constraints(t, x)
        _, y, rho = self.multipliers
        return cost + augmented(c, y, rho, equal)

    @property
    def stage_multipliers(self) -> Array | None:
        """The multipliers of the stage constraints; `None` without multipliers."""
        return None if self.multipliers is None else self.multipliers.stage

    def total(self, states: Array, controls: Array) -> Array:
        """The cost of a trajectory: all stage costs and the final cost.

        **Arguments:** `states`: shape `(T+1, n)`. `controls`: shape `(T, m)`.

        **Returns:** a scalar.
        """
        times = self.times(controls.shape[0])
        each = (times[:-1], states[:-1], controls, self.stage_multipliers)
        with products_whole():
            final = self.final_cost(times[-1], states[-1])
            total = jnp.sum(jax.vmap(self.stage_cost)(*each)) + final
        return total.astype(states.dtype)

    @eqx.filter_jit
    def roll_out(
        self, controls: Array, states: Array | None = None, gains: Array | None = None
    ) -> tuple[Array, Array, Array]:
        """The trajectory from `x0` under the controls `controls - gains (x - states)`,
        clipped to the bounds.

        **Arguments:**

        - `controls`: shape `(T, m)`.
        - `states`: shape `(T+1, n)`, needed with `gains`; none by default.
        - `gains`: shape `(T, m, n)`; zero by default.

        **Returns:** `(states, controls, cost)`, of shapes `(T+1, n)`, `(T, m)` and
        `()`. The cost is infinite if a step fails or a number is not finite.
        """
        if states is None:
            points = controls.shape[0] + 1
            states = jnp.broadcast_to(self.x0, (points, *self.x0.shape))
        return roll_out(self, states, controls, gains)[:3]

    # Compiled, because `Plan` refuses numbers that are not finite unless it is traced.
    @eqx.filter_jit
    def plan(self, states: Array, controls: Array, cost: Array, **fields: Any) -> Plan:
        """Make a plan of a trajectory, such as `roll_out` returns.

        **Arguments:**

        - `states`, `controls`, `cost`: the trajectory and its cost.
        - `fields`: other fields of [`delucax.planning.Plan`][], as keywords. By default
            the gains are zero, the trace is the cost, and the residual is NaN. The
            result is `successful`, or `diverged` if the cost is not finite.

        **Returns:** a [`delucax.planning.Plan`][].
        """
        zero, finite = jnp.zeros_like(cost), jnp.isfinite(cost)
        low, high = self.bounds or (None, None)
        defaults: dict[str, Any] = dict(
            gains=jnp.zeros((*controls.shape, states.shape[1]), controls.dtype),
            trace=cost[None],
            residual=jnp.full_like(cost, jnp.nan),
            violation=zero,
            multipliers=None,
            result=choose(finite, RESULTS.successful, RESULTS.diverged),
            iterations=jnp.asarray(0),
            rollouts=jnp.asarray(1),
            regularisation=zero,
            t0=self.t0,
            dt=self.dynamics.dt,
            low=low,
            high=high,
            difference=self.difference,
        )
        return Plan(states, controls, cost=cost, **(defaults | fields))


def roll_out(
    problem: Problem,
    states: Array,
    controls: Array,
    K: Array | None = None,
    k: Array | None = None,
    length: Array | float = 0.0,
    defects: Array | None = None,
    count_events: bool = False,
) -> tuple[Array, Array, Array, Array | None]:
    """The trajectory under `u - length k - K (x - x_planned)`, and its cost. The last
    entry is the number of events in each step, or `None` if `count_events` is false or
    the dynamics have no events.

    `K`, `k` and `defects` are optional. The step leaves `1 - length` of each defect.
    The cost is infinite if a step fails or a number is not finite.
    """
    count_events = count_events and bool(problem.dynamics.event_names)
    size = problem.x0.shape[0]
    split = functools.partial(split_state, most=_SPLIT_UP_TO)

    def body(parts, inputs):
        t, planned, u, K, k, defect, w = inputs
        x = join_state(parts)
        if k is not None:
            u = u - length * k
        if K is not None:
            u = u - matvec(K, problem.deviation(x, planned))
        u = problem.clip(u)
        if count_events:
            advance = problem.dynamics.advance_with_events
            x_next, result, events = advance(t, x, u, w)
            count = jnp.sum(events.kinds >= 0)
        else:
            (x_next, result), count = problem.dynamics.advance(t, x, u, w), None
        x_next = x_next.astype(x.dtype)
        # Multiple shooting: the step closes only the share `length` of the defects, so
        # that the trajectory stays near the guess of the states.
        if defect is not None:
            x_next = x_next - (1 - length) * defect
        return split(x_next), (parts, u, or_none(result), count)

    times = problem.times(controls.shape[0])[:-1]
    inputs = (times, states[:-1], controls, K, k, defects, problem.w)
    # A planner spends most of its time here. A small state is therefore carried by its
    # components, as in `delucax.rollout`, which is faster.
    whole = size > _SPLIT_UP_TO
    body = products_whole()(body) if whole else by_components(body)
    last, kept = lax.scan(body, split(problem.x0), inputs)
    parts, controls, results, counts = kept
    states = stack_steps(parts, size, last)
    # Check all states, because a cost may ignore or clip some of them.
    cost = problem.total(states, controls)
    good = jnp.isfinite(cost) & jnp.all(jnp.isfinite(states))
    # A step whose solver failed may still return finite numbers.
    good = good & (first_of(results) == RESULTS.successful)
    return states, controls, jnp.where(good, cost, jnp.inf), counts
