"""A filter that makes any controller safe, by control barrier functions."""

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
    r"""A filter that makes any controller safe with the smallest change of its control.

    The filter takes the control $n$ of a controller, and changes it so that the
    barriers $b(t, x)$ stay at zero or above. It solves

    $$\min_u \tfrac12 \sum_i \mathrm{weight}_i\,(u_i - n_i)^2
    \quad\text{such that}\quad c(t, x, u) \ge \mathrm{margin}, \quad
    \mathrm{low} \le u \le \mathrm{high}$$

    **Continuous time.** The vector field $f(t, x, u, w)$ must be affine in $u$. A
    barrier has relative degree one if its first derivative depends on the control. Its
    condition is

    $$c = \dot b + \mathrm{decay}\; b$$

    A barrier has relative degree two if only its second derivative depends on the
    control. The condition of a barrier of relative degree two has
    $\dot b + \mathrm{decay}\; b$ in place of $b$, and a second value of `decay`. The
    filter determines the relative degree of each barrier once, when you construct the
    filter.

    If the filter acts at all times and $b \ge 0$ at the start, then $b \ge 0$ at all
    times. A barrier of degree two also needs $\dot b + \mathrm{decay}\; b \ge 0$ at the
    start.

    **Discrete time.** The change over a step replaces the derivative:

    $$c = b(t + \Delta t, F(t, x, u)) - (1 - \mathrm{decay})\, b(t, x)$$

    The filter linearises the condition at the control $n$, solves for $u$, and
    linearises again at this solution, until the solution does not change any more. If
    the control $n$ is safe already, one linearisation is enough.

    **Disturbances.** With the argument `disturbance`, the condition holds for all
    disturbances with $|w_i| \le \mathrm{disturbance}_i$. For a barrier of relative
    degree two, the filter takes the worst disturbance in both derivatives. In
    continuous time, the worst case is exact, and $f$ must be affine in $w$. In discrete
    time, the worst case is exact only to first order in $w$.

    **A control that is held.** If the control is held between samples, a condition can
    be violated between two samples. [`held`][delucax.controllers.SafetyFilter.held]
    computes a margin that prevents such violations.

    **Conditions that cannot hold.** A condition with a `price` may be violated by an
    amount $d$, at a cost of $\tfrac12\, \mathrm{price}\; d^2$. Conditions without a
    price are hard. If no control within the bounds satisfies all hard conditions, the
    filter returns the control within the bounds that has the smallest sum of distances
    to these conditions. In a rollout, `incidents["failed_filter"]` is true at the steps
    at which the filter failed. The state of the controller has, for the last step,

    - `missed`: by how much each condition was violated,
    - `result`: the status: `no_feasible_point` if a hard condition was violated,
        `ill_posed` if a number was NaN, `not_converged` if a condition in discrete time
        was still violated after `max_iterations`,
    - `iterations`: the number of linearisations.

    The state also has `failures`, the number of failed steps so far.

    **Derivatives.** You can train a policy through the filter. The derivatives are
    exact. In discrete time, the derivatives come from the implicit function theorem,
    and they are exact if the filter converged. A single active condition is solved in
    closed form, and several active conditions by [`delucax.qp.solve`][]. The control is
    not smooth at states where a condition becomes active. At such states the derivative
    is a one-sided derivative, or NaN if a quadratic program was solved.

    **Arguments:**

    - `controller`: any controller.
    - `plant`: a [`delucax.AbstractSystem`][], affine in the control, or an
        [`delucax.AbstractDynamics`][]. The filter must observe the state of the plant.
        If the state is not measured, put the filter into a
        [`delucax.controllers.OutputFeedback`][].
    - `barriers`: a function `b(t, x)` that returns a number or a vector, or a
        dictionary of such functions. You can differentiate with respect to the
        [`delucax.parameter`][] fields of a barrier that is an `eqx.Module`.
    - `decay`: how fast a barrier may fall, 1 by default: a rate (1/s) in continuous
        time, a fraction from 0 to 1 in discrete time. Give a number or, for barriers of
        relative degree two, a pair of the first and the second decay. To give each
        barrier its own decay, pass a dictionary from the names of the barriers to
        numbers or pairs.
    - `margin`: by how much each condition must be above zero, in the units of the
        condition; 0 by default. Give a number, or a dictionary from the name of a
        barrier to a number.
    - `disturbance`: the largest absolute value of each disturbance, a number or of
        shape `(k,)`; none by default.
    - `bounds`: `(low, high)` of the controls, each a number or of shape `(m,)`; none by
        default.
    - `price`: the cost of violating a barrier's condition: a number, or a dictionary
        from the name of a barrier to a number. Barriers without a price are hard. By
        default all are hard.
    - `weight`: the cost of changing each control, a number or of shape `(m,)`; 1 by
        default.
    - `states`: the states at which the filter checks the relative degree of the
        barriers, and whether the system is affine in the control, shape `(k, n)`. By
        default the filter checks 16 points in a box of half-width 1 about the
        equilibrium of the plant, or about zero if the plant defines no equilibrium.
    - `degrees`: the relative degree of each barrier, 1 or 2; a number, or a dictionary
        from the name of a barrier to a number. Give the degrees if the plant or the
        barriers hold traced arrays, for example under `jax.jit`, because then the
        filter cannot determine or check the degrees.
    - `max_iterations`: the largest number of times that the filter linearises the
        conditions at one time step, 20 by default. This limit is only for dynamics in
        discrete time.

    **Raises:** `ValueError` if an argument has the wrong type, shape or value, if a
    barrier does not have relative degree 1 or 2, or if the system is not affine in the
    control or, if `disturbance` is given, in the disturbance.

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
        # Sorted, because JAX sorts the keys of a dictionary.
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
                    f"{where}: plant must have disturbance_names if disturbance is "
                    f"given, got {type(plant).__name__}, which has none."
                )
            self.disturbance = as_entries(disturbance, size, "disturbance", where)
        self.bounds = check_control_bounds(bounds, m, where)
        weight = as_entries(weight, m, "weight", where)
        with jax.ensure_compile_time_eval():
            self.weight = jnp.broadcast_to(weight, (m,))
        self.max_iterations = check_count(max_iterations, "max_iterations", where)
        # Checked here, because the degrees are computed with these numbers.
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
        """The names of the conditions. Each value of a barrier has one condition."""
        return entry_names(self.barriers, self.sizes)

    @property
    def conditions(self) -> Conditions:
        """The conditions without their margin: a function of `(t, x, u)`.

        The function returns a vector, in the order of `names`.
        """
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
        r"""The filter with a larger margin, for a control that is held over `dt`.

        Write a condition as $c = \Delta + \mathrm{decay}\; \psi$. Here $\psi$ is the
        function that the condition keeps positive, either $b$ or
        $\dot b + \mathrm{decay}\; b$, and $\Delta$ is the smallest rate of change of
        $\psi$. Let $c \ge \mathrm{margin}$ at a sample, and let $\Delta$ fall at a rate
        of at most $M$ until the next sample. Then, at a time $s$ after the sample,

        $$\psi \ge (1 - \mathrm{decay}\; s)\, \psi_0 + s\, (\mathrm{margin} - s M / 2)$$

        This lower bound is not negative if $\mathrm{margin} = \mathrm{dt}\; M / 2$ and
        $\mathrm{decay} \cdot \mathrm{dt} \le 1$. So barriers that are not negative at
        the start are never negative.

        The method computes $M$ as a maximum over the controls within the bounds, the
        disturbances, and the states at which all barriers hold and from which $\psi$
        can reach zero within `dt`. It evaluates the corners of the grid cells that
        contain such states, and adds an allowance for the points in between, from
        second differences. Check that the margin changes little if you increase
        `points`. The result is valid if the states stay in the box and the filter does
        not fail.

        **Arguments:**

        - `dt`: the time over which a control is held.
        - `states`: a pair `(low, high)`, each of shape `(n,)`: a box that contains all
            states of a run.
        - `times`: `(start, end)`, needed if a barrier or the plant depends on time.
        - `points`: the number of grid points for each state, each control and time, 11
            by default.

        **Returns:** the filter, with $\mathrm{dt}\; M / 2$ added to its `margin`.

        **Raises:** `ValueError` if the filter acts in discrete time or has no finite
        bounds, if the box has the wrong shape, or if the grid is too large.

        Source: Breeden, Garg and Panagou, 2022 (a margin from the second derivative
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
                f"SafetyFilter: controller must return a control of shape ({m},) for "
                f"the plant, got {jnp.shape(nominal)}."
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

    # With the low precision of an accelerator's products, barriers would be violated.
    @full_precision
    def _least_change(self, t: RealScalar, y: Array, nominal: Array) -> tuple:
        """The control, the missed amounts, the linearisations and the status."""
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
        """The conditions less their margin, as a function of the control."""
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
        """Values of the conditions, by the names of their barriers."""
        named, start = {}, 0
        for name, size in zip(self.barriers, self.sizes, strict=True):
            part = values[start] if size is None else values[start : start + size]
            named[name] = part.astype(float)
            start += size or 1
        return named
