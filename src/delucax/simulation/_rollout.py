"""The closed loop."""

import math
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import ArrayLike

from .._check import (
    as_number,
    as_vector,
    check_bool,
    check_choice,
    check_count,
    check_instance,
    check_key,
    finite_rows,
    finite_vector,
)
from .._controller import AbstractController, initial_state, tallies
from .._jax import by_components, join_state, split_state, stack_steps
from .._module import as_float_array
from .._results import choose, first_failure, first_of, or_none, RESULTS
from .._typing import Checkpoint, Numbers, PRNGKey
from ..disturbances import Zero
from ..environments import Environment
from ._checked import checked, plant_fields
from ._controller_calls import (
    call_controller,
    check_control,
    check_state,
    controller_result,
)
from ._trajectory import Trajectory


KEEP = (
    "states",
    "observations",
    "controls",
    "disturbances",
    "costs",
    "terminated",
    "incidents",
    "controller_state",
)
EXTRA = ("events",)
"""What is kept only when it is asked for."""


def rollout(
    environment: Environment,
    controller: AbstractController,
    *,
    key: PRNGKey,
    horizon: int | None = None,
    x0: Numbers | None = None,
    w: Numbers | None = None,
    keep: Sequence[str] = KEEP,
    checkpoint: Checkpoint = "step",
    gradient_decay: ArrayLike = 1.0,
    truncate: int | None = None,
    throw: bool = True,
) -> Trajectory:
    """Simulate a controller in an environment, step by step.

    At each step k, with `t_k = k dt`: the controller acts on the observation `y_k`; the
    environment clips the control, charges `c(t_k, x_k, u_k)` and steps; then
    `controller.applied(u, cost, state)` is called with the clipped control and its
    cost. The final cost is charged once, at `x_T` or on entering a terminated state,
    after which the state is held at no cost.

    It is already compiled, as `diffrax.diffeqsolve` is: a second call with other
    numbers, another key or start does not compile again. A batch is `jax.vmap` of it.
    It is differentiable with respect to every array leaf of its arguments.

    **Arguments:**

    - `environment`: the environment.
    - `controller`: the controller.
    - `key`: a random key, for the start, the disturbances, the sensor noise and the
        controller.
    - `horizon`: steps; the environment's own by default.
    - `x0`: the first state, shape `(n,)`; drawn by the environment by default.
    - `w`: disturbances, shape `(horizon, k)`, in place of those that the environment
        draws, which is the default. For a system with a diffusion they are its Brownian
        increments: standard normal numbers times `sqrt(dt / substeps)`.
    - `keep`: what the trajectory stores, of `"states"`, `"observations"`, `"controls"`,
        `"disturbances"`, `"costs"`, `"terminated"`, `"incidents"` and
        `"controller_state"`, all by default, and `"events"` of a hybrid plant, which
        take room for `max_events` times two states a step.
    - `checkpoint`: what the gradient stores. `"step"` (default): the state at each
        step, and the step is computed again; `"sqrt"`: the state at each of about the
        square root of T steps, for long horizons; `None`: all intermediate values,
        without recomputation.
    - `gradient_decay`: the gradient passing back through the state is multiplied by it
        at each step. 1, the true gradient, by default; 0.9 damps the exploding
        gradients of a long unstable horizon. It is a factor per step: `exp(-dt / tau)`
        forgets over the time `tau` at any `dt`.
    - `truncate`: the gradient is cut before every `truncate`-th step, in the state and
        in the memory of the controller: truncated back-propagation. Never by default.
    - `throw`: raise if a step fails, the states become NaN or infinite, or a learner
        refuses an update (default); if false, look at `trajectory.result`.

    **Returns:** a [`delucax.Trajectory`][]. Its `result` is the first failure of a
    step, else `diverged`, else `update_refused` if a learner's update was not finite,
    else `plan_failed`, `estimate_failed` or `filter_failed` if a plan, an estimate or a
    filter of the controller did not succeed. `throw` raises on all but these three,
    which the controller handles (`throw=` of [`delucax.controllers.MPC`][]).

    **Raises:** `ValueError` on an argument of the wrong kind or shape; an error at run
    time as `throw` says.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        env = dlx.make("pendulum")
        controller = dlx.controllers.Linear(jnp.array([[20.0, 5.0]]))
        trajectory = dlx.rollout(
            env, controller, key=jax.random.key(0), x0=[0.1, 0.0]
        )
        keys = jax.random.split(jax.random.key(1), 100)
        run = jax.jit(jax.vmap(lambda key: dlx.rollout(env, controller, key=key)))
        batch = run(keys)
        ```
    """
    where = "rollout"
    check_instance(environment, Environment, "environment", where)
    check_instance(controller, AbstractController, "controller", where)
    check_key(key, where)
    check_bool(throw, "throw", where)
    horizon = environment.horizon if horizon is None else horizon
    horizon = check_count(horizon, "horizon", where)
    if x0 is not None:
        x0 = finite_vector(x0, environment.state_size, "x0", where)
    if w is not None:
        w = finite_rows(w, environment.disturbance_size, "w", where, horizon)
    keep = (keep,) if isinstance(keep, str) else keep
    named = isinstance(keep, tuple | list | set | frozenset)
    known = KEEP + EXTRA
    if not named or not set(keep) <= set(known):
        raise ValueError(
            f"{where}: keep must be some of {', '.join(known)}; got {keep!r}."
        )
    if "events" in keep and not environment.dynamics.event_names:
        raise ValueError(
            f"{where}: keep has 'events', but the plant has none; it must be a "
            "delucax.systems.AbstractHybridSystem."
        )
    keep = tuple(name for name in known if name in keep)
    check_choice(checkpoint, ("step", "sqrt", None), "checkpoint", where)
    decay = as_float_array(as_number(gradient_decay, "gradient_decay", where))
    if isinstance(gradient_decay, int | float) and gradient_decay == 1:
        decay = None
    if truncate is not None:
        truncate = check_count(truncate, "truncate", where)
    trajectory = _rollout(
        environment, controller, key, x0, w, horizon, keep, checkpoint, decay, truncate
    )
    return checked(trajectory, where, environment.dynamics) if throw else trajectory


@eqx.filter_jit
def _rollout(env, controller, key, x0, w, horizon, keep, checkpoint, decay, truncate):
    dynamics = env.dynamics
    # Always in four parts: what is drawn does not depend on what else is given.
    start_key, w_key, noise_key, controller_key = env.split_key(key)
    if x0 is None:
        x0 = env.reset(start_key)
    size, dtype, dt = x0.shape[0], x0.dtype, env.dt
    # Drawn for the whole horizon at once, outside of the loop. A disturbance that is
    # known to be zero is left out of it.
    if w is None and not isinstance(env.disturbance, Zero):
        w = env.disturbance.draw(w_key, dt, horizon, dtype)
    noise = None
    if env.sensor_noise is not None:
        noise = env.sensor_noise.draw(noise_key, dt, horizon, dtype)
    can_end = env.terminated is not None
    # Observations are not stored if they equal the states.
    keeps_y = not ("states" in keep and noise is None and dynamics.observes_state)

    first = initial_state(controller, controller_key)
    # A loop carries arrays alone. The rest of a controller's state, such as the names
    # of its tallies, is put back at each step.
    first, static = eqx.partition(first, eqx.is_array)

    def body(carry, inputs):
        parts, memory, ended, total = carry
        k, w, noise = inputs
        # By a product: a sum of steps would be rounded anew at each of them.
        t = (k * dt).astype(dtype)
        x = join_state(parts)
        # The same value, with `decay` times its derivative.
        if decay is not None:
            x = lax.stop_gradient(x) + decay * (x - lax.stop_gradient(x))
        if truncate is not None:
            is_cut = (k > 0) & (k % truncate == 0)
            real, rest = eqx.partition((x, memory), eqx.is_inexact_array)
            cut = lambda leaf: jnp.where(is_cut, lax.stop_gradient(leaf), leaf)
            x, memory = eqx.combine(jax.tree.map(cut, real), rest)
        y = dynamics.observe(t, x)
        if not eqx.is_inexact_array(y) or y.ndim != 1:
            y = as_vector(y, env.observation_size, "observe(t, x)", "rollout")
        y = y if noise is None else (y + noise).astype(dtype)
        observed, (done, length) = y, ended or (None, None)
        if done is not None:
            # After termination everything is evaluated at the first state: it is not
            # used, but its derivatives must be finite, because 0 times infinity is NaN.
            y0 = lax.stop_gradient(dynamics.observe(t, x0)).astype(y.dtype)
            observed = jnp.where(done, y0, y)
            x = jnp.where(done, lax.stop_gradient(x0), x)
        state = eqx.combine(memory, static)
        u, after = call_controller(controller, t, observed, state)
        is_action = jnp.issubdtype(jnp.result_type(u), jnp.integer)
        if env.actions is None or not is_action:
            check_control(u, controller, env.control_size, "environment")
        records = "events" in keep
        advance = dynamics.advance_with_events if records else dynamics.advance
        step, *events = env._advance_by(advance, t, x, env._applied(u), w)
        cost, x_next, result = step.cost.astype(dtype), step.state, step.result
        applied = step.control
        # Broadcasting would otherwise give the loop's state another shape.
        if x_next.shape != x.shape:
            raise ValueError(
                f"rollout: a step must give a state of shape {x.shape} and a scalar "
                f"cost, got shapes {x_next.shape} and {cost.shape}. If a constant has "
                "a batch axis, run a batch of environments: jax.vmap."
            )
        after = controller.applied(applied, cost, after)
        check_state(controller, eqx.combine(first, static), after)
        after = eqx.filter(after, eqx.is_array)
        incidents = {}
        if "incidents" in keep:
            before, now = tallies(memory), tallies(after)
            incidents = {name: now[name] > before[name] for name in now}
            if env.control_bounds is not None and eqx.is_inexact_array(u):
                low, high = env.control_bounds
                incidents["clipped_control"] = jnp.any((u < low) | (u > high))
        if done is not None:
            incidents = {name: now & ~done for name, now in incidents.items()}
            cost, applied = jnp.where(done, 0, cost), jnp.where(done, 0, applied)
            x_next = jnp.where(done, join_state(parts), x_next)
            after = jax.tree.map(lambda a, b: jnp.where(done, a, b), memory, after)
            if records:
                events = [events[0].unless(done)]
            # A result that is statically a success stays one, and costs nothing.
            if result is not RESULTS.successful:
                result = choose(done, RESULTS.successful, result)
            ended = (done | step.terminated, length + ~done)
        after_parts = split_state(x_next.astype(dtype))
        # The state before the step, not after it: `stack_steps` says why.
        kept = {
            "states": parts,
            "observations": split_state(y) if keeps_y else None,
            "controls": split_state(applied),
            "costs": cost,
            "terminated": ended[0] if can_end else None,
            "incidents": incidents,
            "events": events[0] if records else None,
        }
        kept = {name: value for name, value in kept.items() if name in keep}
        # Costs that are kept are summed afterwards, in a tree: less rounding.
        total = None if total is None else total + cost
        return (after_parts, after, ended, total), (kept, or_none(result))

    carry = (
        split_state(x0),
        first,
        (jnp.zeros((), bool), jnp.zeros((), int)) if can_end else None,
        None if "costs" in keep else jnp.zeros((), dtype),
    )
    inputs = (jnp.arange(horizon), w, noise)
    carry, (kept, results) = _scan(body, carry, inputs, horizon, checkpoint)
    parts, last, ended, total = carry
    final_state = join_state(parts)

    def over_time(name: str, size: int, last: Any = ()) -> Any:
        values = kept.get(name)
        if values is None:
            return None
        return (
            stack_steps(values, size, last) if size else jnp.zeros((horizon, 0), dtype)
        )

    has_ended, length = ended or (jnp.zeros((), bool), jnp.asarray(horizon))
    # At the time of termination, where there was one: the state is held from then on.
    end = (length * dt).astype(dtype)
    final_cost = jnp.asarray(env.cost.final(end, final_state), dtype)
    if final_cost.shape != ():
        raise ValueError(
            f"{type(env.cost).__name__}: the final cost must be a scalar, got an array "
            f"of shape {final_cost.shape}."
        )
    costs = kept.get("costs")
    total_cost = (jnp.sum(costs) if total is None else total) + final_cost
    # NaN propagates, so the last state tells of all.
    finite = jnp.all(jnp.isfinite(final_state)) & jnp.isfinite(total_cost)
    result = choose(finite, RESULTS.successful, RESULTS.diverged)
    # In order of cause: a failed step, divergence, then what the controller counted.
    result = first_failure(result, controller_result(tallies(last), tallies(first)))
    return Trajectory(
        states=over_time("states", size, parts),
        controls=over_time("controls", env.control_size),
        costs=costs,
        final_state=final_state,
        final_cost=final_cost,
        total_cost=total_cost,
        length=length,
        ended=has_ended,
        result=first_failure(first_of(results), result),
        dt=dt,
        steps=horizon,
        keep=keep,
        recorded_times=None,
        recorded_observations=over_time("observations", env.observation_size),
        recorded_disturbances=w if "disturbances" in keep else None,
        recorded_terminated=kept.get("terminated"),
        incidents=kept.get("incidents"),
        controller_state=last if "controller_state" in keep else None,
        recorded_events=kept.get("events"),
        **plant_fields(dynamics),
    )


def _scan(body, carry, inputs, horizon, checkpoint):
    """`lax.scan` over the horizon, with what the gradient stores chosen."""
    body = by_components(body)
    # Without it the gradient would store what each operation of a step needs, many
    # times the state. To compute a step again costs less than to write that out.
    if checkpoint == "step":
        body = jax.checkpoint(body)
    if checkpoint != "sqrt":
        return lax.scan(body, carry, inputs)
    # Blocks of sqrt(T) steps: one state is stored for each block, and those of a block
    # while it is run again (Chen, Xu, Zhang and Guestrin, 2016).
    block = max(1, math.isqrt(horizon))
    blocks, rest = divmod(horizon, block)
    inner = jax.checkpoint(body)
    whole = jax.checkpoint(lambda carry, xs: lax.scan(inner, carry, xs))
    cut = blocks * block
    shaped = jax.tree.map(
        lambda a: a[:cut].reshape(blocks, block, *a.shape[1:]), inputs
    )
    carry, kept = lax.scan(whole, carry, shaped)
    kept = jax.tree.map(lambda a: a.reshape(cut, *a.shape[2:]), kept)
    if rest:
        tail = jax.tree.map(lambda a: a[cut:], inputs)
        carry, last = lax.scan(inner, carry, tail)
        kept = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), kept, last)
    return carry, kept
