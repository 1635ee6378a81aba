"""delucax as a contender: its own pendulum, and one that a user writes."""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import delucax as dlx
from benchmarks._problem import Case, DT, GAIN, MAX_SPEED, MAX_TORQUE
from benchmarks._timing import compiled, Contender


NAME = "delucax"


class UserPendulum(dlx.AbstractDynamics):
    """Gymnasium's pendulum as a user would write it, with nothing but
    `delucax.math`."""

    state_names = ("angle", "velocity")
    control_names = ("torque",)
    dt: jax.Array = dlx.parameter(DT)
    gravity: jax.Array = dlx.parameter(10.0)

    def advance(self, t, x, u, w):
        angle, speed = x
        acceleration = 1.5 * self.gravity * dlx.math.sin(angle) + 3 * u[0]
        speed = dlx.math.clip(speed + acceleration * self.dt, -MAX_SPEED, MAX_SPEED)
        x_next = jnp.stack([angle + speed * self.dt, speed])
        return x_next if w is None else x_next + w, dlx.RESULTS.successful


class DiffraxStep(dlx.AbstractDynamics):
    """The pendulum by Diffrax's own `Tsit5().step`; all else as in delucax."""

    state_names = ("angle", "velocity")
    control_names = ("torque",)
    system: dlx.systems.Pendulum
    dt: jax.Array = dlx.parameter(DT)

    def advance(self, t, x, u, w):
        term = diffrax.ODETerm(lambda t, x, u: self.system.vector_field(t, x, u, None))
        t0 = jnp.asarray(t, x.dtype)
        memory = (True, jnp.zeros_like(x))
        x_next, *_ = diffrax.Tsit5().step(
            term, t0, t0 + self.dt, x, u, memory, made_jump=True
        )
        return x_next, dlx.RESULTS.successful


class NoisyPendulum(dlx.AbstractSystem):
    """The pendulum with a noisy torque: a stochastic differential equation."""

    state_names = ("angle", "velocity")
    control_names = ("torque",)
    disturbance_names = ("torque noise",)
    strength: jax.Array = dlx.parameter(0.1)

    def vector_field(self, t, x, u, w):
        return jnp.stack([x[1], 15.0 * dlx.math.sin(x[0]) + 3.0 * u[0]])

    def diffusion(self, t, x, u):
        return jnp.stack([jnp.zeros_like(x[0]), self.strength])[:, None]


def environment(
    case: Case, *, dynamics: dlx.AbstractDynamics | None = None
) -> dlx.Environment:
    """The task of a case."""
    if dynamics is not None:
        return dlx.Environment(
            dynamics,
            dlx.costs.PendulumCost(),
            control_bounds=(-MAX_TORQUE, MAX_TORQUE),
        )
    solvers = {"gym": None, "rk4": dlx.dynamics.RK4(), "tsit5": diffrax.Tsit5()}
    return dlx.make("pendulum", solver=solvers[case.method])


def program(
    case: Case, env: dlx.Environment, *, checkpoint: Any = "step"
) -> tuple[Callable[..., Any], Any]:
    """The function of `(arrays of the environment, gain, angle, speed)` to compile."""
    arrays, static = eqx.partition(env, eqx.is_array)
    key = jax.random.key(0)

    def run(arrays, gain, x0, keep):
        controller = dlx.controllers.Linear(gain[None])
        if case.workload == "free":
            controller = dlx.controllers.Zero(1)
        return dlx.rollout(
            eqx.combine(arrays, static),
            controller,
            key=key,
            x0=x0,
            horizon=case.steps,
            keep=keep,
            checkpoint=checkpoint,
            throw=False,
        )

    def one(arrays, gain, angle, speed):
        x0 = jnp.stack([angle, speed])
        if case.workload == "trajectory":
            kept = run(arrays, gain, x0, ("states", "controls", "costs"))
            return kept.states, kept.controls, kept.costs
        lean = run(arrays, gain, x0, ())
        return lean.final_state if case.workload == "free" else lean.total_cost

    whole = one if case.lanes is None else jax.vmap(one, in_axes=(None, None, 0, 0))
    if case.workload == "gradient":

        def mean_cost(gain, arrays, angle, speed):
            return jnp.mean(whole(arrays, gain, angle, speed))

        gradient = jax.value_and_grad(mean_cost)
        return lambda arrays, gain, *x0: gradient(gain, arrays, *x0), arrays
    return whole, arrays


def contender(
    case: Case,
    *,
    name: str = NAME,
    env: dlx.Environment | None = None,
    checkpoint: Any = "step",
) -> Contender:
    """Compile the case and return it ready to race."""
    env = environment(case) if env is None else env
    function, arrays = program(case, env, checkpoint=checkpoint)
    gain = np.asarray(GAIN, np.float32)
    return compiled(name, case.total_steps, function, arrays, gain, *case.starts())


def simulate(
    case: Case, *, dynamics: dlx.AbstractDynamics | None = None
) -> dict[str, np.ndarray]:
    """What a run of the case returns, time first, by `Case.named`."""
    function, arrays = program(case, environment(case, dynamics=dynamics))
    gain = np.asarray(GAIN, np.float32)
    values = jax.jit(function)(arrays, gain, *case.starts())
    if case.workload == "trajectory":
        states, controls = (np.moveaxis(value, -2, 0) for value in values[:2])
        costs = np.moveaxis(values[2], -1, 0)
        values = (states[..., 0], states[..., 1], controls[..., 0], costs)
    elif case.workload == "free":
        values = (values[..., 0], values[..., 1])
    return case.named(values)
