"""Phase portraits of systems with two states."""

from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from .. import _figures as figures
from .._check import as_vector, check_instance
from ..systems import AbstractHybridSystem, AbstractSystem
from ._marks import event_color
from ._runs import as_runs, Trajectories


Limits: TypeAlias = Float[np.ndarray, "2 2"]

GRID = 60
DASHES = (0, (5, 2))
SIZE = 10.0


def phase_portrait(
    system: AbstractSystem,
    *,
    limits: Any,
    control: Any = None,
    trajectories: Trajectories = (),
) -> Figure:
    r"""Draw the phase portrait of a system with two states, and trajectories in it.

    The streamlines follow the vector field $\dot x$ at time 0. Streamlines are thicker
    where the state moves faster. A dot marks the start of each trajectory. If a state
    is an angle (the system's `difference` wraps it), each trajectory is drawn several
    times, shifted by full turns, wherever it is within the limits.

    If the system has events, dashed lines show where the guards of the events are zero.
    Beyond these lines, no streamlines are drawn. A dotted line joins the states before
    and after each event, if the trajectory kept its events.

    **Arguments:**

    - `system`: a system with two states.
    - `limits`: the ranges of the first and the second state, `((low, high), (low,
        high))`.
    - `control`: a vector, shape `(m,)`, or a function from the state to such a vector
        (for a closed loop); zero by default.
    - `trajectories`: a [`delucax.Trajectory`][], a batch or a sequence of trajectories,
        or a dictionary from labels to trajectories; none by default.

    **Returns:** a `matplotlib.figure.Figure`.

    **Raises:** `ValueError` if the system does not have two states, if a lower limit is
    not below the upper one, or if the control or a trajectory does not fit the system.

    !!! example

        ```python
        import delucax as dlx

        figure = dlx.plotting.phase_portrait(
            dlx.systems.Pendulum(damping=0.5), limits=((-6.0, 6.0), (-8.0, 8.0))
        )
        ```
    """
    where = "phase_portrait"
    check_instance(system, AbstractSystem, "system", where)
    if system.state_size != 2:
        raise ValueError(
            f"{where}: system must have two states, got {system.state_names}."
        )
    limits = _checked_limits(limits, where)
    runs = []
    if not isinstance(trajectories, tuple | list | dict) or len(trajectories):
        runs = as_runs(trajectories, None, "trajectories", where)
        names = runs[0].trajectory.state_names
        if names != system.state_names:
            raise ValueError(
                f"{where}: trajectories have states {names}, but the system has "
                f"{system.state_names}."
            )
    x, v = (np.linspace(low, high, GRID) for low, high in limits)
    states = np.stack(np.meshgrid(x, v), axis=-1).reshape(-1, 2)
    field, guards = _field(system, control, jnp.asarray(states), where)
    field = field.reshape(GRID, GRID, 2)

    figure = figures.NotebookFigure(figsize=(6.0, 4.8), layout="constrained")
    ax = figure.add_subplot()
    figures.style_axes(ax, size=SIZE, ticks=(8, 6))
    ax.grid(False)
    # Speed relative to the limits, so that neither axis outweighs the other.
    speed = np.linalg.norm(field / (limits[:, 1] - limits[:, 0]), axis=-1)
    top = np.nanmax(np.where(np.isfinite(speed), speed, 0.0), initial=0.0) or 1.0
    if np.any(speed > 0):
        width = 0.5 + 0.9 * np.sqrt(speed / top)
        style: dict[str, Any] = {"density": 1.3, "arrowsize": 0.8, "zorder": 1}
        style |= {"linewidth": width, "color": to_rgba(figures.NEUTRAL, 0.6)}
        ax.streamplot(x, v, field[..., 0], field[..., 1], **style)
    entries = []
    for kind, (name, values) in enumerate(guards.items()):
        color = event_color(kind)
        style = {"colors": [color], "linestyles": [DASHES], "zorder": 1}
        values = values.reshape(GRID, GRID)
        ax.contour(x, v, values, levels=[0.0], linewidths=1.4, **style)
        entries.append((Line2D([], [], color=color, ls=DASHES, lw=1.4), name))
    for i, run in enumerate(runs):
        style = figures.line_style(i)
        members = run.paths
        alpha = 1.0 if len(members) == 1 else max(0.2, 0.9 - 0.02 * len(members))
        for path in members:
            _, line = path.broken()
            jumps = np.stack([path.states[path.jumps - 1], path.states[path.jumps]], 1)
            for turn in _turns(system, path.states, limits):
                xs, vs = (line + turn).T
                ax.plot(xs, vs, linewidth=1.8, alpha=alpha, zorder=2, **style)
                ax.plot(xs[:1], vs[:1], "o", color=style["color"], ms=5, zorder=3)
                dotted = {"linestyles": ":", "linewidth": 1.2, "alpha": alpha}
                dotted["color"] = style["color"]
                ax.add_collection(LineCollection(list(jumps + turn), **dotted))
        handle = Line2D([], [], linewidth=1.8, **style)
        if isinstance(trajectories, dict):
            entries.append((handle, figures.wrapped(run.label, 40)))
    ax.set(xlim=limits[0], ylim=limits[1])
    units = system.state_units or ("", "")
    x_label, y_label = map(figures.with_unit, system.state_names, units)
    ax.set_xlabel(figures.wrapped(x_label, 60), size=SIZE)
    ax.set_ylabel(figures.wrapped(y_label, 45), size=SIZE)
    if entries:
        columns = max(1, 60 // (6 + max(len(label) for _, label in entries)))
        figures.top_legend(figure, entries, ncols=columns, fontsize=SIZE)
    return figure


def _checked_limits(limits: Any, where: str) -> Limits:
    try:
        array = np.asarray(limits, float)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.shape != (2, 2) or not np.all(np.isfinite(array)):
        raise ValueError(
            f"{where}: limits must be ((low, high), (low, high)), got {limits!r}."
        )
    if not np.all(array[:, 0] < array[:, 1]):
        raise ValueError(f"{where}: limits must have low < high, got {limits!r}.")
    return array


def _field(
    system: AbstractSystem, control: Any, states: Float[Array, "n 2"], where: str
) -> tuple[Float[np.ndarray, "n 2"], dict[str, np.ndarray]]:
    """The derivative at each row of `states`, NaN beyond a guard. Also, by name, the
    values of the guards that change sign, NaN where a guard is not enabled."""
    if not callable(control):
        given = np.zeros(system.control_size) if control is None else control
        control = as_vector(given, system.control_size, "control", where)
    field, guards = _compiled_field(system, control, states, where)
    if not isinstance(system, AbstractHybridSystem):
        return np.asarray(field), {}
    values, enabled = map(np.asarray, guards)
    names = system.event_names
    directions = np.asarray(system.event_directions or (-1,) * len(names))
    beyond = np.any(enabled & (values * directions > 0), axis=1)
    values = np.where(enabled, values, np.nan).T
    crossed = np.any(values < 0, axis=1) & np.any(values > 0, axis=1)
    zero = {names[i]: values[i] for i in np.flatnonzero(crossed)}
    return np.where(beyond[:, None], np.nan, field), zero


@eqx.filter_jit
def _compiled_field(
    system: AbstractSystem, control: Any, states: Float[Array, "n 2"], where: str
) -> tuple[Float[Array, "n 2"], Any]:
    size = system.control_size
    w = jnp.zeros(system.disturbance_size) if system.disturbance_names else None

    def at(x):
        u = control
        if callable(control):
            u = as_vector(control(x), size, "what control returns", where)
        dx, rows = system.vector_field(0.0, x, u, w), ()
        if isinstance(system, AbstractHybridSystem):
            rows = system.guards(0.0, x, u), system.enabled(0.0, x, u)
        return dx, [jnp.stack([jnp.asarray(a) for a in row]) for row in rows]

    return jax.vmap(at)(states)


def _turns(
    system: AbstractSystem, path: Float[np.ndarray, "times 2"], limits: Limits
) -> list[np.ndarray]:
    """The shifts by whole turns of the angles that bring `path` within the limits."""
    turns, zero = [np.zeros(2)], jnp.zeros(2)
    for i, (low, high) in enumerate(limits):
        full = 2 * np.pi * np.eye(2)[i]
        away = np.asarray(system.difference(zero + full, zero))
        if np.max(np.abs(away)) > 1e-3 or not np.any(np.isfinite(path[:, i])):
            continue
        first = np.ceil((low - np.nanmax(path[:, i])) / (2 * np.pi))
        last = np.floor((high - np.nanmin(path[:, i])) / (2 * np.pi))
        turns = [t + k * full for t in turns for k in np.arange(first, last + 1)]
    return turns
