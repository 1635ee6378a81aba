"""The quadrotors, the winds, the cars and the arm."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, needs_x64, user_error

import delucax as dlx


pytestmark = needs_x64
s = dlx.systems
HOVER = [0.4905, 0.4905]


def field(system, x, u, w=None):
    x, u = jnp.asarray(x, float), jnp.asarray(u, float)
    return vector_field(system, x, u, None if w is None else jnp.asarray(w))


@eqx.filter_jit
def vector_field(system, x, u, w):
    return system.vector_field(0.0, x, u, w)


def test_planar_quadrotor_turns_and_leans_as_the_paper_says():
    quadrotor = s.PlanarQuadrotor()
    x = [0.0, 0.0, 0.3, 1.0, 2.0, 3.0]
    dx = field(quadrotor, x, [0.2, 0.5], [0.1, -0.2])
    ax = -0.7 * np.sin(0.3) / 0.1 + 1.0
    ay = 0.7 * np.cos(0.3) / 0.1 - 9.81 - 2.0
    assert_close(dx, [1.0, 2.0, 3.0, ax, ay, 0.3 / 0.02], rtol=1e-6)
    assert_close(field(quadrotor, np.zeros(6), HOVER), np.zeros(6), atol=1e-5)
    apart = quadrotor.difference(jnp.full(6, 4.0), jnp.zeros(6))
    assert_close(apart[2], 4 - 2 * np.pi, rtol=1e-6)


def test_winds_push():
    place = jnp.array([0.3, -0.4, 1.0, 2.0, 3.0, 4.0])
    blows = lambda wind: wind(0.0, place)
    assert_close(blows(s.DissipativeWind(0.4)), [0.12, -0.16], rtol=1e-6)
    assert_close(blows(s.ConstantWind(0.4)), np.full(2, 0.4 / np.sqrt(2)), rtol=1e-6)
    assert_close(
        blows(s.ConstantWind(0.4, direction=np.pi)),
        [-0.4, 0.0],
        atol=1e-15,
    )
    wind = s.VortexWind(0.4, core=0.5, centres=[[0.0, 0.0]])
    around = lambda r: wind(0.0, jnp.array([r, 0.0]))
    assert_close(around(0.5), [0.0, 0.4], rtol=1e-6)
    for r in (0.0, 0.4, 0.6, 5.0):
        assert np.linalg.norm(around(r)) < 0.4
    three = s.VortexWind(0.4)
    parts = [s.VortexWind(0.4, centres=[c]) for c in ([1, 0], [0.5, 0.5], [0, 1])]
    assert_close(blows(three), sum(blows(one) for one in parts), rtol=1e-5)


def test_a_wind_is_any_function_and_enters_as_the_disturbance_does():
    def gust(t, x):
        return jnp.stack([jnp.sin(t) + x[3], 0.1 * x[0]])

    x, u = jnp.arange(6.0), jnp.asarray(HOVER)
    blown = s.PlanarQuadrotor(wind=gust).vector_field(0.7, x, u, None)
    pushed = s.PlanarQuadrotor().vector_field(0.7, x, u, gust(0.7, x))
    assert_close(blown, pushed, rtol=1e-6)
    with user_error(match=r"wind must be a function of \(t, x\), got 0.1"):
        s.PlanarQuadrotor(wind=0.1)
    calm = s.PlanarQuadrotor(wind=lambda t, x: jnp.zeros(3))
    with user_error(match=r"wind must return a force of shape \(2,\), got .*\(3,\)"):
        calm.vector_field(0.0, x, u, None)
    with user_error(match="centres must have shape"):
        s.VortexWind(centres=[1.0, 2.0])
    with user_error(match="VortexWind: core must be positive"):
        s.VortexWind(core=0.0)


def test_a_planar_quadrotor_leans_into_the_wind():
    x, u = s.PlanarQuadrotor(wind=s.ConstantWind(0.4)).equilibrium()
    assert x[2] > 0.1  # to the left, as the wind blows to the right
    side = 0.4 / np.sqrt(2)
    assert_close(2 * u[0], np.hypot(side, 0.981 - side), rtol=1e-6)


def test_reacher_solves_its_mass_matrix():
    arm = s.Reacher(1.2, 0.7, 0.9, 1.1, gravity=-10.0)
    x, u = np.array([0.4, 1.3, 0.5, -2.0]), np.array([0.3, -0.2])
    m1, m2, l1, l2, g = 1.2, 0.7, 0.9, 1.1, -10.0
    c, d = np.cos(x[1]), np.sin(x[1])
    m12 = m2 * l2**2 + m2 * l1 * l2 * c
    m11 = (m1 + m2) * l1**2 + m2 * l2**2 + 2 * m2 * l1 * l2 * c
    far = m2 * l2 * g * np.sin(x[0] + x[1])
    near = (m1 + m2) * l1 * g * np.sin(x[0])
    b1 = u[0] + m2 * l1 * l2 * (2 * x[2] + x[3]) * x[3] * d - far - near
    b2 = u[1] - m2 * l1 * l2 * x[2] ** 2 * d - far
    expected = np.linalg.solve([[m11, m12], [m12, m2 * l2**2]], [b1, b2])
    assert_close(field(arm, x, u)[2:], expected, rtol=1e-13)
    tip = [l1 * np.cos(0.4) + l2 * np.cos(1.7), l1 * np.sin(0.4) + l2 * np.sin(1.7)]
    assert_close(arm.tip(jnp.asarray(x)), tip, rtol=1e-5)
    # Positive gravity pulls along x, where the arm at zero is.
    assert field(s.Reacher(gravity=10.0), [0.5, 0, 0, 0], np.zeros(2))[2] < 0


def test_quadrotor_rotors_and_wrench_agree():
    rotors, body = s.Quadrotor(), s.Quadrotor(inputs="wrench")
    rng = np.random.default_rng(0)
    x, u = jnp.asarray(rng.normal(size=13)), jnp.asarray(rng.uniform(0, 4, 4))
    wrench = rotors.wrench(u)
    same = field(rotors, x, u, np.ones(3)), field(body, x, wrench, np.ones(3))
    assert_close(*same, rtol=1e-6)
    front, left, back, right = np.asarray(u)
    assert_close(wrench[0], front + left + back + right, rtol=1e-6)
    # Rotor by rotor: r x F, and the drag of each against its turn.
    arms = 0.17 * np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
    lifts = np.asarray(u)[:, None] * np.array([0, 0, 1])
    torque = np.cross(arms, lifts).sum(axis=0)
    torque[2] = 0.016 * (left + right - front - back)
    assert_close(wrench[1:], torque, atol=1e-6)
    assert body.control_names[0] == "thrust" and rotors.control_names[0] == "front"
    with user_error(match="inputs must be 'rotors' or 'wrench', got 'motors'"):
        s.Quadrotor(inputs="motors")


def test_quadrotor_thrust_follows_the_attitude():
    quadrotor = s.Quadrotor(inputs="wrench")
    half = np.pi / 8
    for axis, expected in ((5, [1, 0]), (4, [0, -1])):  # about y, about x
        x = np.zeros(13)
        x[3], x[axis] = np.cos(half), np.sin(half)
        push = field(quadrotor, x, [0.716, 0.0, 0.0, 0.0])[7:9]
        assert_close(push, np.sin(2 * half) * np.array(expected), atol=1e-6)


def test_an_attitude_has_two_quaternions():
    quadrotor = s.Quadrotor()
    x, _ = quadrotor.equilibrium()
    turned = x.at[3:7].set(-x[3:7]).at[0].set(1.0)
    assert_close(quadrotor.difference(turned, x), jnp.zeros(13).at[0].set(1.0))
    features = dlx.make("quadrotor").encode
    assert_close(features(turned)[1:], features(x)[1:])
    left = x.at[3].set(np.sqrt(0.5)).at[6].set(np.sqrt(0.5))
    quarter = [0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
    assert_close(quadrotor.rotation(left), quarter, atol=1e-6)
    long = quadrotor.project(x.at[3:7].set(jnp.array([3.0, 0.0, 4.0, 0.0])))
    assert_close(long[3:7], [0.6, 0.0, 0.8, 0.0], rtol=1e-6)
    gradient = jax.jit(jax.jacobian(quadrotor.project))(jnp.zeros(13))
    assert np.all(np.isfinite(gradient))


def test_a_quadrotor_is_regulated_about_hover(key):
    """From either quaternion of an attitude, on what is controllable: 12 of 13."""
    env = dlx.make("quadrotor")
    quadrotor = env.dynamics.system
    hover = dlx.linearize(env.dynamics)
    A, B = np.asarray(hover.A), np.asarray(hover.B)
    blocks = [B]
    for _ in range(12):
        blocks.append(A @ blocks[-1])
    reach = np.concatenate([b / np.linalg.norm(b) for b in blocks], axis=1)
    assert np.linalg.matrix_rank(reach, tol=1e-9) == 12
    regulator = dlx.controllers.LQR(
        hover, jnp.eye(13), jnp.eye(4), difference=quadrotor.difference
    )
    x0 = quadrotor.project(env.reset(key))
    x0 = x0.at[:3].set(jnp.array([1.0, -1.0, 0.5]))
    other = x0.at[3:7].multiply(-1.0)
    run = lambda x0: dlx.rollout(env, regulator, key=key, x0=x0, horizon=750)
    one, two = run(x0), run(other)
    target, _ = quadrotor.equilibrium()
    assert_close(one.states[-1], target, atol=1e-3)
    assert_close(two.controls, one.controls, atol=1e-9)
    lengths = np.linalg.norm(np.asarray(one.states)[:, 3:7], axis=1)
    assert_close(lengths, np.ones(751), rtol=1e-14)


def test_the_bicycles_agree_at_low_speed():
    """With stiff tyres and no haste, forces keep a car on the circle of geometry."""
    rolling = s.KinematicBicycle(1.1, 1.58)
    slow, turn = 3.0, 0.05
    # The speed of the one is along its course, of the other along its axis.
    tangent = 1.58 / 2.68 * np.tan(turn)
    pace = slow * np.sqrt(1 + tangent**2)
    rate = field(rolling, [0, 0, 0, pace], [0, turn])[2]
    assert_close(rate, slow * np.tan(turn) / 2.68, rtol=1e-5)
    sliding = s.DynamicBicycle(standstill=0.01)
    dynamics = dlx.Discretized(sliding, 0.01, substeps=4)
    x0 = jnp.zeros(6).at[3].set(slow)
    end = dlx.open_loop(dynamics, x0, jnp.tile(jnp.array([0.0, turn]), (60, 1)))[-1]
    assert_close(end[5] / end[3], rate / slow, rtol=0.01)
    assert_close(end[4] / end[3], tangent, rtol=0.05)


@pytest.mark.parametrize(
    "call, match",
    [
        (lambda: s.Reacher(mass_1=0.0), "Reacher: mass_1 must be positive"),
        (lambda: s.Quadrotor(inertia_z=-1.0), "inertia_z must be positive"),
        (lambda: s.KinematicBicycle(front=0.0), "front must be positive"),
        (lambda: s.DynamicBicycle(standstill=0.0), "standstill must be positive"),
        (lambda: s.ConstantWind(float("nan")), "ConstantWind: strength must be finite"),
    ],
)
def test_bad_constants(call, match):
    with user_error(match=match):
        call()
