import re

import jax
import jax.numpy as jnp
import pandas as pd
import pytest
from helpers import needs_x32, once, user_error
from PIL import Image

import delucax as dlx
from delucax import studies
from delucax.__main__ import main
from delucax.studies import _demo
from delucax.studies.paper import _reproduce
from delucax.studies.paper._finding import Claim, Finding


pytestmark = once


def test_the_demo_writes_what_it_says(tmp_path, monkeypatch):
    def study(small):
        assert small
        claims = [Claim("It runs", "it did", True), Claim("It flies", "0 m", False)]
        return Finding("A study", claims)

    made = {"ventilator": None, "study": study}
    for module in (_demo, _reproduce):
        monkeypatch.setattr(module, "STUDIES", made)
    lines = []
    out = tmp_path / "new" / "demo"
    table = studies.demo(out, seeds=1, steps=20, say=lines.append)
    written = pd.read_csv(out / "table.csv")
    assert list(written["controller"]) == ["zero", "LQR", "MLP"] * 2
    assert len(table) == 6
    with Image.open(out / "trajectories.png") as picture:
        assert picture.size[0] > 500
    with Image.open(out / "swing_up.gif") as swing:
        assert swing.n_frames > 20
    policy = dlx.load(out / "mlp.dlx")
    u, _ = policy(0.0, jnp.array([0.1, 0.0]), policy.init())
    assert u.shape == (1,) and abs(u[0]) <= 2
    text = "\n".join(lines)
    assert "times as fast" in text and "million steps" in text
    derivative = next(line for line in lines if line.startswith("The derivative"))
    exact, numeric = map(float, re.findall(r"-?\d+\.\d+", derivative))
    assert abs(exact - numeric) < 1e-6 * abs(exact) + 1e-8
    assert "study       2     1" in text
    assert "Does not hold: It flies (0 m)." in text and "It runs (" not in text
    assert "python -m delucax reproduce all" in lines[-1]
    assert (out / "paper" / "report.html").is_file()


def test_an_unwritable_folder_is_an_error_before_any_work(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    with user_error(OSError, match="out must be a folder to write to"):
        studies.demo(tmp_path / "file", say=lambda line: pytest.fail(line))
    assert main(["demo", "--out", str(tmp_path / "file")]) == 2
    assert "error: demo: out must be" in capsys.readouterr().err
    with user_error(match="seeds must be a whole number of at least 1"):
        studies.demo(tmp_path, seeds=0)


@needs_x32
def test_swings_up_from_unseen_starts():
    env = dlx.make("pendulum")
    fitted = studies.train_swing_up(key=jax.random.key(0), progress=False)
    keys = jax.random.split(jax.random.key(2**20), 100)
    runs = jax.vmap(
        lambda k: dlx.rollout(env, fitted.model, key=k, horizon=400, keep="states")
    )(keys)
    assert jnp.sum(studies.holds_upright(runs)) >= 95


def test_holds_upright_looks_at_the_end_alone():
    env = dlx.make("pendulum")
    zero = dlx.controllers.Zero(1)
    key = jax.random.key(0)
    upright = dlx.rollout(env, zero, key=key, x0=jnp.zeros(2), horizon=200)
    hanging = dlx.rollout(env, zero, key=key, x0=jnp.array([3.0, 0.0]), horizon=200)
    assert studies.holds_upright(upright)
    assert not studies.holds_upright(hanging)
    bare = dlx.rollout(env, zero, key=key, keep=())
    with user_error(match="states kept"):
        studies.holds_upright(bare)
