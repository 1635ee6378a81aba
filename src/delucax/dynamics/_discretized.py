"""A continuous system integrated over one control interval."""

import dataclasses
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
    runge_kutta_step_in_loop,
    solve_result,
    tableau_of,
    throwing_adjoint,
    TimeOffset,
)
from .._jax import by_components, join_state, operations, split_state
from .._module import parameter
from .._results import first_of, or_none, Result, RESULTS
from .._typing import Real, RealScalar
from ..systems import AbstractHybridSystem, AbstractSystem
from ._base import AbstractDiscretization
from ._event_record import Events
from ._hybrid import ahead_of_steps, HybridFlow, Intervals, Outcome
from ._solver_steps import apply, BrownianTerm, field, solver_step


_LARGE = 64
"""Operations of a field above which a step to an event has its stages in a loop: there
are five such steps in a program, and each would repeat them four times."""
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

    A [`delucax.systems.AbstractHybridSystem`][] is integrated from event to event. A
    crossing is found by the cubic through a guard and its rate at both ends of each
    step, so that one there and back within a step is seen, and located on the step
    itself, taken shorter, to rounding: states have the order of the solver. Up to
    `max_events` events, and cuts where a guard that is not enabled crosses zero, may
    fall in an interval. Of guards that cross together the first of `event_names` fires,
    and the others are judged after its reset. Derivatives are those of the computed
    trajectory in both modes and of any order: the event's time moves with the state
    (the saltation matrix); under a batch members without an event are masked. What goes
    wrong has a status:

    - `RESULTS.too_many_events`: the state is held after the last that was handled, as
        where events accumulate or a reset leaves its guard at zero.
    - `RESULTS.beyond_guard`: at the start of the interval or after a reset the state is
        beyond an enabled guard, whose event does not fire until it has come back.
    - `RESULTS.grazing`: a guard hardly crosses zero. The state is right, and
        derivatives are NaN. A guard that is nearer to zero than the cubic's error, and
        does not cross, may be missed or found.
    - `RESULTS.unknown_mode`: the mode is not one of the system's.

    Additive disturbances jump the state at the end of an interval, which may take it
    beyond a guard: name disturbances to hold them in the field instead. The field must
    be defined a little beyond a guard.

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
    - `max_events`: the most events in an interval, 16 by default; of a hybrid system.

    **Raises:** `ValueError` if `dt` is not positive, if `solver` does not fit the
    system or the kind of step, or if `adjoint` or `max_steps` is given without a
    `stepsize_controller`, or `max_events` without events.

    Source: Hairer, Nørsett and Wanner, 1993; Kidger, 2021 (Diffrax); Aizerman and
    Gantmacher, 1958 (derivatives through events).

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
    max_events: int | None = eqx.field(default=None, static=True)

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
        if isinstance(system, AbstractHybridSystem):
            most = 16 if self.max_events is None else self.max_events
            self.max_events = check_count(most, "max_events", where)

    def __check_init__(self):
        where, system, solver = "Discretized", self.system, self.solver
        check_instance(system, AbstractSystem, "system", where)
        noisy = system.noise == "brownian"
        hybrid = isinstance(system, AbstractHybridSystem)
        if self.max_events is not None and not hybrid:
            raise ValueError(
                f"{where}: max_events needs a system with events, "
                f"delucax.systems.AbstractHybridSystem, got {type(system).__name__}."
            )
        if hybrid and isinstance(self.adjoint, diffrax.BacksolveAdjoint):
            raise ValueError(
                f"{where}: adjoint BacksolveAdjoint does not fit a system with events, "
                "whose steps are searched for them; use "
                "diffrax.RecursiveCheckpointAdjoint()."
            )
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
        added, held, increments = self._parts_of(x, w)
        args = self._args(t, x, u, held)
        if isinstance(self.system, AbstractHybridSystem):
            outcome = self._hybrid(x, args, record=False)
            x_next, result = outcome.x, outcome.result
        elif self.stepsize_controller is not None:
            solution, result = self.solve(jnp.zeros((), x.dtype), x, self.dt, args)
            x_next = solution.ys[0]  # pyright: ignore
        elif increments is not None or self.substeps > 1:
            x_next, result = self._repeat(x, args, increments)
        else:
            # Few frames lie between this and the field.
            x_next, result = self.flow(args)(0, x, self.dt)
        return self._finished(x, x_next, added), result

    def advance_with_events(
        self, t: RealScalar, x: Array, u: Array, w: Array | None
    ) -> tuple[Array, Result, Events | None]:
        if not isinstance(self.system, AbstractHybridSystem):
            return *self.advance(t, x, u, w), None
        added, held, _ = self._parts_of(x, w)
        outcome = self._hybrid(x, self._args(t, x, u, held), record=True)
        x_next = self._finished(x, outcome.x, added)
        return x_next, outcome.result, outcome.events

    def _finished(self, x, x_next, added):
        """The next state from that at the end of the interval."""
        # Once per interval, not per substep: the field is also defined off the
        # manifold.
        x_next = self.system.project(x_next)
        check_returned(x_next, x, self.system, "project")
        if added is not None:
            x_next = x_next + added
        return x_next.astype(x.dtype)

    def until_event(
        self, t: RealScalar, x: Array, u: Array, w: Array | None, event: int
    ) -> Outcome:
        """The interval of a system with events, which stops at one of them.

        **Arguments:** `t`, `x`, `u`, `w`: as `advance`. `event`: an index in
            `event_names`.

        **Returns:** the state at the event or at the end, when that is, and whether it
        is at the event.
        """
        _, held, _ = self._parts_of(x, w)
        args = self._args(t, x, u, held)
        return self._hybrid(x, args, record=False, until=event)

    def _parts_of(self, x, w):
        """What of `w` is added to the next state, is held in the field, and drives it
        as increments. A system uses it in one of the three ways."""
        noise, given = self.noise, w
        # Where the system names no disturbances, w is added to the next state.
        if w is None and noise != "additive":
            given = jnp.zeros(self.disturbance_size, x.dtype)
        added = given if noise == "additive" else None
        held = given if noise is None else None
        is_driven = noise == "brownian"
        return added, held, given.reshape(self.substeps, -1) if is_driven else None

    def _args(self, t, x, u, held):
        # An interval is integrated from 0 to dt: where t is large, t + dt is rounded,
        # and so would the length of the interval be.
        system, t = self.system, jnp.asarray(t, x.dtype)
        start = TimeOffset(t, lambda t: evaluate_field(system, t, x, u, held))
        return system, start, u, held

    def _hybrid(self, x, args, record=True, until: int | None = None) -> Outcome:
        """The interval of a system with events."""
        system, start, u, _ = args
        guards = lambda t: jnp.stack(list(system.guards(t, x, u)))
        plant = HybridFlow(self, args, TimeOffset(start.t, guards))
        # The first step is the one that is taken where nothing happens.
        look_ahead = plant.ahead
        if operations(lambda x: field(jnp.zeros_like(x[0]), x, args), x) > _LARGE:
            plant = dataclasses.replace(plant, in_loop=True)
        if self.stepsize_controller is not None:
            look_ahead = functools.partial(ahead_of_steps, plant)
        assert self.max_events is not None
        through = Intervals(plant, look_ahead, self.max_events, until)
        return through(x, self.dt, self.substeps, record)

    def flow(self, args: Any, in_loop: bool = False) -> Any:
        """One step of the solver, `(s, x, h) -> (x_next, result)`: of `h` from `x` at
        `s` after the start of the interval. With `in_loop` its stages are in a
        loop. `args` are those of the interval."""
        system, start, u, held = args
        assert self.solver is not None
        tableau = tableau_of(self.solver)
        if tableau is None:
            solver, term = as_fixed_step_solver(self.solver), diffrax.ODETerm(field)
            return lambda s, x, h: solver_step(solver, term, s, x, h, args)

        def checked(s, x):
            dx = system.vector_field(start.t + s, x, u, held)
            check_returned(dx, x, system, "vector_field")
            return dx

        # The field itself is in the loop where nothing is to be corrected: fewer frames
        # lie between it and an error that it raises.
        rhs = (lambda s, x: field(s, x, args)) if start.is_corrected else checked
        method = runge_kutta_step_in_loop if in_loop else runge_kutta_step
        step = functools.partial(method, tableau, rhs)
        return lambda s, x, h: (step(s, x, h), RESULTS.successful)

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
                x_next = x + h * field(s, x, args) + apply(g(s, x), dB)
                return x_next, RESULTS.successful
            term = diffrax.MultiTerm(diffrax.ODETerm(field), BrownianTerm(g, dB))
            return solver_step(self.solver, term, s, x, h, args)

        return step

    def _repeat(self, x, args, increments):
        """`substeps` steps one after the other, the state carried by its components."""
        h = self.dt / self.substeps
        if increments is not None:
            step = self._noisy_step(x, args)
            if self.substeps == 1:
                return step(0, x, increments[0])
        else:
            flow = self.flow(args)
            step = lambda s, x, _: flow(s, x, h)

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

    def solve(
        self, s: Array, x: Array, end: Array, args: Any, every_step: bool = False
    ) -> tuple[diffrax.Solution, Result]:
        """The solve by a step-size controller from `x` at `s` to `end`; its result.

        Its `ys` are those at the end; with `every_step` also those of all steps.
        """
        solver, adjoint = self.solver, self.adjoint
        controller = self.stepsize_controller
        assert solver is not None and controller is not None and adjoint is not None
        saved: Any = dict(t1=True)
        if every_step:
            steps = diffrax.SubSaveAt(t0=True, steps=True)
            saved = dict(subs=[diffrax.SubSaveAt(t1=True), steps])
        # Without `dt0` Diffrax estimates a first step from the field (Hairer, Nørsett
        # and Wanner, 1993, II.4): the last step of the interval before was cut off at
        # its end and tells little. Without `throw`, because one member of a batch that
        # fails must not stop the others.
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(field),
            solver,
            s,
            end,
            dt0=None,
            y0=x,
            args=args,
            saveat=diffrax.SaveAt(**saved),
            stepsize_controller=controller,
            adjoint=throwing_adjoint(adjoint),
            max_steps=self.max_steps,
            throw=False,
        )
        return solution, solve_result(solution, controller, x.dtype)
