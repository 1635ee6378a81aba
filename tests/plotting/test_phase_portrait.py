"""Phase portraits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import once, user_error
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

import delucax as dlx


pytestmark = once


LIMITS = ((-4.0, 4.0), (-6.0, 6.0))


@pytest.fixture
def flow(monkeypatch):
    """The field that the streamlines are asked to follow."""
    seen = {}
    streamplot = Axes.streamplot

    def record(self, x, y, u, v, **keywords):
        seen.update(x=x, y=y, u=u, v=v)
        return streamplot(self, x, y, u, v, **keywords)

    monkeypatch.setattr(Axes, "streamplot", record)
    return seen


@pytest.fixture(scope="module")
def swing():
    env = dlx.make("pendulum", horizon=20)
    zero = dlx.controllers.Zero(1)
    key = jax.random.key(0)
    return dlx.rollout(env, zero, key=key, x0=jnp.array([3.0, 0.0]))


def trajectory_lines(ax):
    return [line for line in ax.get_lines() if line.get_linestyle() != "None"]


def test_streamlines_follow_the_vector_field(flow):
    system = dlx.systems.Pendulum(damping=0.5)
    figure = dlx.plotting.phase_portrait(system, limits=LIMITS)
    (ax,) = figure.axes
    assert ax.get_xlabel() == "angle [rad]" and ax.get_ylabel() == "velocity [rad/s]"
    assert ax.get_xlim() == LIMITS[0] and ax.get_ylim() == LIMITS[1]
    assert any(isinstance(c, LineCollection) for c in ax.collections)
    x, v = np.meshgrid(flow["x"], flow["y"])
    np.testing.assert_allclose(flow["u"], v, rtol=1e-6)
    np.testing.assert_allclose(
        flow["v"], 15 * np.sin(x) - 0.5 * v, rtol=1e-4, atol=1e-4
    )


def test_control_is_constant_or_a_law(flow):
    def push(t, x, u, w):
        return jnp.stack([x[1], u[0]])

    car = dlx.system(push, states=("x", "v"), controls=1)
    dlx.plotting.phase_portrait(car, limits=LIMITS, control=[2.0])
    np.testing.assert_allclose(flow["v"], 2.0)
    dlx.plotting.phase_portrait(car, limits=LIMITS, control=lambda x: -3 * x[:1])
    x, _ = np.meshgrid(flow["x"], flow["y"])
    np.testing.assert_allclose(flow["v"], -3 * x, rtol=1e-6)


def test_disturbances_inside_are_zero_and_a_field_may_vanish(flow):
    def still(t, x, u, w):
        return jnp.stack([w[0], 0 * x[0]])

    system = dlx.system(still, states=2, controls=0, disturbances=1)
    figure = dlx.plotting.phase_portrait(system, limits=LIMITS)
    assert not flow and figure.axes[0].get_xlabel() == "x0"


def test_angles_show_every_turn_within_the_limits(swing):
    system = dlx.systems.Pendulum()
    figure = dlx.plotting.phase_portrait(system, limits=LIMITS, trajectories=swing)
    lines = trajectory_lines(figure.axes[0])
    starts = sorted(line.get_xdata()[0] for line in lines)
    np.testing.assert_allclose(starts, [3 - 2 * np.pi, 3], rtol=1e-5)
    for line in lines:
        np.testing.assert_allclose(line.get_ydata(), swing.states[:, 1], rtol=1e-5)


def test_plain_states_are_drawn_once(swing):
    def field(t, x, u, w):
        return jnp.stack([x[1], -x[0]])

    names = ("angle", "velocity")
    system = dlx.system(field, states=names, controls=1)
    figure = dlx.plotting.phase_portrait(
        system, limits=LIMITS, trajectories={"one": swing, "half": swing[:10]}
    )
    assert len(trajectory_lines(figure.axes[0])) == 2
    assert [t.get_text() for t in figure.legends[0].get_texts()] == ["one", "half"]


def test_errors_name_the_argument(swing, key):
    portrait = dlx.plotting.phase_portrait
    system = dlx.systems.Pendulum()
    three = dlx.system(lambda t, x, u, w: x, states=3, controls=1)
    lds = dlx.make("lds", A=jnp.eye(2), B=jnp.ones((2, 1)), horizon=5)
    run = dlx.rollout(lds, dlx.controllers.Zero(1), key=key, x0=jnp.ones(2))
    for arguments, match in (
        ((three, LIMITS), "system must have two states, got"),
        ((lds, LIMITS), "system must be an AbstractSystem.*got Environment"),
        ((system, (0, 1)), r"limits must be \(\(low, high\)"),
        ((system, "wide"), "limits must be"),
        ((system, ((1, -1), (0, 1))), "limits must have low < high"),
        ((system, ((0, jnp.inf), (0, 1))), "limits must be"),
    ):
        with user_error(match=f"phase_portrait: {match}"):
            portrait(arguments[0], limits=arguments[1])
    for keywords, match in (
        ({"control": [1.0, 2.0]}, r"control must have shape \(1,\)"),
        ({"control": lambda x: x}, r"what control returns must have shape \(1,\)"),
        ({"trajectories": run}, "trajectories have states"),
        ({"trajectories": 3}, "trajectories must be a Trajectory"),
        ({"trajectories": [swing, run]}, r"trajectories\['trajectory 1'\] has state"),
    ):
        with user_error(match=f"phase_portrait: {match}"):
            portrait(system, limits=LIMITS, **keywords)
