"""How plants look: each task has a drawing, which shows what its state says."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import once, trajectory_of
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from systems_catalogue import SYSTEMS

import delucax as dlx
from delucax.plotting._animate import Scene
from delucax.plotting._drawings._mechanics import arm_points, zigzag
from delucax.plotting._drawings._registry import _BY_TYPE, drawing_for
from delucax.plotting._drawings._vehicles import _course
from delucax.plotting._runs import as_runs


pytestmark = once

KEY = jax.random.key(0)
# What a task needs to be made.
NEEDED = {"lds": {"A": 0.9 * jnp.eye(2), "B": jnp.ones((2, 1))}, "neural": {"key": KEY}}
TASKS = {
    name: (name, NEEDED.get(name, {}))
    for name in dlx.environments.registered()
    if "/" not in name
}
VARIANTS = {
    "acrobot by RK4": ("acrobot", {"solver": dlx.dynamics.RK4()}),
    "lds of one": ("lds", {"A": jnp.eye(1), "B": jnp.ones((1, 1))}),
    "lds of five": ("lds", {"A": jnp.eye(5), "B": jnp.ones((5, 2))}),
    "lds of many": ("lds", {"A": jnp.eye(20), "B": jnp.ones((20, 1))}),
    "masses": ("mass_spring_damper", {"masses": 3}),
    "wind": ("planar_quadrotor", {"wind": "vortices"}),
    "wrench": ("quadrotor", {"inputs": "wrench"}),
}
PLANAR = [name for name, case in SYSTEMS.items() if len(case.low) == 2]


def scene_of(env, run, traces=False):
    return Scene(as_runs(run, None, "", "")[0], env, range(run.steps + 1), 40, traces)


def drawn(env, x, u=None):
    """The axes with a moment drawn on them, in a run that goes there from rest."""
    u = np.zeros(env.control_size) if u is None else u
    run = trajectory_of(env, np.stack([np.zeros(env.state_size), x]), np.stack([u]))
    scene = scene_of(env, run)
    fixed = set(map(id, scene.plant.ax.get_children()))
    scene.plant.draw(x, u)
    new = [a for a in scene.plant.ax.get_children() if id(a) not in fixed]
    return scene.plant.ax, new


@pytest.mark.parametrize(
    "name, arguments",
    [*TASKS.values(), *VARIANTS.values()],
    ids=[*TASKS, *VARIANTS],
)
def test_every_task_has_a_drawing_that_moves(name, arguments):
    env = dlx.make(name, **arguments)
    generic = _BY_TYPE[dlx.AbstractDynamics]
    phase_planes = ("cstr", "lds", "neural", "reactor_start_up", "van_der_pol")
    assert (drawing_for(env) is generic) == (name in phase_planes)
    rng = np.random.default_rng(0)
    states = 0.5 * rng.normal(size=(4, env.state_size))
    scene = scene_of(
        env, trajectory_of(env, states, rng.normal(size=(3, env.control_size)))
    )
    first, last = scene.frame(0), scene.frame(3)
    assert first.shape[1:] == (200, 3) and 60 <= first.shape[0] <= 176
    header = 14  # where the time is told
    assert np.any(first[header:] != last[header:], axis=-1).mean() > 1e-3
    np.testing.assert_array_equal(scene.frame(0), first)
    # A run that fails, or that goes far away, is drawn too.
    far = np.concatenate([states, 1e4 * states, np.full_like(states, np.nan)])
    scene_of(env, trajectory_of(env, far)).frame(5)


def test_arms_reach_where_the_systems_say():
    env = dlx.make("reacher", length_1=0.7, length_2=1.2)
    for x in np.random.default_rng(1).normal(size=(3, 4)):
        _, new = drawn(env, x)
        outer, _ = (a for a in new if hasattr(a, "get_xydata") and len(a.get_xydata()))
        hand = env.dynamics.system.tip(jnp.asarray(x))
        np.testing.assert_allclose(outer.get_xydata()[1], hand, atol=1e-6)
        tip = arm_points(x, (1.0, 1.0))[2]
        np.testing.assert_allclose(tip[1], -np.cos(x[0]) - np.cos(x[0] + x[1]))
    assert arm_points(np.array([0.5, 0.0]), (1.0, 1.0))[2, 0] > 0


def test_poles_lean_to_their_sides_and_have_their_lengths():
    def pole(env, x):
        _, new = drawn(env, x)
        lines = [a for a in new if hasattr(a, "get_xydata")]
        (pole,) = [line for line in lines if line.get_linewidth() == 7]
        return np.diff(pole.get_xydata(), axis=0)[0]

    x = np.array([0.3, 0.0, 0.1, 0.0])
    lean = pole(dlx.make("cartpole", half_length=0.7), x)
    np.testing.assert_allclose(lean, 1.4 * np.array([np.sin(0.1), np.cos(0.1)]))
    env = dlx.make("cartpole_linear", length=0.8)
    lean = pole(env, np.array([0.3, 0.1, 0.0, 0.0]))
    expected = 0.8 * np.array([-np.sin(0.1), np.cos(0.1)])
    np.testing.assert_allclose(lean, expected, rtol=1e-5)


def test_arrows_point_the_way_of_the_force():
    env = dlx.make("double_integrator")
    for force in (-1.0, 0.5):
        _, new = drawn(env, np.array([1.0, 0.0]), np.array([force]))
        arrows = [a for a in new if isinstance(a, Polygon) and len(a.get_xy()) == 8]
        (arrow,) = [a.get_xy() for a in arrows]
        assert np.sign(arrow[:, 0].mean() - 1.0) == np.sign(force)
    _, new = drawn(env, np.array([1.0, 0.0]))
    assert not [a for a in new if isinstance(a, Polygon) and len(a.get_xy()) == 8]


def test_view_goes_along_with_what_leaves_it():
    env = dlx.make("kinematic_bicycle")
    ax, _ = drawn(env, np.array([300.0, 0.0, 0.0, 10.0]))
    low, high = ax.get_xlim()
    assert low < 300 < high and high - low < 40
    assert ax.get_aspect() == 1
    falling = dlx.make("planar_quadrotor")
    ax, _ = drawn(falling, np.array([0.0, -100.0, 0, 0, 0, 0]))
    low, high = ax.get_ylim()
    assert low < -100 < high and high - low < 10


def test_time_is_told_in_the_unit_of_the_plant():
    texts = {
        "mountain_car": "t = 2",
        "cartpole": "t = 0.04 s",
        "cstr": "t = 0.10 min",
    }
    for name, text in texts.items():
        env = dlx.make(name)
        scene = scene_of(env, trajectory_of(env, np.zeros((4, env.state_size))))
        scene.frame(2)
        assert scene.texts[0].get_text() == text


def test_a_car_that_turns_steadily_goes_round_a_circle():
    times = np.linspace(0.0, 4.0, 401)
    headings, course = _course(times, np.tile([3.0, 4.0, 0.5], (401, 1)))
    np.testing.assert_allclose(headings, 0.5 * times)
    # At 5 m/s, ahead and to the left, about a centre that is across of that.
    away = np.linalg.norm(course - 10.0 * np.array([-0.8, 0.6]), axis=-1)
    np.testing.assert_allclose(away, 10.0, rtol=1e-4)
    assert np.all(np.diff(course[:100, 1]) > 0)


def test_spring_joins_its_ends():
    spring = zigzag(1.0, 3.0, 0.5, 0.2)
    np.testing.assert_allclose(spring[[0, -1]], [[1, 0.5], [3, 0.5]])
    assert np.ptp(spring[:, 1]) == pytest.approx(0.4)


def test_past_is_a_line_and_the_rest_is_faint():
    env = dlx.make("lorenz")
    states = np.cumsum(np.ones((6, 3)), axis=0)
    scene = scene_of(env, trajectory_of(env, states))
    scene.frame(3)
    paths = [line for line in scene.plant.ax.get_lines() if len(line.get_xdata()) > 1]
    whole, past = paths
    assert len(whole.get_xdata()) == 6 and whole.get_alpha() < past.get_alpha()
    np.testing.assert_allclose(past.get_xydata(), states[:4, [0, 2]])


def test_default_can_be_replaced():
    kept = dict(_BY_TYPE)
    env, pendulum = dlx.make("lds", **NEEDED["lds"]), dlx.make("pendulum")
    try:
        dlx.plotting.register_drawing(
            dlx.AbstractDynamics, lambda ax, x, u: ax.plot([0, 1], [x[0], 1])
        )
        assert drawing_for(env) is _BY_TYPE[dlx.AbstractDynamics]
        assert drawing_for(env) is not kept[dlx.AbstractDynamics]
        assert drawing_for(pendulum) is kept[dlx.systems.Pendulum]
    finally:
        _BY_TYPE.update(kept)


@pytest.mark.parametrize("name", list(PLANAR))
def test_planar_systems_have_a_phase_portrait(name, monkeypatch):
    monkeypatch.setattr("delucax.plotting._phase.GRID", 12)
    case = SYSTEMS[name]
    limits = tuple(zip(case.low, case.high, strict=True))
    figure = dlx.plotting.phase_portrait(case.make(), limits=limits)
    assert isinstance(figure, Figure)
    (ax,) = figure.axes
    assert len(ax.collections[0].get_segments()) > 20
