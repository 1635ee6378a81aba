"""Operating points."""

import control
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    assert_close,
    assert_gradient,
    needs_x64,
    once,
    tolerance,
    user_error,
)
from hypothesis import given, settings, strategies as st
from jaxtyping import Array

import delucax as dlx


class Reactor(dlx.AbstractSystem):
    """A stirred tank with a cooling jacket."""

    state_names = ("c", "T")
    control_names = ("Tc",)
    k0: Array = dlx.parameter(7.2e10)
    UA: Array = dlx.parameter(2.092)

    def vector_field(self, t, x, u, w):
        c, T = x
        rate = self.k0 * jnp.exp(-8750 / T) * c
        heat = 350 - T + 209.2 * rate + self.UA * (u[0] - T)
        return jnp.stack([1 - c - rate, heat])


class Attitude(dlx.AbstractSystem):
    """A thrust along the axis of a planar craft whose attitude is a unit vector."""

    state_names = ("v", "rate", "cos", "sin")
    control_names = ("thrust", "torque")

    def vector_field(self, t, x, u, w):
        v, rate, cos, sin = x
        del v
        return jnp.stack([u[0] * cos - 9.81, u[1], -sin * rate, cos * rate])

    def project(self, x):
        return x.at[2:].divide(jnp.linalg.norm(x[2:]))


GUESS = dict(x=jnp.array([0.5, 350.0]), u=jnp.array([300.0]))


@needs_x64
@pytest.mark.parametrize("fix, output", [("Tc", []), ("T", [350.0])])
def test_point_is_that_of_python_control(fix, output):
    def rhs(t, x, u, params):
        return np.asarray(Reactor().vector_field(t, x, u, None))

    system = control.NonlinearIOSystem(
        rhs, lambda t, x, u, params: x[1:], inputs=["Tc"], states=2, outputs=["T"]
    )
    # With an output that is asked for the control is free.
    wanted = [output] if output else []
    x, u = control.find_operating_point(system, GUESS["x"], GUESS["u"], *wanted)
    point = dlx.trim(Reactor(), **GUESS, fix=fix)
    assert_close(point.x, x, rtol=1e-5)
    assert_close(point.u, u, rtol=1e-5)
    assert_close(rhs(0.0, point.x, point.u, {}), 0, atol=1e-10)


@needs_x64
@given(st.floats(0.1, 0.9))
@settings(max_examples=10, deadline=None)
def test_a_value_that_is_given_is_held(c):
    point = dlx.trim(Reactor(), **GUESS, fix={"c": c})
    assert point.result == dlx.RESULTS.successful
    assert float(point.x[0]) == np.asarray(c, point.x.dtype)
    # From the two equations by hand.
    T = 8750 / np.log(7.2e10 * c / (1 - c))
    Tc = T - (350 - T + 209.2 * (1 - c)) / 2.092
    tight = 1e-10
    assert_close(point.x[1], T, rtol=tight)
    assert_close(point.u[0], Tc, rtol=tight)


@needs_x64
def test_more_unknowns_than_equations_change_least():
    # x_next = x where 0.1 x0 = 0.1 x1 and 0.2 x1 = u: a line, at (s, s, 0.2 s).
    A, B = jnp.array([[0.9, 0.1], [0.0, 0.8]]), jnp.array([[0.0], [1.0]])
    guess = jnp.array([1.0, 2.0, 0.5])
    point = dlx.trim(dlx.LinearDynamics(A, B), x=guess[:2], u=guess[2:])
    along, unit = np.array([1.0, 1.0, 0.2]), np.asarray(guess)
    scaled = along / unit
    s = scaled @ (guess / unit) / (scaled @ scaled)
    assert_close(jnp.concatenate([point.x, point.u]), s * along, rtol=1e-10)


@once
def test_what_nothing_tells_stays_at_the_guess():
    # Any position is at rest, and the equations have no full rank.
    dynamics = dlx.Discretized(dlx.systems.DoubleIntegrator(), dt=0.1)
    control_name = dynamics.control_names[0]
    point = dlx.trim(dynamics, x=[3.0, 0.4], u=[0.0], fix=control_name)
    assert_close(point.x, [3.0, 0.0], atol=1e-6)


@once
def test_manifold_of_the_state_is_kept():
    angle = 0.3
    x = jnp.array([0.0, 0.1, jnp.cos(angle), jnp.sin(angle)])
    point = dlx.trim(Attitude(), x=x, u=jnp.array([8.0, 0.1]))
    assert_close(jnp.linalg.norm(point.x[2:]), 1, rtol=1e-6)
    field = Attitude().vector_field(0.0, point.x, point.u, None)
    assert_close(field, 0, atol=1e-4)
    assert_close(point.residual, field, atol=1e-4)


@once
def test_what_is_no_equilibrium_says_so():
    case = dict(x=[0.9, 320.0], u=[300.0], fix=("T", "Tc"))
    point = dlx.trim(Reactor(), **case, throw=False)
    assert point.result == dlx.RESULTS.no_equilibrium
    # The nearest to rest of all c, which is the only unknown.
    assert float(jnp.abs(point.residual).max()) > 1
    with pytest.raises(RuntimeError, match="^trim: There is no equilibrium.*residual"):
        dlx.trim(Reactor(), **case)

    cold = dlx.trim(Reactor(), x=[0.5, 0.0], u=[300.0], fix="Tc", throw=False)
    assert cold.result == dlx.RESULTS.diverged


SCALED = {
    "reactor": (Reactor(), (0.5, 340.0), (299.0,), "Tc"),
    "tanks": (dlx.systems.TwoTank(), (9.0, 8.0), (25.0,), "flow"),
}


class Scaled(dlx.AbstractSystem):
    """A plant whose state is in a unit of `1 / scale`."""

    state_names: tuple[str, ...] = eqx.field(static=True)
    control_names: tuple[str, ...] = eqx.field(static=True)
    system: dlx.AbstractSystem
    scale: Array = dlx.parameter()

    def vector_field(self, t, x, u, w):
        return self.scale * self.system.vector_field(t, x / self.scale, u, w)


def in_units(name, scale):
    """A plant in another unit, and a guess for it."""
    system, x, u, fix = SCALED[name]
    scaled = Scaled(system.state_names, system.control_names, system, scale)
    return scaled, scale * jnp.array(x), jnp.array(u), fix


@pytest.mark.parametrize(
    "name",
    [pytest.param("reactor", marks=needs_x64), pytest.param("tanks", marks=once)],
)
def test_units_do_not_matter(name):
    tight = tolerance(1e-3, 1e-9)
    plain, x, u, fix = in_units(name, 1.0)
    point = dlx.trim(plain, x=x, u=u, fix=fix)
    for scale in (1e-6, 1e6):
        scaled, x, u, _ = in_units(name, scale)
        found = dlx.trim(scaled, x=x, u=u, fix=fix)
        assert_close(found.x, scale * point.x, rtol=tight)
        # At the guess itself, with nothing else free, it moves.
        others = [*scaled.state_names, *scaled.control_names][1:]
        stuck = dlx.trim(scaled, x=x, u=u, fix=others, throw=False)
        assert stuck.result == dlx.RESULTS.no_equilibrium


@once
def test_a_small_state_beside_a_large_one_is_found():
    field = lambda t, x, u, w: jnp.stack([101325 - x[0] + u[0], 0.03 - x[1]])
    system = dlx.system(field, states=("p", "c"), controls=("u",))
    for guess in (0.03, 0.01, 0.05, 0.1):
        point = dlx.trim(system, x=[101325.0, guess], u=[0.0], fix="u")
        assert_close(point.x, [101325.0, 0.03], rtol=tolerance(1e-6, 1e-13))


@once
def test_a_large_state_does_not_hide_one_that_moves():
    def field(t, x, u, w):
        p, z, v = x
        return jnp.stack([-10 * (p - 1e5) + u[0], v, -z - v + u[1]])

    system = dlx.system(field, states=("p", "z", "v"), controls=("u", "F"))
    guess = dict(x=[1e5, 0.0, 0.1], u=[0.0, 0.1])
    stuck = dlx.trim(system, **guess, fix="v", throw=False)
    assert stuck.result == dlx.RESULTS.no_equilibrium
    assert_close(stuck.residual[1], 0.1, rtol=1e-6)


@once
@pytest.mark.parametrize("angle, root", [(1.5, 0.0), (1.6, np.pi), (-1.6, -np.pi)])
def test_a_neighbouring_root_is_found(angle, root):
    point = dlx.trim(dlx.systems.Pendulum(), x=[angle, 0.0], u=[0.0], fix="torque")
    assert_close(point.x, [root, 0.0], atol=1e-6)


@once
def test_where_the_slope_is_lost():
    class Polynomial(dlx.AbstractSystem):
        state_names = ("x",)
        control_names = ("u",)
        terms: Array = dlx.parameter()

        def vector_field(self, t, x, u, w):
            return self.terms[0] + self.terms[1] * x**2 + self.terms[2] * x**3

    for terms, result in (([1, 1, 0], "no_equilibrium"), ([0, 0, 1], "successful")):
        for guess in (0.0, 0.5):
            system = Polynomial(jnp.array(terms, float))
            point = dlx.trim(system, x=[guess], u=[0.0], fix="u", throw=False)
            assert point.result == getattr(dlx.RESULTS, result)
            assert_close(point.x, [0.0], atol=1e-3)


@once
def test_rest_at_zero_is_told_from_rounding():
    # Newton's method passes zero by ever less, and never meets it.
    point = dlx.trim(dlx.systems.Pendulum(), x=[0.3, 0.1], u=[0.0], fix="torque")
    assert_close(point.x, np.zeros(2))
    dynamics = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05)
    dlx.controllers.LQR(dynamics, jnp.eye(2), jnp.eye(1), point=point)


@once
def test_printed_it_shows_numbers():
    point = dlx.trim(Reactor(), **GUESS, fix={"c": 0.5})
    assert all(part in repr(point) for part in ("350.0", "300.0", "successful"))
    long = jnp.arange(40.0) + 0.123
    assert "39.123" in repr(eqx.tree_at(lambda p: p.residual, point, long))
    batch = jax.vmap(lambda c: dlx.trim(Reactor(), **GUESS, fix={"c": c}, throw=False))
    assert "successful: 2 of 2" in repr(batch(jnp.array([0.4, 0.5])))
    traced = []
    point = lambda c: dlx.trim(Reactor(), **GUESS, fix={"c": c})
    jax.eval_shape(lambda c: traced.append(repr(point(c))), 0.5)
    assert "traced" in traced[0]


@needs_x64
def test_a_task_is_regulated_at_its_operating_point():
    env = dlx.make("cstr", concentration=0.4)
    point = env.trim(fix="concentration")
    x, u = env.dynamics.system.equilibrium(0.4)
    assert_close(np.append(point.x, point.u), np.append(x, u), rtol=1e-10)
    Q, R = jnp.eye(2), jnp.eye(1)
    linear = dlx.linearize(env.dynamics, x=point)
    assert_close(linear.x_ref, point.x)
    regulator = dlx.controllers.LQR(env.dynamics, Q, R, point=point)
    assert_close(regulator.K, dlx.controllers.LQR(linear, Q, R).K)
    assert_close(regulator.u_ref, point.u)
    sampled = dlx.controllers.lqrd(env.dynamics.system, Q, R, 0.05, point=point)
    assert_close(sampled.x_ref, point.x)
    with user_error(match="LQR: point must be an OperatingPoint.*delucax.trim"):
        dlx.controllers.LQR(env.dynamics, Q, R, point=point.x)
    with user_error(match="linearize: u must be left out"):
        dlx.linearize(env.dynamics, x=point, u=point.u)


@needs_x64
@pytest.mark.parametrize("fix", ["nothing", "c", "T and Tc"])
def test_derivatives_are_those_of_finite_differences(fix):
    """Where many points are at rest, one is, and none."""
    weights = jnp.array([1.0, 0.7 / 350, -0.4 / 300])

    def point(relative):
        k0, UA, c, T, Tc = relative * jnp.array([1.0, 2.092, 0.45, 352.0, 299.0])
        system, x, u = Reactor(7.2e10 * k0, UA), jnp.stack([c, T]), jnp.stack([Tc])
        held = {"nothing": (), "c": {"c": c}, "T and Tc": ("T", "Tc")}[fix]
        found = dlx.trim(system, x=x, u=u, fix=held, throw=False)
        return weights @ jnp.concatenate([found.x, found.u])

    assert_gradient(point, np.ones(5), step=1e-5, rtol=1e-7, atol=1e-7)


@once
def test_bad_input():
    with user_error(match="fix must name states and controls.*none is named 'k0'"):
        dlx.trim(Reactor(), **GUESS, fix="k0")
    with user_error(match="fix must leave a state or a control free"):
        dlx.trim(Reactor(), **GUESS, fix=("c", "T", "Tc"))
    with user_error(match="fix must be a name, several names or a dictionary"):
        dlx.trim(Reactor(), **GUESS, fix=2)
    with user_error(match=r"fix\['c'\] must be a number"):
        dlx.trim(Reactor(), **GUESS, fix={"c": [0.5, 0.5]})
    with user_error(match="x \\(the state\\) must have shape"):
        dlx.trim(Reactor(), x=[0.5], u=[300.0])
    with user_error(match="trim: x \\(the state\\) must be finite"):
        dlx.trim(Reactor(), x=[0.5, np.nan], u=[300.0])
    with user_error(match="trim: u \\(the control\\) must be finite"):
        dlx.trim(Reactor(), x=[0.5, 350.0], u=[np.nan])
    for t in (np.nan, "a"):
        with user_error(match="trim: t must be"):
            dlx.trim(Reactor(), t, **GUESS)
    with user_error(match="no equilibrium"):
        dlx.trim(Reactor())
    with user_error(match="model must be an AbstractSystem or AbstractDynamics"):
        dlx.trim(dlx.make("pendulum"))
