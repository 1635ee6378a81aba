"""Physics with a network for what it leaves out, and tables of measurements."""

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pandas as pd
import pytest
from helpers import assert_close, needs_x64, once, user_error

import delucax as dlx
from delucax.training import sysid


@needs_x64
def test_a_network_finds_the_friction_that_physics_leaves_out():
    class Stiction(dlx.systems.AbstractSystemWrapper):
        system: dlx.AbstractSystem

        def vector_field(self, t, x, u, w):
            slope = self.system.vector_field(t, x, u, w)
            return slope.at[1].add(-2.0 * jnp.tanh(3 * x[1]))

    pendulum = lambda **given: dlx.systems.Pendulum(**given)
    solver = diffrax.Midpoint()
    true = dlx.Discretized(Stiction(pendulum(length=1.3)), 0.05, solver)
    controls = 4 * jnp.repeat(jr.normal(jr.key(0), (60, 1)), 5, axis=0)
    states = dlx.open_loop(true, [1.0, 0.0], controls)
    states = states + 0.003 * jr.normal(jr.key(1), states.shape)
    estimation, test = sysid.Record(states, controls, dt=0.05).split(0.7)
    guess = dlx.Discretized(pendulum(), 0.05, solver)
    fitted = sysid.grey_box(
        guess,
        estimation,
        "system.length",
        corrected=["velocity"],
        width=4,
        spreads=[0.3],
        window=30,
        max_steps=12,
        key=jr.key(2),
    )
    assert fitted.spread == 0.3 and fitted.errors[0.3] < 0.5 * fitted.errors[0.0]
    errors = [
        float(jnp.linalg.norm(sysid.validate(model, test).rmse))
        for model in (fitted.physics.model, fitted.model)
    ]
    assert errors[1] < 0.3 * errors[0]
    # The position's derivative is known, and stays what it is.
    x, u = jnp.array([0.4, -1.5]), jnp.zeros(1)
    assert fitted.model.system.vector_field(0.0, x, u, None)[0] == x[1]
    with user_error(match="corrected must be 'angle' or 'velocity', got 'v'"):
        sysid.grey_box(guess, test, "system.length", corrected=["v"], key=jr.key(0))
    with user_error(match=r"share must be between 0 and 1, got 1\.0"):
        sysid.grey_box(guess, test, "system.length", share=1.0, key=jr.key(0))


def test_scales_and_offsets():
    inner = dlx.systems.MassSpringDamper()
    given = dict(control_scale=2.0, control_offset=0.5, output_scale=3.0)
    outer = dlx.systems.Calibrated(inner, **given, output_offset=[1.0, -1.0])
    x, u = jnp.array([0.3, -0.2]), jnp.array([0.7])
    slope = inner.vector_field(0.0, x, 2.0 * u + 0.5, None)
    assert_close(outer.vector_field(0.0, x, u, None), slope)
    assert_close(outer.observe(0.0, x), 3.0 * x + jnp.array([1.0, -1.0]), rtol=1e-6)
    assert outer.state_names == inner.state_names and not outer.observes_state
    with user_error(match=r"output_offset must be a number or have shape \(2,\)"):
        dlx.systems.Calibrated(inner, output_offset=[1.0, 2.0, 3.0])
    with user_error(match="system must have no events"):
        dlx.systems.Calibrated(dlx.systems.BouncingBall())
    grey = dlx.systems.Corrected(inner, 4, size=[0.0, 1.0], key=jax.random.key(0))
    assert_close(
        grey.vector_field(0.0, x, u, None), inner.vector_field(0.0, x, u, None)
    )


LINES = "t,level,pump,run\n0,1,5,a\n0.5,2,4,a\n1,4,5,a\n\n0,3,1,b\n0.7,2,0,b\n"
NAMES = dict(outputs="level", controls="pump", times="t")


@once
def test_tables(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text(LINES)
    first, second = sysid.read_csv(path, **NAMES, by="run")
    assert_close(first.outputs[:, 0], [1, 2, 4])
    assert_close(second.times, [0.0, 0.7], rtol=1e-6)
    whole = pd.read_csv(path)
    again, _ = sysid.from_frame(whole, **NAMES, by="run")
    assert_close(again.controls, first.controls)
    dates = pd.to_datetime("2026-01-01") + pd.to_timedelta([0, 500, 1000], unit="ms")
    dated = sysid.from_frame(whole[:3].assign(t=dates), **NAMES)
    assert_close(dated.times, [0.0, 0.5, 1.0])
    columns = dict(outputs=["level", "t"], controls="pump", dt=0.1)
    assert sysid.from_frame(whole[:3], **columns).outputs.shape == (3, 2)


@once
@pytest.mark.parametrize(
    "text, match",
    [
        (LINES.replace("pump", "valve"), r"run.csv must have a column 'pump', got \["),
        (LINES.replace("2,4,a", "x,4,a"), "got 'x' in line 3, column 'level'"),
        (LINES.replace("4,5,a", "4"), "got '' in line 4, column 'pump'"),
        (LINES, "times must increase, but 0 in row 3 is before 1 in row 2"),
        ("", "must be a text file whose first line names the columns"),
        ("t,level,pump,run\n", "must have rows of numbers below its first line"),
        (LINES.replace("run", "t"), "must have one column 't', got "),
    ],
)
def test_bad_tables(tmp_path, text, match):
    path = tmp_path / "run.csv"
    path.write_text(text)
    with user_error(match=match):
        sysid.read_csv(path, **NAMES)
    with user_error(match="frame must be a data frame or a dictionary of .*got 3"):
        sysid.from_frame(3, **NAMES)
    table = {"level": [1, "a"], "pump": [1, 2], "t": [0, 1]}
    with user_error(match="must have numbers, got .*'a'.* in row 1, column 'level'"):
        sysid.from_frame(table, **NAMES)


def test_numpy_is_enough():
    """A dictionary of columns is a table."""
    table = {"level": np.arange(4.0), "pump": np.ones(4)}
    record = sysid.from_frame(table, outputs="level", controls="pump", dt=0.5)
    assert len(record) == 4


@needs_x64
def test_a_parameter_that_is_zero_has_an_interval():
    """An offset has no size to compare its uncertainty with."""
    rng = np.random.default_rng(5)
    system = dlx.systems.MassSpringDamper()
    u = np.repeat(rng.normal(size=(30, 1)), 5, axis=0)
    x = np.asarray(dlx.open_loop(dlx.Discretized(system, 0.05), [0.5, 0.0], u))
    log = sysid.Record(x + [0.2, 0.0] + 0.01 * rng.normal(size=x.shape), u / 2, dt=0.05)
    rig = dlx.systems.Calibrated(system, output_offset=[0.0, 0.0])
    names = ["system.control_scale", "system.output_offset"]
    options = dict(x0=[0.0, 0.0], level=0.999)
    fit = sysid.physical(dlx.Discretized(rig, 0.05), log, names, **options)
    truth = np.array([2.0, 0.2, 0.0])
    assert np.all(np.asarray(fit.identifiable))
    assert np.all((fit.low < truth) & (truth < fit.high))
    assert np.all(fit.high - fit.low < 0.1) and fit.low[2] < 0 < fit.high[2]
