"""Simulation of a whole horizon by one continuous-time solve."""

from typing import Any, Literal

import diffrax
import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import ArrayLike

from .._check import (
    as_number,
    check_bool,
    check_choice,
    check_count,
    check_key,
    finite_rows,
    finite_vector,
    is_concrete,
)
from .._controller import AbstractController, initial_state, tallies
from .._integration import (
    as_fixed_step_solver,
    check_method,
    solve_result,
    throwing_adjoint,
    TimeOffset,
)
from .._results import choose, first_failure, RESULTS
from .._typing import Numbers, PRNGKey
from ..math._steps import check_steps
from ..systems import AbstractSystem
from ._checked import checked, plant_fields
from ._controller_calls import check_control, controller_result
from ._hold import (
    field,
    Hold,
    in_intervals,
    Inputs,
    interval_before,
    InTime,
    save_fn,
    SavedState,
)
from ._simulate_checks import (
    as_save_times,
    check_adjoint,
    check_system,
    count_intervals,
)
from ._trajectory import Trajectory


def simulate(
    system: AbstractSystem,
    controller_or_controls: Any,
    t0: Any,
    t1: Any,
    x0: Numbers,
    *,
    hold: Literal["zero"] | None = "zero",
    dt: ArrayLike | None = None,
    w: Numbers | None = None,
    solver: diffrax.AbstractSolver | None = None,
    stepsize_controller: diffrax.AbstractStepSizeController | None = None,
    substeps: int = 1,
    adjoint: diffrax.AbstractAdjoint | None = None,
    max_steps: int | None = None,
    ts: Numbers | None = None,
    key: PRNGKey | None = None,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
    throw: bool = True,
) -> Trajectory:
    r"""Simulate a controlled system over the whole horizon with one call of an ODE
    solver.

    `simulate` integrates $\dot x = f(t, x, u, w)$ from `t0` to `t1` by a single call of
    `diffrax.diffeqsolve`, so `adjoint` determines how the gradient over the whole
    horizon is computed. `simulate` is already compiled: call it directly, without
    `jax.jit`.

    The horizon is cut into $T$ equal intervals. With `hold="zero"`, the control is held
    constant over each interval and switches between intervals. The switches cause no
    integration error, because no step crosses a switch, and all stages of a step use
    the control of the same interval. A step that starts at a switch does not reuse a
    slope from before the switch.

    A large `t0` does not reduce the precision, because the solver measures time from
    `t0`, in intervals. In single precision, the times of the switches have rounding
    errors of about `1e-7 (t1 - t0)`, even if `t0` is large. A step-size controller gets
    times that are measured from `t0`. If the control is not held, the vector field is
    corrected for the rounding error of the time `t0 + s`, as in
    [`delucax.Discretized`][]. Held controllers get the rounded time.

    `simulate` computes no costs: `costs` of the trajectory is `None`, and `final_cost`
    and `total_cost` are zero.

    **Arguments:**

    - `system`: the continuous-time system.
    - `controller_or_controls`: one of

        - an array of controls, shape `(T, m)`;
        - a function of time to a control, shape `(m,)`;
        - a controller. If the control is held, the controller reads the sensor at each
            switch. Then `simulate` calls the method `applied` of the controller with
            this control and a cost of zero. Therefore `simulate` refuses a controller
            that learns from costs.

    - `t0`, `t1`: start and end of the horizon, in units of time, with `t1 > t0`.
    - `x0`: the state at `t0`, shape `(n,)`.
    - `hold`: `"zero"` (default) holds the control constant over each interval. Pass
        `None` for a control that is a function of time, or for continuous feedback
        $u = \pi(t, h(t, x))$ by a controller that has no state.
    - `dt`: the length of an interval, in units of time; `t1 - t0` must be a whole
        multiple of `dt`. By default `dt` is `(t1 - t0) / T` if `controller_or_controls`
        or `w` is an array; otherwise `dt` is required.
    - `w`: disturbances that enter the vector field, shape `(T, k)`, held constant over
        each interval, whatever `hold` is; zero by default.
    - `solver`: a Diffrax solver; `diffrax.Tsit5()` by default.
    - `stepsize_controller`: a step-size controller of Diffrax, such as
        `diffrax.PIDController(rtol=1e-6, atol=1e-8)`; `None` (default) for fixed steps.
    - `substeps`: the number of fixed steps per interval, 1 by default.
    - `adjoint`: `diffrax.RecursiveCheckpointAdjoint()` (default),
        `diffrax.DirectAdjoint()`, `diffrax.ForwardMode()` or
        `diffrax.BacksolveAdjoint()`. `diffrax.BacksolveAdjoint()` needs a
        `stepsize_controller`. It does not work with a controller whose control is held,
        because the memory of a controller cannot run backwards in time. With `ts`,
        `diffrax.BacksolveAdjoint()` raises an error if you ask for a gradient with
        respect to `t0`, `t1` or `ts`.
    - `max_steps`: the largest number of adaptive steps over the horizon; by default
        4096, or 64 times the number of intervals if this is larger.
    - `ts`: the times at which the trajectory is saved, shape `(S + 1,)`, increasing and
        between `t0` and `t1`. By default these times are the `T + 1` ends of the
        intervals. There the states are not interpolated.
    - `key`: a random key for the controller's `init`; none by default.
    - `progress_meter`: a progress meter of Diffrax, such as
        `diffrax.TqdmProgressMeter()`; none by default.
    - `throw`: whether to raise an error if the solve fails or the state becomes NaN or
        infinite; true by default. With `throw=False`, check `trajectory.result`
        yourself.

    **Returns:** a [`delucax.Trajectory`][] at the saved times. For each saved time
    except the first, `controls` and `disturbances` hold the values just before this
    time. With `hold=None`, `controls` instead holds the value just after each saved
    time except the last. For each saved time except the last, `observations` holds the
    reading of the sensor at this time.

    **Raises:** `ValueError` on an argument of the wrong kind or shape, on a solver or
    adjoint that does not fit, on a controller that learns from costs, and on more than
    2^22 steps in single precision, because the times are then too coarse to resolve a
    step. The error is also raised for systems that cannot be integrated by one call of
    the solver: systems that override `project`, systems with a `diffusion` or events,
    and systems without `disturbance_names` if `w` is given. Use
    [`delucax.Discretized`][] for these. An error is raised at run time if the solve
    fails and `throw` is true.

    Source: Kidger, 2021 (Diffrax).

    !!! example

        ```python
        import delucax as dlx
        import diffrax
        import jax
        import jax.numpy as jnp

        pendulum = dlx.systems.Pendulum()
        x0 = jnp.array([0.1, 0.0])

        # The gradient with respect to 20 controls, each held for 0.05 s.
        def cost(controls):
            trajectory = dlx.simulate(pendulum, controls, 0.0, 1.0, x0)
            return jnp.sum(trajectory.final_state**2)

        slopes = jax.jit(jax.grad(cost))(jnp.zeros((20, 1)))

        # Continuous feedback, with adaptive steps.
        feedback = dlx.controllers.Linear(jnp.array([[20.0, 5.0]]))
        adaptive = diffrax.PIDController(rtol=1e-5, atol=1e-6)
        options = dict(hold=None, dt=0.05, stepsize_controller=adaptive)
        trajectory = dlx.simulate(pendulum, feedback, 0.0, 1.0, x0, **options)
        trajectory.states.shape, trajectory.final_state
        ```

        ```text
        ((21, 2), Array([ 0.003, -0.011], dtype=float32))
        ```
    """
    where = "simulate"
    check_system(system, w, where)
    check_choice(hold, ("zero", None), "hold", where)
    check_bool(throw, "throw", where)
    x0 = finite_vector(x0, system.state_size, "x0", where)
    if key is not None:
        check_key(key, where)
    t0, t1 = as_number(t0, "t0", where), as_number(t1, "t1", where)
    dt = None if dt is None else as_number(dt, "dt", where)
    if is_concrete(t0) and is_concrete(t1) and not t1 > t0:
        raise ValueError(f"{where}: t1 must be above t0, got t0 = {t0}, t1 = {t1}.")
    source = controller_or_controls
    if isinstance(source, AbstractController) and source.learns_from_cost:
        raise ValueError(
            f"{where}: {type(source).__name__} learns from the cost of each step, but "
            "simulate has no cost. Use `delucax.rollout`."
        )
    if not callable(source):
        name = "controller_or_controls"
        source = finite_rows(source, system.control_size, name, where)
        if hold is None:
            raise ValueError(
                f"{where}: hold=None needs a controller or a function of time, got an "
                "array of controls. Pass hold='zero' to hold them."
            )
    if w is not None:
        w = finite_rows(w, system.disturbance_size, "w", where)
    substeps = check_count(substeps, "substeps", where)
    adaptive = stepsize_controller is not None
    sampled = hold == "zero" and isinstance(source, AbstractController)
    steps = count_intervals(t0, t1, dt, source, w, where)
    if steps is None and (hold == "zero" or not adaptive or ts is None):
        raise ValueError(
            f"{where}: dt must be given, because no array of controls or disturbances "
            "determines the interval. (With hold=None you may leave it out if you pass "
            "both stepsize_controller and ts.)"
        )
    if ts is not None:
        ts = as_save_times(ts, t0, t1, where)
    check_steps((steps or 1) * substeps, x0.dtype, "the horizon", where)
    solver = diffrax.Tsit5() if solver is None else solver
    adjoint = diffrax.RecursiveCheckpointAdjoint() if adjoint is None else adjoint
    check_method(solver, stepsize_controller, substeps, max_steps, where)
    check_adjoint(adjoint, adaptive, sampled, where)
    if not adaptive:
        max_steps = (steps or 1) * substeps
    elif max_steps is None:
        max_steps = max(4096, 64 * (steps or 0))
    options = dict(
        solver=solver,
        stepsize_controller=stepsize_controller,
        adjoint=adjoint,
        max_steps=check_count(max_steps, "max_steps", where),
        progress_meter=progress_meter or diffrax.NoProgressMeter(),
    )
    start = jnp.asarray(t0, x0.dtype)
    # Computed before the ends are rounded to the precision of the state.
    length = jnp.asarray(t1 - t0, x0.dtype)
    given = system, source, w, x0, start, length, ts, key, hold, steps, substeps
    trajectory = _simulate(*given, options)
    return checked(trajectory, where) if throw else trajectory


@eqx.filter_jit
def _simulate(
    system, source, w, x0, t0, length, ts, key, hold, steps, substeps, options
):
    dtype, intervals = x0.dtype, steps or 1
    if ts is None:
        saves: Any = jnp.arange(intervals + 1, dtype=dtype)
        times: Any = t0 + length * (saves / intervals)
    else:
        times = ts.astype(dtype)
        saves = in_intervals(t0, times, intervals, substeps, length)
    count = times.shape[0]

    sampled = hold == "zero" and isinstance(source, AbstractController)
    args = _inputs(system, source, w, x0, t0, length, intervals, key, hold)
    if sampled:
        # The control at the start. The first step calls the controller again, from the
        # same state.
        u, _ = args.act(jnp.zeros((), dtype), x0, eqx.filter(args.memory, eqx.is_array))
        args = eqx.tree_at(lambda a: a.u, args, u, is_leaf=lambda leaf: leaf is None)
    start = TimeOffset(t0, lambda t: args.field(t, x0))
    args = eqx.tree_at(lambda a: a.start, args, start)

    # Either the ends of the intervals, or the times in `ts` and the end of the horizon.
    saved: Any = dict(t0=True, ts=saves[1:]) if ts is None else dict(t1=True, ts=saves)
    if sampled:
        saved["fn"] = save_fn
    held = hold == "zero" or w is not None
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(field),
        t0=0.0,
        t1=float(intervals),
        dt0=None,
        y0=x0,
        args=args,
        saveat=diffrax.SaveAt(**saved),
        throw=False,
        **_with_switches(options, held, sampled, length, intervals, substeps),
    )
    states: Any = solution.ys
    applied: Any = None
    counts: dict[str, Any] = {}
    if isinstance(states, SavedState):
        states, applied, counts = states
    # With `ts` one more row is saved, at `t1`.
    final_state, states = states[-1], states[:count]

    def before(held):
        """The rows of a held sequence just before each save time but the first."""
        if held is None or ts is None:
            return held
        return held[interval_before(saves[1:], intervals)]

    if applied is not None:
        controls = applied[1:count]
    elif args.controls is not None:
        controls = before(args.controls)
    else:
        controls = jax.vmap(args.control)(times[:-1], states[:-1])
    # Checked here, because at fixed steps Diffrax does not report a state that is not
    # finite.
    finite = jnp.all(jnp.isfinite(final_state))
    result = solve_result(solution, options["stepsize_controller"], dtype)
    result = first_failure(result, choose(finite, RESULTS.successful, RESULTS.diverged))
    # A save at the start is part of the first step, after the first call of the
    # controller, but the counters of the start are those before it.
    for name, first in tallies(args.memory).items():
        at_start = saves[:count] <= 0
        rows = jnp.where(at_start, first, counts[name][:count])
        counts[name] = counts[name].at[:count].set(rows)
    # Counted up to the last save time. The record at `t1` has the counters of the first
    # state.
    last = {name: totals[count - 1] for name, totals in counts.items()}
    incidents = {n: at[1:count] > at[: count - 1] for n, at in counts.items()}
    result = first_failure(result, controller_result(last, tallies(args.memory)))
    sensor = None
    if not system.observes_state:
        sensor = jax.vmap(system.observe)(times[:-1], states[:-1])
    return Trajectory(
        states=states,
        controls=controls,
        costs=None,
        final_state=final_state,
        final_cost=jnp.zeros((), dtype),
        total_cost=jnp.zeros((), dtype),
        length=jnp.asarray(count - 1),
        ended=jnp.zeros((), bool),
        result=result,
        dt=length / steps if ts is None else (times[-1] - times[0]) / (count - 1),
        recorded_times=times,
        recorded_observations=sensor,
        recorded_disturbances=before(w),
        recorded_terminated=None,
        incidents=incidents,
        steps=count - 1,
        # "costs" is listed although there are none, so that they do not count as left
        # out by the user.
        keep=("states", "observations", "controls", "disturbances", "costs"),
        **plant_fields(system),
    )


def _inputs(system, source, w, x0, t0, length, intervals, key, hold) -> Inputs:
    """The arguments of the solve's vector field before a controller is called."""
    controls: Any = None
    memory: Any = None
    if isinstance(source, AbstractController):
        memory = initial_state(source, key)
        if hold is None and jax.tree.leaves(memory):
            raise ValueError(
                f"simulate: hold=None needs a controller without a state, got "
                f"{type(source).__name__}, whose state changes from sample to sample. "
                "Pass hold='zero' and dt."
            )
        # Weak types become strong, because the loop of the solve keeps its types.
        strong = lambda a: jnp.asarray(a, a.dtype) if eqx.is_array(a) else a
        memory = jax.tree.map(strong, memory)
    elif not callable(source):
        controls = source
    elif hold == "zero":
        # Holding a function of time makes an array of its values at the switches.
        switches = t0 + length * (jnp.arange(intervals, dtype=x0.dtype) / intervals)
        controls = jax.vmap(source)(switches)
        check_control(controls[0], source, system.control_size, "system")
    if controls is not None:
        controls, source = controls.astype(x0.dtype), None
    index = jnp.zeros((), jnp.int32)
    horizon = TimeOffset(t0), length, intervals
    return Inputs(system, *horizon, source, memory, controls, w, index, None)


def _with_switches(options, held: bool, sampled: bool, length, intervals, substeps):
    """The options of a solve whose steps end at the switches."""
    dtype = length.dtype

    def fitted(options):
        options = dict(options)
        if held and "solver" in options:
            options["solver"] = Hold(options["solver"], intervals, sampled)
        if (controller := options.get("stepsize_controller")) is not None:
            # No gradient, because the solution does not depend on the choice of steps.
            interval = lax.stop_gradient(length / intervals)
            controller = InTime(controller, interval)  # pyright: ignore
            # A step across a switch would estimate its error from two different fields.
            if held and intervals > 1:
                switches = jnp.arange(1, intervals, dtype=dtype)
                controller = diffrax.ClipStepSizeController(controller, switches)
            options["stepsize_controller"] = controller
        return options

    solver, adjoint = options["solver"], options["adjoint"]
    fixed = options["stepsize_controller"] is None
    if fixed and isinstance(solver, diffrax.AbstractImplicitSolver):
        solver = as_fixed_step_solver(solver)
    # The backward solve has its own solver, which must hold the controls too.
    if isinstance(adjoint, diffrax.BacksolveAdjoint):
        adjoint = diffrax.BacksolveAdjoint(**fitted(adjoint.kwargs))
    adjoint = throwing_adjoint(adjoint)
    options = fitted(options | dict(solver=solver, adjoint=adjoint))
    if fixed:
        ends = jnp.arange(intervals * substeps + 1, dtype=dtype) / substeps
        options["stepsize_controller"] = diffrax.StepTo(ends)
    return options
