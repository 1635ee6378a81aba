"""The quadrotor in a vertical plane."""

import jax
import jax.numpy as jnp
import numpy as np

from ...systems import PlanarQuadrotor
from ..figures import NEUTRAL
from ._canvas import box, Canvas, DARK, rotation, SECOND, View
from ._drawing import Drawing, Episode, Vector


def planar_quadrotor(canvas: Canvas, episode: Episode) -> Drawing:
    """A body with a rotor at each end and its thrust above it, the goal, and the wind
    where there is one."""
    system, target = episode.system, episode.target
    visited = episode.visited((0, 1))
    length = float(system.length)
    low, high = visited.min(axis=0), visited.max(axis=0)
    half = 0.5 * float(np.max(high - low)) + 2 * length
    # About all of it; of what is too large, about its end.
    centre = (low + high) / 2 if half <= 20 * length else visited[-1]
    half = np.full(2, min(max(half, 4 * length), 20 * length))
    view = View(centre, half)
    arm = max(length, 0.16 * float(half[0]))  # seen from afar it is drawn larger
    if target is not None:
        canvas.goal(target[:2], 0.3 * arm)
    if system.wind is not None:
        _draw_wind(canvas, system, view)
    weight = float(system.mass * system.gravity)
    largest = np.maximum(episode.largest_controls, 0.5 * weight)
    view.show(canvas.ax)

    def draw(x: Vector, u: Vector) -> None:
        centre, angle = np.asarray(x[:2], float), float(x[2])
        turned = rotation(angle)
        canvas.polygon(box(2 * arm, 0.16 * arm, 0.07 * arm), centre, angle)
        canvas.disc(centre, 0.2 * arm)
        canvas.disc(centre, 0.09 * arm, "white", zorder=3)
        blade, up = turned @ (0.42 * arm, 0.0), turned @ (0.0, 0.1 * arm)
        for side, share in zip((-1, 1), np.clip(u / largest, -1, 1), strict=True):
            foot = centre + turned @ (0.92 * side * arm, 0.0)
            hub = centre + turned @ (0.92 * side * arm, 0.26 * arm)
            canvas.link(foot, hub, width=2, color=DARK)
            canvas.link(hub - blade, hub + blade, width=3.5, color=SECOND)
            canvas.force(hub + up, turned @ (0.0, 1.5 * arm * share), 1.5 * arm)
        view.follow(canvas.ax, centre, 1.5 * arm)

    return Drawing(draw, lambda states: states[:, :2])


def _draw_wind(canvas: Canvas, system: PlanarQuadrotor, view: View) -> None:
    """Arrows of the force that the wind has at time 0 on what is at rest."""
    assert system.wind is not None
    wind = system.wind
    side = np.linspace(-0.9, 0.9, 9) * view.half[0]
    places = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2) + view.centre
    states = jnp.zeros((len(places), 6)).at[:, :2].set(places)
    forces = np.asarray(jax.vmap(lambda x: wind(jnp.zeros(()), x))(states), float)
    strongest = np.linalg.norm(forces, axis=-1).max() or 1.0
    canvas.ax.quiver(
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
