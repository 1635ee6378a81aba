"""Events, orbits and delays against closed forms and published numbers."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq

import delucax as dlx


s = dlx.systems
BALL = np.array([1.0, 0.85, 9.81])
"""Height, restitution, gravity."""


def row(
    what: str,
    measured: Any,
    limit: float | None = None,
    published: str | None = None,
) -> dict[str, Any]:
    """A figure, what it is at most, and what others say that it is."""
    found = dict(what=what, measured=float(measured), limit=limit)
    return found | dict(published=published)


def apart(a: Any, b: Any) -> float:
    """The largest error of `a`, relative to the largest of `b`."""
    a, b = np.asarray(a), np.asarray(b)
    return float(np.abs(a - b).max() / np.abs(b).max())


def final(system: Any, x0: Any, steps: int, dt: float, **options: Any) -> Array:
    """The last state of a free run."""
    dynamics = dlx.Discretized(system, dt=dt, **options)
    return dlx.open_loop(dynamics, x0, jnp.zeros((steps, 1)))[-1]


def bounce_times(p: Any, count: int) -> Array:
    """Those of a ball without drag, in closed form."""
    first = jnp.sqrt(2 * p[0] / p[2])
    flights = 2 * first * p[1] ** jnp.arange(1, count)
    return first + jnp.concatenate([jnp.zeros(1), jnp.cumsum(flights)])


def bounces(quick: bool) -> list[dict[str, Any]]:
    """A ball that bounces ten times, against its closed form; with drag, the order."""
    del quick
    count, steps = 10, 16
    times = np.asarray(bounce_times(BALL, count + 1))
    end = 0.6 * times[-2] + 0.4 * times[-1]

    def ball(p):
        return s.BouncingBall(restitution=p[1], gravity=p[2])

    def fallen(p):
        v = p[1] ** count * jnp.sqrt(2 * p[0] * p[2])
        left = end - bounce_times(p, count)[-1]
        return jnp.stack([v * left - p[2] * left**2 / 2, v - p[2] * left])

    def run(p):
        dynamics = dlx.Discretized(ball(p), dt=end / steps)
        env = dlx.Environment(dynamics, dlx.costs.Quadratic(jnp.eye(2), jnp.eye(1)))
        start = dict(x0=jnp.stack([p[0], 0 * p[0]]), horizon=steps)
        start |= dict(keep="events", throw=False)
        zero = dlx.controllers.Zero(1)
        run = dlx.rollout(env, zero, key=jax.random.key(0), **start)
        return run.final_state, run.events

    p = jnp.asarray(BALL)
    state, events = jax.jit(run)(p)
    at = np.nonzero(np.asarray(events.kinds) == 0)
    measured = jax.jit(lambda p: (run(p)[0], run(p)[1].times[at]))
    exact = lambda p: (fallen(p), bounce_times(p, count))
    rows = [
        row("ten bounces: state", apart(state, fallen(p)), 1e-8),
        row("ten bounces: times", apart(events.times[at], times[:count]), 1e-8),
    ]
    true = jax.jacfwd(exact)(p)
    for mode, jacobian in (("forward", jax.jacfwd), ("reverse", jax.jacrev)):
        found = jacobian(measured)(p)
        for name, a, b in zip(("state", "times"), found, true, strict=True):
            what = f"ten bounces: {mode} derivatives of the {name}"
            rows.append(row(what, apart(a, b), 1e-8))
    order_x, order_t = with_drag()
    return [
        *rows,
        row("with drag: order of the state", order_x, None, "4"),
        row("with drag: order of the time of a bounce", order_t, None, "4"),
    ]


def with_drag() -> np.ndarray:
    """The orders at which state and time converge to those of another solver, by a
    bounce. The run ends before the top, where the drag `-v |v|` has a kink."""
    end, x0 = 1.0, np.array([3.0, 0.0])
    hits: Any = lambda t, x: x[0]
    hits.terminal, hits.direction = True, -1
    field = lambda t, x: np.array([x[1], -10.0 - 0.5 * x[1] * abs(x[1])])
    options: Any = dict(rtol=1e-13, atol=1e-14, method="DOP853")
    fallen = solve_ivp(field, (0, end), x0, events=hits, **options)
    time, after = fallen.t[-1], np.array([0.0, -0.8 * fallen.y[1, -1]])
    x = solve_ivp(field, (0, end - time), after, **options).y[:, -1]
    errors = []
    for steps in (16, 32):
        system = s.BouncingBall(drag=0.5, gravity=10.0)
        dynamics = dlx.Discretized(system, dt=end, substeps=steps)
        start = 0.0, jnp.asarray(x0), jnp.zeros(1), None
        x_next, _, events = eqx.filter_jit(dynamics.advance_with_events)(*start)
        errors.append([np.abs(x_next - x).max(), abs(events.times[0] - time)])
    return np.log2(np.array(errors[0]) / np.array(errors[1]))


class Switch(s.AbstractHybridSystem):
    """`dx/dt = 1` until x is at `limit` and becomes 0, or until that time, and rest."""

    limit: Array = dlx.parameter(0.7)
    by_time: bool = False

    state_names, control_names = ("x", "mode"), ("u",)
    mode_names = ("before", "after")
    event_names, event_directions = ("switch",), (1,)

    def vector_field(self, t, x, u, w):
        rests = self.by_time & (x[1] == 1)
        return jnp.stack([jnp.where(rests, 0.0, 1.0), 0 * x[1]])

    def guards(self, t, x, u):
        return ((t if self.by_time else x[0]) - self.limit,)

    def enabled(self, t, x, u):
        return (x[1] == 0,)

    def resets(self, t, x, u):
        return (jnp.stack([x[0] if self.by_time else 0 * x[0], x[1] + 1]),)


def reported(quick: bool) -> list[dict[str, Any]]:
    """Derivatives that were reported to be wrong or missing in other libraries."""
    x0 = jnp.zeros(2)
    anew = jax.grad(lambda limit: final(Switch(limit), x0, 4, 0.25)[0])
    stop = jax.grad(lambda at: final(Switch(at, by_time=True), x0, 8, 0.25)[0])
    free = s.BouncingBall(gravity=0.0, restitution=1.0)
    height = lambda h: final(free, jnp.stack([h, -5.0 + 0 * h]), 20, 0.05)[0]
    h = jnp.linspace(2.9, 3.0, 11 if quick else 101)
    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(height)))(h)
    return [
        row("DiffEqGPU 533: derivative", anew(0.7), None, "-1"),
        row("diffrax 729: derivative", stop(1.0), None, "1"),
        row("brax 317: height after the bounce", np.abs(values - 5 + h).max(), 1e-8),
        row("brax 317: slope of that", np.abs(slopes + 1).max(), 1e-8),
    ]


def orbits(quick: bool) -> list[dict[str, Any]]:
    """Periodic gaits, against published ones."""
    orbit = dlx.analysis.periodic_orbit
    rolling = dlx.Discretized(s.RimlessWheel(slope=0.1), dt=0.005)
    wheel = orbit(rolling, "step", [0.1 - np.pi / 8, 1.2])

    def walk(slope, guess):
        dynamics = dlx.Discretized(s.SimplestWalker(slope=slope), dt=0.05)
        rest = 2 * guess[0], (1 - np.cos(2 * guess[0])) * guess[1]
        return orbit(dynamics, "step", np.array([*guess[:2], *rest]))

    simplest = walk(0.009, (0.2, -0.2))
    near = walk(0.0145, walk(0.012, simplest.state).state).state
    beyond = lambda slope: abs(np.asarray(walk(slope, near).multipliers)).max() - 1
    doubling = brentq(beyond, 0.0148, 0.0154, xtol=1e-4 if quick else 1e-6)
    # The gravity of the paper, as its period tells.
    gait = dlx.Discretized(s.CompassGait(gravity=9.8), dt=0.02)
    compass = orbit(gait, "step", [-0.323, 0.218, -0.378, -1.092])
    first = np.asarray(simplest.multipliers)[0]
    x = simplest.state
    pair, last = np.asarray(compass.multipliers)[[0, 2]]
    return [
        row("rimless wheel: multiplier", abs(wheel.multipliers[0] - 0.5), 1e-8),
        row("simplest walker: stance [rad]", x[0], None, "0.200311"),
        row("simplest walker: rate of the stance", x[1], None, "-0.199832"),
        row("simplest walker: multiplier, real part", first.real, None, "-0.19010"),
        row("simplest walker: imaginary part", abs(first.imag), None, "0.55760"),
        row(
            "simplest walker: slope where the period doubles", doubling, None, "0.0151"
        ),
        row("compass gait: period [s]", compass.period, None, "0.7347"),
        row("compass gait: multiplier, real part", pair.real, None, "-0.1997"),
        row("compass gait: imaginary part", abs(pair.imag), None, "0.5445"),
        row("compass gait: third multiplier", last.real, None, "0.1316"),
    ]


A, B = np.array([[0.0, 1.0], [-2.0, -0.3]]), np.array([[0.0], [1.0]])
STEP = 0.1


class Spring(dlx.AbstractSystem):
    """`x' = A x + B u`."""

    state_names, control_names = ("p", "v"), ("u",)

    def vector_field(self, t, x, u, w):
        return jnp.asarray(A, x.dtype) @ x + jnp.asarray(B, x.dtype) @ u

    def equilibrium(self):
        return jnp.zeros(2), jnp.zeros(1)


class Lag(s.AbstractDelaySystem):
    """`x' = -rate x(t - tau)`."""

    rate: Array = dlx.parameter(1.0)
    delays: Array = dlx.parameter([1.0])
    state_names, control_names = ("x",), ("u",)

    def vector_field(self, t, x, u, w, late):
        return -self.rate * late[0] + u

    def equilibrium(self):
        return jnp.zeros(1), jnp.zeros(1)


def sampled(tau: float) -> tuple[int, Any, Any, Any]:
    """The exact sampled system of a control that is late: whole steps, the transition,
    and the effects of the older and of the newer control (Åström and Wittenmark, 1997,
    equations 2.12 and 2.13)."""
    held = np.block([[A, B], [np.zeros((1, 3))]])
    whole = int(tau / STEP + 1e-9)
    rest = tau - whole * STEP
    newer = expm(held * (STEP - rest))[:2, 2:]
    older = expm(A * (STEP - rest)) @ expm(held * rest)[:2, 2:]
    return whole, expm(A * STEP), older, newer


def delays(quick: bool) -> list[dict[str, Any]]:
    """Late controls and states."""
    del quick

    def growth(rate):
        late = dlx.dynamics.MethodOfSteps(Lag(rate=rate), dt=0.1)
        return np.abs(np.linalg.eigvals(np.asarray(dlx.linearize(late).A))).max() - 1

    tau, start = 1.37 * STEP, np.array([1.0, 0.5])
    whole, phi, older, newer = sampled(tau)
    options: Any = dict(solver=diffrax.Dopri8())
    options["stepsize_controller"] = diffrax.PIDController(rtol=1e-12, atol=1e-12)
    exactly = dlx.Discretized(Spring(), dt=STEP, **options)
    late = dlx.dynamics.TransportDelay(exactly, controls=tau)
    controls = np.random.default_rng(0).standard_normal((12, 1))
    past = np.concatenate([np.zeros((whole + 1, 1)), controls])
    states = [start]
    for k in range(len(controls)):
        states.append(phi @ states[-1] + older @ past[k] + newer @ past[k + 1])
    found = dlx.open_loop(late, late.filled(start), controls)[:, :2]

    K = np.array([[1.5, 0.4]])
    often = dlx.Discretized(Spring(), dt=STEP, substeps=200)
    model = dlx.linearize(dlx.dynamics.TransportDelay(often, controls=tau))
    closed = np.asarray(model.A) - np.asarray(model.B) @ np.pad(K, ((0, 0), (0, 2)))
    polynomial = np.poly(np.linalg.eigvals(closed))

    def own(z):
        # z x = phi x - older K x / z^2 - newer K x / z, times z^2
        matrix = z * np.eye(2) - phi + older @ K / z**2 + newer @ K / z
        return z**2 * np.linalg.det(matrix)

    points = 0.7, -1.1, 0.4 + 0.9j
    worst = max(abs(np.polyval(polynomial, z) - own(z)) for z in points)
    missed = np.abs(found - np.array(states)).max()
    limit = brentq(growth, 1.4, 1.7)
    return [
        row("delayed state: limit of stability", abs(limit - np.pi / 2), 1e-3),
        row("late control: characteristic polynomial", worst, 1e-8),
        row("late control: states", missed, 1e-10),
    ]


PARTS = {"bounces": bounces, "reported": reported, "orbits": orbits, "delays": delays}
