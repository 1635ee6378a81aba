"""The gallery shows every task, and its code makes its pictures."""

import importlib.util
import re
from pathlib import Path

import jax
import pytest
from helpers import once
from PIL import Image

import delucax as dlx


pytestmark = once

DOCS = Path(__file__).parents[2] / "docs"
PICTURES = DOCS / "assets" / "gallery"
TASKS = {name for name in dlx.environments.registered() if "/" not in name}


def test_every_task_is_shown_and_nothing_else():
    page = (DOCS / "gallery.md").read_text()
    assert set(re.findall(r"^### (\w+)$", page, re.MULTILINE)) == TASKS
    assert set(re.findall(r"assets/gallery/(\w+)\.gif", page)) == TASKS
    assert set(re.findall(r'film\("(\w+)"', page)) == TASKS
    assert {path.stem for path in PICTURES.glob("*")} == TASKS


def test_pictures_move_and_are_small():
    sizes = [path.stat().st_size for path in PICTURES.glob("*.gif")]
    assert max(sizes) < 200_000 and sum(sizes) < 4_500_000
    for path in PICTURES.glob("*.gif"):
        with Image.open(path) as image:
            assert image.n_frames >= 20 and image.info["loop"] == 0
            assert image.width == 300


# `test_drawings` draws every system.
DRAWN = {"pendulum", "balloon_lung"}


def test_code_of_the_page_draws_its_pictures(tmp_path, monkeypatch):
    """Its closed loops are traced, of those that plan one, and some are run and
    drawn."""

    def sparing(film):
        def traced(name, env, controller, x0=None, steps=None, frames=60):
            assert 20 <= frames
            if name in DRAWN:
                film(name, env, controller, x0, steps, frames=2)
            assert x0 is None or x0.shape == (env.state_size,)
            named.add(name)
            if isinstance(controller, dlx.controllers.MPC):
                # The page makes all in one way, and the trace of a planner takes long.
                planned.append(name)
                if len(planned) > 1:
                    return
            options = dict(key=jax.random.key(0), x0=x0, horizon=steps)
            run = lambda: dlx.rollout(env, controller, **options).states
            assert jax.eval_shape(run).shape[1] == env.state_size

        return traced

    named, planned = set(), []
    monkeypatch.chdir(tmp_path)
    path = DOCS / "figures" / "gallery.py"
    spec = importlib.util.spec_from_file_location("gallery_figures", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    pictures = module.draw([], tmp_path, sparing)
    assert named == TASKS and {picture.stem for picture in pictures} == DRAWN


@pytest.mark.parametrize("name", sorted(TASKS))
def test_code_of_the_page_names_the_task(name):
    page = (DOCS / "gallery.md").read_text()
    (section,) = re.findall(rf"^### {name}\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)
    assert f'dlx.make("{name}"' in section
