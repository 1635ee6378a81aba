"""The safety filter of dynamics in discrete time, and the margin for a held control."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, assert_gradient, needs_x64, once, user_error

import delucax as dlx


c = dlx.controllers
KEY = jax.random.key(0)


class Turned(dlx.AbstractDynamics):
    """A point that moves by a bent function of two controls."""

    state_names, control_names = ("x", "y"), ("u", "v")
    dt: jax.Array = dlx.parameter(0.1)
    bend: jax.Array = dlx.parameter(0.3)

    def advance(self, t, x, u, w):
        step = jnp.stack([u[0] + self.bend * u[1] ** 2, jnp.sin(u[1])])
        x_next = x + self.dt * step
        return (x_next if w is None else x_next + w), dlx.RESULTS.successful


class Disc(eqx.Module):
    radius: jax.Array = dlx.parameter(1.0)

    def __call__(self, t, x):
        return x @ x - self.radius**2


X = jnp.array([-1.02, 0.25])


def around(**options):
    nominal = c.Constant([3.0, 0.5])
    return c.SafetyFilter(nominal, Turned(), Disc(), decay=0.2, **options)


@needs_x64
def test_bent_dynamics_to_the_last_digit():
    """The condition is met by the dynamics themselves, with equality, and the change is
    along its gradient there: a first-order point of the problem that is not convex."""
    safe = around()
    u, state = safe(0.0, X, safe.init())
    condition = lambda u: Disc()(0.0, Turned()(0.0, X, u)) - 0.8 * Disc()(0.0, X)
    assert_close(condition(u), 0.0, atol=1e-12)
    slope, change = jax.grad(condition)(u), u - jnp.array([3.0, 0.5])
    assert_close(change[0] * slope[1] - change[1] * slope[0], 0.0, atol=1e-9)
    assert change @ slope > 0.1 and 2 < state.iterations < 20
    # Without need there is one linearisation, and no change.
    u, state = safe(0.0, X - 5, safe.init())
    assert state.iterations == 1 and np.all(u == jnp.array([3.0, 0.5]))


@needs_x64
def test_what_did_not_converge_is_said():
    safe = around(max_iterations=2)
    u, state = safe(0.0, X, safe.init())
    assert state.result == dlx.RESULTS.not_converged and state.missed["barrier"] > 0
    assert state.failures.count == 1 and np.all(np.isfinite(u))
    safe = around(bounds=(0.5, 4.0))
    u, state = safe(0.0, jnp.array([-1.02, 0.0]), safe.init())
    assert state.result == dlx.RESULTS.no_feasible_point
    assert np.all((u >= 0.5) & (u <= 4.0))


@needs_x64
def test_derivatives_in_steps():
    """By the implicit function theorem, the curvature of the condition included."""
    made = around(bounds=(-1.0, 5.0))

    def control(z):
        where = lambda s: (
            s.barriers["barrier"].radius,
            s.plant.bend,
            s.decay,
            s.controller.value,
        )
        values = z[0], z[1], z[2] * jnp.ones((1, 2)), z[3:5]
        u, _ = (safe := eqx.tree_at(where, made, values))(0.0, z[5:], safe.init())
        return u @ jnp.array([1.0, -2.0])

    z = np.array([1.0, 0.3, 0.2, 3.0, 0.5, *X])
    assert np.all(assert_gradient(control, z, step=1e-5, atol=1e-6) != 0)


@needs_x64
def test_degree_two_in_steps():
    """The position of a mass that Euler's method pushes sees the force two steps on:
    `b2 - 1.5 b1 + 0.54 b0` is zero."""
    A, B = jnp.array([[1.0, 0.1], [0.0, 1.0]]), jnp.array([[0.0], [0.1]])
    mass = dlx.LinearDynamics(A, B, dt=0.1)
    wall = lambda t, x: 1.0 - x[0]
    safe = c.SafetyFilter(c.Constant([9.0]), mass, wall, decay=(0.1, 0.4))
    assert safe.degrees == (2,)
    x = jnp.array([0.7, 1.0])
    u, _ = safe(0.0, x, safe.init())
    later = A @ x + B @ u
    b = [float(1.0 - z[0]) for z in (x, later, A @ later)]
    assert_close(b[2] - (0.9 + 0.6) * b[1] + 0.9 * 0.6 * b[0], 0.0, atol=1e-12)


@needs_x64
def test_disturbances_in_steps():
    """One that is added to the state, of which a linear barrier is affine."""
    safe = c.SafetyFilter(
        c.Constant([9.0, 0.0]),
        Turned(),
        lambda t, x: 1 - x[0] + 0.5 * x[1],
        disturbance=(0.02, 0.04),
        decay=0.5,
    )
    x = jnp.array([0.9, 0.1])
    u, _ = safe(0.0, x, safe.init())
    worst = Turned()(0.0, x, u, jnp.array([0.02, -0.04]))
    assert_close(1 - worst[0] + 0.5 * worst[1], 0.5 * 0.15, atol=1e-12)


@once
def test_a_loop_in_steps_stays_inside():
    env = dlx.make("pendulum", dt=0.05)
    push = c.Constant([2.0])
    ahead = lambda x: x[0] + 0.3 * x[1]
    lean = {"right": lambda t, x: 0.3 - ahead(x), "left": lambda t, x: 0.3 + ahead(x)}
    safe = c.SafetyFilter(push, env.dynamics, lean, decay=0.3)
    run = dlx.rollout(env, safe, key=KEY, x0=[0.1, 0.0], horizon=60)
    assert run.result == dlx.RESULTS.successful
    assert 0.29 < np.max(np.abs(run.states[:, 0])) <= 0.3


class Spun(eqx.Module):
    """A pendulum that a disturbed torque turns."""

    def __call__(self, t, x, u, w):
        return jnp.stack([x[1], 15 * jnp.sin(x[0]) + 3 * u[0] + w[0]])


SPUN = dlx.system(Spun(), states=2, controls=1, disturbances=1)
DT = 0.01


def limited(**options):
    """Turning no faster than 4 rad/s, pushed to turn faster."""
    fast = lambda t, x: 4.0 - x[1]
    options = dict(decay=3.0, bounds=(-8.0, 8.0), disturbance=0.5) | options
    return c.SafetyFilter(c.Constant([6.0]), SPUN, fast, **options)


def most_speed(safe, dt):
    """The highest speed, between samples too, under the worst disturbance."""
    inner = dlx.Discretized(SPUN, dt / 4)

    @jax.jit
    def run(x):
        def step(carry, k):
            x, state = carry
            u, state = safe(k * dt, x, state)
            path = []
            for _ in range(4):
                x, _ = inner.advance(0.0, x, u, jnp.array([0.5]))
                path.append(x[1])
            return (x, state), jnp.stack(path)

        start = x, safe.init()
        return jnp.max(jax.lax.scan(step, start, jnp.arange(int(6 / dt)))[1])

    return float(run(jnp.array([0.0, 3.0])))


BOX = [-np.pi, -1.0], [np.pi, 4.0]


@needs_x64
def test_the_margin_covers_the_hold():
    """Without it the excess is of the order of the step; with it there is none."""
    safe = limited()
    excess = [most_speed(safe, dt) - 4 for dt in (2 * DT, DT)]
    assert 0.4 < excess[1] / excess[0] < 0.6 and excess[1] > 1e-3
    held = safe.held(DT, BOX)
    assert held.margin.shape == (1,) and held.margin[0] > 3 * excess[1]
    assert 3.0 < most_speed(held, DT) <= 4
    # More points change it little.
    finer = safe.held(DT, BOX, points=31).margin
    assert_close(held.margin, finer, rtol=0.5)
    assert held.margin >= finer


@needs_x64
def test_the_margin_by_hand():
    """Of a point whose speed is held, a barrier at rest falls evenly, and one that
    moves by `sin t` is bent as `sin t` is. Of a mass, the change moves by the force."""
    plant = dlx.system(lambda t, x, u, w: u, states=1, controls=1)
    made = lambda plant, barrier: c.SafetyFilter(
        c.Zero(1), plant, barrier, bounds=(-1.0, 1.0)
    )
    still, moving = lambda t, x: 1 - x[0], lambda t, x: 3 + jnp.sin(t) - x[0]
    assert_close(made(plant, still).held(0.05, ([-1.0], [1.0])).margin, [0.0])
    with user_error(match="times must be given"):
        made(plant, moving).held(0.05, ([-1.0], [4.0]))
    box = dict(times=(0.0, 6.3), points=41)
    margin = made(plant, moving).held(0.05, ([-1.0], [4.0]), **box).margin
    assert_close(margin, [0.05 / 2], rtol=0.02)
    mass = dlx.systems.DoubleIntegrator()
    margin = made(mass, still).held(0.05, ([0.0, -0.1], [1.0, 0.1])).margin
    # The force is near -v, and at most 0.1 and what a step adds to it.
    assert 0.05 * 0.1 / 2 < margin < 0.05 * 0.4 / 2


@once
@pytest.mark.parametrize(
    "call, match",
    [
        (lambda: around().held(0.1, ([0, 0], [1, 1])), "plant must be in continuous"),
        (lambda: limited(bounds=None).held(0.1, BOX), "bounds of the controls must"),
        (lambda: limited().held(0.0, BOX), "dt must be positive"),
        (lambda: limited().held(0.5, BOX), "dt must be at most 1 / decay"),
        (lambda: limited().held(0.1, BOX, points=2), "points must be a whole number"),
        (lambda: limited().held(0.1, BOX, points=999), "points must give a grid"),
        (lambda: limited().held(0.1, ([0.0], [1.0])), "states must have shape"),
        (lambda: limited().held(0.1, BOX[::-1]), "states must have low <= high"),
        (lambda: limited().held(0.1, 3.0), "states must be a pair"),
        (lambda: limited().held(0.1, ([0, 5], [1, 6])), "point at which all barriers"),
    ],
)
def test_words_for_the_hold(call, match):
    with user_error(match=match):
        call()
