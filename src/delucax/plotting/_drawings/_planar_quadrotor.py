"""The quadrotor in a vertical plane."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes

from ...environments import Environment
from ...simulation import Trajectory
from ...systems import PlanarQuadrotor
from .._figure import NEUTRAL
from ._parts import (
    body,
    box,
    DARK,
    disc,
    finite_states,
    largest_controls,
    link,
    mark,
    push,
    rotation,
    SECOND,
    shares,
    square_view,
    target_of,
    View,
)
from ._registry import add_drawing, Drawing, system_of


def setup_planar_quadrotor(
    ax: Axes, environment: Environment, trajectory: Trajectory
) -> dict[str, Any]:
    """The goal, and the wind where there is one."""
    system = system_of(environment)
    path = finite_states(trajectory)[:, :2]
    target = target_of(environment)
    if target is not None:
        path = np.concatenate([path, target[None, :2]])
    length = float(system.length)
    view = square_view(path, 4 * length, 20 * length, 2 * length)
    arm = max(length, 0.16 * float(view.half[0]))  # seen from afar it is drawn larger
    if target is not None:
        mark(ax, target, 0.3 * arm)
    if system.wind is not None:
        _draw_wind(ax, system, view)
    weight = float(system.mass * system.gravity)
    largest = np.maximum(largest_controls(environment, trajectory), 0.5 * weight)
    view.show(ax)
    return {"arm": arm, "largest_thrusts": largest, "view": view}


def _draw_wind(ax: Axes, system: PlanarQuadrotor, view: View) -> None:
    """Arrows of the force that the wind has at time 0 on what is at rest."""
    wind: Any = system.wind
    side = np.linspace(-0.9, 0.9, 9) * view.half[0]
    places = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2) + view.centre
    states = jnp.zeros((len(places), 6)).at[:, :2].set(places)
    forces = np.asarray(jax.vmap(lambda x: wind(jnp.zeros(()), x))(states), float)
    strongest = np.linalg.norm(forces, axis=-1).max() or 1.0
    ax.quiver(
        *places.T,
        *(forces * (0.25 * view.half[0] / strongest)).T,
        angles="xy",
        scale_units="xy",
        scale=1.0,
        pivot="middle",
        width=0.005,
        color=NEUTRAL,
        alpha=0.35,
        zorder=0,
    )


def draw_planar_quadrotor(
    ax: Axes,
    x: np.ndarray,
    u: np.ndarray,
    arm: float,
    largest_thrusts: np.ndarray,
    view: View,
) -> None:
    """A body with a rotor at each end and its thrust above it."""
    centre, angle = np.asarray(x[:2], float), float(x[2])
    turned = rotation(angle)
    body(ax, box(2 * arm, 0.16 * arm, 0.07 * arm), centre, angle)
    disc(ax, centre, 0.2 * arm)
    disc(ax, centre, 0.09 * arm, color="white", zorder=3)
    for side, share in zip((-1, 1), shares(u, largest_thrusts), strict=True):
        foot, hub = (
            centre + turned @ (0.92 * side * arm, height * arm)
            for height in (0.0, 0.26)
        )
        link(ax, foot, hub, color=DARK, width=2)
        blade = turned @ (0.42 * arm, 0.0)
        link(ax, hub - blade, hub + blade, color=SECOND, width=3.5)
        thrust = turned @ (0.0, 1.5 * arm * share)
        push(ax, hub + turned @ (0.0, 0.1 * arm), thrust, 1.5 * arm)
    view.follow(ax, centre, 1.5 * arm)


def trace_planar_quadrotor(states: np.ndarray, **keywords: Any) -> np.ndarray:
    """Where it has flown."""
    return states[:, :2]


add_drawing(
    Drawing(draw_planar_quadrotor, setup_planar_quadrotor, trace_planar_quadrotor),
    PlanarQuadrotor,
)
