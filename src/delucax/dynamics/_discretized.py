"""A continuous system integrated over one control interval."""

import functools
from typing import Any

import diffrax
import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array

from .._check import check_count, check_instance
from .._integration import (
    as_fixed_step_solver,
    check_kind,
    check_method,
    check_returned,
    evaluate_field,
    RK4,
    runge_kutta_step,
    solve_result,
    tableau_of,
    throwing_adjoint,
    TimeOffset,
)
from .._jax import by_components, join_state, split_state
from .._module import parameter
from .._results import choose, first_of, or_none, promote, Result, RESULTS
from .._typing import Real, RealScalar
from ..systems import AbstractSystem
from ._base import AbstractDiscretization


# Euler and ItoMilstein converge to the solution in Itô's sense, the others to that in
# Stratonovich's: where g depends on x these are different processes.
_SDE_SOLVERS = (
    diffrax.Euler,
    diffrax.EulerHeun,
    diffrax.ItoMilstein,
    diffrax.StratonovichMilstein,
    diffrax.Heun,
    diffrax.Midpoint,
    diffrax.Ralston,
)


class Discretized(AbstractDiscretization):
    r"""Zero-order-hold discretisation: a system is integrated over one control interval
    with the control held.

    `x_next = x + integral over [t, t + dt] of f(s, x(s), u, w) ds`, the control (and a
    disturbance that enters the field) held over the interval; then the system's
    `project`; then, where the system names no disturbances, `+ w`, which may take the
    state off the manifold of `project` until the next step.

    With a fixed step (the default) `dt` is cut into `substeps` equal steps of `solver`:
    explicit Runge-Kutta methods are written out stage by stage, diagonally implicit
    ones take Diffrax `solver.step`s. With a `stepsize_controller` each interval is one
    `diffrax.diffeqsolve`, whose gradient is taken as `adjoint` says.

    The interval is integrated in its own time, from 0, so that an autonomous step is
    the same at any `t`. A time-dependent field or diffusion is evaluated at `t + s`.
    Below double precision that sum is rounded (by up to 5e-4 at 1e4 in float32), and
    the field is then corrected by its first two derivatives with respect to time along
    the rounding error. One without a second forward-mode derivative (a
    `jax.custom_vjp` of time) is evaluated at the rounded time.

    If the system has a `diffusion`, then `w` holds the Brownian increments of the
    substeps one after the other, each with variance `dt / substeps`, and the solver is
    one of Euler (Euler-Maruyama, Itô), ItoMilstein, EulerHeun, Heun, Midpoint, Ralston
    or StratonovichMilstein (all Stratonovich).

    **Arguments:**

    - `system`: the continuous-time system.
    - `dt`: the control interval, a positive number (an array leaf: changing it does not
        compile again).
    - `solver`: a Diffrax solver; [`delucax.dynamics.RK4`][] by default, and
        `diffrax.Euler` for a system with a diffusion.
    - `substeps`: solver steps per interval, 1 by default; fixed-step only.
    - `stepsize_controller`: such as `diffrax.PIDController(rtol=1e-6, atol=1e-8)`;
        `None` for fixed steps.
    - `adjoint`: any `diffrax.AbstractAdjoint`; `diffrax.RecursiveCheckpointAdjoint()`
        by default. Needs a `stepsize_controller`: fixed steps are differentiated as
        they are written. `diffrax.BacksolveAdjoint()` has no gradient with respect to
        `dt`, and raises if one is asked for.
    - `max_steps`: the most adaptive steps in an interval, 256 by default.

    **Raises:** `ValueError` if `dt` is not positive, if `solver` does not fit the
    system or the kind of step, or if `adjoint` or `max_steps` is given without a
    `stepsize_controller`.

    Source: Hairer, Nørsett and Wanner, 1993; Kidger, 2021 (Diffrax).

    !!! example

        ```python
        import delucax as dlx
        import diffrax
        import jax.numpy as jnp

        pendulum = dlx.systems.Pendulum()
        fixed = dlx.Discretized(pendulum, dt=0.05, solver=diffrax.Tsit5(), substeps=2)
        adaptive = dlx.Discretized(
            pendulum,
            dt=0.05,
            solver=diffrax.Tsit5(),
            stepsize_controller=diffrax.PIDController(rtol=1e-6, atol=1e-8),
        )
        adaptive(0.0, jnp.array([0.1, 0.0]), jnp.zeros(1))
        ```
    """

    system: AbstractSystem
    dt: Real = parameter()
    solver: diffrax.AbstractSolver | None = None
    substeps: int = eqx.field(default=1, static=True)
    stepsize_controller: diffrax.AbstractStepSizeController | None = None
    adjoint: diffrax.AbstractAdjoint | None = None
    max_steps: int | None = eqx.field(default=None, static=True)

    def __post_init__(self):
        system, where = self.system, "Discretized"
        self.substeps = check_count(self.substeps, "substeps", where)
        if self.solver is None:
            noisy = isinstance(system, AbstractSystem) and system.noise == "brownian"
            self.solver = diffrax.Euler() if noisy else RK4()
        if self.stepsize_controller is not None:
            if self.adjoint is None:
                self.adjoint = diffrax.RecursiveCheckpointAdjoint()
            steps = 256 if self.max_steps is None else self.max_steps
            self.max_steps = check_count(steps, "max_steps", where)

    def __check_init__(self):
        where, system, solver = "Discretized", self.system, self.solver
        check_instance(system, AbstractSystem, "system", where)
        noisy = system.noise == "brownian"
        fixed = self.stepsize_controller is None
        if fixed and self.adjoint is not None:
            raise ValueError(
                f"{where}: adjoint is given without stepsize_controller. Fixed "
                "steps are differentiated as they are written; give "
                "stepsize_controller=diffrax.PIDController(rtol=..., atol=...), or "
                "choose what `rollout` stores with its checkpoint= argument."
            )
        method = solver, self.stepsize_controller, self.substeps, self.max_steps
        check_method(*method, where, with_diffusion=noisy)
        if not fixed:
            check_kind(self.adjoint, "adjoint", where)
        if noisy and not fixed:
            raise ValueError(
                f"{where}: stepsize_controller does not fit a system with a "
                "diffusion, whose Brownian increments are drawn for fixed steps."
            )
        if noisy and not isinstance(solver, _SDE_SOLVERS):
            fitting = ", ".join(s.__name__ for s in _SDE_SOLVERS)
            raise ValueError(
                f"{where}: solver {type(solver).__name__} does not fit a system "
                f"with a diffusion; use one of {fitting}."
            )

    @property
    def disturbance_size(self) -> int:
        """The size of `w`: that of the system; with a diffusion times the substeps, as
        `w` holds one increment of each Brownian motion per substep.
        """
        return self.system.disturbance_size * (self.increments or 1)

    @property
    def increments(self) -> int:
        """One increment per substep for a system with a diffusion, else 0."""
        return self.substeps if self.noise == "brownian" else 0

    def advance(
        self, t: RealScalar, x: Array, u: Array, w: Array | None
    ) -> tuple[Array, Result]:
        system, noise = self.system, self.noise
        # A system uses w in one of three ways: in its field, held; as increments of
        # Brownian motions; or, where it names no disturbances, added to the next state.
        given: Any = w
        if w is None and noise != "additive":
            given = jnp.zeros(self.disturbance_size, x.dtype)
        added = given if noise == "additive" else None
        held = given if noise is None else None
        increments = given.reshape(self.substeps, -1) if noise == "brownian" else None
        # An interval is integrated from 0 to dt: where t is large, t + dt is rounded,
        # and so would the length of the interval be.
        t = jnp.asarray(t, x.dtype)
        start = TimeOffset(t, lambda t: evaluate_field(system, t, x, u, held))
        args = system, start, u, held
        if self.stepsize_controller is not None:
            x_next, result = self._adaptive(x, args)
        else:
            noisy = increments is not None
            step = self._noisy_step(x, args) if noisy else self._fixed_step(args)
            if self.substeps == 1:
                x_next, result = step(0, x, increments[0] if noisy else None)
            else:
                x_next, result = self._repeat(step, x, increments)
        # Once per interval, not per substep: the field is also defined off the
        # manifold.
        x_next = system.project(x_next)
        check_returned(x_next, x, system, "project")
        if added is not None:
            x_next = x_next + added
        return x_next.astype(x.dtype), result

    def _fixed_step(self, args):
        """A substep, as a function of the time in the interval and the state."""
        system, start, u, held = args
        assert self.solver is not None
        h, tableau = self.dt / self.substeps, tableau_of(self.solver)
        if tableau is None:
            solver, term = as_fixed_step_solver(self.solver), diffrax.ODETerm(_field)
            return lambda s, x, _: _solver_step(solver, term, s, x, h, args)

        def field(s, x):
            dx = system.vector_field(start.t + s, x, u, held)
            check_returned(dx, x, system, "vector_field")
            return dx

        # The field itself is in the loop where nothing is to be corrected: fewer frames
        # lie between it and an error that it raises.
        rhs = (lambda s, x: _field(s, x, args)) if start.is_corrected else field
        step = functools.partial(runge_kutta_step, tableau, rhs)
        return lambda s, x, _: (step(s, x, h), RESULTS.successful)

    def _noisy_step(self, x, args):
        """A substep with an increment of the Brownian motions."""
        system, start, u, _ = args
        h = self.dt / self.substeps
        # The diffusion may depend on time where the field does not, so it has a check
        # of its own.
        start = TimeOffset(start.t, lambda t: system.diffusion(t, x, u))

        def g(s, x):
            return start.evaluate(s, lambda t: system.diffusion(t, x, u))

        def step(s, x, dB):
            # Euler and Maruyama's method; Diffrax's takes a term with a path of its
            # own.
            if type(self.solver) is diffrax.Euler:
                x_next = x + h * _field(s, x, args) + _apply(g(s, x), dB)
                return x_next, RESULTS.successful
            term = diffrax.MultiTerm(diffrax.ODETerm(_field), _BrownianTerm(g, dB))
            return _solver_step(self.solver, term, s, x, h, args)

        return step

    def _repeat(self, step, x, increments):
        """`substeps` steps one after the other, the state carried by its components."""
        h = self.dt / self.substeps

        @by_components
        def body(parts, index_and_increment):
            i, increment = index_and_increment
            # By i h, and no running sum, whose rounding would grow with the substeps.
            x_next, result = step(i * h, join_state(parts), increment)
            return split_state(x_next.astype(x.dtype)), or_none(result)

        xs = jnp.arange(self.substeps), increments
        # The first failure of a substep is that of the interval.
        parts, results = lax.scan(body, split_state(x), xs)
        return join_state(parts), first_of(results)

    def _adaptive(self, x, args):
        solver, controller, adjoint = (
            self.solver,
            self.stepsize_controller,
            self.adjoint,
        )
        assert solver is not None and controller is not None and adjoint is not None
        # Without `dt0` Diffrax estimates a first step from the field (Hairer, Nørsett
        # and Wanner, 1993, II.4): the last step of the interval before was cut off at
        # its end and tells little. Without `throw`, because one member of a batch that
        # fails must not stop the others.
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(_field),
            solver,
            jnp.zeros((), x.dtype),
            self.dt,
            dt0=None,
            y0=x,
            args=args,
            stepsize_controller=controller,
            adjoint=throwing_adjoint(adjoint),
            max_steps=self.max_steps,
            throw=False,
        )
        assert solution.ys is not None
        result = solve_result(solution, controller, x.dtype)
        return solution.ys[0], result


def _apply(g: Array, dB: Array) -> Array:
    return g * dB if g.ndim == 1 else g @ dB


class _BrownianTerm(diffrax.AbstractTerm):
    """`g dB` with the increment of this step given, where Diffrax's own term would
    evaluate a path: increments are data here, to be given, kept and differentiated."""

    diffusion: Any
    increment: Array

    def vf(self, t, y, args):
        del args
        return self.diffusion(t, y)

    def contr(self, t0, t1, **kwargs):
        del t0, t1, kwargs
        return self.increment

    def prod(self, vf, control):
        return _apply(vf, control)


def _field(s, x, args):
    """The vector field at `s` after the start of the interval. Adjoints differentiate
    `args` only, not closures.
    """
    system, start, u, held = args
    return start.evaluate(s, lambda t: evaluate_field(system, t, x, u, held))


def _solver_step(solver, term, s, x, h, args):
    """One Diffrax step of `h` from `s` after the start of the interval. It starts
    afresh, as it must after a switch of the control.
    """
    # In local time, so that t1 - t0 is h to rounding, however late the interval is.
    t0 = jnp.asarray(s, x.dtype)
    t1 = t0 + h
    state = solver.init(term, t0, t1, x, args)
    x_next, _, _, _, result = solver.step(
        term, t0, t1, x, args, state, made_jump=jnp.array(True)
    )
    if result is diffrax.RESULTS.successful:
        return x_next, RESULTS.successful
    # Diffrax's message refers to a step-size controller, which there is not.
    solved = promote(result) == RESULTS.successful
    return x_next, choose(solved, RESULTS.successful, RESULTS.stage_not_solved)
