"""What `replace` accepts is what the constructor accepts, for every module."""

import functools
import inspect
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
import pytest
from helpers import as_a_user, once, user_error
from hypothesis import given, settings, strategies as st
from systems_catalogue import SYSTEMS

import delucax as dlx
from delucax._module import path_string


c, d = dlx.costs, dlx.disturbances
A, B = np.array([[1.0, 0.1], [0.0, 0.9]]), np.array([[0.0], [0.1]])


class Case(NamedTuple):
    """`make` makes the module; `names` are the arguments that have a field of another
    name."""

    make: Any
    names: dict[str, str] = {}


WEIGHTS = dict(names={"final": "Qf"})
CASES = {
    "LinearDynamics": Case(lambda: dlx.LinearDynamics(A, B, C=A, E=B, dt=0.1)),
    "Discretized": Case(lambda: dlx.Discretized(dlx.systems.Pendulum(), 0.1)),
    "WorstCase": Case(
        lambda: dlx.dynamics.WorstCase(dlx.LinearDynamics(A, B), A, bound=1.0)
    ),
    "Quadratic": Case(lambda: c.Quadratic(A @ A.T, np.ones(1), A @ A.T), **WEIGHTS),
    "Quadratic about a point": Case(
        lambda: c.Quadratic(np.ones(2), np.ones(1), None, np.ones(2), np.ones(1)),
        **WEIGHTS,
    ),
    "Tracking": Case(
        lambda: c.Tracking(A @ A.T, np.ones(1), dlx.references.Constant(np.ones(2))),
        **WEIGHTS,
    ),
    "Rate": Case(lambda: c.Rate(c.PendulumCost(), 0.1)),
    "Scaled": Case(lambda: 2.0 * c.PendulumCost()),
    "Uniform": Case(lambda: d.Uniform(-1.0, 1.0, size=2)),
    "Uniform in a box": Case(lambda: d.Uniform([-1.0, -2.0], [1.0, 1.0])),
    "Gaussian": Case(lambda: d.Gaussian([0.1, 0.2], 0.3)),
    "RandomWalk": Case(lambda: d.RandomWalk(0.1, [0.2, 0.3])),
    "Constant": Case(lambda: d.Constant([0.1, 0.2])),
    "Sinusoid": Case(lambda: d.Sinusoid([0.1, 0.2], 1.0)),
    "Square": Case(lambda: d.Square([0.1, 0.2], 1.0)),
    "between": Case(lambda: d.Constant(0.1, size=2).between(0.0, 1.0)),
    "FromArray": Case(lambda: d.FromArray(A)),
    "Sequence of a reference": Case(lambda: dlx.references.Sequence(A, 0.1)),
    "UniformState": Case(lambda: dlx.environments.UniformState([0.0, 1.0], [2.0, 3.0])),
    "Linear": Case(lambda: dlx.controllers.Linear(A)),
    "Random": Case(lambda: dlx.controllers.Random([0.1, 0.2])),
    "OpenLoop": Case(lambda: dlx.controllers.OpenLoop(A)),
    "PID": Case(
        lambda: dlx.controllers.PID([1.0, 2.0], 0.1, dt=0.1, anti_windup_time=0.5)
    ),
    "LeakyPID": Case(lambda: dlx.controllers.LeakyPID(1.0, [0.1, 0.2], dt=0.1)),
    "BreathWaveform": Case(dlx.lung.BreathWaveform),
    "Valves": Case(dlx.lung.Valves),
    **{name: Case(case.make) for name, case in SYSTEMS.items() if name[0] in "LMPQ"},
}
for name in ("LinearSystem", "Pendulum"):
    assert name in CASES


@functools.cache
def made(name):
    return CASES[name].make()


def arguments(name):
    """The constructor's arguments as the module has them."""
    module = made(name)
    signature = inspect.signature(type(module)).parameters
    names = CASES[name].names
    return {p: getattr(module, names.get(p, p)) for p in signature}


def leaves(module):
    """`(path, array)` of everything that `replace` can change."""
    flat = jax.tree_util.tree_flatten_with_path(module)[0]
    return [(path_string(p), a) for p, a in flat if eqx.is_inexact_array(a)]


def altered(draw, old):
    """A value near `old`, or one that may not be legal."""
    kind = draw(
        st.sampled_from(["near", "more"] * 3 + ["sign", "nan", "long", "deep", "flat"])
    )
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    near = np.asarray(old) * (1 + 0.3 * rng.uniform(size=np.shape(old)))
    longer = np.concatenate([near.reshape(-1), [1.0]])
    return {
        "near": near,
        "more": 1.5 * np.asarray(old),
        "sign": -near - 0.1,
        "nan": np.where(rng.uniform(size=near.shape) < 0.5, near, np.nan),
        "long": longer,
        "deep": near[..., None],
        "flat": near.reshape(-1)[0],
    }[kind]


def outcome(function):
    try:
        return function()
    except ValueError:
        return None


@once
@pytest.mark.parametrize("name", CASES)
@settings(max_examples=25, deadline=None, database=None)
@given(data=st.data())
def test_replacing_is_constructing_anew(name, data):
    """Any arguments, changed at once: both are refused, or both are the same."""
    module, given = made(name), arguments(name)
    fields = {p: CASES[name].names.get(p, p) for p in given}
    numbers = [p for p in given if eqx.is_inexact_array(given[p])]
    if not numbers:
        return
    chosen = data.draw(st.lists(st.sampled_from(numbers), min_size=1, unique=True))
    values = {p: altered(data.draw, given[p]) for p in chosen}
    with as_a_user():
        made_anew = outcome(lambda: type(module)(**(given | values)))
        changes = {fields[p]: value for p, value in values.items()}
        replaced = outcome(lambda: dlx.replace(module, changes))
    assert (made_anew is None) == (replaced is None), values
    if replaced is not None:
        assert jax.tree.structure(replaced) == jax.tree.structure(made_anew)
        for a, b in zip(
            jax.tree.leaves(replaced), jax.tree.leaves(made_anew), strict=True
        ):
            np.testing.assert_allclose(a, b, rtol=1e-6)


def dynamics(n, m=1):
    return dlx.LinearDynamics(0.9 * np.eye(n), np.ones((n, m)), dt=0.1)


def quadratic(n, m=1):
    return c.Quadratic(np.ones(n), np.ones(m))


PARTS = {
    "MPC": lambda: dlx.controllers.MPC(dynamics(2), quadratic(2), 5),
    "sampling MPC": lambda: dlx.controllers.MPC(
        dynamics(2), quadratic(2), 5, planner=dlx.planning.CEM()
    ),
    "LQR that follows": lambda: dlx.controllers.LQR(
        dynamics(2), np.eye(2), np.eye(1), reference=np.ones(2)
    ),
    "LQI": lambda: dlx.controllers.LQI(
        dynamics(2), np.eye(3), np.eye(1), output=[[1.0, 0.0]], reference=[1.0]
    ),
    "FiniteHorizonLQR": lambda: dlx.controllers.FiniteHorizonLQR(
        dynamics(2), np.eye(2), np.eye(1), horizon=5
    ),
    "HInfinity": lambda: dlx.controllers.HInfinity(dynamics(2), np.eye(2), np.eye(1)),
    "LQG": lambda: dlx.controllers.LQG(
        dynamics(2), np.eye(2), np.eye(1), np.eye(2), np.eye(2)
    ),
    "KalmanFilter": lambda: dlx.estimators.KalmanFilter(
        dynamics(2), np.eye(2), np.eye(2), steady_state=True
    ),
    "Plan": lambda: dlx.planning.ilqr(
        dynamics(2), quadratic(2), np.ones(2), np.zeros((5, 1)), bounds=(-1, 1)
    ),
    "GPC": lambda: dlx.controllers.gpc(
        dynamics(2), quadratic(2), base=dlx.controllers.Linear(A[:1]), memory=3
    ),
}


@functools.cache
def part(name):
    return PARTS[name]()


@once
@pytest.mark.parametrize(
    "name, changes, match",
    [
        ("MPC", {"dynamics": dynamics(3)}, "MPC: cost must fit a state of size 3"),
        ("MPC", {"dynamics": dynamics(3), "cost": quadratic(3)},
            r"MPC: start.states must have shape \(2, 6, 3\), got shape \(2, 6, 2\)"),
        ("MPC", {"dynamics": dynamics(2, 2), "cost": quadratic(2, 2)},
            r"MPC: start.controls must have shape \(2, 5, 2\)"),
        ("MPC", {"dynamics": 5}, "MPC: dynamics must be an AbstractDynamics"),
        ("MPC", {"cost": quadratic(3)}, "MPC: cost must fit a state of size 2"),
        ("MPC", {"cost": 5}, "MPC: cost must be an AbstractCost"),
        ("MPC", {"start.states": None}, "MPC: start.states must .*got none"),
        ("MPC", {"planner": 5}, "MPC: planner must be an AbstractPlanner"),
        ("sampling MPC", {"dynamics": dynamics(3)}, "MPC: cost must fit"),
        ("sampling MPC", {"planner.scale": -1.0}, "CEM: scale must be positive"),
        ("LQR that follows", {"feed_forward.signals.dynamics": dynamics(3)},
            "feed_forward must fit K, for 2 states.*got feed_forward.M"),
        ("LQR that follows", {"feed_forward.signals.reference": lambda t: np.ones(3)},
            "LQR: reference must be a vector of size 2"),
        ("LQI", {"reference": lambda t: np.ones(2)}, "LQI: reference must be a vector"),
        ("LQI", {"dt": -1.0}, "LQI: dt must be positive"),
        ("FiniteHorizonLQR", {"dt": -1.0}, "FiniteHorizonLQR: dt must be positive"),
        ("HInfinity", {"gamma": -1.0}, "HInfinity: gamma must be at least 0"),
        ("LQG", {"regulator.K": np.ones((1, 3)), "regulator.P": np.eye(3),
            "regulator.x_ref": np.ones(3)}, r"regulator.K must have shape \(1, 2\)"),
        ("LQG", {"regulator": dlx.controllers.Linear([[1.0, 2.0]])}, "must be a LQR"),
        ("KalmanFilter", {"dynamics": dynamics(3)}, r"W must have shape \(3, 3\)"),
        ("KalmanFilter",
            {"dynamics": dlx.LinearDynamics(np.stack([A, A]), np.stack([B, B]))},
            "dynamics with steady_state must be time-invariant"),
        ("Plan", {"states": np.ones((7, 2))}, "Plan: shapes must fit each other"),
        ("Plan", {"dt": -1.0}, "Plan: dt must be positive"),
        ("Plan", {"low": [1.0], "high": [-1.0]}, "low <= high"),
        ("Plan", {"low": [1.0, 1.0], "high": [2.0, 2.0]}, "low and high must be"),
        ("GPC",
            {"loop.dynamics": dynamics(3),
             "loop.base": dlx.controllers.Linear(A[:1, [0, 1, 1]])},
            r"response must have shape \(h, 4, 1\)"),
        ("GPC", {"policy.start": np.ones((2, 6))}, "policy must take 6 features"),
        ("GPC", {"cost": lambda t, y, u: y}, "cost must give a scalar"),
    ],
)  # fmt: skip
def test_parts_of_a_controller_must_fit(name, changes, match):
    with user_error(match=match):
        dlx.replace(part(name), changes)


@once
def test_a_plan_can_be_changed():
    plan = dlx.replace(part("Plan"), {"states": np.ones((6, 2)), "low": [-2.0]})
    np.testing.assert_allclose(plan.states, 1.0)
