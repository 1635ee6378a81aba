"""Simulation of a controller in an environment, step by step."""

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
from .._results import (
    choose,
    first_failure,
    first_of,
    or_none,
    plain_errors,
    RESULTS,
)
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
"""Entries of `keep` that are not there by default."""


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
    r"""Simulate a controller in an environment, step by step.

    At each step $k$, at the time $t_k = k\, \Delta t$:

    1. The controller computes a control from the observation $y_k$.
    2. The environment clips the control, charges the stage cost $c(t_k, x_k, u_k)$ and
        steps to $x_{k+1}$.
    3. `controller.applied(u, cost, state)` gets the clipped control and its cost.

    The final cost is charged once: at the last state, or at the first state that
    terminates the episode. After termination, the state is held and costs nothing.

    `rollout` is already compiled: call it directly, without `jax.jit`. If you call
    `rollout` with another random key, first state or value of a parameter, it does not
    compile again. For a batch, use `jax.vmap`. You can differentiate with respect to
    every array leaf of the arguments.

    **Arguments:**

    - `environment`: a [`delucax.Environment`][].
    - `controller`: a [`delucax.AbstractController`][].
    - `key`: a random key for the first state, the disturbances, the sensor noise and
        the controller.
    - `horizon`: the number of steps; by default the horizon of the environment.
    - `x0`: the first state, shape `(n,)`; drawn by the environment by default.
    - `w`: disturbances, shape `(horizon, k)`; drawn by the environment by default. For
        a system with a diffusion, pass Brownian increments: standard normal numbers
        times `sqrt(dt / substeps)`.
    - `keep`: the names of the arrays that the trajectory stores. By default the
        trajectory stores `"states"`, `"observations"`, `"controls"`, `"disturbances"`,
        `"costs"`, `"terminated"`, `"incidents"` and `"controller_state"`. For a plant
        with events you may add `"events"`; the events need memory for `2 * max_events`
        states per step.
    - `checkpoint`: what the gradient stores. `"step"` (default) stores the state at
        each step, and computes each step a second time in the backward pass. `"sqrt"`
        stores the states of only about $\sqrt{T}$ of $T$ steps; use it for long
        horizons. `None` stores all intermediate values and computes no step a second
        time.
    - `gradient_decay`: a factor by which the gradient is multiplied at each step, when
        it passes back through the state. 1 (default) gives the true gradient. 0.9 damps
        exploding gradients over a long, unstable horizon. If the gradient should decay
        with a time constant `tau`, for any `dt`, use `exp(-dt / tau)`.
    - `truncate`: a number of steps for truncated back-propagation. Before every
        `truncate`-th step, the gradient through the state and through the memory of the
        controller is cut. By default the gradient is never cut.
    - `throw`: whether to raise an error if a step fails, the states become NaN or
        infinite, or a learning controller refuses an update; true by default. With
        `throw=False`, check `trajectory.result` yourself.

    **Returns:** a [`delucax.Trajectory`][]. The `result` of the trajectory is the first
    of these that applies:

    - the first failure of a step;
    - `diverged`;
    - `update_refused`: the update of a learning controller was not finite;
    - `plan_failed`, `estimate_failed` or `filter_failed`: a plan, an estimate or a
        safety filter of the controller did not succeed;
    - success.

    `throw` does not raise an error for `plan_failed`, `estimate_failed` and
    `filter_failed`, because the controller handles these failures itself (see `throw=`
    of [`delucax.controllers.MPC`][]).

    **Raises:** `ValueError` on an argument of the wrong kind or shape. An error is
    raised at run time if the rollout fails and `throw` is true.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        env = dlx.make("pendulum")
        controller = dlx.controllers.Linear(jnp.array([[20.0, 5.0]]))
        key = jax.random.key(0)
        trajectory = dlx.rollout(env, controller, key=key, x0=[0.1, 0.0])

        run = lambda key: dlx.rollout(env, controller, key=key)
        batch = jax.jit(jax.vmap(run))(jax.random.split(key, 100))
        trajectory.total_cost, batch.states.shape
        ```

        ```text
        (Array(0.074, dtype=float32), (100, 201, 2))
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
            f"{where}: keep must hold names among {', '.join(known)}, got {keep!r}."
        )
    if "events" in keep and not environment.dynamics.event_names:
        raise ValueError(
            f"{where}: keep must not hold 'events' for a plant without events. Only a "
            "delucax.systems.AbstractHybridSystem has some."
        )
    keep = tuple(name for name in known if name in keep)
    check_choice(checkpoint, ("step", "sqrt", None), "checkpoint", where)
    decay = as_float_array(as_number(gradient_decay, "gradient_decay", where))
    if isinstance(gradient_decay, int | float) and gradient_decay == 1:
        decay = None
    if truncate is not None:
        truncate = check_count(truncate, "truncate", where)
    options = keep, checkpoint, decay, truncate
    with plain_errors(where):
        trajectory = _rollout(environment, controller, key, x0, w, horizon, *options)
    return checked(trajectory, where, environment.dynamics) if throw else trajectory


@eqx.filter_jit
def _rollout(env, controller, key, x0, w, horizon, keep, checkpoint, decay, truncate):
    dynamics = env.dynamics
    # Always split in four, so that no draw depends on which other arguments are given.
    start_key, w_key, noise_key, controller_key = env.split_key(key)
    if x0 is None:
        x0 = env.reset(start_key)
    size, dtype, dt = x0.shape[0], x0.dtype, env.dt
    # A disturbance that is known to be zero is left out of the loop.
    if w is None and not isinstance(env.disturbance, Zero):
        w = env.disturbance.draw(w_key, dt, horizon, dtype)
    noise = None
    if env.sensor_noise is not None:
        noise = env.sensor_noise.draw(noise_key, dt, horizon, dtype)
    can_end = env.terminated is not None
    # Observations are not stored if they equal the states.
    keeps_y = not ("states" in keep and noise is None and dynamics.observes_state)

    first = initial_state(controller, controller_key)
    # The loop carries only arrays. The rest of a controller's state, such as the names
    # of its tallies, is put back at each step.
    first, static = eqx.partition(first, eqx.is_array)

    def body(carry, inputs):
        parts, memory, ended, total = carry
        k, w, noise = inputs
        # A product, because a sum of steps would be rounded at each step.
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
            # After termination everything is evaluated at the first state. The values
            # are not used, but their derivatives must be finite, because 0 times
            # infinity is NaN.
            y0 = lax.stop_gradient(dynamics.observe(t, x0)).astype(y.dtype)
            observed = jnp.where(done, y0, y)
            x = jnp.where(done, lax.stop_gradient(x0), x)
        state = eqx.combine(memory, static)
        u, after = call_controller(controller, t, observed, state)
        # The number of an action is not a control, and is never clipped.
        is_action = env.actions is not None and jnp.issubdtype(
            jnp.result_type(u), jnp.integer
        )
        if not is_action:
            check_control(u, controller, env.control_size, "environment")
        records = "events" in keep
        advance = dynamics.advance_with_events if records else dynamics.advance
        step, *events = env._advance_by(advance, t, x, env._applied(u), w)
        cost, x_next, result = step.cost.astype(dtype), step.state, step.result
        if is_action and env.actions is not None:
            is_known = (jnp.asarray(u) >= 0) & (u < len(env.actions))
            known = choose(is_known, RESULTS.successful, RESULTS.unknown_action)
            result = first_failure(known, result)
        applied = step.control
        # Checked, because broadcasting may give the next state another shape.
        if x_next.shape != x.shape:
            raise ValueError(
                f"rollout: a step must give a state of shape {x.shape} and a scalar "
                f"cost, got shapes {x_next.shape} and {cost.shape}. If a constant has "
                "a batch axis, use jax.vmap over the environment."
            )
        after = controller.applied(applied, cost, after)
        check_state(controller, eqx.combine(first, static), after)
        after = eqx.filter(after, eqx.is_array)
        incidents = {}
        if "incidents" in keep:
            before, now = tallies(memory), tallies(after)
            incidents = {name: now[name] > before[name] for name in now}
            if env.control_bounds is not None and not is_action:
                low, high = env.control_bounds
                incidents["clipped_control"] = jnp.any((u < low) | (u > high))
        if done is not None:
            incidents = {name: now & ~done for name, now in incidents.items()}
            cost, applied = jnp.where(done, 0, cost), jnp.where(done, 0, applied)
            x_next = jnp.where(done, join_state(parts), x_next)
            after = jax.tree.map(lambda a, b: jnp.where(done, a, b), memory, after)
            if records:
                events = [events[0].unless(done)]
            # A result that is statically a success needs no choice.
            if result is not RESULTS.successful:
                result = choose(done, RESULTS.successful, result)
            ended = (done | step.terminated, length + ~done)
        after_parts = split_state(x_next.astype(dtype))
        # The state before the step, not after it, for the reason given in
        # `stack_steps`.
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
        # Costs that are kept are summed afterwards, in a tree, which rounds less.
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
    # At the time of termination, if any, because the state is held from then on.
    end = (length * dt).astype(dtype)
    final_cost = jnp.asarray(env.cost.final(end, final_state), dtype)
    if final_cost.shape != ():
        raise ValueError(
            f"{type(env.cost).__name__}: the final cost must be a scalar, got an array "
            f"of shape {final_cost.shape}."
        )
    costs = kept.get("costs")
    total_cost = (jnp.sum(costs) if total is None else total) + final_cost
    # NaN propagates, so it is enough to check the last state.
    finite = jnp.all(jnp.isfinite(final_state)) & jnp.isfinite(total_cost)
    result = choose(finite, RESULTS.successful, RESULTS.diverged)
    # In the order of causes: a failed step, divergence, incidents of the controller.
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
    """`lax.scan` over the horizon; `checkpoint` chooses what the gradient stores."""
    body = by_components(body)
    # Without a checkpoint the gradient stores the intermediate values of each step,
    # many times the state. To compute a step again takes less time than to store them.
    if checkpoint == "step":
        body = jax.checkpoint(body)
    if checkpoint != "sqrt":
        return lax.scan(body, carry, inputs)
    # Blocks of sqrt(T) steps. One state is stored for each block, and the states of one
    # block while it runs again (Chen, Xu, Zhang and Guestrin, 2016).
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
