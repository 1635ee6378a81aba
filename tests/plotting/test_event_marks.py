"""Events in figures: lines that jump, marks, and frames that show them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import once
from matplotlib.collections import LineCollection

import delucax as dlx
from delucax.plotting._animate import Scene
from delucax.plotting._marks import event_color
from delucax.plotting._path import with_events
from delucax.plotting._runs import as_runs


pytestmark = once

KEEP = ("states", "controls", "costs", "disturbances", "events")
HORIZON = 14


@pytest.fixture(scope="module")
def env():
    dynamics = dlx.Discretized(dlx.systems.BouncingBall(), dt=0.1)
    cost = dlx.costs.Quadratic(jnp.eye(2), jnp.eye(1))
    return dlx.Environment(dynamics, cost, horizon=HORIZON)


@pytest.fixture(scope="module")
def balls(env):
    """Twelve, from heights that grow."""
    zero, key = dlx.controllers.Zero(1), jax.random.key(0)

    def fall(height):
        x0 = jnp.stack([height, 0.0])
        return dlx.rollout(env, zero, key=key, x0=x0, keep=KEEP)

    return jax.vmap(fall)(jnp.linspace(0.5, 1.05, 12))


@pytest.fixture(scope="module")
def ball(balls):
    return balls[10]


def times_of(trajectory):
    return np.array([time for time, _ in trajectory.event_list()])


def marks(ax, linestyle):
    """The lines in the colour of events."""
    return [
        line
        for line in ax.get_lines()
        if line.get_color() == event_color(0) and line.get_linestyle() == linestyle
    ]


def test_lines_jump_where_the_state_does(ball):
    height, velocity = dlx.plot(ball).axes[:2]
    times = times_of(ball)
    assert len(times) == 2
    line = height.get_lines()[0].get_xydata()
    assert np.isnan(line).any(axis=1).sum() == 2
    at = np.flatnonzero(np.isnan(line[:, 0]))
    for i, axis in ((0, height), (1, velocity)):
        line = axis.get_lines()[0].get_xydata()
        for sides, ends in ((at - 1, "before"), (at + 1, "after")):
            states = getattr(ball.events, ends)
            states = np.asarray(states)[np.asarray(ball.events.kinds) >= 0]
            expected = np.stack([times, states[:, i]], axis=1)
            np.testing.assert_allclose(line[sides], expected, rtol=1e-6)
    np.testing.assert_allclose(height.get_lines()[0].get_ydata()[at - 1], 0, atol=1e-6)


def test_few_events_are_lines_with_a_name(ball):
    figure = dlx.plot(ball)
    for ax in figure.axes[:2]:
        at = [line.get_xdata()[0] for line in marks(ax, "--")]
        np.testing.assert_allclose(at, times_of(ball))
    (text,) = figure.legends[0].get_texts()
    assert text.get_text() == f"bounce: 2, first at {times_of(ball)[0]:.3g}"
    assert not dlx.plot(dataclasses.replace(ball, recorded_events=None)).legends
    only_costs = dlx.plot(ball, show="costs")
    assert not only_costs.legends and not marks(only_costs.axes[0], "--")


def test_many_events_and_those_of_a_batch_are_ticks(balls, ball, monkeypatch):
    times = [times_of(balls[i]) for i in range(12)]
    figure = dlx.plot(balls)
    (text,) = figure.legends[0].get_texts()
    assert text.get_text() == f"bounce: {sum(map(len, times))} in 12 runs"
    for drawn, count in ((figure, 12), (dlx.plot(balls[:3]), 3)):
        first, second, *_ = drawn.axes
        (ticks,) = marks(first, "None")
        expected = np.concatenate(times[:count])
        np.testing.assert_allclose(ticks.get_xdata(), expected)
        assert not marks(second, "None") and not marks(first, "--")
    monkeypatch.setattr("delucax.plotting._marks.MOST", 1)
    assert len(marks(dlx.plot(ball).axes[0], "None")) == 1


def test_those_of_compared_runs_have_their_colours(balls):
    figure = dlx.plot({"low": balls[0], "high": balls[11]})
    ticks = [line for line in figure.axes[0].get_lines() if line.get_marker() == "|"]
    assert [len(line.get_xdata()) for line in ticks] == [3, 2]
    assert len({line.get_color() for line in ticks}) == 2
    assert len({line.get_ydata()[0] for line in ticks}) == 2


def test_delayed_plants_jump_in_their_own_states(env):
    late = dlx.dynamics.Delayed(env.dynamics, controls=1)
    cost = dlx.costs.Quadratic(jnp.eye(3), jnp.eye(1))
    delayed = dlx.Environment(late, cost, horizon=HORIZON)
    push = dlx.controllers.Constant(jnp.array([1.0]))
    x0 = late.filled(jnp.array([1.0, 0.0]))
    run = dlx.rollout(delayed, push, key=jax.random.key(0), x0=x0, keep=KEEP)
    (path,) = as_runs(run, None, "", "")[0].paths
    np.testing.assert_allclose(path.states[path.samples], run.states)
    np.testing.assert_allclose(path.states[path.jumps][:, 2], 1.0)


def test_phase_portrait_ends_at_the_floor(ball):
    limits = ((-0.3, 1.2), (-5.0, 5.0))
    system = dlx.systems.BouncingBall()
    figure = dlx.plotting.phase_portrait(system, limits=limits, trajectories=ball)
    (ax,) = figure.axes
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["bounce"]
    flow, *rest = [c for c in ax.collections if isinstance(c, LineCollection)]
    assert min(np.min(line[:, 0]) for line in flow.get_segments()) > -0.03
    jumps = np.stack(rest[-1].get_segments())
    np.testing.assert_allclose(jumps[:, :, 0], 0.0, atol=1e-6)
    np.testing.assert_allclose(jumps[:, 1, 1], -0.8 * jumps[:, 0, 1], rtol=1e-5)
    # No guard is zero where the ball is high.
    limits = ((0.5, 1.2), (-5.0, 5.0))
    assert not dlx.plotting.phase_portrait(system, limits=limits).legends


def test_frames_show_the_moments_of_events(env, ball):
    animation = dlx.animate(env, ball)
    assert animation.indices == tuple(range(HORIZON + 1))
    scene = Scene(as_runs(ball, None, "", "")[0], env, animation.indices, 40)
    first, second = (round(10 * time) for time in times_of(ball))
    for k, text in ((first - 1, ""), (first, "bounce 1"), (second, "bounce 2")):
        scene.frame(k)
        assert scene.texts[2].get_text() == text
        height, _ = scene._moment(scene.rows[k])[0]
        assert (abs(height) < 1e-6) == bool(text)
    assert scene.texts[2].get_color() == event_color(0)
    scene.frame(second - 1)
    assert scene.texts[2].get_color() != event_color(0)
    grown = scene.lines[0][0].get_xydata()
    assert np.nanmin(grown[:, 1]) == pytest.approx(0.0, abs=1e-6)
    assert grown[-1, 0] == pytest.approx(0.1 * (second - 1))


def test_events_that_were_not_kept_are_found(env, ball):
    lost = dataclasses.replace(ball, recorded_events=None)
    found = dlx.animate(env, lost).trajectory
    np.testing.assert_allclose(found.events.times, ball.events.times, atol=1e-6)
    np.testing.assert_array_equal(found.events.kinds, ball.events.kinds)
    cut = dataclasses.replace(lost, length=jnp.asarray(6))
    assert len(with_events(env, cut).event_list()) == 1
    # What is not known is not guessed.
    keep = ("states", "controls", "costs")
    unknown = dataclasses.replace(lost, keep=keep, recorded_disturbances=None)
    assert with_events(env, unknown).recorded_events is None
