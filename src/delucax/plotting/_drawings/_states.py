"""States that stand for nothing to be seen: a plane of two, or bars of many."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes

from ...dynamics import AbstractDynamics
from ...environments import Environment
from ...simulation import Trajectory
from ...systems import AbstractSystem, Lorenz
from .._figure import NEUTRAL, style_axes, with_unit, wrapped
from ._parts import (
    ACTION,
    BODY,
    finite_states,
    GOAL,
    largest_controls,
    target_of,
    View,
)
from ._registry import add_drawing, Drawing, system_of


SIZE = 11.0
ARROWS = 15
MOST_NAMES = 16


def setup_plane(
    ax: Axes,
    environment: Environment,
    trajectory: Trajectory,
    columns: tuple[int, int] = (0, 1),
) -> dict[str, Any]:
    """The plane of two states, with the goal, and with the flow where there are but
    two."""
    dynamics = environment.dynamics
    units = dynamics.state_units or ("",) * dynamics.state_size
    ax.set_axis_on()
    ax.set_aspect("auto")
    style_axes(ax, size=SIZE, ticks=(6, 6))
    names = [with_unit(dynamics.state_names[c], units[c]) for c in columns]
    ax.set_xlabel(wrapped(names[0], 40), size=SIZE)
    ax.set_ylabel(wrapped(names[1], 40), size=SIZE)
    points = finite_states(trajectory)[:, columns]
    target = target_of(environment)
    if target is not None:
        points = np.concatenate([points, target[None, columns]])
        ax.plot(*target[list(columns)], "o", ms=13, mfc="none", mec=GOAL, mew=2)
    low, high = points.min(axis=0), points.max(axis=0)
    margin = np.where(high > low, 0.09 * (high - low), 1.0)
    view = View((low + high) / 2, (high - low) / 2 + margin)
    view.show(ax)
    if dynamics.state_size == 2:
        ax.grid(False)
        _draw_flow(ax, environment, view)
    return {"columns": columns, "view": view}


def _draw_flow(ax: Axes, environment: Environment, view: View) -> None:
    """Faint arrows along which the states go, all of one length: under the control of
    the equilibrium, or without control if none is named."""
    ends = view.centre - view.half, view.centre + view.half
    sides = np.linspace(*ends, ARROWS + 2)[1:-1].T
    places = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
    system: Any = system_of(environment)
    try:
        u = environment.dynamics.equilibrium()[1]
    except ValueError:
        u = jnp.zeros(system.control_size)
    if isinstance(system, AbstractSystem):
        w = jnp.zeros(system.disturbance_size) if system.disturbance_names else None
        field = lambda x: system.vector_field(0.0, x, u, w)
    else:
        field = lambda x: system(0.0, x, u) - x
    ways = np.asarray(jax.vmap(field)(jnp.asarray(places)), float) / view.half
    ways = ways / np.maximum(np.linalg.norm(ways, axis=-1, keepdims=True), 1e-12)
    ax.quiver(
        *places.T,
        *ways.T,
        pivot="middle",
        scale=1.6 * ARROWS,
        width=0.004,
        color=NEUTRAL,
        alpha=0.4,
        zorder=0,
    )


def draw_plane(
    ax: Axes, x: np.ndarray, u: np.ndarray, columns: tuple[int, int], view: View
) -> None:
    """A dot where the two states are; the view grows where it would leave."""
    del u
    at = x[list(columns)]
    ax.plot(*at, "o", color=ACTION, markersize=9, zorder=4)
    away = np.abs(at - view.centre) / view.half
    View(view.centre, view.half * np.maximum(1.0, 1.05 * away)).show(ax)


def trace_plane(states: np.ndarray, columns: tuple[int, int], view: View) -> np.ndarray:
    """Where the states have been in the plane."""
    return states[:, columns]


def setup_butterfly(
    ax: Axes, environment: Environment, trajectory: Trajectory
) -> dict[str, Any]:
    """The plane of x and z, in which the wings are seen."""
    return setup_plane(ax, environment, trajectory, (0, 2))


def setup_bars(
    ax: Axes, environment: Environment, trajectory: Trajectory
) -> dict[str, Any]:
    """A column for each state and each control, named beneath, with the range that the
    state goes through."""
    dynamics = environment.dynamics
    n, m = dynamics.state_size, dynamics.control_size
    units = dynamics.state_units or ("",) * n
    states = finite_states(trajectory)
    largest = np.abs(states).max(axis=0, initial=0.0)
    # States of one unit are drawn to one scale.
    scale = np.array(
        [max(b for b, v in zip(largest, units, strict=True) if v == u) for u in units]
    )
    scale = np.where(scale > 0, scale, 1.0)
    places = np.append(np.arange(n), n + 0.6 + np.arange(m))
    ax.set_aspect("auto")
    ax.axhline(0, color=NEUTRAL, lw=1.5, zorder=3)
    low, high = states.min(axis=0) / scale, states.max(axis=0) / scale
    ax.bar(places[:n], high - low, 0.8, bottom=low, color=BODY, alpha=0.12)
    ax.bar(places[n:], 2.0, 0.8, bottom=-1.0, color=ACTION, alpha=0.1)
    names = [*dynamics.state_names, *dynamics.control_names]
    if len(names) <= MOST_NAMES:
        upright = max(map(len, names)) * len(names) > 36
        for place, name in zip(places, names, strict=True):
            ax.text(
                float(place),
                -1.1,
                name,
                size=SIZE,
                ha="center",
                va="top",
                rotation=90 if upright else 0,
            )
    ax.set(xlim=(-0.7, places[-1] + 0.7), ylim=(-1.35, 1.1))
    control_scale = largest_controls(environment, trajectory)
    return {"places": places, "scale": np.append(scale, control_scale)}


def draw_bars(
    ax: Axes,
    x: np.ndarray,
    u: np.ndarray,
    places: np.ndarray,
    scale: np.ndarray,
) -> None:
    """States in blue and controls in orange, each as a bar from zero."""
    heights = np.clip(np.append(x, u) / scale, -1, 1)
    colors = [BODY] * len(x) + [ACTION] * len(u)
    ax.bar(places, heights, 0.8, color=colors, zorder=2)


def setup_states(
    ax: Axes, environment: Environment, trajectory: Trajectory
) -> dict[str, Any]:
    """A plane if there are two states, else bars."""
    plane = environment.state_size == 2
    setup = setup_plane if plane else setup_bars
    return {"plane": plane, **setup(ax, environment, trajectory)}


def draw_states(
    ax: Axes, x: np.ndarray, u: np.ndarray, plane: bool, **keywords: Any
) -> None:
    """A dot in the plane, or bars."""
    (draw_plane if plane else draw_bars)(ax, x, u, **keywords)


def trace_states(states: np.ndarray, plane: bool, **keywords: Any) -> np.ndarray:
    """The path in the plane; none of bars."""
    return trace_plane(states, **keywords) if plane else np.zeros((0, 2))


add_drawing(Drawing(draw_plane, setup_butterfly, trace_plane), Lorenz)
# What has no drawing of its own.
add_drawing(Drawing(draw_states, setup_states, trace_states), AbstractDynamics)
