"""A filter that makes any controller safe: control barrier functions."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int, PyTree

from .._check import (
    as_entries,
    as_rows,
    bounds_field,
    check_control_bounds,
    check_count,
    check_finite,
    check_positive,
    check_range,
    is_concrete,
)
from .._controller import AbstractController, check_controller, Tally
from .._jax import value_and_jacobians
from .._module import as_module
from .._results import Result, RESULTS
from .._typing import Array, PRNGKey, RealScalar
from ..dynamics import AbstractDynamics
from ..math._linear_solve import full_precision
from ..systems import AbstractPlant, AbstractSystem
from ._barriers import (
    as_degrees,
    by_entry,
    check_plant,
    checked_degrees,
    Conditions,
    entry_names,
    sample_states,
    sizes_of,
)
from ._hold_margin import hold_margin
from ._least_change import (
    judged,
    least_change,
    least_change_sequentially,
    missed,
    Task,
)
from ._operating_point import check_state


class SafetyFilterState(NamedTuple):
    """The state of [`delucax.controllers.SafetyFilter`][]."""

    controller: PyTree
    result: Result
    missed: dict[str, Array]
    failures: Tally
    iterations: Int[Array, ""]


class SafetyFilter(AbstractController):
    r"""The least change of a controller's action that keeps barriers at least zero.

    With the action `n` of the controller, the control is the solution of

    $$\min_u \tfrac12 \sum_i \mathrm{weight}_i\,(u_i - n_i)^2
    \quad\text{such that}\quad c(t, x, u) \ge \mathrm{margin}, \quad
    \mathrm{low} \le u \le \mathrm{high}.$$

    For a system in continuous time, `f(t, x, u, w)` affine in `u`, a barrier `b(t, x)`
    whose derivative sees the control (relative degree one) gives the condition

    `c = db/dt + decay b`,

    and one whose second derivative does (degree two) gives it for `db/dt + decay b`,
    with a second decay. The constructor determines the degree. Where the control is
    applied at all times, `b >= 0` then holds for ever if it does at first; of degree
    two, if `db/dt + decay b >= 0` does too.

    For dynamics in discrete time the change over a step takes the place of the
    derivative: `c = b(t + dt, F(t, x, u)) - (1 - decay) b(t, x)`. The condition is
    linearised at the action, then again at each solution, until the solution stays.
    If no barrier is at risk, that is one linearisation.

    **Disturbances.** With `disturbance`, the condition holds for the worst
    `|w_i| <= disturbance_i`, in both orders of degree two: of continuous time exactly,
    as `f` must be affine in `w`; of discrete time to the first order.

    **A control that is held.** Between two samples a condition falls.
    [`held`][delucax.controllers.SafetyFilter.held] computes a margin that covers it.

    **Where it cannot be.** A condition with a `price` may be missed by `d`, which costs
    `1/2 price d^2`. If the hard conditions cannot all hold between the bounds, the
    control is the one between the bounds that misses them least, by the sum of the
    distances to them. Such a step is counted in `incidents["failed_filter"]` of a
    rollout. The state has of the last step `missed`, by how much each condition was
    missed; `result`: `no_feasible_point` then, `ill_posed` if a number was NaN, and
    `not_converged` if a condition in discrete time was missed after `max_iterations`;
    the number of failures, `failures`; and `iterations`, the linearisations.

    One active condition is solved in closed form, several by [`delucax.qp.solve`][].
    Derivatives are exact in both modes, so that a policy can be trained through the
    filter. The control is not smooth where a condition becomes active; there the
    derivative is that of one side, or NaN of a quadratic program. In discrete time they
    follow from the implicit function theorem, and mean nothing if not converged.

    **Arguments:**

    - `controller`: any controller.
    - `plant`: an [`delucax.AbstractSystem`][], affine in the control, or an
        [`delucax.AbstractDynamics`][]. It observes its state; around an estimator see
        [`delucax.controllers.OutputFeedback`][].
    - `barriers`: a function `b(t, x)` that returns a number or a vector, or a
        dictionary of such functions, whose keys name them. An `eqx.Module` with
        [`delucax.parameter`][] fields can be differentiated with respect to them.
    - `decay`: how fast a barrier may fall, 1 by default: a rate (1/s) in continuous
        time, a fraction up to 1 in discrete time. A number; a pair for the two orders
        of degree two; or a dictionary of these by barrier.
    - `margin`: what each condition must be at least, 0 by default, in its own units. A
        number, or a dictionary by barrier.
    - `disturbance`: bounds of `|w|`, a number or one for each; none by default.
    - `bounds`: `(low, high)` of the controls, each a number or of shape `(m,)`; none by
        default.
    - `price`: of a missed condition; a number, or a dictionary by barrier, which leaves
        the others hard. All are hard by default.
    - `weight`: the price of a change of each control, 1 by default; a number or of
        shape `(m,)`.
    - `states`: where the relative degree and that the system is affine are checked,
        shape `(k, n)`; by default 16 points at most 1 from the equilibrium, or zero.
    - `degrees`: the relative degree of each barrier, 1 or 2; a number, or a dictionary
        by barrier. It is for where plant or barriers are traced: nothing is checked at
        sample states then.
    - `max_iterations`: the most linearisations in discrete time, 20 by default.

    **Raises:** `ValueError` on arguments of the wrong kind, shape or value; if a
    barrier does not see the control up to degree two, by its name; if the system is not
    affine in the control, or in a disturbance that is bounded.

    Source: Ames et al., 2017 and 2019; Nguyen and Sreenath, 2016, Xiao and Belta, 2019
    (degree two); Jankovic, 2018 (disturbances); Agrawal and Sreenath, 2017 (discrete
    time).

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        env = dlx.make("pendulum", dt=0.01)
        push = dlx.controllers.Constant(jnp.array([2.0]))
        lean = lambda t, x: 0.3 - x[0]  # rad
        safe = dlx.controllers.SafetyFilter(
            push, env.dynamics.system, {"lean": lean}, decay=5.0, bounds=(-5.0, 5.0)
        )
        run = dlx.rollout(env, safe, key=jax.random.key(0), x0=[0.1, 0.0], horizon=200)
        run.states[:, 0].max()
        ```
    """

    controller: AbstractController
    plant: AbstractPlant
    barriers: dict[str, Callable[..., Any]]
    decay: Array
    margin: Array
    disturbance: Array | None
    bounds: tuple[Array, Array] | None = bounds_field("SafetyFilter")
    price: Array | None
    weight: Array
    sizes: tuple[int | None, ...] = eqx.field(static=True)
    degrees: tuple[int, ...] = eqx.field(static=True)
    max_iterations: int = eqx.field(static=True)

    def __init__(
        self,
        controller: AbstractController,
        plant: AbstractPlant,
        barriers: Callable[..., Any] | Mapping[str, Callable[..., Any]],
        *,
        decay: Any = 1.0,
        margin: Any = 0.0,
        disturbance: Any = None,
        bounds: Any = None,
        price: Any = None,
        weight: Any = 1.0,
        states: Any = None,
        degrees: Any = None,
        max_iterations: int = 20,
    ):
        where = "SafetyFilter"
        self.controller, self.plant = controller, plant
        check_plant(plant, where)
        n, m = plant.state_size, plant.control_size
        given = barriers if isinstance(barriers, Mapping) else {"barrier": barriers}
        if not given:
            raise ValueError(f"{where}: barriers must not be empty.")
        # In the order that JAX gives to the keys of a dictionary.
        keys = sorted(given, key=str)
        self.barriers = {str(key): as_module(given[key]) for key in keys}
        self.sizes = sizes_of(self.barriers, n, where)
        sizes = dict(zip(self.barriers, self.sizes, strict=True))
        each = lambda value, name, like, default=None: by_entry(
            value, name, like, sizes, default, where
        )
        self.decay = each(decay, "decay", (2,))
        self.margin = each(margin, "margin", (), 0.0)
        self.price = None if price is None else each(price, "price", (), np.inf)
        self.disturbance = None
        if disturbance is not None:
            size = plant.disturbance_size
            if isinstance(plant, AbstractSystem) and not plant.disturbance_names:
                raise ValueError(
                    f"{where}: disturbance needs a plant with disturbance_names, whose "
                    f"field it enters, and {type(plant).__name__} has none."
                )
            self.disturbance = as_entries(disturbance, size, "disturbance", where)
        self.bounds = check_control_bounds(bounds, m, where)
        weight = as_entries(weight, m, "weight", where)
        with jax.ensure_compile_time_eval():
            self.weight = jnp.broadcast_to(weight, (m,))
        self.max_iterations = check_count(max_iterations, "max_iterations", where)
        # The numbers are checked before anything is computed with them.
        self.degrees = (1,) * len(self.names)
        self.__check_init__()
        known = None if degrees is None else as_degrees(degrees, sizes, where)
        samples = sample_states(plant)
        if states is not None:
            samples = as_rows(states, n, "states", where)
            check_finite(samples, "states", where)
        given = plant, self.barriers, self.names, samples
        self.degrees = checked_degrees(*given, known, disturbance is not None, where)

    def __check_init__(self):
        where = "SafetyFilter"
        check_controller(self.controller, "controller", where)
        check_plant(self.plant, where)
        p, m = len(self.names), self.plant.control_size
        shapes = {"decay": (p, 2), "margin": (p,), "price": (p,), "weight": (m,)}
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value is not None and np.shape(value) != shape:
                raise ValueError(
                    f"{where}: {name} must have shape {shape}, got shape "
                    f"{np.shape(value)}."
                )
        most = 1 if isinstance(self.plant, AbstractDynamics) else np.inf
        check_range(self.decay, "decay", where, 0, most)
        if self.disturbance is not None:
            check_range(self.disturbance, "disturbance", where)
        for name in ("decay", "margin", "disturbance"):
            check_finite(getattr(self, name), name, where)
        check_positive(self.weight, "weight", where)
        if self.price is not None and is_concrete(self.price):
            if not np.all(np.asarray(self.price) > 0):
                raise ValueError(
                    f"{where}: price must be positive, got {np.asarray(self.price)}."
                )
        check_control_bounds(self.bounds, m, where)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the conditions, one for each value of a barrier."""
        return entry_names(self.barriers, self.sizes)

    @property
    def conditions(self) -> Conditions:
        """The conditions without their margin: a function of `(t, x, u)`, whose values
        are in the order of `names`."""
        given = self.plant, self.barriers, self.decay, self.disturbance
        return Conditions(*given, degrees=self.degrees)

    def held(
        self,
        dt: RealScalar,
        states: tuple[Any, Any],
        *,
        times: tuple[float, float] | None = None,
        points: int = 11,
    ) -> "SafetyFilter":
        """The filter with a margin for a control that is held over `dt`.

        A condition is `c = d + decay psi`: `psi` is what it keeps positive, the barrier
        or `db/dt + decay b`, and `d` its least change. Let `c >= margin` at a sample,
        and `-dd/dt <= M` until the next one. Then `s` after the sample

        `psi >= (1 - decay s) psi_0 + s (margin - s M / 2)`,

        which is not negative with `margin = dt M / 2` and `decay dt <= 1`. So barriers
        that hold at first hold at all times.

        `M` is a maximum over the controls between the bounds, the disturbances, and the
        states at which all barriers hold and from which `psi` can fall to zero within
        `dt`. It is taken at the corners of the cells of a grid that have such points in
        them, with an allowance for what is between them from its second differences:
        see that more points change it little. It supposes that the states stay in the
        box, and that the filter does not fail.

        **Arguments:**

        - `dt`: the time for which a control is held.
        - `states`: a pair `(low, high)`, each of shape `(n,)`: a box that the states do
            not leave.
        - `times`: `(start, end)`, if a barrier or the plant depends on time.
        - `points`: of the grid for each state, each control and time, 11 by default.

        **Returns:** the filter, with this added to its `margin`.

        **Raises:** `ValueError` in discrete time, without finite bounds, on a box of
        the wrong shape, or on a grid that is too large.

        Source: Breeden, Garg and Panagou, 2022 (the margin by the second derivative
        along a step); Cortez et al., 2019.

        !!! example

            ```python
            import delucax as dlx
            import jax.numpy as jnp

            still = dlx.controllers.Zero(1)
            slow = lambda t, x: 4.0 - x[1] ** 2
            safe = dlx.controllers.SafetyFilter(
                still, dlx.systems.Pendulum(), slow, bounds=(-8.0, 8.0)
            )
            safe.held(0.01, ([-3.2, -2.0], [3.2, 2.0])).margin
            ```
        """
        where = "SafetyFilter.held"
        given = self.conditions, self.bounds, dt, states, points
        margin = self.margin + hold_margin(*given, times, where)
        return eqx.tree_at(lambda safe: safe.margin, self, margin)

    def init(self, *, key: PRNGKey | None = None) -> PyTree:
        return SafetyFilterState(
            controller=self.controller.init(key=key),
            result=jax.tree.map(jnp.asarray, RESULTS.successful),
            missed=self._named(jnp.zeros(len(self.names))),
            failures=Tally("failed_filter"),
            iterations=jnp.zeros((), int),
        )

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        check_state(self, y, self.plant.state_size)
        nominal, memory = self.controller(t, y, state.controller)
        m = self.plant.control_size
        if jnp.shape(nominal) != (m,):
            raise ValueError(
                f"SafetyFilter: controller must return a control of shape ({m},), as "
                f"the plant takes, got {jnp.shape(nominal)}."
            )
        u, over, count, result = self._least_change(t, y, nominal.astype(y.dtype))
        after = SafetyFilterState(
            controller=memory,
            result=result,
            missed=self._named(over),
            failures=state.failures.add(result != RESULTS.successful),
            iterations=jnp.asarray(count, state.iterations.dtype),
        )
        return u, after

    # An accelerator's rounded products would let the plant through its barriers.
    @full_precision
    def _least_change(self, t: RealScalar, y: Array, nominal: Array) -> tuple:
        """The control, what the conditions miss, how many iterations, the status."""
        task, conditions = self._task(nominal), self._above(t, y)
        if isinstance(self.plant, AbstractDynamics):
            u, over, size, count, converged = least_change_sequentially(
                task, conditions, self.max_iterations
            )
        else:
            s, (A,) = value_and_jacobians(conditions, task.nominal)
            u = least_change(task, s, A)
            over, size = missed(task, s, A, u)
            count, converged = 1, True
        return u, over, count, judged(task, over, size, converged)

    def applied(self, u: Array, cost: Array, state: PyTree) -> PyTree:
        memory = self.controller.applied(u, cost, state.controller)
        return state._replace(controller=memory)

    def _above(self, t: RealScalar, x: Array) -> Callable[[Array], Array]:
        """The conditions, as functions of the control that must not be negative."""
        time, margin = jnp.asarray(t, x.dtype), self.margin.astype(x.dtype)
        return lambda u: self.conditions(time, x, u) - margin

    def _task(self, nominal: Array) -> Task:
        dtype, m = nominal.dtype, self.plant.control_size
        low, high = (None, None) if self.bounds is None else self.bounds
        whole = lambda end: jnp.broadcast_to(end, (m,)).astype(dtype)
        low, high = (None if end is None else whole(end) for end in (low, high))
        price = None if self.price is None else self.price.astype(dtype)
        return Task(nominal, low, high, self.weight.astype(dtype), price)

    def _named(self, values: Array) -> dict[str, Array]:
        """Values of the conditions by the names of their barriers."""
        named, start = {}, 0
        for name, size in zip(self.barriers, self.sizes, strict=True):
            part = values[start] if size is None else values[start : start + size]
            named[name] = part.astype(float)
            start += size or 1
        return named
