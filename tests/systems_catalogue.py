"""Every system, with where it is tried and what it conserves."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import delucax as dlx


s = dlx.systems


class Case(NamedTuple):
    """A system, and boxes for its state and control.

    - `make`: the system.
    - `low`, `high`: corners of the box of states.
    - `u_low`, `u_high`: of the box of controls.
    - `dt`: a step that resolves it.
    """

    make: Callable[[], Any]
    low: Any
    high: Any
    u_low: Any
    u_high: Any
    dt: float


class Conserved(NamedTuple):
    """What a system with constants of its own conserves under a held control.

    - `make`: the system.
    - `x0`, `u`: where it starts, and what is held.
    - `value`: `(system, t, x) -> array` that stays as it is.
    - `dt`: a step at which the error of RK4 is seen.
    """

    make: Callable[[], Any]
    x0: Any
    u: Any
    value: Callable[..., Any]
    dt: float


def box(*half):
    half = np.array(half)
    return -half, half


def sample(rng, size, edges, low, high):
    """Vectors inside a box; of every other one a share of the entries at the ends."""
    low, high = np.asarray(low), np.asarray(high)
    unit = rng.uniform(0, 1, (size, low.size))
    ends = rng.uniform(0, 1, unit.shape) < edges
    ends[::2] = False
    unit = np.where(ends, np.round(unit), unit)
    return jnp.asarray(low + (high - low) * unit)


def _linear():
    A = jnp.array([[0.0, 1.0, 0.0], [-2.0, -0.3, 0.5], [0.0, 0.2, -1.0]])
    B = jnp.array([[0.0, 1.0], [1.0, 0.0], [0.5, 0.5]])
    point = dict(x_ref=jnp.ones(3), u_ref=jnp.array([0.5, 0.0]))
    return s.LinearSystem(A, B, E=B[:, :1], **point)


def _swing(t, x, u, w):
    return jnp.stack([x[1], u[0] - jnp.sin(x[0]) + 0.1 * jnp.cos(t)])


def _neural():
    return s.NeuralSystem(3, 2, width=8, depth=2, key=jax.random.key(3))


_QUAD = [3.0] * 3 + [1.0] * 4 + [3.0] * 6
SYSTEMS = {
    "Acrobot": Case(s.Acrobot, *box(3.2, 3.2, 6.0, 9.0), *box(1.0), 0.02),
    "CartPole": Case(s.CartPole, *box(2.4, 2.0, 3.2, 4.0), *box(10.0), 0.02),
    "MountainCar": Case(s.MountainCar, [-1.2, -0.07], [0.6, 0.07], *box(1.0), 1.0),
    "Pendulum": Case(s.Pendulum, *box(3.2, 8.0), *box(2.0), 0.05),
    "PlanarQuadrotor": Case(
        s.PlanarQuadrotor, *box(2.0, 2.0, 3.2, 3.0, 3.0, 4.0), *box(1.0, 1.0), 0.02
    ),
    "PlanarQuadrotor in vortices": Case(
        lambda: s.PlanarQuadrotor(wind=s.VortexWind(0.4)),
        *box(2.0, 2.0, 3.2, 3.0, 3.0, 4.0),
        *box(1.0, 1.0),
        0.02,
    ),
    "Reacher": Case(
        lambda: s.Reacher(gravity=-10.0), *box(3.2, 3.2, 4.0, 4.0), *box(1.0, 1.0), 0.01
    ),
    "DoubleIntegrator": Case(s.DoubleIntegrator, *box(2.0, 1.0), *box(1.0), 0.1),
    "MassSpringDamper": Case(s.MassSpringDamper, *box(1.0, 1.0), *box(1.0), 0.1),
    "MassSpringDamper of three": Case(
        lambda: s.MassSpringDamper([1.0, 2.0, 0.5], [1.0, 3.0, 2.0], masses=3),
        *box(*[1.0] * 6),
        *box(1.0),
        0.1,
    ),
    "VanDerPol": Case(s.VanDerPol, *box(2.5, 3.0), *box(3.0), 0.05),
    "Lorenz": Case(
        s.Lorenz, [-20.0, -20.0, 10.0], [20.0, 20.0, 40.0], *box(50.0), 0.005
    ),
    "Quadrotor": Case(s.Quadrotor, *box(*_QUAD), [0.0] * 4, [6.0] * 4, 0.01),
    "Quadrotor by its wrench": Case(
        lambda: s.Quadrotor(drag=0.1, inputs="wrench"),
        *box(*_QUAD),
        [0.0, -0.1, -0.1, -0.1],
        [24.0, 0.1, 0.1, 0.1],
        0.01,
    ),
    "KinematicBicycle": Case(
        s.KinematicBicycle, *box(9.0, 9.0, 3.2, 15.0), *box(3.0, 0.5), 0.05
    ),
    "DynamicBicycle": Case(
        s.DynamicBicycle,
        [-9.0, -9.0, -3.2, 10.0, -1.0, -0.5],
        [9.0, 9.0, 3.2, 30.0, 1.0, 0.5],
        *box(5.0, 0.2),
        0.01,
    ),
    "DoublePendulumCart": Case(
        s.DoublePendulumCart, *box(2.0, 3.2, 3.2, 3.0, 9.0, 9.0), *box(40.0), 0.01
    ),
    "FurutaPendulum": Case(
        s.FurutaPendulum, *box(3.2, 3.2, 15.0, 25.0), *box(10.0), 0.01
    ),
    "SlungLoad": Case(
        s.SlungLoad, *box(4.0, 4.0, 3.2, 3.2, 3.0, 3.0, 5.0, 5.0), *box(5.0, 5.0), 0.02
    ),
    "DriftingCar": Case(
        s.DriftingCar, [-2.0, -6.0, -2.0], [15.0, 6.0, 2.0], *box(6000.0, 0.6), 0.01
    ),
    "BouncingBall": Case(
        lambda: s.BouncingBall(drag=0.1), [0.1, -5.0], [3.0, 5.0], *box(5.0), 0.02
    ),
    "RimlessWheel": Case(s.RimlessWheel, [-0.3, -2.0], [0.45, 2.0], *box(1.0), 0.02),
    "SimplestWalker": Case(s.SimplestWalker, *box(0.3, 0.3, 0.6, 0.6), *box(0.1), 0.05),
    "CompassGait": Case(s.CompassGait, *box(0.4, 0.4, 2.0, 2.0), *box(5.0), 0.01),
    "Thermostat": Case(s.Thermostat, [19.0, 0.0], [21.0, 1.0], *box(1.0), 0.1),
    "StickSlip": Case(s.StickSlip, [-0.2, -0.5, 0.0], [0.2, 0.5, 2.0], *box(1.0), 0.05),
    "ValveWithStops": Case(
        s.ValveWithStops, [0.0, -4.0, 0.0], [1.0, 4.0, 0.0], *box(25.0), 0.02
    ),
    "TwoTank": Case(s.TwoTank, [0.0, 0.0], [20.0, 20.0], [0.0], [30.0], 1.0),
    "CSTR": Case(s.CSTR, [0.3, 340.0], [0.7, 360.0], [280.0], [320.0], 0.05),
    "PermanentMagnetMotor": Case(
        lambda: s.PermanentMagnetMotor(d_inductance=0.006),
        *box(20.0, 20.0, 200.0),
        *box(150.0, 150.0),
        2e-4,
    ),
    "NeuralSystem": Case(_neural, *box(1.0, 1.0, 1.0), *box(1.0, 1.0), 0.05),
    "LinearSystem": Case(_linear, *box(1.0, 1.0, 1.0), *box(1.0, 1.0), 0.05),
    "FunctionSystem": Case(
        lambda: dlx.system(_swing, states=2, controls=1),
        *box(3.2, 4.0),
        *box(1.0),
        0.05,
    ),
}


def _pendulum(system, t, x):
    lift = 1.5 * system.gravity / system.length
    return 0.5 * x[1] ** 2 + lift * jnp.cos(x[0])


def _two_links(m11, m12, m22, v1, v2):
    return 0.5 * (m11 * v1 * v1 + 2 * m12 * v1 * v2 + m22 * v2 * v2)


def _acrobot(system, t, x):
    m1, m2, l1 = system.mass_1, system.mass_2, system.length_1
    c1, c2, g = system.center_1, system.center_2, system.gravity
    own = m2 * c2**2 + system.inertia_2
    cross = own + m2 * l1 * c2 * jnp.cos(x[1])
    first = m1 * c1**2 + system.inertia_1 + m2 * l1**2
    whole = first + own + 2 * m2 * l1 * c2 * jnp.cos(x[1])
    kinetic = _two_links(whole, cross, own, x[2], x[3])
    height = (m1 * c1 + m2 * l1) * jnp.cos(x[0]) + m2 * c2 * jnp.cos(x[0] + x[1])
    return kinetic - g * height


def _cartpole(system, t, x):
    m, l = system.pole_mass, system.half_length
    c = jnp.cos(x[2])
    total = system.cart_mass + m
    spin = _two_links(total, m * l * c, 4 / 3 * m * l**2, x[1], x[3])
    return spin + m * system.gravity * l * c


def _mountain_car(system, t, x):
    return 0.5 * x[1] ** 2 + system.gravity * jnp.sin(3 * x[0]) / 3


def _driven_off(system, t, x):
    """Without thrust, in the wind that drives off."""
    square = x[0] ** 2 + x[1] ** 2
    moving = 0.5 * system.mass * (x[3] ** 2 + x[4] ** 2)
    weight = system.mass * system.gravity * x[1]
    return moving + weight - 0.5 * system.wind.strength * square


def _reacher(system, t, x):
    m1, m2, l1, l2 = system.mass_1, system.mass_2, system.length_1, system.length_2
    c = jnp.cos(x[1])
    m22 = m2 * l2**2
    m12 = m22 + m2 * l1 * l2 * c
    m11 = (m1 + m2) * l1**2 + m22 + 2 * m2 * l1 * l2 * c
    kinetic = _two_links(m11, m12, m22, x[2], x[3])
    along = (m1 + m2) * l1 * jnp.cos(x[0]) + m2 * l2 * jnp.cos(x[0] + x[1])
    return kinetic - system.gravity * along


def _chain(system, t, x):
    n = system.masses
    stretch = jnp.diff(x[:n], prepend=0.0)
    return 0.5 * jnp.sum(system.mass * x[n:] ** 2 + system.stiffness * stretch**2)


def _lorenz(system, t, x):
    return (x[0] ** 2 - 2 * system.sigma * x[2]) * jnp.exp(2 * system.sigma * t)


def _tumbling(system, t, x):
    """Energy and, in the world, angular momentum of a body without thrust."""
    inertia = jnp.stack([system.inertia_x, system.inertia_y, system.inertia_z])
    spin = inertia * x[10:]
    energy = 0.5 * jnp.dot(x[10:], spin) + 0.5 * system.mass * jnp.dot(x[7:10], x[7:10])
    energy = energy + system.mass * system.gravity * x[2]
    rotation = system.rotation(x).reshape(3, 3)
    return jnp.concatenate([energy[None], 100 * rotation @ spin])


def _circle(system, t, x):
    """The centre of the circle that a held steering drives."""
    slip = jnp.arctan(system.rear / (system.front + system.rear) * jnp.tan(0.3))
    radius = system.rear / jnp.sin(slip)
    course = x[2] + slip
    return x[:2] + radius * jnp.stack([-jnp.sin(course), jnp.cos(course)])


def _sliding(system, t, x):
    """The velocity over ground of a car on ice."""
    c, d = jnp.cos(x[2]), jnp.sin(x[2])
    return jnp.stack([x[3] * c - x[4] * d, x[3] * d + x[4] * c])


def _motor(system, t, x):
    currents = system.d_inductance * x[0] ** 2 + system.q_inductance * x[1] ** 2
    return 0.75 * currents + 0.5 * system.inertia * x[2] ** 2


_ICE = dict(front_stiffness=1e-12, rear_stiffness=1e-12)
_OFF = s.DissipativeWind(0.4)
_TUMBLE = [0.0] * 3 + [1.0, 0.0, 0.0, 0.0] + [1.0, 0.0, 2.0] + [4.0, 0.1, 5.0]
CONSERVED = {
    "Pendulum": Conserved(s.Pendulum, [1.0, 0.5], [0.0], _pendulum, 0.05),
    "Acrobot": Conserved(s.Acrobot, [1.0, -2.0, 1.0, 2.0], [0.0], _acrobot, 0.05),
    "CartPole": Conserved(s.CartPole, [0.0, 1.0, 1.0, 2.0], [0.0], _cartpole, 0.04),
    "MountainCar": Conserved(s.MountainCar, [0.3, 0.0], [0.0], _mountain_car, 4.0),
    "PlanarQuadrotor": Conserved(
        lambda: s.PlanarQuadrotor(wind=_OFF),
        [1.0, 1.0, 0.3, 1.0, 2.0, 1.0],
        [0.0, 0.0],
        _driven_off,
        0.05,
    ),
    "Reacher": Conserved(
        lambda: s.Reacher(1.0, 0.7, 0.9, 1.2, gravity=9.81),
        [1.0, 1.5, 1.0, -2.0],
        [0.0, 0.0],
        _reacher,
        0.02,
    ),
    "MassSpringDamper": Conserved(
        lambda: s.MassSpringDamper([1.0, 2.0], [1.0, 3.0], 0.0, masses=2),
        [1.0, -0.5, 0.0, 1.0],
        [0.0],
        _chain,
        0.1,
    ),
    "VanDerPol": Conserved(
        lambda: s.VanDerPol(0.0), [1.0, 1.0], [0.0], lambda s, t, x: x @ x, 0.1
    ),
    "Lorenz": Conserved(
        lambda: s.Lorenz(0.5, 28.0, 1.0), [1.0, 2.0, 3.0], [0.0], _lorenz, 0.01
    ),
    "Quadrotor": Conserved(
        lambda: s.Quadrotor(inertia_x=0.005), _TUMBLE, [0.0] * 4, _tumbling, 0.02
    ),
    "KinematicBicycle": Conserved(
        s.KinematicBicycle, [0.0, 0.0, 0.3, 8.0], [0.0, 0.3], _circle, 0.1
    ),
    "DynamicBicycle": Conserved(
        lambda: s.DynamicBicycle(**_ICE),
        [0.0, 0.0, 0.3, 8.0, 1.0, 2.0],
        [0.0, 0.0],
        _sliding,
        0.05,
    ),
    "PermanentMagnetMotor": Conserved(
        lambda: s.PermanentMagnetMotor(0.0, d_inductance=0.006, friction=0.0),
        [5.0, -3.0, 80.0],
        [0.0, 0.0],
        _motor,
        5e-4,
    ),
}
