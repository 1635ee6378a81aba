"""How plants with events look: feet stay where they are put, and modes are seen."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import once, trajectory_of
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Polygon

import delucax as dlx
from delucax.plotting._drawings._canvas import Canvas, Episode
from delucax.plotting._drawings._registry import drawing_for


pytestmark = once

s = dlx.systems


class Plant:
    """A plant on axes, moment by moment."""

    def __init__(self, system):
        n = system.state_size
        cost = dlx.costs.Quadratic(jnp.eye(n), jnp.eye(1))
        dynamics = dlx.Discretized(system, dt=0.1)
        env = dlx.Environment(dynamics, cost, control_bounds=(-1.0, 1.0))
        run = trajectory_of(env, np.ones((2, n)))
        self.ax = Figure().add_subplot()
        self.drawing = drawing_for(env)(Canvas(self.ax), Episode(env, run))
        self.fixed = set(self.ax.get_children())

    def at(self, *states, u=0.0, times=None):
        """What is drawn at the last of the states."""
        for artist in set(self.ax.get_children()) - self.fixed:
            artist.remove()
        states = np.asarray(states, float)
        times = np.asarray(range(len(states)) if times is None else times, float)
        past = [(times, states)] if self.drawing.walks else []
        self.drawing.draw(states[-1], np.array([u]), *past)
        return [a for a in self.ax.get_children() if a not in self.fixed]


def legs(artists):
    """The ends of the thick lines: at the hip, and at the feet."""
    lines = [a for a in artists if isinstance(a, Line2D) and a.get_linewidth() >= 5]
    return np.stack([line.get_xydata() for line in lines])


def feet(artists):
    return sorted(map(tuple, np.round(legs(artists)[:, 1], 6)))


def step_of(system, before):
    """A state before a step, the one after it, and two on the way to the next."""
    x = jnp.asarray(before)
    after = np.asarray(system.resets(0.0, x, jnp.zeros(1))[0])
    way = before - after
    return before, after, after + way / 3, after + 2 * way / 3


WALKERS = {
    "wheel": (s.RimlessWheel(), np.array([np.pi / 8 + 0.08, 1.5])),
    "compass": (s.CompassGait(), np.array([0.2187, -0.32342, -0.4, -1.1])),
    "simplest": (s.SimplestWalker(), np.array([-0.2003, -0.2, -0.4006, -0.1])),
}


@pytest.mark.parametrize("name", list(WALKERS))
def test_a_step_moves_no_foot_and_the_next_goes_on_from_there(name):
    system, before = WALKERS[name]
    steps, plant = step_of(system, before), Plant(system)
    first, second = plant.at(steps[0]), plant.at(*steps[:2])
    np.testing.assert_allclose(feet(first), feet(second), atol=2e-4)
    hips = [legs(artists)[:, 0].mean(axis=0) for artists in (first, second)]
    np.testing.assert_allclose(*hips, atol=1e-4)
    # The stance foot is at the origin first, and one step down the slope then.
    again = plant.at(*steps, *steps[:2])
    slope = float(system.slope)
    way = legs(again)[0, 0] - legs(second)[0, 0]
    assert way[0] > 0.3
    np.testing.assert_allclose(way[1], -np.tan(slope) * way[0], atol=1e-3)
    # The view goes along.
    plant.at(*steps * 9)
    assert plant.ax.get_xlim()[0] > 0.5


def test_samples_without_their_events_tell_of_steps_too():
    """Neither the passing of the legs nor a slow swing is one."""
    plant = Plant(s.CompassGait())
    before, after, *_ = step_of(*WALKERS["compass"])
    apart = plant.at(before, after + 0.02)
    assert np.min(legs(apart)[:, 1, 0]) > -0.1
    passing = plant.at([-0.1, 0.1, 1, -1], [0.1, -0.1, 1, -1])
    assert np.abs(legs(passing)[:, 1]).min(axis=0)[0] < 1e-6
    assert plant.drawing.walks


def test_the_wheel_keeps_its_own_spoke():
    system, before = WALKERS["wheel"]
    steps, plant = step_of(system, before), Plant(system)
    marked = []
    for count in range(1, 10):
        lines = plant.at(*(steps * 9)[: 4 * count - 2])
        (spoke,) = [a for a in lines if isinstance(a, Line2D) and a.get_zorder() == 3]
        marked.append(np.diff(spoke.get_xydata(), axis=0)[0])
    # It turns by one spoke a step, and has come round after eight.
    np.testing.assert_allclose(marked[8], marked[0], atol=1e-6)
    turns = [a[0] * b[1] - a[1] * b[0] for a, b in itertools.pairwise(marked)]
    np.testing.assert_allclose(turns, -np.sin(np.pi / 4), atol=1e-6)


def test_the_ball_stands_on_the_floor_and_leaves_marks():
    plant = Plant(s.BouncingBall())
    artists = plant.at([1.0, 0.0], [0.0, -4.0], [0.0, 3.0], [0.4, 0.1], [0.39, -0.1])
    (ball,) = [a for a in artists if isinstance(a, Circle)]
    assert ball.center[1] - ball.radius == pytest.approx(0.39)
    (mark,) = [a for a in artists if isinstance(a, Line2D)]
    np.testing.assert_allclose(mark.get_ydata(), 0.4)
    assert not [a for a in plant.at([1.0, 0.0]) if isinstance(a, Line2D)]


def test_the_heater_glows_while_it_is_on():
    plant = Plant(s.Thermostat())
    lines = lambda artists: [a for a in artists if isinstance(a, Line2D)]
    assert not lines(plant.at([20.0, 0.0]))
    assert len(lines(plant.at([20.0, 1.0]))) == 3
    level = lambda temperature: max(
        a.get_y() + a.get_height()
        for a in plant.at([temperature, 0.0])
        if hasattr(a, "get_height")
    )
    assert level(21.0) > level(20.0) > level(19.0)


def test_the_belt_moves_and_takes_the_block_along():
    plant = Plant(s.StickSlip(belt=0.5))

    def marks(time, mode):
        artists = plant.at([0.1, 0.2, mode], times=[time])
        (block,) = [a for a in artists if isinstance(a, Polygon)]
        lines = [a.get_xydata() for a in artists if isinstance(a, Line2D)]
        short = [line[0, 0] for line in lines if len(line) == 2 and line[0, 1] == 0]
        return (
            block.get_facecolor(),
            np.ptp(block.get_xy()[:, 0]) / 2 + block.get_xy()[:, 0].min(),
            np.array(short),
        )

    (sticks, at, early), (slips, again, late) = marks(0.0, 0.0), marks(0.2, 1.0)
    assert sticks != slips and at == again == pytest.approx(0.1)
    np.testing.assert_allclose(late[0] - early[0], 0.1, atol=1e-6)


def test_the_stop_that_holds_the_valve_is_green():
    plant = Plant(s.ValveWithStops())
    for state, height in (
        ([0.0, 0, 1], -0.06),
        ([1.0, 0, 2], 1.18),
        ([0.5, 0, 0], None),
    ):
        lines = [a for a in plant.at(state) if isinstance(a, Line2D)]
        green = [line for line in lines if line.get_color() == Canvas.GOAL]
        assert len(green) == (0 if height is None else 2)
        for line in green:
            np.testing.assert_allclose(line.get_ydata(), height)
