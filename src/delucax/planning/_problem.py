"""What is planned: dynamics, a cost, constraints; its trajectories and local model."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._jax import by_components, first_possible, join_state, split_state, stack_steps
from .._module import check_parameters, function_field
from .._results import first_of, or_none, RESULTS
from ..costs import AbstractCost
from ..dynamics import AbstractDynamics
from ..math import matvec
from ..math._linear_solve import symmetric
from ._lq import Stages


class Constraints(eqx.Module):
    """What must hold along a plan: `inequality(t, x, u) <= 0` and
    `equality(t, x, u) = 0` at each step, `final_inequality(t, x) <= 0` and
    `final_equality(t, x) = 0` at the end.

    Each returns a number or a vector. The constraints of a step hold at the first one
    too, where the state is given: one on the state alone must hold there anyway. Bounds
    on the controls alone are cheaper as `bounds` of the planner.

    **Arguments:**

    - `inequality`: a function of time, state and control; none by default.
    - `equality`: likewise; none by default.
    - `final_inequality`: a function of time and the last state; none by default.
    - `final_equality`: likewise; none by default.

    A function that is a module with [`delucax.parameter`][] fields can be
    differentiated with respect to them.

    **Raises:** `ValueError` if one is no function, or if there is none.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        slow = lambda t, x, u: jnp.abs(x[1]) - 3.0
        upright = lambda t, x: x
        constraints = dlx.planning.Constraints(slow, final_equality=upright)
        dynamics = dlx.Discretized(dlx.systems.Pendulum(), dt=0.1)
        cost = dlx.costs.Quadratic([0.0, 0.0], [1.0])
        plan = dlx.planning.ilqr(
            dynamics,
            cost,
            jnp.array([1.0, 0.0]),
            jnp.zeros((20, 1)),
            constraints=constraints,
        )
        plan.states[-1], plan.violation
        ```
    """

    inequality: Callable[[Array, Array, Array], Any] | None = function_field(None)
    equality: Callable[[Array, Array, Array], Any] | None = function_field(None)
    final_inequality: Callable[[Array, Array], Any] | None = function_field(None)
    final_equality: Callable[[Array, Array], Any] | None = function_field(None)

    def __check_init__(self):
        check_parameters(self)
        if all(function is None for function in vars(self).values()):
            raise ValueError("Constraints: at least one function must be given.")


Values: TypeAlias = tuple[Float[Array, "*steps p"], Bool[Array, "*steps p"]]
"""The values of constraints, inequalities first, and which are of equalities."""


class Multipliers(NamedTuple):
    """Of the constraints: at each step, at the end, and the weight of the squares."""

    stage: Array  # (T, p)
    final: Array  # (q,)
    rho: Array


def values_of(functions: tuple[Any, Any], arguments: tuple, dtype: Any) -> Values:
    """Of an inequality and an equality, either of which may be none."""
    given = (jnp.zeros(0) if f is None else f(*arguments) for f in functions)
    inequality, equality = (jnp.ravel(jnp.asarray(c, dtype)) for c in given)
    c = jnp.concatenate([inequality, equality])
    return c, jnp.arange(c.size) >= inequality.size


def augmented(c: Array, y: Array, rho: Array, equal: Array) -> Array:
    """What constraints with values `c` and multipliers `y` add to the cost:
    `y c + rho c^2 / 2`, or `(max(0, y + rho c)^2 - y^2) / (2 rho)` of an inequality.

    Source: Hestenes, 1969; Powell, 1969; Rockafellar, 1973 (inequalities).
    """
    # The two agree where an inequality is active, and so do their first derivatives at
    # the switch; the second one jumps there. A weight of zero leaves the Lagrangian.
    active = equal | (y + rho * c > 0)
    safe = jnp.where(rho > 0, rho, 1)
    return jnp.sum(jnp.where(active, c * (y + rho * c / 2), -(y**2) / (2 * safe)))


def updated(c: Array, y: Array, rho: Array, equal: Array) -> Array:
    """The multipliers after a minimisation."""
    return jnp.where(equal, y + rho * c, jnp.maximum(y + rho * c, 0))


def violated(c: Array, y: Array, rho: Array, equal: Array) -> Array:
    """How far each constraint is from holding, or its multiplier from being needed."""
    # max(c, -y / rho) is zero just where c <= 0, y >= 0 and y c = 0: both feasibility
    # and complementarity, in the unit of the constraint.
    slack = jnp.maximum(c, -y / rho)
    return jnp.where(equal, jnp.abs(c), jnp.abs(slack))


class Problem(eqx.Module):
    """A planning problem. Everything in it can be differentiated.

    With multipliers its cost is the augmented Lagrangian.
    """

    dynamics: AbstractDynamics
    cost: AbstractCost
    x0: Array
    t0: Array
    w: Array | None = None
    bounds: tuple[Array, Array] | None = None
    difference: Callable[[Array, Array], Array] | None = None
    constraints: Constraints | None = None
    multipliers: Multipliers | None = None

    def deviation(self, x: Array, x_ref: Array) -> Array:
        """`x` from `x_ref`, as the caller measures it."""
        return x - x_ref if self.difference is None else self.difference(x, x_ref)

    def times(self, horizon: int) -> Array:
        """The times of the states, shape `(T + 1,)`."""
        steps = jnp.arange(horizon + 1)
        return (self.t0 + steps * self.dynamics.dt).astype(self.x0.dtype)

    def clip(self, u: Array) -> Array:
        """The control between the bounds."""
        if self.bounds is None:
            return u
        low, high = self.bounds
        return jnp.minimum(jnp.maximum(u, low), high)

    def room(self, controls: Array) -> tuple[Array, Array] | None:
        """The bounds of a change of each control, if there are any."""
        if self.bounds is None:
            return None
        low, high = self.bounds
        return low - controls, high - controls

    def step(self, t: Array, x: Array, u: Array, w: Array | None) -> Array:
        """The next state."""
        return self.dynamics.advance(t, x, u, w)[0].astype(x.dtype)

    def stage_constraints(self, t: Array, x: Array, u: Array) -> Values:
        """The values of the constraints of a step."""
        assert self.constraints is not None
        functions = self.constraints.inequality, self.constraints.equality
        return values_of(functions, (t, x, u), x.dtype)

    def final_constraints(self, t: Array, x: Array) -> Values:
        """The values of the constraints at the end."""
        assert self.constraints is not None
        functions = self.constraints.final_inequality, self.constraints.final_equality
        return values_of(functions, (t, x), x.dtype)

    def constraints_along(self, states: Array, controls: Array) -> tuple[Any, Any]:
        """The values of the constraints of all steps, and at the end."""
        times = self.times(controls.shape[0])
        stage = jax.vmap(self.stage_constraints)(times[:-1], states[:-1], controls)
        return stage, self.final_constraints(times[-1], states[-1])

    def with_multipliers(self, multipliers: Multipliers | None) -> "Problem":
        """The problem whose cost is the augmented Lagrangian with these, if any."""
        return dataclasses.replace(self, multipliers=multipliers)

    def stage_cost(self, t: Array, x: Array, u: Array, y: Array | None) -> Array:
        """The cost of a step, and what the constraints add to it."""
        cost = self.cost(t, x, u)
        if self.multipliers is None or y is None:
            return cost + 0.0  # an integer cost has a gradient then
        c, equal = self.stage_constraints(t, x, u)
        return cost + augmented(c, y, self.multipliers.rho, equal)

    def final_cost(self, t: Array, x: Array) -> Array:
        """The cost at the end, and what the constraints add to it."""
        cost = self.cost.final(t, x)
        if self.multipliers is None:
            return cost
        c, equal = self.final_constraints(t, x)
        _, y, rho = self.multipliers
        return cost + augmented(c, y, rho, equal)

    @property
    def stage_multipliers(self) -> Array | None:
        """Those of the steps."""
        return None if self.multipliers is None else self.multipliers.stage

    def total(self, states: Array, controls: Array) -> Array:
        """The cost of a trajectory."""
        times = self.times(controls.shape[0])
        each = (times[:-1], states[:-1], controls, self.stage_multipliers)
        final = self.final_cost(times[-1], states[-1])
        return (jnp.sum(jax.vmap(self.stage_cost)(*each)) + final).astype(states.dtype)


def roll_out(
    problem: Problem,
    states: Array,
    controls: Array,
    K: Array | None = None,
    k: Array | None = None,
    length: Array | float = 0.0,
    gaps: Array | None = None,
) -> tuple[Array, Array, Array]:
    """The trajectory under `u - length k - K (x - x_planned)`, and its cost.

    Each of `K` and `k` may be left out. `1 - length` of each gap is left.
    The cost is infinite if anything goes wrong.
    """
    size = problem.x0.shape[0]

    # The state is carried by its components, as in `delucax.rollout`: most of the time
    # of a planner is spent here.
    @by_components
    def body(parts, inputs):
        t, planned, u, K, k, gap, w = inputs
        x = join_state(parts, size)
        if k is not None:
            u = u - length * k
        if K is not None:
            u = u - matvec(K, problem.deviation(x, planned))
        u = problem.clip(u)
        x_next, result = problem.dynamics.advance(t, x, u, w)
        x_next = x_next.astype(x.dtype)
        # Of multiple shooting: the trajectory keeps the share of the gap that a step of
        # this length does not close, so that it stays near the guess of the states.
        if gap is not None:
            x_next = x_next - (1 - length) * gap
        return split_state(x_next), (parts, u, or_none(result))

    times = problem.times(controls.shape[0])[:-1]
    inputs = (times, states[:-1], controls, K, k, gaps, problem.w)
    last, (parts, controls, results) = lax.scan(body, split_state(problem.x0), inputs)
    states = stack_steps(parts, size, last)
    # A cost may forget states that are not finite, and clip what is: all are looked at.
    cost = problem.total(states, controls)
    good = jnp.isfinite(cost) & jnp.all(jnp.isfinite(states))
    good = good & (first_of(results) == RESULTS.successful)
    return states, controls, jnp.where(good, cost, jnp.inf)


def model(
    problem: Problem,
    states: Array,
    controls: Array,
    gaps: Array | None,
    second_order: bool,
    use_exact: Array | None = None,
    spacing: float | None = None,
) -> Stages:
    """The linear-quadratic model of the problem about a trajectory.

    The second derivatives of dynamics and constraints are left out where `use_exact` is
    false. With a `spacing` the dynamics are linearised by central differences.
    """
    size, times = states.shape[1], problem.times(controls.shape[0])
    t, end = times[:-1], times[-1]
    z = jnp.concatenate([states[:-1], controls], axis=1)
    step = lambda z, t, w: problem.step(t, z[:size], z[size:], w)
    stage_cost = lambda z, t, y: problem.stage_cost(t, z[:size], z[size:], y)
    final_cost = lambda x: problem.final_cost(end, x)

    def stage_hessian(z, t, y):
        """That of the cost, with the constraints as their linear parts squared."""
        if problem.multipliers is None:
            return jax.hessian(stage_cost)(z, t, y)
        c = lambda z: problem.stage_constraints(t, z[:size], z[size:])
        cost = jax.hessian(lambda z: problem.cost(t, z[:size], z[size:]))(z)
        return cost + squared(c, z, y, problem.multipliers.rho)

    y = problem.stage_multipliers
    v = jax.grad(final_cost)(states[-1])
    if spacing is None:
        # In reverse where that is possible: a step has fewer outputs than inputs.
        slopes = first_possible(jax.jacrev(step), jax.jacfwd(step))
    else:
        slopes = central(step, spacing, problem.deviation)
    F = jax.vmap(slopes)(z, t, problem.w)
    h = jax.vmap(jax.grad(stage_cost))(z, t, y)
    H = jax.vmap(stage_hessian)(z, t, y)
    V = jax.hessian(lambda x: problem.cost.final(end, x))(states[-1])
    if problem.multipliers is not None:
        c = lambda x: problem.final_constraints(end, x)
        V = V + squared(c, states[-1], *problem.multipliers[1:])
    if second_order:
        # Those of the Hamiltonian, cost + costate' F: the curvature of the dynamics
        # counts by how much the next state is worth.
        def hamiltonian(z, t, w, y, costate):
            return stage_cost(z, t, y) + costate @ step(z, t, w)

        slope = jax.grad(hamiltonian)
        ways = jax.jacfwd(slope), jax.jacrev(slope), jax.jacfwd(jax.jacfwd(hamiltonian))
        each = z, t, problem.w, y, costates_of(F, h, v)
        exact = jax.vmap(first_possible(*ways))(*each)
        at_end = jax.hessian(final_cost)(states[-1])
        if use_exact is None:
            H, V = exact, at_end
        else:
            H, V = jnp.where(use_exact, exact, H), jnp.where(use_exact, at_end, V)
    # Rounding leaves Hessians not quite symmetric, which the pass back relies on.
    stages = Stages(F, symmetric(H), h, gaps, symmetric(V), v)
    return jax.tree.map(lambda a: a.astype(states.dtype), stages)


def squared(c: Callable[[Array], Values], z: Array, y: Array, rho: Array) -> Array:
    """The Hessian of the active constraints' squares, without second derivatives: that
    of `rho c'c / 2` by Gauss and Newton, `rho J'J`."""
    slope = jax.jacfwd(lambda z: c(z)[0])(z)
    value, equal = c(z)
    active = equal | (y + rho * value > 0)
    return rho * slope.T @ jnp.where(active[:, None], slope, 0)


def costates_of(F: Array, h: Array, v: Array) -> Array:
    """The gradient of the cost with respect to each next state, shape `(T, n)`, by the
    adjoint equation `p_k = h_x + A'p_{k+1}` with the last one `v`."""
    size = v.shape[0]

    def back(costate, here):
        F, h = here
        return h[:size] + matvec(F[:, :size].T, costate), costate

    return lax.scan(back, v.astype(h.dtype), (F, h), reverse=True)[1]


def central(f: Any, spacing: float, deviation: Any) -> Any:
    """The Jacobian in the first argument by central differences: two calls for each
    of its entries."""

    def evaluate(z, *args):
        # By the deviation, because the two sides of a wrapped angle are a turn apart.
        def along(way):
            change = spacing * way
            return deviation(f(z + change, *args), f(z - change, *args))

        ways = jnp.eye(z.shape[0], dtype=z.dtype)
        return jax.vmap(along)(ways).T / (2 * spacing)

    return evaluate
