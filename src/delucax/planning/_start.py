"""Starts of planners: trajectories under feedback."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._check import check_count, check_finite, check_instance
from .._jax import host_unless_traced, jacobian, xp
from .._message import shortened
from .._module import as_float_array, parameter, shown
from .._typing import RealScalar
from ..costs import AbstractCost
from ..dynamics import AbstractDynamics
from ..math._linear_solve import full_precision, is_definite, symmetric
from ..math._small import products_whole
from ..riccati import dare
from ._multipliers import Multipliers
from ._problem import Problem


class Start(eqx.Module):
    r"""A start for a planner: controls, with or without feedback, and their trajectory.

    The control at step $k$ is

    $$u_k = \bar u_k - K_k\, (x_k - \bar x_k)$$

    where $\bar u_k$, $\bar x_k$ and $K_k$ are `controls`, `states` and `gains`. The
    control is clipped to the bounds of the planner. Without gains, an unstable plant
    drifts far away under given controls. With stabilising gains the plant stays near
    `states`.

    To give several starts, stack their arrays along a new first axis. The planner
    computes the trajectory of each start and begins with the cheapest trajectory. It
    ignores a start that diverges.

    **Arguments:**

    - `controls`: shape `(T, m)`, or `(c, T, m)` for `c` starts.
    - `states`: shape `(T+1, n)` or `(c, T+1, n)`; needed with `gains`.
    - `gains`: shape `(T, m, n)` or `(c, T, m, n)`; none by default.
    - `multipliers`: [`delucax.planning.Multipliers`][] to start from, the same for all
        starts. By default all multipliers are zero. If the given multipliers do not
        contain a constraint, or have another shape for this constraint, the multipliers
        of this constraint are also zero. Planners without multipliers ignore this
        argument.

    **Raises:** `ValueError`, when a planner is called, if the shapes do not fit the
    problem or a number is not finite.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dynamics = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05)
        cost = dlx.costs.Quadratic([1.0, 0.1], [0.1])
        lqr = dlx.controllers.LQR(
            dlx.linearize(dynamics), jnp.eye(2), 0.1 * jnp.eye(1)
        )
        start = dlx.planning.Start(
            jnp.tile(lqr.u_ref, (60, 1)),
            jnp.tile(lqr.x_ref, (61, 1)),
            jnp.tile(lqr.K, (60, 1, 1)),
        )
        plan = dlx.planning.ilqr(dynamics, cost, jnp.array([0.3, 0.0]), start)
        plan.trace[0], plan.cost
        ```

        ```text
        (Array(3.285, dtype=float32), Array(3.084, dtype=float32))
        ```
    """

    controls: Float[Array, "*batch T m"] = parameter()
    states: Float[Array, "*batch T+1 n"] | None = parameter(None)
    gains: Float[Array, "*batch T m n"] | None = parameter(None)
    multipliers: Multipliers | None = None

    __repr__ = shown

    @property
    def horizon(self) -> int:
        """The number of steps."""
        return self.controls.shape[-2]

    @property
    def trajectories(self) -> "Start":
        """The start without multipliers."""
        return Start(self.controls, self.states, self.gains)

    def shifted(self) -> "Start":
        """The start for the next time step; the last step is repeated."""
        shift = lambda a: jnp.concatenate([a[1:], a[-1:]])
        # Of several starts, each one is shifted. They share their multipliers.
        each = shift if self.controls.ndim == 2 else jax.vmap(shift)
        start, y = jax.tree.map(each, self.trajectories), self.multipliers
        if y is not None:
            moving = dict(
                stage=y.stage, states=y.states, controls=y.controls, costates=y.costates
            )
            y = dataclasses.replace(y, **jax.tree.map(shift, moving))
        return dataclasses.replace(start, multipliers=y)

    @property
    def count(self) -> int:
        """The number of starts."""
        return self.controls.shape[0] if self.controls.ndim == 3 else 1

    def checked(
        self, state_size: int, control_size: int, name: str, where: str
    ) -> "Start":
        """Check that the arrays of the start fit each other and a problem.

        **Arguments:**

        - `state_size`: the number of states `n`.
        - `control_size`: the number of controls `m`.
        - `name`: the name of the start in messages.
        - `where`: the name of the function that takes the start, for messages.

        **Returns:** the start, with floating-point arrays.

        **Raises:** `ValueError` if a shape does not fit the problem or a number is not
        finite.
        """
        n, m = state_size, control_size
        given = self.controls, self.states, self.gains
        arrays: list[Any] = [as_float_array(a) for a in given]
        shape = getattr(arrays[0], "shape", ())
        batch, T = shape[:-2], shape[-2] if len(shape) > 1 else 0
        if len(batch) > 1 or T < 1:
            raise ValueError(
                f"{where}: {name}.controls must have shape (T, {m}), or (c, T, {m}) "
                f"for c starts, got shape {shape}."
            )
        rows = dict(controls=(T, m), states=(T + 1, n), gains=(T, m, n))
        for (field, row), array in zip(rows.items(), arrays, strict=True):
            if array is None and field != "controls":
                continue
            got = getattr(array, "shape", None)
            if not eqx.is_inexact_array(array) or got != (*batch, *row):
                got = shortened(array) if got is None else f"shape {got}"
                raise ValueError(
                    f"{where}: {name}.{field} must have shape {(*batch, *row)}, got "
                    f"{got}."
                )
            check_finite(array, f"{name}.{field}", where)
        if self.gains is not None and self.states is None:
            raise ValueError(
                f"{where}: {name}.states must be given with {name}.gains, got none."
            )
        return Start(*arrays, multipliers=self.multipliers)

    def stacked(self, state_size: int) -> "Start":
        """The start as a stack of starts that all have states and gains.

        **Arguments:** `state_size`: the number of states `n`.
        """
        start = self
        if self.controls.ndim == 2:
            start = jax.tree.map(lambda a: a[None], self.trajectories)
        controls, states, gains = start.controls, start.states, start.gains
        if states is None or gains is None:
            # With gains of zero, the states do not matter.
            c, T, m = controls.shape
            states = jnp.zeros((c, T + 1, state_size), controls.dtype)
            gains = jnp.zeros((c, T, m, state_size), controls.dtype)
        return Start(controls, states, gains, self.multipliers)

    def cheapest(self, problem: Problem) -> tuple["Start", Array, Array, Array]:
        """The start with the cheapest trajectory.

        **Arguments:** `problem`: a [`delucax.planning.Problem`][].

        **Returns:** `(start, states, controls, cost)`: the start with the lowest cost,
        and its trajectory and cost from `problem.roll_out`. The cost is infinite if all
        starts diverge.
        """

        def roll(start):
            states, gains = start.states, start.gains
            states, controls, cost = problem.roll_out(start.controls, states, gains)
            # If a start diverges, its controls may be NaN. The given ones are finite.
            given = jax.vmap(problem.clip)(start.controls)
            return states, jnp.where(jnp.isfinite(cost), controls, given), cost

        if self.controls.ndim == 2:
            return self, *roll(self)
        starts = self.trajectories
        # A loop, because on CPU `jax.vmap` over a few starts is slower.
        rolled = lax.map(roll, starts)
        # No derivative, because the choice is piecewise constant in the costs.
        best = jnp.argmin(lax.stop_gradient(rolled[2]))
        start, *rolled = jax.tree.map(lambda a: a[best], (starts, *rolled))
        return dataclasses.replace(start, multipliers=self.multipliers), *rolled

    @staticmethod
    def default(
        dynamics: AbstractDynamics,
        cost: AbstractCost,
        horizon: int,
        t0: RealScalar = 0.0,
        *,
        controls: Any = None,
    ) -> "Start":
        """The default of planners: two starts, of which they take the cheaper one.

        1. The trajectory of the LQR about an operating point.
        2. The trajectory of the constant control of this point.

        The operating point is the first of these that exists:

        1. the two `targets` of the cost, if it has both,
        2. the equilibrium of the dynamics,
        3. the one target of the cost, with zeros for the other,
        4. zeros.

        A [`delucax.costs.Quadratic`][] has targets. A cost that is made of it by `+`,
        `*` or [`delucax.costs.Rate`][] has them too. If the operating point is not an
        equilibrium, the LQR may be a poor start: find an equilibrium with
        [`delucax.trim`][], and give it to the cost as its targets.

        The LQR linearises the dynamics at the operating point. Its weights are the
        second derivatives of the stage cost there. There is no LQR if:

        - these derivatives are not finite,
        - the second derivative of the cost with respect to the control is not positive
            definite,
        - no gain stabilises the plant, or
        - the dynamics cannot be differentiated.

        The first start then has a gain of zero: it holds the control of the operating
        point.

        **Arguments:**

        - `dynamics`: the discrete-time dynamics.
        - `cost`: the stage and final cost.
        - `horizon`: the number of steps `T`.
        - `t0`: the time at which dynamics and cost are evaluated; 0 by default.
        - `controls`: the controls of the second start, shape `(T, m)`; by default the
            control of the operating point.

        **Returns:** a [`delucax.planning.Start`][]. Its derivatives are zero.

        **Raises:** `ValueError` if `dynamics` is not an `AbstractDynamics`, `cost` is
        not an `AbstractCost`, or the horizon is not a whole number of at least 1.

        Source: Rawlings, Mayne and Diehl, 2017 (the regulator as a warm start).

        !!! example

            ```python
            import delucax as dlx

            env = dlx.make("pendulum")
            start = dlx.planning.Start.default(env.dynamics, env.cost, 20)
            start.gains[0, 0]
            ```

            ```text
            Array([[19.69, 5.26]], dtype=float32)
            ```
        """
        where = "Start.default"
        check_instance(dynamics, AbstractDynamics, "dynamics", where)
        check_instance(cost, AbstractCost, "cost", where)
        T = check_count(horizon, "horizon", where)
        # The derivative of a plan does not depend on its start.
        constant = lambda leaf: lax.stop_gradient(leaf) if eqx.is_array(leaf) else leaf
        dynamics, cost = jax.tree.map(constant, (dynamics, cost))
        point = operating_point(dynamics, cost)
        try:
            t0 = jnp.asarray(t0, point[0].dtype)
            *matrices, posed = _expanded(dynamics, cost, *point, t0)
        except (NotImplementedError, RuntimeError, TypeError, ValueError):
            # The dynamics are not differentiable. A planner that needs derivatives
            # reports this itself.
            regulator = None
        else:
            solution = dare(*matrices, throw=False)
            regulator = solution.K, solution.spectral_radius, posed
        return Start(*_both(*point, regulator, controls, T))


def operating_point(
    dynamics: AbstractDynamics, cost: AbstractCost
) -> tuple[Array, Array]:
    """The operating point `(x, u)` of the cost or the dynamics; zeros without one."""
    n, m = dynamics.state_size, dynamics.control_size
    return cost.set_point(dynamics) or (jnp.zeros(n), jnp.zeros(m))


@eqx.filter_jit
@full_precision
def _expanded(dynamics, cost, x, u, t0):
    """The linear-quadratic problem `(A, B, Q, R, S)` about a point, and whether it is
    well-posed."""
    n, z = x.shape[0], jnp.concatenate([x, u])
    problem = Problem(dynamics, cost, x, t0)
    stage_cost = lambda z: problem.stage_cost(t0, z[:n], z[n:], None)
    with products_whole():
        F = jacobian(lambda z: problem.step(t0, z[:n], z[n:], None))(z)
        H = symmetric(jax.hessian(stage_cost)(z)).astype(x.dtype)
    # z'Hz = x'Qx + 2 x'Su + u'Ru.
    A, B, Q, R, S = F[:, :n], F[:, n:], H[:n, :n], H[n:, n:], H[:n, n:]
    posed = jnp.all(jnp.isfinite(F)) & jnp.all(jnp.isfinite(H)) & is_definite(R)
    # Identities, if the problem is not well-posed, so that the solver ends at once.
    safe = (jnp.where(posed, M, jnp.eye(*M.shape, dtype=M.dtype)) for M in (A, B, Q, R))
    return *safe, jnp.where(posed, S, 0), posed


@host_unless_traced
def _both(x, u, regulator, controls, T):
    """Controls, states and gains of two starts: under a regulator, and under controls
    alone."""
    K = xp.zeros((u.shape[0], x.shape[0]), x.dtype)
    if regulator is not None:
        gain, radius, posed = regulator
        # Any stabilising gain is a valid start, even if its Riccati residual is large.
        stable = posed & (radius < 1) & xp.all(xp.isfinite(gain))
        K = xp.where(stable, gain, K)
    # The second start has gains of zero, so that both can be stacked.
    held = xp.tile(u, (T, 1))
    return (
        xp.stack([held, held if controls is None else controls]),
        xp.tile(x, (2, T + 1, 1)),
        xp.stack([xp.tile(K, (T, 1, 1)), xp.zeros((T, *K.shape), K.dtype)]),
    )


def controls_of(start: Start) -> Array:
    """The controls of the first start, shape `(T, m)`."""
    return start.controls[0] if start.controls.ndim == 3 else start.controls
