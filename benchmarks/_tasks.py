"""Every named task as two contenders: the whole of delucax, and a raw `lax.scan`.

Both run the same episodes: the task's own horizon, its own start and a control that is
held, with the bounds, the cost and the end of the episode that the task has; and both
are given the numbers of the task as arguments, so that neither compiles anew for
others. delucax calls `rollout` with a `Constant` controller. The raw scan is what is
left without a control library: the state is the carry, and the bounds, the integrator
and the cost are written out below. It calls the system's vector field, and so the same
vectorised sine.
"""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

import delucax as dlx
from benchmarks._problem import Episodes
from benchmarks._timing import compiled, Contender


OURS = "delucax"
RAW = "raw lax.scan"

# What a task cannot be made without.
ARGUMENTS = {
    "lds": dict(key=jax.random.key(1)),
    "neural": dict(key=jax.random.key(2)),
}


def names() -> list[str]:
    """Each task once, but the lungs, the pendulum and the plants with events.

    The paper's names are others for the same; the pendulum has `benchmarks.pendulum`,
    and a raw scan that finds events would be what delucax does.
    """
    every = dlx.environments.registered()
    lungs = {name.removeprefix("lung/") for name in every if name.startswith("lung/")}
    apart = {"pendulum", *lungs}
    found = [name for name in every if "/" not in name and name not in apart]
    return [n for n in found if not getattr(task(n).dynamics, "event_names", ())]


def task(name: str) -> dlx.Environment:
    """The task of that name."""
    return dlx.make(name, **ARGUMENTS.get(name, {}))


def held(env: dlx.Environment) -> jax.Array:
    """A control within the bounds that keeps the plant moving."""
    if env.control_bounds is None:
        return jnp.full(env.control_size, 0.1)
    low, high = (jnp.broadcast_to(e, env.control_size) for e in env.control_bounds)
    return low + 0.6 * (high - low)


def starts(env: dlx.Environment, count: int) -> jax.Array:
    """The task's own starts, drawn beforehand."""
    return jax.vmap(env.reset)(jax.random.split(jax.random.key(0), count))


def ours(case: Episodes, static: Any) -> Callable[..., Any]:
    """`rollout`, a function of the task's numbers, the control and a start."""
    key = jax.random.key(0)
    keep = ("states", "controls", "costs") if case.kept == "trajectory" else ()

    def episode(arrays, control, x0):
        run = dlx.rollout(
            eqx.combine(arrays, static),
            dlx.controllers.Constant(control),
            key=key,
            x0=x0,
            horizon=case.steps,
            keep=keep,
            throw=False,
        )
        if case.kept == "cost":
            return run.total_cost, run.final_state
        return run.states, run.controls, run.costs

    return episode


def raw(case: Episodes, static: Any) -> Callable[..., Any]:
    """The raw scan, a function of the same."""

    def episode(arrays, control, x0):
        env = eqx.combine(arrays, static)
        advance, stage = _step(env.dynamics), _stage_cost(env.cost)
        bounds, ends, dt = env.control_bounds, env.terminated, env.dt

        def body(carry, _):
            x, total, ended = carry
            u = control if bounds is None else dlx.math.clip(control, *bounds)
            cost, x_next = stage(x, u), advance(x, u)
            if ends is not None:
                cost, u = jnp.where(ended, 0, cost), jnp.where(ended, 0, u)
                x_next = jnp.where(ended, x, x_next)
                ended = ended | ends(dt, x_next)
            kept = (x, u, cost) if case.kept == "trajectory" else None
            total = total if case.kept == "trajectory" else total + cost
            return (x_next, total, ended), kept

        start = x0, jnp.zeros(()), None if ends is None else jnp.zeros((), bool)
        (x, total, _), kept = lax.scan(body, start, None, case.steps)
        if case.kept == "cost":
            return total + env.cost.final(dt, x), x
        states, controls, costs = kept
        return jnp.concatenate([states, x[None]]), controls, costs

    return episode


def _step(dynamics: Any) -> Callable[..., Any]:
    """A step of the task's dynamics, by hand."""
    clip, wrap = dlx.math.clip, dlx.math.wrap
    h = dynamics.dt
    if isinstance(dynamics, dlx.LinearDynamics):
        A, B = dynamics.A, dynamics.B
        return lambda x, u: dlx.math.matvec(A, x) + dlx.math.matvec(B, u)
    field = lambda x, u: dynamics.system.vector_field(0.0, x, u, None)

    def euler(x, u):
        return x + h * field(x, u)

    def rk4(x, u, h):
        a = field(x, u)
        b = field(x + h / 2 * a, u)
        c = field(x + h / 2 * b, u)
        d = field(x + h * c, u)
        return x + h / 6 * (a + 2 * (b + c) + d)

    def pendulum(x, u):
        velocity = x[1] + h * dynamics.system.acceleration(x[0], x[1], u[0])
        velocity = clip(velocity, -dynamics.max_speed, dynamics.max_speed)
        return jnp.stack([x[0] + h * velocity, velocity])

    def acrobot(x, u):
        x, fast = rk4(x, u, h), (dynamics.max_velocity_1, dynamics.max_velocity_2)
        velocities = [clip(v, -most, most) for v, most in zip(x[2:], fast, strict=True)]
        return jnp.stack([wrap(x[0]), wrap(x[1]), *velocities])

    def mountain_car(x, u):
        velocity = x[1] + h * dynamics.system.acceleration(x[0], u[0])
        velocity = clip(velocity, -dynamics.max_speed, dynamics.max_speed)
        position = x[0] + h * velocity
        position = clip(position, dynamics.min_position, dynamics.max_position)
        stopped = (position <= dynamics.min_position) & (velocity < 0)
        return jnp.stack([position, jnp.where(stopped, 0, velocity)])

    own = {
        "GymAcrobot": acrobot,
        "GymCartPole": euler,
        "GymMountainCar": mountain_car,
        "GymPendulum": pendulum,
    }
    if not isinstance(dynamics, dlx.Discretized):
        return own[type(dynamics).__name__]
    if isinstance(dynamics.solver, diffrax.Euler):
        assert dynamics.substeps == 1
        return euler
    assert isinstance(dynamics.solver, dlx.dynamics.RK4)
    project, substeps = dynamics.system.project, dynamics.substeps

    def solved(x, u):
        for _ in range(substeps):
            x = rk4(x, u, h / substeps)
        return project(x)

    return solved


def _stage_cost(cost: dlx.AbstractCost) -> Callable[..., Any]:
    """The stage cost, by hand where it is quadratic."""
    if not isinstance(cost, dlx.costs.Quadratic):
        return lambda x, u: cost(0.0, x, u)
    Q, R = cost.Q, cost.R
    assert Q.ndim == R.ndim == 1
    x_ref = jnp.zeros_like(Q) if cost.state_target is None else cost.state_target
    u_ref = jnp.zeros_like(R) if cost.control_target is None else cost.control_target
    difference = cost.difference or (lambda x, x_ref: x - x_ref)

    def stage(x, u):
        d, v = difference(x, x_ref), u - u_ref
        return jnp.sum(Q * d * d) + jnp.sum(R * v * v)

    return stage


def contenders(case: Episodes) -> tuple[Contender, Contender]:
    """Both, compiled and ready to race: ours and the raw one."""
    env = task(case.task)
    arrays, static = eqx.partition(env, eqx.is_array)
    given = arrays, held(env), starts(env, case.count)

    def contender(name: str, episode: Callable[..., Any]) -> Contender:
        def run(arrays, control, first):
            one = lambda x0: episode(arrays, control, x0)
            return jax.vmap(one)(first) if case.batched else lax.map(one, first)

        return compiled(name, case.total_steps, run, *given)

    return contender(OURS, ours(case, static)), contender(RAW, raw(case, static))


def disagreement(name: str, steps: int = 20) -> float:
    """How far the two differ over a short episode, relative to the largest state."""
    case = Episodes(name, steps, 1, kept="trajectory")
    env = task(name)
    arrays, static = eqx.partition(env, eqx.is_array)
    given = arrays, held(env), starts(env, 1)[0]
    found = (jax.jit(one(case, static))(*given) for one in (ours, raw))
    pairs = zip(*found, strict=True)
    return max(
        float(np.max(np.abs(a - b)) / (1e-6 + np.max(np.abs(b)))) for a, b in pairs
    )
