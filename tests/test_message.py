"""What error messages say of values."""

import jax.numpy as jnp
import numpy as np
import pandas
import pytest
from helpers import as_a_user, once
from hypothesis import given, settings, strategies as st

import delucax as dlx
from delucax._message import shortened


TABLE = pandas.DataFrame(np.arange(400.0).reshape(200, 2), columns=["x", "v"])
QUADRATIC = dlx.costs.Quadratic
PLANT = dlx.LinearDynamics(np.eye(2), np.ones((2, 1)))
ENV = dlx.Environment(PLANT, QUADRATIC(np.eye(2), np.eye(1)))

DOORS = {
    "A": lambda value: dlx.LinearDynamics(value, np.ones((2, 1))),
    "x0": lambda value: dlx.open_loop(PLANT, value, jnp.zeros((3, 1))),
    "controls": lambda value: dlx.open_loop(PLANT, jnp.zeros(2), value),
    "Q": lambda value: QUADRATIC(value, np.eye(1)),
    "outputs": lambda value: dlx.training.sysid.Record(value, jnp.zeros(3), dt=1.0),
    "length": lambda value: dlx.systems.Pendulum(length=value),
    "dt": lambda value: dlx.Discretized(dlx.systems.Pendulum(), value),
    r"x \(the state\)": lambda value: dlx.linearize(PLANT, x=value, u=[0.0]),
}


@once
@pytest.mark.parametrize("name", DOORS)
@pytest.mark.parametrize("table", [TABLE, TABLE["x"]], ids=["table", "column"])
def test_a_table_is_refused_in_a_line(name, table):
    kind = type(table).__name__
    match = rf"{name} must .*got a {kind} \(`.to_numpy\(\)`"
    with as_a_user(), pytest.raises(ValueError, match=match) as raised:
        DOORS[name](table)
    assert len(str(raised.value)) < 300


@once
@pytest.mark.parametrize("name", DOORS)
def test_a_list_of_words_is_refused_in_a_line(name):
    with pytest.raises(ValueError, match=f"{name} must ") as raised:
        DOORS[name]([["position", "velocity"]] * 200)
    assert len(str(raised.value)) < 400


@once
@given(st.recursive(st.text() | st.floats(), st.lists, max_leaves=200))
@settings(max_examples=50, deadline=None, database=None)
def test_no_value_is_shown_at_length(value):
    text = shortened(value)
    assert len(text) < 160 and (len(repr(value)) > 120 or text == repr(value))
    big = np.zeros((20, 30))
    assert shortened(big) == "an array of shape (20, 30) and dtype float64"
    assert shortened(np.array([1.0, np.nan])) == "[ 1. nan]"
