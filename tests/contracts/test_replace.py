"""What `replace` accepts is what the constructor accepts, for every module."""

import functools
import inspect
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
import pytest
from helpers import as_a_user, once
from hypothesis import given, settings, strategies as st
from systems_catalogue import SYSTEMS

import delucax as dlx
from delucax._paths import path_string


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
    "Window": Case(lambda: d.Window(d.Constant(0.1, size=2), 0.0, 1.0)),
    "FromArray": Case(lambda: d.FromArray(A)),
    "Sequence of a reference": Case(lambda: dlx.references.Sequence(A, 0.1)),
    "UniformState": Case(lambda: dlx.environments.UniformState([0.0, 1.0], [2.0, 3.0])),
    "Linear": Case(lambda: dlx.controllers.Linear(A)),
    "Random": Case(lambda: dlx.controllers.Random([0.1, 0.2])),
    "Sequence": Case(lambda: dlx.controllers.Sequence(A)),
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
