"""A continuous-time system, integrated over one control interval at a time."""

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
    tableau_of,
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
from ._solver_steps import adaptive_solve, apply, BrownianTerm, field, solver_step


_LARGE = 64
"""If a field has more operations than this, steps to an event loop over their stages. A
program has five such steps, and each would otherwise repeat the field four times."""
# Euler and ItoMilstein converge to the Itô solution, the others to the Stratonovich
# solution. These differ if g depends on x.
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
    r"""Discrete-time dynamics of a continuous-time system: each step integrates the
    system over one control interval, with the control held (zero-order hold).

    $$x_{k+1} = x_k + \int_{t_k}^{t_k + \Delta t} f(s, x(s), u_k, w_k)\, \mathrm{d}s$$

    After the integration, the system's `project` is applied. If the system has
    `disturbance_names`, the disturbance `w` enters the vector field and is held over
    the interval. If the system has no `disturbance_names`, `w` is added to the state
    after the projection. This may move the state off the manifold of `project` until
    the next step.

    **Fixed steps** (the default): the interval is cut into `substeps` equal steps of
    `solver`. The solver may be an explicit or a diagonally implicit Runge-Kutta method.

    **Adaptive steps** (with a `stepsize_controller`): each interval is solved by one
    call of `diffrax.diffeqsolve`, and `adjoint` decides how the gradient of this solve
    is computed.

    **Late times:** each interval is integrated in a local time $s$ that starts at 0, so
    that a step of an autonomous system has the same result at any start time `t`. A
    time-dependent vector field or diffusion is evaluated at `t + s`. Below double
    precision, the sum `t + s` is rounded: in float32 the error is up to 5e-4 at a time
    of 1e4. The value of the vector field is then corrected for this rounding error, by
    its first two derivatives with respect to time. There is no correction if the second
    derivative cannot be computed in forward mode, for example because the vector field
    uses a `jax.custom_vjp` of time.

    **Diffusion:** if the system has a `diffusion`, `w` holds the Brownian increments of
    all substeps, one after the other, each with the variance `dt / substeps`. Use one
    of the Diffrax solvers Euler (Euler-Maruyama) or ItoMilstein for Itô's
    interpretation, and EulerHeun, Heun, Midpoint, Ralston or StratonovichMilstein for
    Stratonovich's.

    **Events:** a [`delucax.systems.AbstractHybridSystem`][] is integrated from event to
    event.

    - *Detection.* In each step of the solver, the value of a guard is approximated by a
        cubic polynomial of time. The cubic matches the values and the time derivatives
        of the guard at both ends of the step. The zeros of the cubic show where the
        guard crosses zero, even if the guard crosses zero and comes back within the
        same step. The step is then shortened until it ends at the event, up to
        rounding. So the events do not lower the order of accuracy of the solver.
    - *Limits.* Up to `max_events` events may happen in one control interval. A zero
        crossing of a guard counts as an event here, even if the event of this guard is
        not enabled. If several guards cross zero at the same time, the event that is
        first in `event_names` fires; the other events are checked after the reset of
        the first one.
    - *Derivatives* are the exact derivatives of the computed trajectory, in forward and
        reverse mode and to any order. The derivatives take into account that the time
        of an event changes with the state (the saltation matrix).

    If something goes wrong, the status says so:

    - `RESULTS.too_many_events`: there are more than `max_events` events in the
        interval, because they accumulate or because a reset leaves its guard at zero.
        The state then stays at its value after the last event that was handled.
    - `RESULTS.beyond_guard`: the state is beyond an enabled guard at the start of the
        interval or after a reset. The event of this guard does not fire until the guard
        has returned to its allowed side.
    - `RESULTS.grazing`: a guard hardly crosses zero. The state is still correct, but
        the derivatives are NaN. If a guard does not cross zero but comes closer to zero
        than the error of the cubic interpolation, the event may or may not fire.
    - `RESULTS.unknown_mode`: the mode is not one of the system's modes.

    Additive disturbances make the state jump at the end of an interval, possibly beyond
    a guard. To avoid such jumps, give the system `disturbance_names`: disturbances then
    enter the vector field and are held over the interval. The vector field must be
    defined a little beyond each guard, because a step may pass the guard before the
    event is located.

    **Arguments:**

    - `system`: the continuous-time system.
    - `dt`: the control interval $\Delta t$, in units of time, a positive number. If you
        change `dt`, JAX does not compile again, because `dt` is an array leaf.
    - `solver`: a Diffrax solver; [`delucax.dynamics.RK4`][] by default, and
        `diffrax.Euler` for a system with a diffusion.
    - `substeps`: the number of solver steps per control interval, 1 by default; for
        fixed steps only.
    - `stepsize_controller`: a step-size controller of Diffrax, such as
        `diffrax.PIDController(rtol=1e-6, atol=1e-8)`; `None` (default) for fixed steps.
    - `adjoint`: any `diffrax.AbstractAdjoint`, for adaptive steps only;
        `diffrax.RecursiveCheckpointAdjoint()` by default. Fixed steps are
        differentiated directly. `diffrax.BacksolveAdjoint()` raises an error if you ask
        for a gradient with respect to `dt`.
    - `max_steps`: the largest number of adaptive steps in one control interval, 256 by
        default.
    - `max_events`: the largest number of events in an interval of a hybrid system, 16
        by default.

    **Raises:** `ValueError` if `dt` is not positive, if `solver` does not fit the
    system or the kind of step, if `adjoint` or `max_steps` is given without a
    `stepsize_controller`, or if `max_events` is given for a system without events.

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

        ```text
        Array([0.102, 0.075], dtype=float32)
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
                f"{where}: max_events needs a system with events, a "
                f"delucax.systems.AbstractHybridSystem, got {type(system).__name__}."
            )
        if hybrid and isinstance(self.adjoint, diffrax.BacksolveAdjoint):
            raise ValueError(
                f"{where}: adjoint must not be BacksolveAdjoint for a system with "
                "events. Use diffrax.RecursiveCheckpointAdjoint()."
            )
        fixed = self.stepsize_controller is None
        if fixed and self.adjoint is not None:
            raise ValueError(
                f"{where}: adjoint needs a stepsize_controller, because fixed steps "
                "are differentiated directly. Pass "
                "stepsize_controller=diffrax.PIDController(rtol=..., atol=...). To "
                "choose what the gradient of a rollout stores, use the argument "
                "checkpoint= of `rollout`."
            )
        method = solver, self.stepsize_controller, self.substeps, self.max_steps
        check_method(*method, where, with_diffusion=noisy)
        if not fixed:
            check_kind(self.adjoint, "adjoint", where)
        if noisy and not fixed:
            raise ValueError(
                f"{where}: stepsize_controller must be left out for a system with a "
                "diffusion, because its Brownian increments are drawn for fixed steps."
            )
        if noisy and not isinstance(solver, _SDE_SOLVERS):
            fitting = ", ".join(s.__name__ for s in _SDE_SOLVERS)
            raise ValueError(
                f"{where}: solver {type(solver).__name__} does not fit a system "
                f"with a diffusion. Use one of {fitting}."
            )

    @property
    def disturbance_size(self) -> int:
        """The size of the disturbance `w`: the `disturbance_size` of the system; with a
        diffusion, this number times the number of substeps.
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
            # Called directly, so that the traceback of an error in the field is short.
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
        """The next state, from the state at the end of the integration."""
        # Once per interval, not per substep, because the field is also defined off the
        # manifold.
        x_next = self.system.project(x_next)
        check_returned(x_next, x, self.system, "project")
        if added is not None:
            x_next = x_next + added
        return x_next.astype(x.dtype)

    def until_event(
        self, t: RealScalar, x: Array, u: Array, w: Array | None, event: int
    ) -> Outcome:
        """An interval of a system with events, which stops at a given event.

        **Arguments:** `t`, `x`, `u`, `w`: as in `advance`. `event`: an index in
            `event_names`.

        **Returns:** the state at the event or at the end of the interval, the time of
        this state, and whether the event happened.
        """
        _, held, _ = self._parts_of(x, w)
        args = self._args(t, x, u, held)
        return self._hybrid(x, args, record=False, until=event)

    def _parts_of(self, x, w):
        """`w` as `(added, held, increments)`: added to the next state, held in the
        field, or as increments of each substep. A system uses one of the three; the
        others are `None`."""
        noise, given = self.noise, w
        if w is None and noise != "additive":
            given = jnp.zeros(self.disturbance_size, x.dtype)
        added = given if noise == "additive" else None
        held = given if noise is None else None
        is_driven = noise == "brownian"
        return added, held, given.reshape(self.substeps, -1) if is_driven else None

    def _args(self, t, x, u, held):
        # Integrated from 0 to dt, because for a large t the sum t + dt is rounded, and
        # so would be the length of the interval.
        system, t = self.system, jnp.asarray(t, x.dtype)
        start = TimeOffset(t, lambda t: evaluate_field(system, t, x, u, held))
        return system, start, u, held

    def _hybrid(self, x, args, record=True, until: int | None = None) -> Outcome:
        """The interval of a system with events."""
        system, start, u, _ = args
        guards = lambda t: jnp.stack(list(system.guards(t, x, u)))
        plant = HybridFlow(self, args, TimeOffset(start.t, guards))
        # The first step stays written out: it is the one that is taken if no event
        # happens.
        look_ahead = plant.ahead
        if operations(lambda x: field(jnp.zeros_like(x[0]), x, args), x) > _LARGE:
            plant = dataclasses.replace(plant, in_loop=True)
        if self.stepsize_controller is not None:
            look_ahead = functools.partial(ahead_of_steps, plant)
        assert self.max_events is not None
        through = Intervals(plant, look_ahead, self.max_events, until)
        return through(x, self.dt, self.substeps, record)

    def flow(self, args: Any, in_loop: bool = False) -> Any:
        """One step of the solver, as a function `(s, x, h) -> (x_next, result)`: a step
        of length `h` from the state `x` at the time `s` after the start of the
        interval. With `in_loop`, the stages of the solver are computed in a loop.
        `args` come from `_args`."""
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

        # Without a correction the field is called directly, which makes the traceback
        # of an error in it shorter.
        rhs = (lambda s, x: field(s, x, args)) if start.is_corrected else checked
        method = runge_kutta_step_in_loop if in_loop else runge_kutta_step
        step = functools.partial(method, tableau, rhs)
        return lambda s, x, h: (step(s, x, h), RESULTS.successful)

    def _noisy_step(self, x, args):
        """One substep with an increment of the Brownian motions."""
        system, start, u, _ = args
        h = self.dt / self.substeps
        # Another TimeOffset, because the diffusion may depend on time where the field
        # does not.
        start = TimeOffset(start.t, lambda t: system.diffusion(t, x, u))

        def g(s, x):
            return start.evaluate(s, lambda t: system.diffusion(t, x, u))

        def step(s, x, dB):
            # The Euler-Maruyama method by hand, because Diffrax's Euler takes a term
            # with a path of its own.
            if type(self.solver) is diffrax.Euler:
                x_next = x + h * field(s, x, args) + apply(g(s, x), dB)
                return x_next, RESULTS.successful
            term = diffrax.MultiTerm(diffrax.ODETerm(field), BrownianTerm(g, dB))
            return solver_step(self.solver, term, s, x, h, args)

        return step

    def _repeat(self, x, args, increments):
        """`substeps` steps one after the other. The state is carried in components."""
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
            # By i h, because the rounding of a running sum would grow.
            x_next, result = step(i * h, join_state(parts), increment)
            return split_state(x_next.astype(x.dtype)), or_none(result)

        xs = jnp.arange(self.substeps), increments
        # The interval has the status of the first substep that failed.
        parts, results = lax.scan(body, split_state(x), xs)
        return join_state(parts), first_of(results)

    def solve(
        self, s: Array, x: Array, end: Array, args: Any, every_step: bool = False
    ) -> tuple[diffrax.Solution, Result]:
        """A solve with adaptive steps from the state `x` at the time `s` to the time
        `end`, and the result of this solve. `ys` of the solution holds the state at the
        end. With `every_step`, `ys` also holds the states of all steps.
        """
        method: Any = dict(solver=self.solver, max_steps=self.max_steps)
        method |= dict(stepsize_controller=self.stepsize_controller)
        return adaptive_solve(s, x, end, args, every_step, self.adjoint, method)
