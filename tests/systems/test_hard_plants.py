"""The pendulums on what moves, the load on a cable and the car that drifts, against
Lagrange's equations and published numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, needs_x64, user_error

import delucax as dlx


pytestmark = needs_x64
s = dlx.systems


def rod(mass, length, start, along):
    """`(mass, centre, moment about it, direction)` of a thin rod."""
    return mass, start + 0.5 * length * along, mass * length**2 / 12, along


def points(mass, centre, moment, along):
    """Two point masses that move as a thin body does."""
    half = jnp.sqrt(moment / mass) * along
    return [(mass / 2, centre + half), (mass / 2, centre - half)]


def two_on_a_cart(c, q):
    way = lambda angle: jnp.stack([jnp.sin(angle), jnp.cos(angle)])
    cart, first, second = jnp.stack([q[0], 0.0 * q[0]]), way(q[1]), way(q[2])
    lower = rod(c.mass_1, c.length_1, cart, first)
    upper = rod(c.mass_2, c.length_2, cart + c.length_1 * first, second)
    return [(c.cart_mass, cart), *points(*lower), *points(*upper)]


def on_an_arm(c, q):
    out = jnp.stack([jnp.cos(q[0]), jnp.sin(q[0]), 0.0 * q[0]])
    aside = jnp.stack([-jnp.sin(q[0]), jnp.cos(q[0]), 0.0 * q[0]])
    along = jnp.sin(q[1]) * aside + jnp.cos(q[1]) * jnp.eye(3)[2]
    centre = c.arm_length * out + c.center * along
    moment = c.inertia - c.mass * c.center**2
    # The arm is a mass at a distance of 1 m, which does not rise.
    return [(c.arm_inertia, out), *points(c.mass, centre, moment, along)]


def under_a_quadrotor(c, q):
    hangs = jnp.stack([jnp.sin(q[3]), -jnp.cos(q[3])])
    across = jnp.stack([jnp.cos(q[2]), jnp.sin(q[2])])
    body = points(c.mass, q[:2] - c.cable * hangs, c.inertia, across)
    return [(c.load, q[:2]), *body]


# Each a system, the positions of its masses, and the forces on its coordinates.
MECHANICS = {
    "DoublePendulumCart": (
        s.DoublePendulumCart(1.2, 0.4, 0.8, 0.6, 0.7),
        two_on_a_cart,
        lambda c, q, v, u: jnp.stack([u[0], 0.0 * u[0], 0.0 * u[0]]),
    ),
    "FurutaPendulum": (
        s.FurutaPendulum(arm_friction=2e-3, friction=1e-4),
        on_an_arm,
        lambda c, q, v, u: jnp.stack(
            [
                c.motor_constant * (u[0] - c.motor_constant * v[0]) / c.resistance
                - c.arm_friction * v[0],
                -c.friction * v[1],
            ]
        ),
    ),
    "SlungLoad": (
        s.SlungLoad(load=0.3, cable=0.7),
        under_a_quadrotor,
        lambda c, q, v, u: (
            jax.vjp(c.quadrotor, q)[1](
                (u[0] + u[1]) * jnp.stack([-jnp.sin(q[2]), jnp.cos(q[2])])
            )[0]
            + jnp.zeros(4).at[2].set(c.arm * (u[1] - u[0]))
        ),
    ),
}


@pytest.mark.parametrize("name", MECHANICS)
def test_accelerations_are_those_of_lagrange(name):
    """From the positions of point masses alone, at random states and controls."""
    system, masses, forces = MECHANICS[name]
    n, m = system.state_size // 2, system.control_size

    def lagrangian(q, v):
        """Kinetic minus potential energy; weight is along the last axis."""
        value = 0.0
        for k in range(len(masses(system, q))):
            mass, place = masses(system, q)[k]
            moves = jax.jvp(lambda q, k=k: masses(system, q)[k][1], (q,), (v,))[1]
            value += mass * (0.5 * moves @ moves - system.gravity * place[-1])
        return value

    @jax.jit
    @jax.vmap
    def both(x, u):
        q, v = x[:n], x[n:]
        momentum = jax.grad(lagrangian, 1)
        _, turned = jax.jvp(lambda q: momentum(q, v), (q,), (v,))
        push = forces(system, q, v, u) + jax.grad(lagrangian)(q, v) - turned
        inertia = jax.jacfwd(momentum, 1)(q, v)
        expected = jnp.linalg.solve(inertia, push)
        return system.vector_field(0.0, x, u, None), jnp.concatenate([v, expected])

    rng = np.random.default_rng(0)
    x, u = rng.normal(0, 3, (20, 2 * n)), rng.normal(0, 5, (20, m))
    ours, theirs = both(jnp.asarray(x), jnp.asarray(u))
    assert_close(ours, theirs, rtol=1e-9, atol=1e-9)


def test_the_drift_is_that_of_the_paper():
    """Hindiyeh and Gerdes, 2014, at 8 m/s and -12 degrees, to what their cosine of the
    steering angle, 1, makes of it."""
    car = s.DriftingCar()
    x, u = car.equilibrium()
    assert_close(car.vector_field(0.0, x, u, None), np.zeros(3), atol=1e-12)
    assert_close(np.rad2deg(np.arctan(x[1] / x[0])), -20.44, rtol=0.01)
    assert_close(x[2], 0.600, rtol=2e-3)
    assert_close(u[0], 2293.0, rtol=5e-3)
    # What the rear tyre has left to corner with; all of it is used.
    _, grip = car.grips()
    assert_close(np.hypot(u[0], 4469.0), grip, rtol=2e-3)
    # Countersteered, and unstable.
    poles = np.linalg.eigvals(dlx.linearize(car, 0.0, x, u).A)
    assert u[1] < 0 < x[2] and np.max(poles.real) > 1
    for speed, steering in ((5.0, 0.0), (15.0, -0.4)):
        x, u = car.equilibrium(speed, steering)
        assert_close([x[0], u[1]], [speed, steering])
        assert_close(car.vector_field(0.0, x, u, None), np.zeros(3), atol=1e-12)
    for arguments in (dict(speed=8.0, steering=0.4), dict(speed=-8.0)):
        with user_error(match="DriftingCar: speed and steering must be those of a dri"):
            car.equilibrium(**arguments)


def test_an_equilibrium_has_a_derivative():
    car = s.DriftingCar()
    slope = jax.jit(jax.jacfwd(lambda v: car.equilibrium(v)[0]))(8.0)
    near = [car.equilibrium(8.0 + h)[0] for h in (-1e-4, 1e-4)]
    assert_close(slope, (near[1] - near[0]) / 2e-4, rtol=1e-6)


def test_brush_tyres_are_linear_at_small_slips_and_slide_at_large_ones():
    car = s.DriftingCar()
    same = dict(mass=1724.0, inertia=1300.0, front=1.35, rear=1.15, standstill=0.1)
    linear = s.DynamicBicycle(front_stiffness=120000.0, rear_stiffness=175000.0, **same)
    x, u = jnp.array([20.0, 1e-4, 1e-4]), jnp.array([300.0, 1e-5])
    ours = car.vector_field(0.0, x, u, None)
    longer = jnp.concatenate([jnp.zeros(3), x])
    theirs = linear.vector_field(0.0, longer, u / jnp.array([1724.0, 1.0]), None)[3:]
    assert_close(ours[1:], theirs[1:], rtol=1e-3)
    assert_close(ours[0], theirs[0], atol=1e-8)
    # Aside, without driving: both axles push back with all their grip.
    aside = car.vector_field(0.0, jnp.array([0.0, 5.0, 0.0]), jnp.zeros(2), None)
    assert_close(aside, [0.0, -0.55 * 9.81, 0.0], atol=1e-12)
    # With all of the grip driving, the front axle alone does, but for a fiftieth.
    full = jnp.array([car.grips()[1], 0.0])
    aside = car.vector_field(0.0, jnp.array([0.0, 5.0, 0.0]), full, None)
    share = (1.15 + 0.02 * 1.35) / 2.5
    assert_close(aside[1], -0.55 * 9.81 * share, rtol=1e-6)
