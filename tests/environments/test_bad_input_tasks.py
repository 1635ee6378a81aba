import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import once, user_error

import delucax as dlx
from delucax.environments import _registry


pytestmark = once


def environment(**arguments):
    dynamics = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05)
    return dlx.Environment(dynamics, dlx.costs.PendulumCost(), **arguments)


def step(**arguments):
    return environment(**arguments).step(0.0, jnp.zeros(2), jnp.zeros(1))


def of_another_kind():
    dlx.register("tests/system", "delucax.systems:Pendulum")
    return dlx.make("tests/system")


BOX = dlx.environments.UniformState(-jnp.ones(2), jnp.ones(2))


@pytest.mark.parametrize(
    "call, match",
    [
        (lambda: dlx.make("pendulum").reset(0), "reset: key must be .*got 0"),
        (lambda: BOX(0), "UniformState: key must be one random key.*got 0"),
        (lambda: environment(initial_state=[np.nan, 0]), "initial_state must be fin"),
        (
            lambda: step(terminated=lambda t, x: x[0]),
            r"terminated must return one boolean, got shape \(\) and dtype float",
        ),
        (
            lambda: step(terminated=lambda t, x: x > 0),
            r"terminated must return one boolean, got shape \(2,\)",
        ),
        (
            lambda: environment(encode=lambda y: y[0]).feature_size,
            r"encode must return a vector, got an array of shape \(\)",
        ),
        (
            lambda: environment(control_bounds=(jnp.zeros(2), jnp.ones(2))),
            r"control_bounds must be numbers or have shape \(1,\), got \(2,\)",
        ),
        (
            lambda: dlx.environments.UniformState(jnp.ones(2), jnp.ones(3)),
            r"UniformState: low and high must be numbers or have shape \(2,\)",
        ),
        (
            lambda: dlx.make("pendulum", lenght=1.2),
            "pendulum: no argument is called 'lenght'; did you mean 'length'",
        ),
        (
            lambda: dlx.make("lds", key=jax.random.key(0), horizn=3),
            r"lds: no argument is called 'horizn'; did you mean 'horizon'\?",
        ),
        (of_another_kind, "'tests/system' must be an Environment, .*returned Pendulum"),
        (lambda: dlx.make("pendulum", dt="0.1"), "dt must be positive.*got '0.1'"),
        (lambda: dlx.make("pendulum", dt=jnp.ones(2)), r"dt must be a number.*\(2,\)"),
    ],
)
def test_bad_input(call, match):
    with user_error(match=match):
        call()


@pytest.mark.parametrize(
    "call, match",
    [
        (lambda: dlx.make(["pendulum"]), r"no task is called \['pendulum'\]"),
        (lambda: dlx.make("pendulum", max_torque=-1.0), "pendulum: max_torque must be"),
        (lambda: dlx.replace(dlx.make("pendulum"), "x"), "replace: changes must be"),
        (
            lambda: dlx.randomise(dlx.make("pendulum"), jax.random.key(0), ["x"]),
            "randomise: ranges must be",
        ),
        (
            lambda: dlx.rollout(
                dlx.make("pendulum"),
                dlx.controllers.Zero(1),
                key=jax.random.key(0),
                keep=None,
            ),
            "rollout: keep must be",
        ),
        (
            lambda: dlx.disturbances.Gaussian(1.0, size=1.5),
            "Gaussian: size must be a whole number",
        ),
    ],
)
def test_wrong_kinds(call, match):
    with user_error(match=match):
        call()


def test_what_is_registered_must_be_there(monkeypatch):
    monkeypatch.setattr(_registry, "_REGISTRY", {"nowhere": "no.such.module:task"})
    with user_error(match="'nowhere' is registered as 'no.such.module:task'"):
        dlx.make("nowhere")
