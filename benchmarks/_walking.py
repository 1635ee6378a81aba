"""A compass gait with a hip motor learns to walk on level ground.

The policy is a network that starts from nothing, and is trained by the gradient through
its impacts, over little more than one step of the walker: beyond that the gradient of a
policy that still falls explodes. Such a short horizon does not see how a gait ends, so
that the policy is looked at every 25 iterations: the one kept is that which walks
farthest from starts that are not those of the examination.
"""

import time
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optax
from jaxtyping import Array

import delucax as dlx
from delucax.training import expected_cost, fit


DT, HORIZON, BATCH, MOST = 0.05, 24, 64, 10.0
STEPS, STARTS, LONGEST = 100, 20, 2400
CENTRE = np.array([-0.25, 0.25, -0.35, -1.2])
SPREAD = np.array([0.03, 0.03, 0.25, 0.1])
"""The starts are uniform in this box: just after a step, within 12% of the angles,
7% of the speed of the stance leg, and 70% of that of the swing leg."""
ENERGY, PLACE = 6.0, 0.27
"""What the walker of Goswami, Thuilot and Espiau has above standing still on its slope
of 3 degrees [J], and half the angle between its legs there [rad]."""


def energy(system: Any, x: Array) -> Array:
    """Kinetic and potential energy, zero where both legs stand still upright."""
    swing, stance, swing_rate, stance_rate = x
    m, h, a, b = system.leg_mass, system.hip_mass, system.lower, system.upper
    l = a + b
    moving = m * b**2 * swing_rate**2 + ((h + m) * l**2 + m * a**2) * stance_rate**2
    moving = moving / 2 - m * l * b * jnp.cos(stance - swing) * swing_rate * stance_rate
    raised = (h * l + m * a + m * l) * (jnp.cos(stance) - 1)
    return moving + system.gravity * (raised - m * b * (jnp.cos(swing) - 1))


def fell(t: Any, x: Array) -> Array:
    """The stance leg lies, or the swing foot is in the ground ahead of the other."""
    under = (x[0] - x[1] > 0.1) & (jnp.cos(x[1]) < jnp.cos(x[0]))
    return under | (jnp.abs(x[1]) > 0.7)


class Gait(dlx.AbstractCost):
    """Energy, the place of the swing leg once the stance leg leans forward, effort, and
    a price of a fall."""

    system: Any = dlx.parameter()

    def __call__(self, t, x, u):
        late = jax.nn.sigmoid(-40 * (x[1] + 0.1))
        placed = 30 * late * (x[0] - PLACE) ** 2
        lacking = energy(self.system, x) - ENERGY
        return 0.03 * lacking**2 + placed + 0.001 * u[0] ** 2

    def final(self, t, x):
        return jnp.where(fell(t, x), 30.0, 0.0).astype(x.dtype)


class Network(dlx.AbstractController):
    """A torque from all four states."""

    net: eqx.nn.MLP = dlx.weight()

    def __call__(self, t, y, state):
        scaled = y * jnp.array([3.0, 3.0, 0.7, 0.7]) + jnp.array([0.0, 0.0, 0.0, 0.7])
        return MOST * jnp.tanh(self.net(scaled.astype(y.dtype))), state


class Tracking(dlx.AbstractController):
    """The torque that brings the energy to a target, as Goswami, Espiau and Keramane,
    1997, have it, without their division by zero. Target and gain are the best of 35
    pairs, on four starts of their own."""

    system: Any = dlx.parameter()
    target: Array = dlx.parameter(4.0)
    gain: Array = dlx.parameter(1.0)

    def __call__(self, t, y, state):
        apart = y[3] - y[2]
        wanted = self.gain * (self.target - energy(self.system, y))
        u = wanted * apart / (apart**2 + 0.3)
        return jnp.clip(u, -MOST, MOST)[None], state


def level(substeps: int = 1) -> dlx.Environment:
    """The walker on level ground, with the starts of its box."""
    system = dlx.systems.CompassGait(slope=0.0)
    starts = dlx.environments.UniformState(CENTRE - SPREAD, CENTRE + SPREAD)
    return dlx.Environment(
        dlx.Discretized(system, dt=DT, substeps=substeps),
        Gait(system),
        initial_state=starts,
        horizon=HORIZON,
        terminated=fell,
    )


@eqx.filter_jit
def walked(env: dlx.Environment, controller: Any, starts: Array) -> tuple[Any, ...]:
    """Steps from each start until a fall or `STEPS`, seconds that it took, and the mean
    square of the torque."""

    def one(x0):
        def going(carry):
            _, count, k, _ = carry
            return (count < STEPS) & (k < LONGEST)

        def body(carry):
            x, count, k, effort = carry
            t = k * env.dynamics.dt
            u, _ = controller(t, x, None)
            x, result, events = env.dynamics.advance_with_events(t, x, u, None)
            good = (result == dlx.RESULTS.successful) & ~env.terminated(t, x)
            count = count + jnp.sum(events.kinds >= 0)
            return x, count, jnp.where(good, k + 1, LONGEST + k), effort + u[0] ** 2

        zero = jnp.zeros((), int)
        start = x0, zero, zero, jnp.zeros((), x0.dtype)
        _, count, k, effort = jax.lax.while_loop(going, body, start)
        k = jnp.where(k >= LONGEST, k - LONGEST + 1, k)
        return count, k * DT, effort / k

    return jax.vmap(one)(starts)


def drawn(env: dlx.Environment, count: int, seed: int) -> Array:
    """Starts of the box."""
    return jax.vmap(env.initial_state)(jr.split(jr.key(seed), count))


def trained(env: dlx.Environment, seed: int, rounds: int, starts: Array) -> Any:
    """The best policy of some rounds of 25 iterations, and after how many."""
    loss = expected_cost(env, batch=BATCH)
    optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(2e-3))
    policy = Network(eqx.nn.MLP(4, 1, 32, 2, jnp.tanh, key=jr.key(seed)))
    best, most, at = policy, -1.0, 0
    for k in range(rounds):
        key = jr.fold_in(jr.key(seed), k)
        fitted = fit(loss, policy, optimiser, 25, key=key, progress=False)
        policy = fitted.model
        reached = float(jnp.mean(walked(env, policy, starts)[0]))
        if reached > most:
            best, most, at = policy, reached, 25 * (k + 1)
        if most >= STEPS:
            break
    return best, at


def walker(quick: bool) -> dict[str, Any]:
    """Zero torque, the energy law and policies of three seeds, from the same starts."""
    env, system = level(), dlx.systems.CompassGait(slope=0.0)
    tests, others = drawn(env, STARTS, 1000), drawn(env, 32, 2000)
    policies: dict[str, Any] = {
        "zero torque": (dlx.controllers.Zero(1), 0, 0.0),
        "energy law": (Tracking(system), 0, 0.0),
    }
    for seed in range(1 if quick else 3):
        begin = time.perf_counter()
        policy, iterations = trained(env, seed, 4 if quick else 10, others)
        seconds = time.perf_counter() - begin
        policies[f"trained, seed {seed}"] = policy, iterations, seconds
    rows = []
    for name, (policy, iterations, seconds) in policies.items():
        count, took, effort = walked(env, policy, tests)
        finer, *_ = walked(level(4), policy, tests)
        found = {
            "walker": name,
            "starts": int(np.sum(count >= STEPS)),
            "starts, finer steps": int(np.sum(finer >= STEPS)),
            "fewest steps": int(np.min(count)),
            "seconds a step": float(np.sum(took) / np.sum(count)),
            "torque": float(np.sqrt(np.mean(effort))),
            "iterations": iterations,
            "seconds": seconds,
        }
        print(found, flush=True)
        rows.append(found)
    return {"rows": rows}
