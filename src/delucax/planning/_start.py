"""The starts of planners: trajectories under feedback."""

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
    """A start of a planner: the trajectory of the model under

    `u_k = controls[k] - gains[k] (x_k - states[k])`,

    between the bounds of the planner. Controls alone, without gains, drive an unstable
    plant far away. Under a stabilising gain it stays near `states`.

    Several starts are stacked along a first axis. A planner computes their trajectories
    together and starts from the cheapest. One that diverges is ignored.

    **Arguments:**

    - `controls`: shape `(T, m)`, or `(c, T, m)` for `c` starts.
    - `states`: shape `(T+1, n)` or `(c, T+1, n)`; needed with `gains`.
    - `gains`: shape `(T, m, n)` or `(c, T, m, n)`; none by default.
    - `multipliers`: [`delucax.planning.Multipliers`][] to start from, the same for all
        starts, by planners that have them; zero by default, and where the names or the
        shapes are not those of the constraints.

    **Raises:** `ValueError` from the planner on shapes that do not fit, or numbers that
    are not finite.

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
        """The start a step later, its last step held."""
        shift = lambda a: jnp.concatenate([a[1:], a[-1:]])
        start, y = jax.tree.map(shift, self.trajectories), self.multipliers
        if y is not None:
            moving = dict(
                stage=y.stage, states=y.states, controls=y.controls, costates=y.costates
            )
            y = dataclasses.replace(y, **jax.tree.map(shift, moving))
        return dataclasses.replace(start, multipliers=y)

    @property
    def count(self) -> int:
        """How many starts there are."""
        return self.controls.shape[0] if self.controls.ndim == 3 else 1

    def checked(
        self, state_size: int, control_size: int, name: str, where: str
    ) -> "Start":
        """The start with arrays that fit each other and a problem, or an error.

        **Arguments:**

        - `state_size`: n.
        - `control_size`: m.
        - `name`, `where`: of the start and of what takes it, for the message.
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
        """One start or several as several, with states and gains.

        **Arguments:** `state_size`: n.
        """
        start = self
        if self.controls.ndim == 2:
            start = jax.tree.map(lambda a: a[None], self.trajectories)
        controls, states, gains = start.controls, start.states, start.gains
        if states is None or gains is None:
            # Zero gains make the states irrelevant.
            c, T, m = controls.shape
            states = jnp.zeros((c, T + 1, state_size), controls.dtype)
            gains = jnp.zeros((c, T, m, state_size), controls.dtype)
        return Start(controls, states, gains, self.multipliers)

    def cheapest(self, problem: Problem) -> tuple["Start", Array, Array, Array]:
        """The start with the cheapest trajectory.

        **Arguments:** `problem`: a [`delucax.planning.Problem`][].

        **Returns:** `(start, states, controls, cost)`: the start alone, and what
        `problem.roll_out` returns for it; the cost is infinite if all diverge.
        """

        def roll(start):
            states, gains = start.states, start.gains
            states, controls, cost = problem.roll_out(start.controls, states, gains)
            # The controls of a start that diverges are finite at least as given.
            given = jax.vmap(problem.clip)(start.controls)
            return states, jnp.where(jnp.isfinite(cost), controls, given), cost

        if self.controls.ndim == 2:
            return self, *roll(self)
        starts = self.trajectories
        # A loop over scalars is faster on CPU than one over vectors of a few entries.
        rolled = lax.map(roll, starts)
        # The choice is piecewise constant in the costs.
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
        """The start that planners take by default, of which they use the cheaper one:

        1. under the LQR about an operating point,
        2. with its control held.

        The operating point is the `targets` of the cost where they name both a state
        and a control; otherwise the equilibrium that the dynamics define; otherwise
        zeros stand in for a target that is missing. A [`delucax.costs.Quadratic`][] has
        targets, and so has what is made of it by `+`, `*` or [`delucax.costs.Rate`][].

        If that point is not an equilibrium, an LQR about it may be a poor start: give
        the cost both targets, which [`delucax.trim`][] finds.

        The weights of the LQR are the second derivatives of the stage cost at that
        point.

        There is no such LQR where the derivatives at that point are not finite, the
        second derivative of the cost with respect to the control is not positive
        definite, no gain stabilises the plant, or the dynamics cannot be
        differentiated. The gain of the first start is then zero, and no LQR is tried.

        A trajectory that rests at the operating point is not among the starts, for it
        does not begin at the first state. The LQR leads there.

        **Arguments:**

        - `dynamics`: the discrete-time dynamics.
        - `cost`: the stage and final cost.
        - `horizon`: the steps `T`.
        - `t0`: the time at which both are evaluated, 0 by default.
        - `controls`: in place of those of the second one, shape `(T, m)`.

        **Returns:** a [`delucax.planning.Start`][]. No derivative goes through it.

        **Raises:** `ValueError` if `dynamics` or `cost` is not one, or the horizon is
        not a whole number of at least 1.

        Source: Rawlings, Mayne and Diehl, 2017 (the regulator as a warm start).

        !!! example

            ```python
            import delucax as dlx

            env = dlx.make("pendulum")
            start = dlx.planning.Start.default(env.dynamics, env.cost, 20)
            start.gains[0, 0]
            ```
        """
        where = "Start.default"
        check_instance(dynamics, AbstractDynamics, "dynamics", where)
        check_instance(cost, AbstractCost, "cost", where)
        T = check_count(horizon, "horizon", where)
        # An implicit derivative does not depend on the start, so none need go through
        # it.
        constant = lambda leaf: lax.stop_gradient(leaf) if eqx.is_array(leaf) else leaf
        dynamics, cost = jax.tree.map(constant, (dynamics, cost))
        point = operating_point(dynamics, cost)
        try:
            t0 = jnp.asarray(t0, point[0].dtype)
            *matrices, posed = _expanded(dynamics, cost, *point, t0)
        except (NotImplementedError, RuntimeError, TypeError, ValueError):
            # Not differentiable. A planner that needs derivatives says so itself.
            regulator = None
        else:
            solution = dare(*matrices, throw=False)
            regulator = solution.K, solution.spectral_radius, posed
        return Start(*_both(*point, regulator, controls, T))


def operating_point(
    dynamics: AbstractDynamics, cost: AbstractCost
) -> tuple[Array, Array]:
    """The operating point, or zeros where neither names one."""
    n, m = dynamics.state_size, dynamics.control_size
    return cost.set_point(dynamics) or (jnp.zeros(n), jnp.zeros(m))


@eqx.filter_jit
@full_precision
def _expanded(dynamics, cost, x, u, t0):
    """The linear-quadratic problem about a point, and whether it is one."""
    n, z = x.shape[0], jnp.concatenate([x, u])
    problem = Problem(dynamics, cost, x, t0)
    stage_cost = lambda z: problem.stage_cost(t0, z[:n], z[n:], None)
    with products_whole():
        F = jacobian(lambda z: problem.step(t0, z[:n], z[n:], None))(z)
        H = symmetric(jax.hessian(stage_cost)(z)).astype(x.dtype)
    # z'Hz = x'Qx + 2 x'Su + u'Ru.
    A, B, Q, R, S = F[:, :n], F[:, n:], H[:n, :n], H[n:, n:], H[:n, n:]
    posed = jnp.all(jnp.isfinite(F)) & jnp.all(jnp.isfinite(H)) & is_definite(R)
    # Identities in place of what is not finite, so that the solver ends at once.
    safe = (jnp.where(posed, M, jnp.eye(*M.shape, dtype=M.dtype)) for M in (A, B, Q, R))
    return *safe, jnp.where(posed, S, 0), posed


@host_unless_traced
def _both(x, u, regulator, controls, T):
    """Controls, states and gains of the starts under a regulator, and under the
    controls alone."""
    K = xp.zeros((u.shape[0], x.shape[0]), x.dtype)
    if regulator is not None:
        gain, radius, posed = regulator
        # Any stabilising gain is a valid start, also one of large residual.
        stable = posed & (radius < 1) & xp.all(xp.isfinite(gain))
        K = xp.where(stable, gain, K)
    # Both starts are feedback, the second with a gain of zero, so that they stack.
    held = xp.tile(u, (T, 1))
    return (
        xp.stack([held, held if controls is None else controls]),
        xp.tile(x, (2, T + 1, 1)),
        xp.stack([xp.tile(K, (T, 1, 1)), xp.zeros((T, *K.shape), K.dtype)]),
    )


def controls_of(start: Start) -> Array:
    """The controls of the first start, shape `(T, m)`."""
    return start.controls[0] if start.controls.ndim == 3 else start.controls
