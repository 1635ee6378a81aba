"""Moving pictures: their frames, their files, and how plants are drawn."""

import base64
import dataclasses
import io
import re
import sys

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
from helpers import once, user_error
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from PIL import Image

import delucax as dlx
from delucax.plotting._animate import Scene
from delucax.plotting._drawings._canvas import arc_arrow, Canvas, Episode
from delucax.plotting._drawings._mechanics import pendulum
from delucax.plotting._drawings._registry import _BY_TYPE, drawing_for
from delucax.plotting._export import compressed, expanded
from delucax.plotting._runs import as_runs


pytestmark = once


class Cart(dlx.AbstractSystem):
    state_names = ("position", "speed")
    control_names = ("force",)

    def vector_field(self, t, x, u, w):
        return jnp.stack([x[1], u[0]])


class HeavyCart(Cart):
    pass


class Tank(dlx.AbstractSystem):
    state_names = ("level",)
    control_names = ("inflow",)

    def vector_field(self, t, x, u, w):
        return u - x


def environment_of(system, dt=0.1, **arguments):
    n, m = system.state_size, system.control_size
    cost = dlx.costs.Quadratic(jnp.eye(n), jnp.eye(m))
    arguments = {"initial_state": jnp.ones(n), "horizon": 20} | arguments
    return dlx.Environment(dlx.Discretized(system, dt), cost, **arguments)


def run_of(environment, **arguments):
    zero = dlx.controllers.Zero(environment.control_size)
    return dlx.rollout(environment, zero, key=jax.random.key(0), **arguments)


@pytest.fixture(scope="module")
def env():
    return dlx.make("pendulum", horizon=12)


@pytest.fixture(scope="module")
def trajectory(env):
    push = dlx.controllers.Constant(jnp.array([1.5]))
    return dlx.rollout(env, push, key=jax.random.key(0), x0=jnp.array([1.0, 0.0]))


@pytest.fixture(scope="module")
def animation(env, trajectory):
    return dlx.animate(env, trajectory)


@pytest.fixture(scope="module")
def scene(env, trajectory):
    run = as_runs(trajectory, None, "trajectory", "test")[0]
    return Scene(run, env, range(13), 60)


def test_gif_holds_every_frame_at_its_pace(animation, tmp_path):
    animation.save(tmp_path / "run.gif")
    frames = []
    with Image.open(tmp_path / "run.gif") as image:
        assert image.n_frames == len(animation) == 13
        assert image.info["loop"] == 0
        for k in range(image.n_frames):
            image.seek(k)
            assert image.info["duration"] == 50
            frames.append(np.asarray(image.convert("RGB")).astype(int))
    assert frames[0].shape[1] == 600
    for before, after in zip(frames, frames[1:], strict=False):
        assert np.mean(np.any(before != after, axis=-1)) > 1e-3
    for frame, rendered in zip(frames, expanded(animation._frames), strict=True):
        assert np.abs(frame - np.asarray(rendered)).max() <= 24
    white = np.all(frames[0] == 255, axis=-1).mean()
    assert 0.5 < white < 0.99


def test_path_saves_at_once(env, trajectory, tmp_path):
    path = tmp_path / "run.gif"
    dlx.animate(env, trajectory, path=str(path), max_frames=4)
    with Image.open(path) as image:
        assert image.n_frames == 4


def test_page_needs_nothing_else(animation, tmp_path):
    animation.save(tmp_path / "run.html")
    page = (tmp_path / "run.html").read_text(encoding="utf-8")
    assert "http:" not in page and "https:" not in page
    images = [base64.b64decode(data) for data in re.findall(r"iVBOR[\w+/=]+", page)]
    assert len(images) == len(animation)
    pictures = [Image.open(io.BytesIO(data)) for data in images]
    assert pictures[0].width == 600
    # A browser lays each over the first, as the files themselves say.
    meant = expanded(animation._frames)
    for shown, frame in zip(expanded(pictures), meant, strict=True):
        np.testing.assert_array_equal(np.asarray(shown), np.asarray(frame))
    assert f'max="{len(animation) - 1}"' in page and "setInterval(next, 50)" in page


def test_notebook_plays_it_and_repeats_itself(env, trajectory, animation):
    from IPython.core.formatters import DisplayFormatter

    data, _ = DisplayFormatter().format(animation)
    assert "<script>" in data["text/html"]
    assert dlx.animate(env, trajectory)._repr_html_() == data["text/html"]


def test_mp4_goes_through_ffmpeg(animation, tmp_path, monkeypatch):
    program = tmp_path / "ffmpeg"
    program.write_text(
        f"#!{sys.executable}\n"
        "import sys\n"
        "data = sys.stdin.buffer.read()\n"
        "open(sys.argv[-1], 'w').write(f'{len(data)} ' + ' '.join(sys.argv))\n"
        "sys.exit('refused' if 'refused' in sys.argv[-1] else 0)\n"
    )
    program.chmod(0o755)
    monkeypatch.setitem(matplotlib.rcParams, "animation.ffmpeg_path", str(program))
    animation.save(tmp_path / "run.mp4")
    size, *arguments = (tmp_path / "run.mp4").read_text().split()
    width, height = animation._frames[0].size
    assert int(size) == len(animation) * width * height * 3
    assert f"{width}x{height}" in arguments and "20" in arguments
    with pytest.raises(RuntimeError, match="ffmpeg could not write.*refused"):
        animation.save(tmp_path / "refused.mp4")


def test_frames_survive_compression(scene):
    frames = [scene.frame(k) for k in (0, 6, 6, 12)]
    whole = list(expanded(compressed(frames)))
    for image, frame in zip(whole, frames, strict=True):
        error = np.abs(np.asarray(image).astype(int) - frame)
        assert error.max() <= 32 and error.mean() < 0.5
    still = compressed([frames[0], frames[0]])
    np.testing.assert_array_equal(*map(np.asarray, expanded(still)))


def test_real_time_and_the_spread_of_frames(env, trajectory):
    whole = dlx.animate(env, trajectory)
    assert whole.indices == tuple(range(13))
    assert abs(whole.fps - 20) < 1e-3
    some = dlx.animate(env, trajectory, max_frames=5)
    assert some.indices == (0, 3, 6, 9, 12)
    assert abs(some.fps - 4 / 0.6) < 1e-3
    assert dlx.animate(env, trajectory, fps=12).fps == 12


def test_fast_and_slow_plants_are_watchable():
    fast = environment_of(Cart(), dt=0.001, horizon=1000)
    fast = dlx.animate(fast, run_of(fast))
    assert fast.fps == 30 and len(fast) == 31
    slow = environment_of(Cart(), dt=10.0, horizon=50)
    slow = dlx.animate(slow, run_of(slow))
    assert slow.fps == 5 and len(slow) == 51


def test_ends_where_the_episode_ends():
    env = environment_of(Cart(), terminated=lambda t, x: x[0] > 2.05)
    run = run_of(env)
    assert int(run.length) == 11
    assert dlx.animate(env, run).indices[-1] == 11


def test_frame_says_time_and_cost_and_moves_its_dots(scene, trajectory):
    scene.frame(6)
    cost = float(np.sum(trajectory.costs[:6]))
    assert scene.texts[0].get_text() == "t = 0.30 s"
    assert scene.texts[1].get_text() == f"cost so far {cost:.4g}"
    dots = [line for line, _ in scene.lines if line.get_marker() == "o"]
    angle, velocity, torque, stage = (dot.get_ydata()[0] for dot in dots)
    np.testing.assert_allclose([angle, velocity], trajectory.states[6])
    np.testing.assert_allclose(torque, 1.5)
    np.testing.assert_allclose(stage, trajectory.costs[6])
    assert all(abs(dot.get_xdata()[0] - 0.3) < 1e-6 for dot in dots)
    grown = [line for line, _ in scene.lines if line.get_marker() != "o"]
    assert all(len(line.get_xdata()) == 7 for line in grown)
    scene.frame(12)
    assert np.isfinite([dot.get_ydata()[0] for dot in dots]).all()


def pendulum_at(env, trajectory, angle, torque):
    """The artists of a pendulum: its lines and the arrow of its torque, if any."""
    ax = Figure().add_subplot()
    drawing = pendulum(Canvas(ax), Episode(env, trajectory))
    fixed = len(ax.get_lines())
    drawing.draw(np.array([angle, 0.0]), np.array([torque]))
    arrows = [p for p in ax.patches if isinstance(p, Polygon)]
    return ax.get_lines()[fixed:], arrows


def test_pendulum_points_where_its_angle_says(env, trajectory):
    for angle, tip in ((0.0, (0, 1)), (np.pi / 2, (-1, 0)), (np.pi, (0, -1))):
        (rod,), arrows = pendulum_at(env, trajectory, angle, 0.0)
        np.testing.assert_allclose([line[1] for line in rod.get_data()], tip, atol=1e-9)
        assert not arrows


def test_torque_arrow_grows_with_the_torque_and_turns_its_way(env, trajectory):
    def sweep(torque):
        _, (arrow,) = pendulum_at(env, trajectory, 0.0, torque)
        return np.ptp(arrow.get_xy(), axis=0).prod(), arrow.get_xy()[:, 0].mean()

    sizes = [sweep(torque)[0] for torque in (0.2, 0.6, 1.2)]
    assert sizes == sorted(sizes) and sizes[2] > 2 * sizes[0]
    # Anticlockwise from straight up is to the left, clockwise to the right.
    assert sweep(0.6)[1] < 0 < sweep(-0.6)[1]
    np.testing.assert_allclose(sweep(5.0), sweep(2.0))
    tip = arc_arrow(1.0, 0.0, np.pi / 2)[41]
    np.testing.assert_allclose(tip, [0, 1], atol=1e-9)


def test_largest_torque_is_the_bound_or_what_was_applied(env, trajectory):
    assert Episode(env, trajectory).largest_controls == 2.0
    free = dlx.make("pendulum", max_torque=jnp.inf)
    largest = Episode(free, trajectory).largest_controls
    np.testing.assert_allclose(largest, 1.5)


def test_other_plants_are_a_dot_in_a_plane_or_bars(key):
    lds = dlx.make("lds", A=0.9 * jnp.eye(2), B=jnp.ones((2, 1)), horizon=4)
    run = dlx.rollout(lds, dlx.controllers.Zero(1), key=key, x0=jnp.ones(2))
    scene = Scene(as_runs(run, None, "", "")[0], lds, range(5), 40)
    scene.frame(2)
    assert scene.plant.ax.get_xlabel() == "x0" and scene.plant.ax.get_ylabel() == "x1"
    goal, path, past, dot = scene.plant.ax.get_lines()
    np.testing.assert_allclose(np.ravel(dot.get_data()), run.states[2])
    assert len(path.get_xdata()) == 5 and len(past.get_xdata()) == 3
    np.testing.assert_allclose(np.ravel(goal.get_data()), 0)
    tank = environment_of(Tank(), horizon=4)
    run = run_of(tank)
    scene = Scene(as_runs(run, None, "", "")[0], tank, range(5), 40)
    fixed = len(scene.plant.ax.patches)
    scene.frame(3)
    level, inflow = [bar.get_height() for bar in scene.plant.ax.patches[fixed:]]
    np.testing.assert_allclose([level, inflow], [run.states[3, 0], 0.0], rtol=1e-6)


def test_plant_alone(env, trajectory):
    alone = dlx.animate(env, trajectory, traces=False, max_frames=2)
    assert alone._frames[0].width == 300
    run = as_runs(trajectory, None, "trajectory", "test")[0]
    scene = Scene(run, env, [0], 60, traces=False)
    assert scene.figure.axes == [scene.plant.ax] and not scene.lines


def test_flat_colours_leave_no_ghost():
    paper = np.full((40, 60, 3), 239, np.uint8)
    rng = np.random.default_rng(0)
    frames = [paper.copy() for _ in range(3)]
    for k, frame in enumerate(frames):
        frame[10:30, 20 * k : 20 * k + 20] = rng.integers(0, 256, (20, 20, 3))
    for image, frame in zip(expanded(compressed(frames)), frames, strict=True):
        flat = np.all(frame == 239, axis=-1)
        assert np.all(np.asarray(image)[flat] == 239)


def test_registered_drawing_is_used(key):
    seen = []

    def draw(ax, x, u, size=0.0):
        seen.append((x, u, size))
        ax.plot([x[0], x[0] + size], [0, 1])
        ax.text(x[0], 0, "cart")

    def setup(ax, environment, trajectory):
        assert isinstance(environment, dlx.Environment)
        assert trajectory.states.shape == (21, 2)
        ax.set(xlim=(-3, 3), ylim=(-1, 1))
        return {"size": 0.5}

    dlx.plotting.register_drawing(Cart, draw, setup)
    env = environment_of(HeavyCart())
    run = run_of(env)
    scene = Scene(as_runs(run, None, "", "")[0], env, range(21), 40)
    frames = [scene.frame(k) for k in (0, 10, 20)]
    assert [s[2] for s in seen] == [0.5] * 3
    np.testing.assert_allclose(np.stack([s[0] for s in seen]), run.states[::10])
    assert all(isinstance(a, np.ndarray) for s in seen for a in s[:2])
    assert scene.plant.ax.get_xlim() == (-3, 3)
    # What was drawn before is gone.
    assert len(scene.plant.ax.get_lines()) == len(scene.plant.ax.texts) == 1
    np.testing.assert_array_equal(scene.frame(0), frames[0])


def test_drawing_without_setup_fits_all_that_it_draws():
    dlx.plotting.register_drawing(Tank, lambda ax, x, u: ax.plot([0, 1], [x[0], 7]))
    env = environment_of(Tank())
    try:
        scene = Scene(as_runs(run_of(env), None, "", "")[0], env, range(21), 40)
        low, high = scene.plant.ax.get_ylim()
        assert low <= np.exp(-2) and 7 <= high <= 8
        assert scene.plant.ax.get_aspect() == 1
    finally:
        del _BY_TYPE[Tank]


def test_drawings_are_found_by_type(env):
    fine = dlx.make("pendulum", solver=dlx.dynamics.RK4())
    assert drawing_for(env) is drawing_for(fine) is pendulum

    def draw(ax, x, u):
        pass

    kept = dict(_BY_TYPE)
    try:
        dlx.plotting.register_drawing(type(env.dynamics), draw)
        assert drawing_for(env) is pendulum
        dlx.plotting.register_drawing(dlx.systems.Pendulum, draw)
        assert drawing_for(env) is _BY_TYPE[dlx.systems.Pendulum] is not pendulum
    finally:
        _BY_TYPE.clear()
        _BY_TYPE.update(kept)


def test_registration_errors():
    for arguments, match in (
        ((int, print), "system_class must be a subclass"),
        ((dlx.systems.Pendulum(), print), "system_class must be a subclass"),
        ((Cart, None), "draw must be a function"),
        ((Cart, print, 3), "setup must be a function"),
    ):
        with user_error(match=f"register_drawing: {match}"):
            dlx.plotting.register_drawing(*arguments)


def test_bad_paths_are_refused_before_anything_is_drawn(
    env, trajectory, tmp_path, monkeypatch
):
    def never(*args):
        raise AssertionError("it was drawn")

    monkeypatch.setattr("delucax.plotting._animate.Scene", never)
    monkeypatch.setitem(matplotlib.rcParams, "animation.ffmpeg_path", "no-such-program")
    (tmp_path / "folder.gif").mkdir()
    for path, match in (
        (tmp_path / "run.avi", r"path must end in .gif, .html, .mp4, got .*run.avi"),
        (tmp_path / "run", "path must end in"),
        (tmp_path / "missing" / "run.gif", "path must be a file in an existing"),
        (tmp_path / "folder.gif", "path must be a file in an existing"),
        (tmp_path / "run.mp4", "path ends in .mp4, which needs the program ffmpeg"),
        (3, "path must be the path of a file, got 3"),
    ):
        with user_error(match=match):
            dlx.animate(env, trajectory, path=path)
    with user_error(match="path must end in"):
        dlx.animate(env, trajectory).save(tmp_path / "run.png")


def test_errors_name_the_argument(env, trajectory, key):
    lds = dlx.make("lds", A=jnp.eye(2), B=jnp.ones((2, 1)), horizon=5)
    zero = dlx.controllers.Zero(1)
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), trajectory)
    blind = dlx.rollout(env, zero, key=key, keep=("controls",))
    idle = dlx.rollout(env, zero, key=key, keep=("states",))
    for arguments, match in (
        ((env, 3), "trajectory must be a Trajectory, got int"),
        ((env, batch), r"trajectory must be one trajectory, got a batch of shape \(2,"),
        ((env, blind), "trajectory holds no states"),
        ((env, idle), "trajectory holds no controls"),
        ((env, trajectory[3:3]), "trajectory must have at least one step"),
        ((lds, trajectory), "environment has state_names"),
        ((3, trajectory), "environment must be an Environment, got int"),
    ):
        with user_error(match=f"animate: {match}"):
            dlx.animate(*arguments)
    for keywords, match in (
        ({"fps": 0}, "fps must be positive and finite, got 0"),
        ({"fps": jnp.inf}, "fps must be positive and finite"),
        ({"dpi": "high"}, "dpi must be positive and finite, got 'high'"),
        ({"traces": "no"}, "traces must be True or False, got 'no'"),
        ({"max_frames": 0}, "max_frames must be a whole number of at least 1"),
    ):
        with user_error(match=f"animate: {match}"):
            dlx.animate(env, trajectory, **keywords)


def test_setup_must_return_keywords(env, trajectory):
    run = as_runs(trajectory, None, "trajectory", "test")[0]
    kept = dict(_BY_TYPE)
    try:
        dlx.plotting.register_drawing(dlx.systems.Pendulum, print, lambda *args: 3)
        with user_error(match="setup of a drawing must return a dictionary or None"):
            Scene(run, env, [0], 40)
    finally:
        _BY_TYPE.update(kept)


def test_a_series_that_is_not_finite_at_first():
    environment = environment_of(Cart())
    run = run_of(environment)
    costs = run.costs.at[0].set(jnp.nan)
    run = dataclasses.replace(run, costs=costs)
    scene = Scene(as_runs(run, None, "run", "test")[0], environment, [0, 10], dpi=20)
    scene.frame(0)
    shown = [len(line.get_xdata()) for line, _ in scene.lines[-2:]]
    assert shown == [0, 0]
