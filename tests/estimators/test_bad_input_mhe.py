"""Invalid arguments of moving-horizon estimation."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import once, user_error

import delucax as dlx


pytestmark = once
c = dlx.estimators
PENDULUM = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05)


def mhe(dynamics=PENDULUM, W=1e-4, V=1e-2, window=4, **options):
    square = lambda a: a * np.eye(2) if np.ndim(a) == 0 else np.array(a)
    return c.MHE(dynamics, square(W), square(V), window, **options)


WALK = c.RandomWalk(0.1)


@pytest.mark.parametrize(
    "options, match",
    [
        (dict(dynamics=dlx.systems.Pendulum()), "dynamics must be an AbstractDyn"),
        (dict(W=np.eye(3)), r"W must have shape \(2, 2\)"),
        (dict(V=np.eye(1)), r"V must have shape \(2, 2\)"),
        (dict(W=-1.0), "W must be positive semidefinite"),
        (dict(V=np.nan), "V must be finite"),
        (dict(mean=[0.0]), r"mean must have shape \(2,\)"),
        (dict(mean=[0.0, np.nan]), "mean must be finite"),
        (dict(covariance=[[1.0, 2.0], [2.0, 1.0]]), "covariance must be positive semi"),
        (dict(covariance=np.eye(3)), r"covariance must have shape \(2, 2\)"),
        (dict(window=0), "window must be a whole number of at least 1"),
        (dict(window=2.5), "window must be a whole number"),
        (dict(iterations=0), "iterations must be a whole number"),
        (dict(bounds=(1.0, 0.0)), "bounds must have low <= high"),
        (dict(bounds=1.0), "bounds must be a pair"),
        (dict(bounds=(np.zeros(3), 1.0)), r"bounds must .* shape \(2,\)"),
        (dict(bounds=(np.nan, 1.0)), "bounds must have low <= high"),
        (dict(disturbance_bounds=(0.1, -0.1)), "disturbance_bounds must have low"),
        (dict(robust=0.0), "robust"),
        (dict(robust=2.0, V=[[1.0, 0.0], [0.0, 0.0]]), "V must be .* with robust"),
        (dict(parameters=["system.length"]), "parameters must be a dictionary"),
        (dict(parameters={"system.length": 0.1}), "parameters must be a dictionary"),
        (dict(parameters={"system.lenght": WALK}), "parameters: .* 'lenght'.*length"),
        (
            dict(parameters={"solver": WALK}),
            "parameters names 'solver', .* start",
        ),
        (
            dict(parameters={"system.length": c.RandomWalk([0.1, 0.1])}),
            r"variance of parameters\['system.length'\]",
        ),
        (dict(observation_difference=1.0), "observation_difference must be a function"),
    ],
)
def test_a_wrong_argument(options, match):
    with user_error(match=match):
        mhe(**options)


def test_a_parameter_that_is_not_a_number():
    broken = eqx.tree_at(lambda d: d.system.length, PENDULUM, jnp.array(jnp.nan))
    with user_error(match="system.length.*start value.* must be finite"):
        mhe(broken, parameters={"system.length": WALK})


@pytest.mark.parametrize(
    "arguments, match",
    [
        ((-0.1,), "variance must be at least 0"),
        ((np.nan,), "variance"),
        ((0.1, -1.0), "step must be at least 0"),
        ((0.1, np.inf), "step must be finite"),
        ((0.1, 0.0, (1.0, 0.0)), "bounds must have low <= high"),
    ],
)
def test_a_wrong_walk(arguments, match):
    with user_error(match=match):
        c.RandomWalk(*arguments)


def test_a_wrong_record():
    ys = np.zeros((3, 2))
    with user_error(match="window must be at most the 3 observations .* got 4"):
        c.run_estimator(mhe(), ys)
    with user_error(match=r"observations must have shape \(steps, 2\)"):
        c.run_estimator(mhe(), np.zeros((5, 3)))
    with user_error(match="observations must be finite"):
        c.run_estimator(mhe(window=3), np.full((3, 2), np.nan))
    with user_error(match=r"controls must have shape \(3, 1\)"):
        c.run_estimator(mhe(window=3), ys, np.zeros((2, 1)))
    with user_error(match="estimator must be an AbstractEstimator"):
        c.run_estimator(PENDULUM, ys)


def test_a_replacement_is_checked():
    with user_error(match="covariance must be positive semidefinite"):
        dlx.replace(mhe(), {"covariance": -np.eye(2)})
    walked = mhe(parameters={"system.length": WALK})
    with user_error(match="variance"):
        dlx.replace(walked, {"parameters.system.length.variance": -1.0})
