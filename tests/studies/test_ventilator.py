"""The study as a command: it goes on where it was, and refuses what it should."""

import csv
import json
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, minutes, once, user_error

import delucax as dlx
from delucax import lung, studies
from delucax.__main__ import main
from delucax._module import stack
from delucax.studies.ventilator import _contenders, _simulators
from delucax.studies.ventilator._contenders import (
    best_candidates,
    Contender,
    divergence_note,
    FeedForward,
    Trainer,
    tuned_pids,
)
from delucax.studies.ventilator._report import save_controllers
from delucax.studies.ventilator._simulators import grouped, left_out
from delucax.studies.ventilator._stages import FULL, Stages


pytestmark = once

KEY = jax.random.key(0)


@pytest.fixture
def begun(tmp_path, monkeypatch):
    """A study that was cut off at once."""

    def cut_off(size):
        raise KeyboardInterrupt

    monkeypatch.setattr(_simulators, "explored", cut_off)
    with pytest.raises(KeyboardInterrupt):
        studies.lung_study(tmp_path, small=True, say=lambda line: None)
    return tmp_path


def test_goes_on_where_it_was_cut_off(tmp_path):
    made, said = [], []

    def first():
        made.append("first")
        return jnp.arange(3.0)

    def cut_off(data, *, checkpoint, progress):
        assert data == "data" and not progress
        checkpoint.write_text("half of it")
        raise KeyboardInterrupt

    stages = Stages(tmp_path, {"seeds": 1}, said.append, progress=False)
    stages.stage("first", "One", first)
    with pytest.raises(KeyboardInterrupt):
        stages.training("second", "Two", cut_off, "data")
    again = Stages(tmp_path, {"seeds": 1}, said.append, progress=False)
    assert_close(again.stage("first", "One", first), [0.0, 1.0, 2.0])
    assert made == ["first"] and said[-1].startswith("One: done before")
    # What is left of its training is there to go on from, and gone at its end.
    left = []

    def finish(*, checkpoint, progress):
        left.append((checkpoint, checkpoint.read_text()))
        return 5.0

    assert again.training("second", "Two", finish) == 5.0
    ((checkpoint, text),) = left
    assert text == "half of it" and not checkpoint.exists()


def test_other_settings_are_refused(begun):
    with user_error(match="other settings: seeds is 1 there and 2 here"):
        studies.lung_study(begun, small=True, seeds=2)
    with user_error(match="seeds must be a whole number of at least 1, got 0"):
        studies.lung_study(begun, seeds=0)
    with user_error(match="other settings: sensor_delay is 2 there and 3 here"):
        studies.lung_study(begun, small=True, sensor_delay=3)
    with user_error(match="sensor_delay must be a whole number of at least 0, got -1"):
        studies.lung_study(begun, sensor_delay=-1)


def test_damaged_files_are_refused(begun):
    (begun / "breaths.dlx").write_bytes(b"delucax-file 1 0000\nnonsense")
    with user_error(match=r"breaths.dlx' is damaged"):
        studies.lung_study(begun, small=True)
    (begun / "settings.json").write_text("{")
    with user_error(match=r"settings.json' is damaged"):
        studies.lung_study(begun, small=True)


def test_wrong_data_are_named(tmp_path, capsys):
    path = tmp_path / "train.csv"
    path.write_text("id,breath_id,R,C,time_step,u_in,pressure\n")
    assert main(["lung", "--data", str(path), "--out", str(tmp_path / "out")]) == 2
    assert "row 1: column u_out is missing" in capsys.readouterr().err


def test_breaths_that_are_left_out_are_said(tmp_path, monkeypatch):
    resistance = jnp.where(jnp.arange(16) < 9, 5.0, 50.0)
    zeros = jnp.tile(jnp.arange(16.0)[:, None], (1, 29))
    known = dict(resistance=resistance, compliance=jnp.full(16, 20.0))
    recorded = lung.Breaths(zeros, 0 * zeros, zeros, dt=0.03, **known)
    lungs, breaths = grouped(recorded)
    assert lungs.tolist() == [[5.0, 20.0], [50.0, 20.0]]
    assert breaths.pressure[:, :, 0].tolist() == [list(range(7)), list(range(9, 16))]
    assert left_out(recorded[2:], breaths) == ""

    def cut_off(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(_simulators, "divided", cut_off)
    said, data = [], tmp_path / "train.csv"
    lung.write_breaths(data, recorded)
    for _ in range(2):  # also where the breaths are found
        with pytest.raises(KeyboardInterrupt):
            studies.lung_study(tmp_path / "out", data=data, say=said.append)
        assert "2 of the 16 breaths are left out, so that each of" in said[-1]
        assert "the 2 lungs has 7 breaths" in said[-1]


def test_what_passed_the_limit_is_not_saved(tmp_path):
    waveform = lung.BreathWaveform()
    forward = FeedForward(waveform)
    highest = (30.0, 61.0, float("nan"))
    contenders = [Contender("A", seed, forward, True) for seed in range(3)]
    rows = [
        dict(controller="A", seed=seed, lung="x", highest=value)
        for seed, value in enumerate(highest)
    ]
    unsafe = save_controllers(tmp_path, contenders, ["x"], rows)
    assert unsafe == ["a_1", "a_2"]
    assert [path.name for path in tmp_path.iterdir()] == ["a_0.dlx"]


def test_tuned_pids_are_the_best_that_were_tried(tmp_path, monkeypatch):
    """The training itself is that of `test_learning`: here it makes them stronger."""

    def stronger(envs, pids, *, steps, **options):
        gain = lambda pid: pid.first.kp
        model = eqx.tree_at(gain, pids, 1.5 * gain(pids))
        return SimpleNamespace(model=model, history={"diverged": np.zeros(steps)})

    monkeypatch.setattr(lung, "train_controllers", stronger)
    monkeypatch.delitem(_contenders._TUNED_KINDS, "leaky PID")  # compiles as long
    waveform = lung.BreathWaveform()
    envs = stack([lung.single_compartment(resistance=R) for R in (5.0, 50.0)])
    size = FULL._replace(tuned=20, pid_steps=3)
    options = dict(checkpoint=tmp_path / "tuned.fit", progress=False)
    said = []
    trainer = Trainer(envs, waveform, size, KEY, said.append)
    found = tuned_pids(envs, trainer, **options)
    assert len(found) == 2 and not said
    error = lambda env, pid: jnp.mean(lung.breath_error(env, pid, key=KEY))
    errors = eqx.filter_jit(eqx.filter_vmap(error))
    own = errors(envs, found["tuned PID + feed-forward"])
    alike = errors(envs, stack([found["tuned PID + feed-forward for all"]] * 2))
    assert jnp.all(own <= alike + 1e-3) and jnp.all(own < 10)


def test_a_pid_that_diverges_is_not_the_best(monkeypatch):
    gains, errors = np.arange(9.0).reshape(3, 3), [[np.nan, 2, 1], [np.nan, 1, 2.5]]
    found = jnp.asarray(gains), jnp.asarray(errors)
    monkeypatch.setattr(lung, "pid_grid", lambda envs, **options: found)
    envs = stack([lung.single_compartment()] * 2)
    trainer = Trainer(envs, lung.BreathWaveform(), FULL, KEY, print)
    best = _contenders.searched_pids(envs, trainer)
    assert best["PID"].kp.tolist() == [6.0, 3.0] and best["PID for all"].kp == 3.0


@pytest.mark.parametrize("name, most", [("PID", 0.2), ("LeakyPID", 4.0)])
def test_pids_are_drawn_over_orders_of_magnitude(name, most):
    kind, waveform = getattr(dlx.controllers, name), lung.BreathWaveform()
    drawn = _contenders._drawn(kind, 400, jnp.asarray(0.03), waveform, KEY)
    pids, forwards = drawn.first, drawn.second
    assert type(pids) is kind and pids.kp.shape == (400,)
    ranges = (pids.kp, 0.03, 8.0), (pids.ki, 0.05, 40.0), (pids.kd, most / 70, most)
    for gains, low, high in ranges:
        gains = np.asarray(gains)
        # Half of the PIDs have no derivative.
        used = gains[gains > 0]
        assert len(used) == 400 or 150 < len(used) < 250
        assert low <= np.min(used) < 2 * low and high / 2 < np.max(used) <= high
    for values in (forwards.gain, forwards.offset):
        assert 150 < np.sum(np.asarray(values) == 0) < 250
    # Each of them runs.
    run = eqx.filter_vmap(lambda one: one(0.0, jnp.array([5.0]), one.init())[0])
    runs = np.asarray(eqx.filter_jit(run)(drawn))
    assert np.all(np.isfinite(runs)) and len(np.unique(runs)) == 400


def test_what_has_no_finite_error_is_not_chosen():
    candidates = dict(number=jnp.arange(6).reshape(3, 2))
    errors = jnp.array([[jnp.inf, 2.0, 1.0], [3.0, jnp.inf, 4.0]])
    assert best_candidates(candidates, errors, False)["number"].tolist() == [4, 1]
    assert best_candidates(candidates, errors, True)["number"].tolist() == [4, 5]
    assert divergence_note(np.zeros(5), errors[:, 2]) == ""
    assert "2 of 6 errors are not finite" in divergence_note(np.zeros(5), errors)
    assert "In 1 of 5 training steps" in divergence_note(np.eye(5)[0], errors[:, 2])


def write_lungs(path, lungs, breaths):
    """A file of breaths of some lungs."""
    parts = [
        lung.explore(
            lung.double_compartment(resistance=R, compliance=C),
            breaths,
            key=jax.random.key(k),
            length=80,
            scale=0.5,
            resistance=R,
            compliance=C,
        )
        for k, (R, C) in enumerate(lungs)
    ]
    join = lambda *columns: jnp.concatenate(columns) if columns[0].ndim else columns[0]
    lung.write_breaths(path, jax.tree.map(join, *parts))


@minutes("trains lungs, networks and PIDs, as `python -m delucax lung --small` does")
@pytest.mark.parametrize("from_file", [False, True])
def test_small_study(tmp_path, from_file):
    data, out = None, tmp_path / "out"
    if from_file:
        data = tmp_path / "train.csv"
        write_lungs(data, [(5.0, 20.0), (50.0, 20.0)], 8)
    said = []
    rows = studies.lung_study(
        out, small=True, data=data, say=said.append, progress=False
    )
    lungs = {row["lung"] for row in rows if row["split"] == "unseen"}
    assert len(lungs) == 2
    with open(out / "report.csv") as file:
        written = list(csv.DictReader(file))
    assert len(written) == len(rows)
    assert set(written[0]) >= {"lung", "controller", "seed", "split", "mae"}
    summary = json.loads((out / "summary.json").read_text())
    assert summary["highest_pressure"] < summary["abort"]
    # On average: of a lung in the file there is one breath to test on.
    wrong, learned = (
        np.mean(list(summary["simulators"][kind].values()))
        for kind in ("single compartment", "learned")
    )
    assert learned < wrong
    assert ("grey-box" in summary["judged_in"]) == from_file
    controllers = sorted((out / "controllers").glob("mlp_R*.dlx"))
    assert len(controllers) == len(lungs)
    env = dlx.make("lung/double_compartment")
    dlx.rollout(env, dlx.load(controllers[0]), key=jax.random.key(0), horizon=10)
    for name in ("controllers.png", "simulators.png", "breath.gif"):
        assert (out / name).stat().st_size > 1000
    # A second time there is nothing left to do but the report.
    said.clear()
    again = studies.lung_study(
        out, small=True, data=data, say=said.append, progress=False
    )
    assert again == rows and sum("found" in line for line in said) >= 6
