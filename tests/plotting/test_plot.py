"""Trajectories against time: what is in the figure."""

import dataclasses
import io
import warnings

import jax
import jax.numpy as jnp
import matplotlib
import matplotlib.colors
import matplotlib.style
import numpy as np
import pytest
from helpers import once, user_error
from matplotlib.collections import PolyCollection
from PIL import Image

import delucax as dlx
from delucax._figures import PALETTE


pytestmark = once


class Drone(dlx.AbstractSystem):
    """Twelve states in four units."""

    state_names = tuple(
        f"{kind}_{axis}" for kind in ("p", "angle", "v", "rate") for axis in "xyz"
    )
    control_names = ("thrust_front_left", "thrust_front_right", "thrust_rear")
    state_units = ("m",) * 3 + ("rad",) * 3 + ("m/s",) * 3 + ("rad/s",) * 3
    control_units = ("N",) * 3

    def vector_field(self, t, x, u, w):
        return jnp.concatenate([x[6:], -x[:6] + 0.1 * jnp.concatenate([u, u])])


class LongNames(dlx.AbstractSystem):
    state_names = (
        "horizontal position of the cart along the rail, measured from its middle",
        "cart_velocity_as_it_is_measured_by_the_encoder_of_the_motor",
    )
    control_names = ("force of the motor on the cart",)
    state_units = ("m", "m/s")
    control_units = ("N",)

    def vector_field(self, t, x, u, w):
        return jnp.stack([x[1], u[0]])


def environment_of(system, **arguments):
    n, m = system.state_size, system.control_size
    cost = dlx.costs.Quadratic(jnp.eye(n), jnp.eye(m))
    dynamics = dlx.Discretized(system, dt=0.1)
    return dlx.Environment(dynamics, cost, horizon=20, **arguments)


@pytest.fixture(scope="module")
def env():
    return dlx.make("pendulum", horizon=30)


@pytest.fixture(scope="module")
def linear():
    return dlx.controllers.Linear(jnp.array([[20.0, 5.0]]))


@pytest.fixture(scope="module")
def trajectory(env, linear):
    return dlx.rollout(env, linear, key=jax.random.key(0), x0=jnp.array([0.3, 0.0]))


@pytest.fixture(scope="module")
def batch(env, linear):
    keys = jax.random.split(jax.random.key(1), 20)
    return jax.vmap(lambda key: dlx.rollout(env, linear, key=key))(keys)


@pytest.fixture(scope="module")
def drone():
    low = jnp.array([-1.0, -2.0, -jnp.inf])
    env = environment_of(Drone(), control_bounds=(low, 3.0))
    return env, dlx.rollout(env, dlx.controllers.Zero(3), key=jax.random.key(0))


@pytest.fixture(scope="module")
def ending():
    """A batch whose members terminate at different times, each with its length."""
    env = environment_of(
        LongNames(),
        terminated=lambda t, x: x[0] > 1.0,
        initial_state=lambda key: jax.random.uniform(key, (2,)),
    )
    push = dlx.controllers.Constant(jnp.array([1.0]))
    keys = jax.random.split(jax.random.key(2), 20)
    return jax.vmap(lambda key: dlx.rollout(env, push, key=key))(keys)


def plain(text):
    return text.replace("\n", " ")


def data_lines(ax):
    """The lines that are neither bounds nor marks."""
    return [
        line
        for line in ax.get_lines()
        if line.get_linestyle() != "None" and line.get_transform() == ax.transData
    ]


def legend_texts(owner):
    legend = owner.legends[0] if hasattr(owner, "legends") else owner.get_legend()
    return [text.get_text() for text in legend.get_texts()]


def test_panels_have_names_units_and_the_values(trajectory):
    figure = dlx.plot(trajectory)
    labels = [ax.get_ylabel() for ax in figure.axes]
    assert labels == ["angle [rad]", "velocity [rad/s]", "torque [N m]", "cost"]
    assert figure.axes[-1].get_xlabel() == "time [s]"
    for i, ax in enumerate(figure.axes[:2]):
        (line,) = data_lines(ax)
        np.testing.assert_allclose(line.get_xdata(), trajectory.times)
        np.testing.assert_allclose(line.get_ydata(), trajectory.states[:, i])
    (cost,) = data_lines(figure.axes[3])
    np.testing.assert_allclose(cost.get_ydata()[:-1], trajectory.costs)
    assert f"{trajectory.total_cost:.4g}" in figure.axes[3].get_title(loc="right")


def test_controls_are_steps_that_last_to_the_end(trajectory):
    (line,) = data_lines(dlx.plot(trajectory).axes[2])
    assert line.get_drawstyle() == "steps-post"
    controls = np.asarray(trajectory.controls)[:, 0]
    np.testing.assert_allclose(line.get_xdata(), trajectory.times)
    np.testing.assert_allclose(line.get_ydata(), np.append(controls, controls[-1]))


def test_bounds_are_dashed_where_an_environment_is_given(env, trajectory):
    def dashed(figure):
        lines = figure.axes[2].get_lines()
        return sorted(l.get_ydata()[0] for l in lines if l.get_linestyle() == "--")

    assert dashed(dlx.plot(trajectory)) == []
    assert dashed(dlx.plot(trajectory, environment=env)) == [-2.0, 2.0]


def test_bounds_of_each_control_of_a_panel(drone):
    env, run = drone
    lines = dlx.plot(run, environment=env, show="controls").axes[0].get_lines()
    found = sorted(l.get_ydata()[0] for l in lines if l.get_linestyle() == "--")
    assert found == [-2.0, -1.0, 3.0, 3.0, 3.0]


def test_states_that_share_a_unit_share_a_panel(drone):
    figure = dlx.plot(drone[1])
    assert len(figure.axes) == 6
    for i, unit in enumerate(("[m]", "[rad]", "[m/s]", "[rad/s]", "[N]")):
        ax = figure.axes[i]
        names = (*Drone.state_names, *Drone.control_names)[3 * i : 3 * i + 3]
        assert ax.get_ylabel().endswith(unit)
        assert [plain(text) for text in legend_texts(ax)] == list(names)
        colors = {line.get_color() for line in data_lines(ax)}
        assert len(colors) == len(data_lines(ax)) == 3


def test_states_without_units_are_spread_over_panels(key):
    env = dlx.make("lds", A=jnp.eye(12), B=jnp.ones((12, 1)), horizon=5)
    run = dlx.rollout(env, dlx.controllers.Zero(1), key=key, x0=jnp.ones(12))
    figure = dlx.plot(run)
    assert [len(data_lines(ax)) for ax in figure.axes] == [6, 6, 1, 1]
    assert figure.axes[0].get_ylabel().replace("\n", " ") == "x0, x1, x2, x3, x4, x5"
    assert figure.axes[-1].get_xlabel() == "time"


def test_long_names_are_whole_and_fit(ending):
    figure = dlx.plot(ending[0])
    names = (*LongNames.state_names, *LongNames.control_names)
    units = (*LongNames.state_units, *LongNames.control_units)
    figure.draw_without_rendering()
    boxes = [ax.yaxis.label.get_window_extent() for ax in figure.axes]
    for ax, name, unit in zip(figure.axes, names, units, strict=False):
        label = ax.get_ylabel()
        assert name.replace(" ", "") in label.replace("\n", "").replace(" ", "")
        assert label.endswith(f"[{unit}]")
    for upper, lower in zip(boxes, boxes[1:], strict=False):
        assert lower.y1 < upper.y0
    assert all(box.x0 >= 0 and box.y1 <= figure.bbox.y1 for box in boxes)


def test_comparison_overlays_with_a_legend(env, trajectory, key):
    zero = dlx.rollout(env, dlx.controllers.Zero(1), key=key, horizon=15)
    figure = dlx.plot({"linear": trajectory, "zero": zero})
    assert len(figure.axes) == 4
    texts = legend_texts(figure)
    assert [text.split(" (")[0] for text in texts] == ["linear", "zero"]
    assert f"{zero.total_cost:.4g}" in texts[1]
    for ax in figure.axes:
        first, second = data_lines(ax)
        assert len(first.get_xdata()) == 31 and len(second.get_xdata()) == 16
        assert first.get_color() != second.get_color()
    handles = figure.legends[0].get_lines()
    assert handles[1].get_color() == data_lines(figure.axes[0])[1].get_color()


def test_comparison_has_a_panel_for_each_state(drone):
    figure = dlx.plot([drone[1]] * 2)
    assert len(figure.axes) == 12 + 3 + 1
    assert figure.axes[3].get_ylabel() == "angle_x [rad]"
    assert figure.get_supxlabel() == "time [s]"


def test_sequence_takes_labels(trajectory):
    figure = dlx.plot([trajectory, trajectory[:10]], labels=("long", "short"))
    assert [t.split(" (")[0] for t in legend_texts(figure)] == ["long", "short"]
    quiet = dataclasses.replace(trajectory, incidents={})
    assert dlx.plot(quiet, labels="run 7").get_suptitle() == "run 7"
    (legend,) = dlx.plot(trajectory, labels="run 7").legends
    assert legend.get_title().get_text() == "run 7"


def test_more_lines_than_colours_differ_in_style(trajectory):
    lines = data_lines(dlx.plot([trajectory] * 8, show="angle").axes[0])
    styles = {(line.get_color(), str(line._dash_pattern)) for line in lines}
    assert len(styles) == 8


def test_small_batch_is_drawn_member_by_member(batch):
    few = batch[:5]
    lines = data_lines(dlx.plot(few).axes[0])
    assert len(lines) == 5
    for line, states in zip(lines, few.states, strict=True):
        np.testing.assert_allclose(line.get_ydata(), states[:, 0])


def test_large_batch_is_drawn_as_quartiles(batch):
    figure = dlx.plot(batch)
    for ax, values in zip(figure.axes, np.moveaxis(batch.states, -1, 0), strict=False):
        (line,) = data_lines(ax)
        low, middle, high = np.quantile(values, [0.25, 0.5, 0.75], axis=0)
        np.testing.assert_allclose(line.get_ydata(), middle, atol=1e-6)
        (band,) = [c for c in ax.collections if isinstance(c, PolyCollection)]
        ys = band.get_paths()[0].vertices[:, 1]
        np.testing.assert_allclose([ys.min(), ys.max()], [low.min(), high.max()])
    assert "median" in figure.axes[3].get_title(loc="right")


def test_batch_with_several_axes_is_one_batch(batch):
    nested = jax.tree.map(lambda leaf: leaf.reshape(4, 5, *leaf.shape[1:]), batch)
    (line,) = data_lines(dlx.plot(nested).axes[0])
    (flat,) = data_lines(dlx.plot(batch).axes[0])
    np.testing.assert_array_equal(line.get_ydata(), flat.get_ydata())


def test_members_that_have_ended_leave_the_band(ending):
    lengths = np.asarray(ending.length)
    assert lengths.min() < lengths.max()
    figure = dlx.plot(ending)
    (line,) = data_lines(figure.axes[0])
    k = int(lengths.min()) + 1
    there = lengths >= k
    assert 0 < there.sum() < len(there)
    expected = np.median(np.asarray(ending.states)[there, k, 0])
    np.testing.assert_allclose(line.get_ydata()[k], expected, rtol=1e-6)
    ended = int((lengths < 20).sum())
    assert legend_texts(figure) == [f"terminated: {ended} of 20"]


def test_termination_is_marked_and_nothing_drawn_after_it(ending):
    run = ending[int(np.argmin(ending.length))]
    length = int(run.length)
    figure = dlx.plot(run)
    (line,) = data_lines(figure.axes[0])
    assert np.isfinite(line.get_ydata()[: length + 1]).all()
    assert np.isnan(line.get_ydata()[length + 1 :]).all()
    (control,) = data_lines(figure.axes[2])
    assert np.isfinite(control.get_ydata()[: length + 1]).all()
    assert np.isnan(control.get_ydata()[length + 1 :]).all()
    (mark,) = [m for m in figure.axes[0].get_lines() if m.get_marker() == "o"]
    np.testing.assert_allclose(mark.get_xdata(), run.times[length], rtol=1e-6)
    np.testing.assert_allclose(mark.get_ydata(), run.states[length, 0], rtol=1e-6)
    assert legend_texts(figure) == ["terminated"]


def test_failure_is_marked_where_it_happened(key):
    square = dlx.system(lambda t, x, u, w: x**4, states=1, controls=1)
    env = environment_of(square, initial_state=jnp.array([3.0]))
    run = dlx.rollout(env, dlx.controllers.Zero(1), key=key, throw=False)
    finite = np.isfinite(np.asarray(run.states)[:, 0])
    assert not finite.all()
    figure = dlx.plot(run)
    (mark,) = [m for m in figure.axes[0].get_lines() if m.get_marker() == "x"]
    last = np.flatnonzero(finite)[-1]
    np.testing.assert_allclose(mark.get_xdata(), run.times[last])
    assert legend_texts(figure) == [f"failed: {dlx.RESULTS[run.result]}"]
    compared = dlx.plot({"good": run[:1], "bad": run})
    assert "failed" in legend_texts(compared)[-1]


def test_show_chooses_and_orders(trajectory):
    figure = dlx.plot(trajectory, show=("costs", "velocity", "torque"))
    labels = [ax.get_ylabel() for ax in figure.axes]
    assert labels == ["cost", "velocity [rad/s]", "torque [N m]"]
    figure = dlx.plot(trajectory, show=("observations", "disturbances"))
    assert [ax.get_ylabel() for ax in figure.axes] == ["y0, y1", "w0, w1"]
    drawn = {line.get_drawstyle() for line in data_lines(figure.axes[1])}
    assert drawn == {"steps-post"}


def test_what_was_not_kept_is_left_out(env, linear, key):
    run = dlx.rollout(env, linear, key=key, keep=("states",))
    labels = [ax.get_ylabel() for ax in dlx.plot(run).axes]
    assert labels == ["angle [rad]", "velocity [rad/s]"]


def test_no_steps_is_a_point(trajectory):
    (line,) = data_lines(dlx.plot(trajectory[4:4]).axes[0])
    np.testing.assert_allclose(line.get_ydata(), trajectory.states[4:5, 0])


def test_notebook_shows_the_figure_at_its_nominal_size(trajectory):
    from IPython.core.formatters import DisplayFormatter

    figure = dlx.plot(trajectory)
    data, metadata = DisplayFormatter().format(figure)
    image = Image.open(io.BytesIO(data["image/png"]))
    width, height = figure.get_size_inches() * figure.dpi
    size = metadata["image/png"]
    assert abs(size["width"] - width) <= 1 and abs(size["height"] - height) <= 1
    assert image.width == 2 * size["width"]
    colors = image.convert("RGB").getcolors(image.width * image.height)
    blue = matplotlib.colors.to_rgb(data_lines(figure.axes[0])[0].get_color())
    near = [c for n, c in colors if np.abs(np.array(blue) * 255 - c).max() < 12]
    assert near and max(colors)[1] == (255, 255, 255)


def test_settings_are_left_alone_and_nothing_warns(trajectory, batch):
    before = dict(matplotlib.rcParams)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for figure in (dlx.plot(trajectory), dlx.plot(batch)):
            figure.savefig(io.BytesIO(), format="pdf")
    assert dict(matplotlib.rcParams) == before


def test_the_style_sheet_has_the_palette_of_the_figures(trajectory):
    with matplotlib.style.context("delucax.plotting.style"):
        cycle = matplotlib.rcParams["axes.prop_cycle"].by_key()["color"]
    assert tuple(cycle) == PALETTE
    assert data_lines(dlx.plot(trajectory).axes[0])[0].get_color() == cycle[0]


def test_errors_name_the_argument(env, linear, trajectory, key):
    lds = dlx.make("lds", A=jnp.eye(2), B=jnp.ones((2, 1)), horizon=5)
    other = dlx.rollout(lds, dlx.controllers.Zero(1), key=key, x0=jnp.ones(2))
    blind = dlx.rollout(env, linear, key=key, keep=("controls", "costs"))
    poor = dlx.rollout(env, linear, key=key, keep=("states",))
    for arguments, match in (
        (({},), "trajectory must not be empty"),
        (([],), "trajectory must not be empty"),
        ((3,), "trajectory must be a Trajectory.*got int"),
        (({"a": 3},), r"trajectory\['a'\] must be a Trajectory, got int"),
        ((blind,), "trajectory holds no states; keep them"),
        (({"a": trajectory, "b": other},), r"trajectory\['b'\] has state_names"),
        (({"a": trajectory, "b": poor},), r"trajectory\['b'\] holds no controls, cost"),
    ):
        with user_error(match=match):
            dlx.plot(*arguments)
    for keywords, match in (
        ({"labels": ("a", "b")}, "labels must be 1 strings"),
        ({"show": ("angle", "height")}, "show must be among states, .*'height'"),
        ({"show": ()}, "show must name what to draw"),
        ({"environment": lds}, "environment has state_names"),
        ({"environment": 3}, "environment must be an Environment, got int"),
    ):
        with user_error(match=match):
            dlx.plot(trajectory, **keywords)
    with user_error(match="labels must not be given with a dictionary"):
        dlx.plot({"a": trajectory}, labels=["b"])


def test_traced_values_are_refused(env, linear, key):
    @jax.jit
    def draw(x0):
        dlx.plot(dlx.rollout(env, linear, key=key, x0=x0))
        return x0

    with user_error(match="trajectory must hold values"):
        draw(jnp.zeros(2))


def test_incidents_are_ticks_above_the_controls(env, trajectory, key):
    failed = jnp.arange(30) % 7 == 3
    clipped = jnp.arange(30) < 4
    none = jnp.zeros(30, bool)
    names = "failed_plan", "clipped_control", "refused_update"
    incidents = dict(zip(names, (failed, clipped, none), strict=True))
    run = dataclasses.replace(trajectory, incidents=incidents)
    figure = dlx.plot(run)
    assert legend_texts(figure) == [
        "clipped control: 4 steps, first at 0",
        "failed plan: 4 steps, first at 0.15",
    ]
    ticks = [ln for ln in figure.axes[2].get_lines() if ln.get_marker() == "|"]
    np.testing.assert_allclose(ticks[0].get_xdata(), trajectory.times[:4])
    np.testing.assert_allclose(ticks[1].get_xdata(), trajectory.times[:-1][failed])
    texts = legend_texts(dlx.plot({"a": run, "b": trajectory}))
    assert texts[2:] == ["failed plan: in 1 of 2"]
