from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    assert_close,
    needs_x64,
    once,
    tolerance,
    user_error,
)
from jaxtyping import Array

import delucax as dlx


A = jnp.array([[1.0, 1.0], [0.0, 1.0]])
B = jnp.array([[0.0], [1.0]])
Q, R = jnp.eye(2), jnp.eye(1)


def test_gain_and_cost_to_go(key):
    regulator = dlx.controllers.LQR(dlx.LinearDynamics(A, B), Q, R)
    assert_close(regulator.K, [[0.42208244, 1.24392885]], rtol=1e-5)
    env = dlx.make("lds", A=A, B=B)
    x0 = jnp.array([1.0, -2.0])
    run = dlx.rollout(env, regulator, key=key, x0=x0, horizon=100)
    assert_close(run.total_cost, x0 @ regulator.P @ x0, rtol=tolerance(1e-5, 1e-12))


@needs_x64
def test_no_neighbouring_gain_is_better(key):
    env = dlx.make("lds", A=A, B=B)
    regulator = dlx.controllers.LQR(env.dynamics, Q, R)

    def cost(K):
        controller = eqx.tree_at(lambda c: c.K, regulator, K)
        x0 = jnp.array([[1.0, 0.0], [0.0, 1.0]])
        run = lambda x: dlx.rollout(env, controller, key=key, x0=x, horizon=60)
        return jnp.sum(jax.vmap(lambda x: run(x).total_cost)(x0))

    assert_close(cost(regulator.K), jnp.trace(regulator.P), rtol=1e-5)
    gradient = jax.grad(cost)(regulator.K)
    assert_close(gradient, np.zeros((1, 2)), atol=1e-9)


def test_cross_weight():
    # x'Qx + 2x'Su + u'Ru with v = u + R^-1 S'x is the plain problem of v.
    S = jnp.array([[0.2], [-0.3]])
    cross = dlx.controllers.LQR(dlx.LinearDynamics(A, B), Q, R, S)
    plain = dlx.controllers.LQR(dlx.LinearDynamics(A - B @ S.T, B), Q - S @ S.T, R)
    assert_close(cross.K, plain.K + S.T, atol=tolerance(1e-5, 1e-12))
    assert_close(cross.P, plain.P, rtol=tolerance(1e-4, 1e-12))


def test_holds_an_operating_point(key):
    # A cart against a constant headwind rests only under a constant push.
    def field(t, x, u, w):
        return jnp.stack([x[1], u[0] - 3.0 - x[1]])

    system = dlx.system(field, states=("position", "velocity"), controls=("push",))
    dynamics = dlx.Discretized(system, dt=0.1)
    x, u = jnp.array([2.0, 0.0]), jnp.array([3.0])
    regulator = dlx.controllers.LQR(dlx.linearize(dynamics, 0.0, x, u), Q, R)
    env = dlx.Environment(dynamics, dlx.costs.Quadratic(Q, R))
    run = dlx.rollout(env, regulator, key=key, x0=jnp.zeros(2), horizon=200)
    assert_close(run.final_state, x, atol=1e-4)
    assert_close(run.controls[-1], u, atol=1e-3)


@once
def test_angles_wrap():
    env = dlx.make("pendulum")
    upright = dlx.linearize(env.dynamics)
    difference = env.dynamics.difference
    wrapped = dlx.controllers.LQR(upright, Q, R, difference=difference)
    plain = dlx.controllers.LQR(upright, Q, R)
    near, far = jnp.array([0.1, 0.0]), jnp.array([0.1 + 4 * np.pi, 0.0])
    u, _ = wrapped(0.0, near, None)
    assert_close(wrapped(0.0, far, None)[0], u, rtol=1e-4)
    assert_close(plain(0.0, near, None)[0], u, rtol=1e-6)
    assert abs(plain(0.0, far, None)[0][0] - u[0]) > 10


@needs_x64
def test_inside_jit_and_vmap(key):
    env = dlx.make("pendulum")
    x0 = jnp.array([0.2, 0.0])

    @eqx.filter_jit
    @jax.vmap
    def costs(length):
        plant = dlx.replace(env, {"dynamics.system.length": length})
        regulator = dlx.controllers.LQR(dlx.linearize(plant.dynamics), Q, R)
        return dlx.rollout(plant, regulator, key=key, x0=x0, horizon=50).total_cost

    lengths = jnp.array([0.8, 1.0])
    one = dlx.controllers.LQR(dlx.linearize(env.dynamics), Q, R)
    alone = dlx.rollout(env, one, key=key, x0=x0, horizon=50).total_cost
    assert_close(costs(lengths)[1], alone, rtol=1e-11)


@once
def test_no_stabilising_gain():
    unstable = dlx.LinearDynamics(2 * jnp.eye(2), B)
    with pytest.raises(RuntimeError, match="stabilis"):
        dlx.controllers.LQR(unstable, Q, R)
    with pytest.raises(eqx.EquinoxRuntimeError, match="stabilis"):
        design = lambda A: dlx.controllers.LQR(dlx.LinearDynamics(A, B), Q, R).K
        eqx.filter_jit(design)(unstable.A)


@once
def test_wrong_arguments():
    dynamics = dlx.LinearDynamics(A, B)
    LQR = dlx.controllers.LQR
    with user_error(match="dynamics must be a LinearD.*linearize.*got LinearSys"):
        LQR(dlx.linearize(dlx.systems.Pendulum()), Q, R)
    varying = dlx.LinearDynamics(jnp.stack([A, A]), B)
    with user_error(match="must be time-invariant, got matrices at 2 times"):
        LQR(varying, Q, R)
    LQR(varying.at(0.0), Q, R)
    with user_error(match=r"must rest at .*residual is 5.0e-01.*delucax.trim"):
        LQR(dlx.LinearDynamics(A, B, x_ref=jnp.ones(2), x_next=jnp.zeros(2)), Q, R)
    with user_error(match="must observe their state.*use `delucax.controllers.LQG`"):
        LQR(dlx.LinearDynamics(A, B, jnp.array([[1.0, 0.0]])), Q, R)
    with user_error(match="must observe their state"):
        LQR(dlx.LinearDynamics(A, B, 2 * jnp.eye(2)), Q, R)
    with user_error(match=r"dare: Q must have shape \(2, 2\)"):
        LQR(dynamics, jnp.eye(3), R)
    with user_error(match=r"dare: Q must be a matrix, got shape \(2,\)"):
        LQR(dynamics, jnp.ones(2), R)
    with user_error(match="the observation must have size 2, got size 3"):
        LQR(dynamics, Q, R)(0.0, jnp.zeros(3), None)


@once
def test_traced_point_that_moves():
    def gain(x_next):
        dynamics = dlx.LinearDynamics(A, B, x_ref=jnp.ones(2), x_next=x_next)
        return dlx.controllers.LQR(dynamics, Q, R).x_ref

    gain = eqx.filter_jit(gain)
    gain(jnp.ones(2))
    with pytest.raises(eqx.EquinoxRuntimeError, match="rest at their operating point"):
        gain(jnp.zeros(2))


class Reactor(dlx.AbstractSystem):
    """A stirred tank, its state in any unit."""

    scale: Array = dlx.parameter()
    state_names: ClassVar = ("c", "T")
    control_names: ClassVar = ("Tc",)

    def vector_field(self, t, x, u, w):
        c, T = x / self.scale
        rate = 7.2e10 * jnp.exp(-8750 / T) * c
        heat = 350 - T + 209.2 * rate + 2.092 * (u[0] - T)
        return self.scale * jnp.stack([1 - c - rate, heat])


@eqx.filter_jit
def linearised(system, dt, x, u):
    return dlx.linearize(dlx.Discretized(system, dt, substeps=2), x=x, u=u)


def reactor(scale, dt, Tc):
    """It at c = 0.5, T = 350."""
    x = scale * np.array([0.5, 350.0])
    return linearised(Reactor(scale), jnp.asarray(dt), x, np.array([Tc]))


@pytest.mark.parametrize("dt", [0.05, 1e-3])
@pytest.mark.parametrize("scale", [1.0, 1e-6, 1e6])
def test_rest_is_relative_to_the_terms(dt, scale):
    # As textbooks give it: what is left is two millionths of the terms. The weights are
    # those of the same problem in other units.
    regulators = (
        lambda linear: dlx.controllers.LQR(linear, Q / scale**2, R),
        lambda linear: dlx.controllers.LQI(
            linear, jnp.eye(3), R, output=jnp.array([[0.0, 1.0]])
        ),
        lambda linear: dlx.controllers.HInfinity(linear, Q, R, gamma=1e6),
    )
    for design in regulators if scale == 1 else regulators[:1]:
        design(reactor(scale, dt, 300.0))
        with user_error(match="must rest at their operating point.*residual is"):
            design(reactor(scale, dt, 301.0))


class Unlike(dlx.AbstractSystem):
    """A pressure in Pa, and a spring."""

    state_names: ClassVar = ("p", "z", "v")
    control_names: ClassVar = ("u", "F")

    def vector_field(self, t, x, u, w):
        p, z, v = x
        return jnp.stack([-10 * (p - 1e5) + u[0], v, -z - v + u[1]])


@pytest.mark.parametrize("dt", [0.05, 1e-3])
def test_states_of_other_sizes_do_not_hide_one_that_moves(dt):
    def design(x, u):
        linear = linearised(Unlike(), jnp.asarray(dt), np.array(x), np.array(u))
        return dlx.controllers.LQR(linear, jnp.eye(3), jnp.eye(2))

    design([1e5, 0.1, 0.0], [0.0, 0.1])
    with user_error(match="must rest at their operating point.*residual is"):
        design([1e5, 0.0, 0.1], [0.0, 0.1])


@once
def test_a_point_that_does_not_fit():
    point = dlx.dynamics.OperatingPoint(
        jnp.zeros(3), jnp.zeros(1), jnp.zeros(3), dlx.RESULTS.successful
    )
    with user_error(match="LQR: dynamics must be an Abs.*point.*lqrd.*got CSTR"):
        dlx.controllers.LQR(dlx.systems.CSTR(), Q, R, point=point)
    dynamics = dlx.Discretized(dlx.systems.CSTR(), dt=0.1)
    with user_error(match=r"LQR: point must have x of shape \(2,\).*got \(3,\)"):
        dlx.controllers.LQR(dynamics, Q, R, point=point)
