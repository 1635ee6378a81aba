"""How a plant looks: draw functions, found by the type of the system."""

import inspect
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Polygon

from ..dynamics import AbstractDynamics
from ..environments import Environment
from ..simulation import Trajectory
from ..systems import AbstractSystem, Pendulum
from ._figure import color_of, NEUTRAL, style_axes, with_unit, wrapped


class Drawing(NamedTuple):
    """A draw function and what prepares the axes for it."""

    draw: Callable[..., Any]
    setup: Callable[[Axes, Environment, Trajectory], Mapping[str, Any] | None] | None


_DRAWINGS: dict[type, Drawing] = {}


def register_drawing(
    system_class: type[AbstractSystem] | type[AbstractDynamics],
    draw: Callable[..., Any],
    setup: Callable[..., Any] | None = None,
) -> None:
    """Tell [`delucax.animate`][] how a kind of plant looks.

    It is used for environments whose system, or whose dynamics, is of that class or a
    subclass of it. A later registration for the same class replaces the earlier one.

    **Arguments:**

    - `system_class`: a subclass of [`delucax.AbstractSystem`][] or of
        [`delucax.AbstractDynamics`][].
    - `draw`: `draw(ax, x, u)` draws one moment on Matplotlib axes of equal aspect: `x`
        is the state and `u` the control, NumPy vectors. It is called afresh for each
        frame; what it drew before is removed.
    - `setup`: `setup(ax, environment, trajectory)`, called once, draws what stays and
        sets the limits of the axes. A dictionary that it returns is passed on to `draw`
        as keyword arguments: lengths of the plant, for example. None by default; the
        limits then fit all that is drawn.

    **Raises:** `ValueError` if the class is not one of systems or dynamics, or if
    `draw` or `setup` cannot be called.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        class Cart(dlx.AbstractSystem):
            state_names = ("position", "speed")
            control_names = ("force",)

            def vector_field(self, t, x, u, w):
                return jnp.stack([x[1], u[0]])

        def draw(ax, x, u):
            ax.plot([x[0] - 0.2, x[0] + 0.2], [0, 0], linewidth=12)
            ax.arrow(x[0], 0, 0.1 * u[0], 0)

        def setup(ax, environment, trajectory):
            ax.set(xlim=(-2, 2), ylim=(-0.5, 0.5))

        dlx.plotting.register_drawing(Cart, draw, setup)
        ```
    """
    kinds = (AbstractSystem, AbstractDynamics)
    if not (inspect.isclass(system_class) and issubclass(system_class, kinds)):
        raise ValueError(
            "register_drawing: system_class must be a subclass of AbstractSystem or "
            f"AbstractDynamics, got {system_class!r}."
        )
    for name, given in (("draw", draw), ("setup", setup)):
        if not (callable(given) or name == "setup" and given is None):
            raise ValueError(
                f"register_drawing: {name} must be a function, got {given!r}."
            )
    _DRAWINGS[system_class] = Drawing(draw, setup)


def drawing_for(environment: Environment) -> Drawing | None:
    """The drawing for the plant of an environment, the most particular one first.

    Looks at the dynamics and at what they wrap, the innermost system first.
    """
    nodes: list[Any] = [environment.dynamics]
    while True:
        inner = getattr(nodes[-1], "system", getattr(nodes[-1], "dynamics", None))
        if not isinstance(inner, AbstractSystem | AbstractDynamics):
            break
        nodes.append(inner)
    for node in reversed(nodes):
        for cls in type(node).__mro__:
            if cls in _DRAWINGS:
                return _DRAWINGS[cls]
    return None


def setup_phase(
    ax: Axes, environment: Environment, trajectory: Trajectory
) -> dict[str, Any]:
    """The plane of the first two states, with the whole path faint in it."""
    dynamics = environment.dynamics
    units = dynamics.state_units or ("",) * dynamics.state_size
    states = np.asarray(trajectory.states)
    states = np.where(np.isfinite(states), states, np.nan)
    ax.set_axis_on()
    ax.set_aspect("auto")
    style_axes(ax, size=11.0, ticks=(6, 6))
    ax.margins(0.06)
    ax.plot(states[:, 0], states[:, 1], color=color_of(0), linewidth=1.5, alpha=0.35)
    ax.set_xlabel(wrapped(with_unit(dynamics.state_names[0], units[0]), 40), size=11)
    ax.set_ylabel(wrapped(with_unit(dynamics.state_names[1], units[1]), 40), size=11)
    return {}


def draw_phase(ax: Axes, x: np.ndarray, u: np.ndarray) -> None:
    """A dot where the first two states are."""
    del u
    ax.plot(x[:1], x[1:2], "o", color=color_of(1), markersize=9)


def setup_pendulum(
    ax: Axes, environment: Environment, trajectory: Trajectory
) -> dict[str, Any]:
    """The circle that the tip goes round, with a tick where it is upright."""
    ax.set(xlim=(-1.25, 1.25), ylim=(-1.25, 1.25))
    ax.add_artist(Circle((0, 0), 1, fill=False, color=NEUTRAL, alpha=0.25, lw=1))
    ax.plot([0, 0], [1.06, 1.16], color=NEUTRAL, linewidth=2)
    largest = 0.0
    if environment.control_bounds is not None:
        ends = [np.max(np.abs(np.asarray(end))) for end in environment.control_bounds]
        largest = float(max(ends))
    if not (np.isfinite(largest) and largest > 0):
        largest = float(np.nanmax(np.abs(np.asarray(trajectory.controls)), initial=0.0))
    return {"largest_torque": largest or 1.0}


def draw_pendulum(
    ax: Axes, x: np.ndarray, u: np.ndarray, largest_torque: float = 2.0
) -> None:
    """A rod of length 1 with a bob, hinged at the origin, angle 0 upright and growing
    anticlockwise; the torque is an arc of up to 240 degrees about the hinge."""
    angle = float(x[0])
    tip = np.array([-np.sin(angle), np.cos(angle)])
    ax.plot(
        [0, tip[0]],
        [0, tip[1]],
        color=color_of(0),
        linewidth=9,
        solid_capstyle="round",
        zorder=2,
    )
    ax.add_artist(Circle((tip[0], tip[1]), 0.11, color=color_of(0), zorder=2))
    share = float(np.clip(u[0] / largest_torque, -1, 1))
    if abs(share) > 0.01:
        arrow = arc_arrow(0.36, angle + np.pi / 2, math.radians(240) * share)
        ax.add_artist(Polygon(arrow, color=color_of(1), lw=0, zorder=3))
    ax.add_artist(Circle((0, 0), 0.055, facecolor="white", edgecolor=NEUTRAL, zorder=4))


def arc_arrow(radius: float, start: float, sweep: float) -> np.ndarray:
    """The corners of an arrow bent about the origin: from the angle `start`, through
    `sweep`, both in radians."""
    width = 0.16 * radius
    head = min(0.5, 0.6 * abs(sweep))  # the angle that the head takes of the sweep
    end = start + sweep - np.sign(sweep) * head
    angles = np.linspace(start, end, 40)
    along = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    reach = width * (0.6 + head)
    point = radius * np.array([[np.cos(start + sweep), np.sin(start + sweep)]])
    outer, inner = (radius + width / 2) * along, (radius - width / 2) * along
    base = [(radius + reach) * along[-1:], point, (radius - reach) * along[-1:]]
    return np.concatenate([outer, *base, inner[::-1]])


register_drawing(Pendulum, draw_pendulum, setup_pendulum)
PHASE = Drawing(draw_phase, setup_phase)
