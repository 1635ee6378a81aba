"""The report of the paper, from studies that take no time."""

import base64
import csv

import jax
import numpy as np
import pytest
from helpers import once, user_error
from matplotlib.figure import Figure

from delucax import studies, training
from delucax.controllers import mlp_policy
from delucax.environments import pendulum
from delucax.studies._swing_up import spread_starts
from delucax.studies.paper import (
    _gradients,
    _reproduce,
    _wall_clock,
)
from delucax.studies.paper._finding import Claim, Finding, side_by_side


pytestmark = once


def drawn(small):
    figure = Figure(figsize=(1, 1))
    figure.add_subplot().plot([0, 1])
    claims = [Claim("One is < two", f"1, small is {small}", True)]
    rows = [{"method": "a", "cost": 1.5}, {"method": "b"}]
    return Finding("Drawn", claims, {"Costs": rows}, {"line": figure}, "Done at once.")


def ventilator(small, out, say):
    say("  Breaths: 1 s")
    out.mkdir()
    (out / "breath.gif").write_bytes(b"GIF89a")
    claims = [Claim("It breathes", "not", False)]
    return Finding("Lungs", claims, {}, {"breath.gif": out / "breath.gif"})


def broken(small):
    raise RuntimeError("no <plant>")


@pytest.fixture
def made_up(monkeypatch):
    made = {"drawn": drawn, "ventilator": ventilator, "broken": broken}
    monkeypatch.setattr(_reproduce, "STUDIES", made)


def test_the_report_holds_claims_tables_and_images(tmp_path, made_up):
    lines = []
    rows = studies.reproduce("all", tmp_path, small=True, say=lines.append)
    assert [row["holds"] for row in rows] == [True, False, False]
    with open(tmp_path / "claims.csv", newline="") as file:
        assert [row["study"] for row in csv.DictReader(file)] == [
            "drawn",
            "ventilator",
            "broken",
        ]
    page = (tmp_path / "report.html").read_text()
    assert "1 of 3 claims hold" in page
    assert "One is &lt; two. Measured: 1, small is True" in page
    image = base64.b64encode((tmp_path / "line.png").read_bytes()).decode()
    assert f'<img src="data:image/png;base64,{image}" alt="line">' in page
    assert '<img src="data:image/gif;base64,R0lGODlh" alt="breath">' in page
    assert "RuntimeError: no &lt;plant&gt;" in page
    assert "no <plant>" in (tmp_path / "broken.txt").read_text()
    assert "  Breaths: 1 s" in lines and "1 of 3 claims hold" in lines[-2]


def test_small_and_full_lungs_are_apart(tmp_path, made_up):
    for small in (True, False):
        studies.reproduce("ventilator", tmp_path, small=small, say=len)
    assert {path.name for path in tmp_path.glob("lung*")} == {"lung", "lung-small"}


def test_unknown_studies_are_named(tmp_path):
    with user_error(match="one of 'all', .*'oracle-complexity', .*, got 'lungs'"):
        studies.reproduce("lungs", tmp_path)
    with user_error(match="got 'nope'"):  # before all of them are begun
        studies.reproduce(["all", "nope"], tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_the_paper_is_judged_at_its_own_rate():
    claim = _gradients.descent_claim(182, 108)
    assert not claim.holds
    assert claim.measured == "182 rollouts at the paper's rate 0.01 (108 at 0.02)"
    assert _gradients.descent_claim(120, None).holds
    assert not _gradients.descent_claim(None, 90).holds


def test_a_load_that_comes_and_goes_meets_all_simulators(monkeypatch):
    """The one run takes 100 times as long as the other, whatever else runs."""
    now = 0.0

    def taking(seconds):
        def run():
            nonlocal now, turns
            load = 1 + 4 * (turns // 4 % 2)  # of every other two rounds
            now, turns = now + load * seconds, turns + 1

        return run

    turns = 0
    monkeypatch.setattr(_wall_clock.time, "perf_counter", lambda: now)
    seconds = _wall_clock.take_turns([taking(0.01), taking(1.0)], 6)
    assert seconds.shape == (6, 2) and seconds.std(axis=0).min() > 0
    np.testing.assert_allclose(seconds[:, 1] / seconds[:, 0], 100)


def test_several_seeds_descend_as_each_alone():
    losses = _gradients.train_linear(5, np.arange(2), progress=False).history.loss
    assert losses.shape == (5, 2)
    alone = _gradients.train_linear(5, 1, progress=False).history.loss
    np.testing.assert_allclose(losses[:, 1], alone, rtol=1e-5)


def test_a_horizon_that_is_data_gives_the_same_variance():
    draws = 4
    short, _ = _gradients._over_horizons((2, 5), draws)
    env = spread_starts(pendulum())
    policy = mlp_policy(env, width=32, depth=1, key=jax.random.key(0))
    loss = training.expected_cost(env, batch=1, horizon=2)
    (each,) = _gradients._estimates([(training.analytic, loss, policy)], draws)
    variance = np.sum(np.var(each, axis=0)) / _gradients.DRAWN
    np.testing.assert_allclose(short["analytic"], variance, rtol=1e-4)
    assert short["REINFORCE"] > short["analytic"]


def test_side_by_side_keeps_the_order_and_raises():
    assert side_by_side(lambda x: 2 * x, range(4)) == [0, 2, 4, 6]
    with pytest.raises(ZeroDivisionError):
        side_by_side(lambda x: 1 / x, (1, 0))
