"""Slips in what the loops are given, and in what a controller answers."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import once, user_error

import delucax as dlx


pytestmark = once


PENDULUM = dlx.systems.Pendulum()
FEEDBACK = dlx.controllers.Linear(jnp.array([[20.0, 5.0]]))


class Slip(dlx.AbstractController):
    kind: str = eqx.field(static=True)

    def init(self, *, key=None):
        return {
            "dtype": jnp.zeros((), jnp.int32),
            "shape": {"seen": jnp.zeros(2)},
            "number": 0,
            "structure": (jnp.zeros(1),),
        }.get(self.kind)

    def __call__(self, t, y, state):
        u = jnp.zeros(1, y.dtype)
        if self.kind == "alone":
            return u
        if self.kind == "shape":
            return u, {"seen": jnp.append(state["seen"], y[0])}
        return u, {} if self.kind == "structure" else state + y[0]


class Rise(dlx.AbstractController):
    """Numbers whose dtype follows from what they meet, and what stays as it was."""

    def init(self, *, key=None):
        return jnp.asarray(0.0), "name", jnp.tanh

    def __call__(self, t, y, state):
        total, name, function = state
        return jnp.zeros(1, y.dtype), (total + y[0], name, function)


def rollout(controller=FEEDBACK, **arguments):
    arguments = dict(key=jax.random.key(0), horizon=3) | arguments
    return dlx.rollout(dlx.make("pendulum"), controller, **arguments)


def simulate(controller=FEEDBACK, **arguments):
    x0 = jnp.array([0.1, 0.0])
    return dlx.simulate(PENDULUM, controller, 0.0, 0.3, x0, dt=0.1, **arguments)


@pytest.mark.parametrize("run", [rollout, simulate])
@pytest.mark.parametrize(
    "kind, match",
    [
        ("alone", r"__call__ must return \(u, state\).*got an array of shape \(1,\)"),
        ("dtype", r"state must keep .*i32\[\], got f\d\d\[\]"),
        ("shape", r"state\['seen'\] must keep .*\[2\], got f\d\d\[3\]"),
        ("number", "state must keep .*, 0, got .*JAX arrays for all that changes"),
        ("structure", r"state must keep the structure.*\(f\d\d\[1\],\), got \{\}"),
    ],
)
def test_a_slip_of_a_controller(run, kind, match):
    with user_error(match=f"Slip: {match}"):
        run(Slip(kind))


def test_continuous_feedback_without_its_state():
    with user_error(match=r"Slip: __call__ must return \(u, state\)"):
        simulate(Slip("alone"), hold=None)


def test_one_solve_refuses_to_teach_by_costs():
    class Bandit(dlx.controllers.Zero):
        learns_from_cost = True

    pendulum, x0 = dlx.systems.Pendulum(), jnp.zeros(2)
    with user_error(match="simulate: Bandit learns from the cost.*rollout"):
        dlx.simulate(pendulum, Bandit(1), 0.0, 1.0, x0, dt=0.1)


@pytest.mark.parametrize("run", [rollout, simulate])
def test_states_that_are_well_made(run):
    assert run(Rise()).states.shape == (4, 2)


@pytest.mark.parametrize(
    "run, match",
    [
        (lambda: simulate(key=0), "simulate: key must be one random key.*got 0"),
        (lambda: rollout(w=np.full((3, 2), np.nan)), "w must be finite"),
        (lambda: rollout(w="wind"), r"w must have shape \(3, 2\), .*got 'wind'"),
        (lambda: rollout(gradient_decay=np.nan), "gradient_decay must be finite"),
        (lambda: rollout(gradient_decay="x"), "gradient_decay must be a number"),
        (lambda: rollout(gradient_decay=[0.9]), "gradient_decay must be a number"),
        (
            lambda: dlx.simulate(
                PENDULUM, np.full((3, 1), np.inf), 0.0, 0.3, jnp.zeros(2)
            ),
            "controller_or_controls must be finite",
        ),
        (
            lambda: dlx.rollout(
                dlx.make("pendulum"), FEEDBACK, key=jax.random.key(0), throw="no"
            ),
            "rollout: throw must be True or False, got 'no'",
        ),
        (
            lambda: dlx.simulate(
                PENDULUM, np.zeros((3, 1)), 0.0, 0.3, jnp.zeros(2), throw="no"
            ),
            "simulate: throw must be True or False, got 'no'",
        ),
    ],
)
def test_bad_input(run, match):
    with user_error(match=match):
        run()


def test_constants_with_a_batch_axis():
    heavy = dlx.make("pendulum", mass=jnp.ones(3))
    with user_error(match=r"shapes \(2, 3\).*batch axis.*jax.vmap"):
        dlx.rollout(heavy, FEEDBACK, key=jax.random.key(0))


class Rows(dlx.disturbances.AbstractDisturbance):
    size: int = eqx.field(static=True, default=2)

    def sequence(self, key, times):
        return [[0.0, 0.0]] * len(times)


def test_a_sequence_that_is_no_array():
    env = dlx.make("pendulum")
    env = dlx.Environment(env.dynamics, env.cost, disturbance=Rows())
    with user_error(match=r"Rows: sequence must return an array.*got a list"):
        dlx.rollout(env, FEEDBACK, key=jax.random.key(0))
