"""The drawing of each plant, and the default drawings: a plane of states, or bars."""

import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ... import systems
from ..._check import check_function
from ..._figures import style_axes, with_unit, wrapped
from ...dynamics import AbstractDynamics
from ...environments import Environment
from ...systems import AbstractSystem
from . import _machines, _mechanics, _switches, _vehicles, _walkers
from ._canvas import Canvas, Drawing, Episode, layers, Setup, Vector, View


SIZE = 11.0
ARROWS = 15
MOST_NAMES = 16


def state_space(canvas: Canvas, episode: Episode) -> Drawing:
    """The default drawing: a plane if there are two states, else bars."""
    planar = episode.environment.state_size == 2
    return plane(canvas, episode) if planar else bars(canvas, episode)


def plane(
    canvas: Canvas, episode: Episode, columns: tuple[int, int] = (0, 1)
) -> Drawing:
    """A dot in the plane of two states, with the goal, and with the flow if there are
    no other states. The view grows if the dot would leave it."""
    ax, dynamics, target = canvas.ax, episode.environment.dynamics, episode.target
    units = dynamics.state_units or ("",) * dynamics.state_size
    ax.set_axis_on()
    ax.set_aspect("auto")
    style_axes(ax, size=SIZE, ticks=(6, 6))
    names = [wrapped(with_unit(dynamics.state_names[c], units[c]), 40) for c in columns]
    ax.set_xlabel(names[0], size=SIZE)
    ax.set_ylabel(names[1], size=SIZE)
    points = episode.visited(columns)
    if target is not None:
        ax.plot(*target[list(columns)], "o", ms=13, mfc="none", mec=canvas.GOAL, mew=2)
    low, high = points.min(axis=0), points.max(axis=0)
    margin = np.where(high > low, 0.09 * (high - low), 1.0)
    view = canvas.view((low + high) / 2, (high - low) / 2 + margin)
    if dynamics.state_size == 2:
        ax.grid(False)
        _draw_flow(canvas, episode, view)

    def draw(x: Vector, u: Vector) -> None:
        del u
        at = x[list(columns)]
        ax.plot(*at, "o", color=canvas.ACTION, markersize=9, zorder=4)
        away = np.abs(at - view.centre) / view.half
        canvas.view(view.centre, view.half * np.maximum(1.0, 1.05 * away))

    return Drawing(draw, lambda states: states[:, columns])


def _draw_flow(canvas: Canvas, episode: Episode, view: View) -> None:
    """Draw the directions of the flow as faint arrows, under the control of the
    equilibrium, or zero control if the plant defines no equilibrium."""
    ends = view.centre - view.half, view.centre + view.half
    sides = np.linspace(*ends, ARROWS + 2)[1:-1].T
    places = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
    system = episode.system
    try:
        u = episode.environment.dynamics.equilibrium()[1]
    except ValueError:
        u = jnp.zeros(system.control_size)
    if isinstance(system, AbstractSystem):
        w = jnp.zeros(system.disturbance_size) if system.disturbance_names else None
        field = lambda x: system.vector_field(0.0, x, u, w)
    else:
        field = lambda x: system(0.0, x, u) - x
    ways = np.asarray(jax.vmap(field)(jnp.asarray(places)), float) / view.half
    ways = ways / np.maximum(np.linalg.norm(ways, axis=-1, keepdims=True), 1e-12)
    style = {"color": canvas.NEUTRAL, "alpha": 0.4, "zorder": 0, "width": 0.004}
    canvas.ax.quiver(*places.T, *ways.T, pivot="middle", scale=1.6 * ARROWS, **style)


def bars(canvas: Canvas, episode: Episode) -> Drawing:
    """A bar from zero for each state, in blue, and each control, in orange, with its
    name below and its range as a faint bar."""
    ax, dynamics, states = canvas.ax, episode.environment.dynamics, episode.states
    n, m = dynamics.state_size, dynamics.control_size
    largest = np.abs(states).max(axis=0, initial=0.0)
    # States with the same unit share a scale.
    units = np.array(dynamics.state_units or ("",) * n)
    scale = np.array([largest[units == unit].max() for unit in units])
    scale = np.where(scale > 0, scale, 1.0)
    places = np.append(np.arange(n), n + 0.6 + np.arange(m))
    ax.set_aspect("auto")
    ax.axhline(0, color=canvas.NEUTRAL, lw=1.5, zorder=3)
    low, high = states.min(axis=0) / scale, states.max(axis=0) / scale
    ax.bar(places[:n], high - low, 0.8, bottom=low, color=canvas.BODY, alpha=0.12)
    ax.bar(places[n:], 2.0, 0.8, bottom=-1.0, color=canvas.ACTION, alpha=0.1)
    names = [*dynamics.state_names, *dynamics.control_names]
    if len(names) <= MOST_NAMES:
        upright = max(map(len, names)) * len(names) > 36
        style = {"size": SIZE, "ha": "center", "va": "top"}
        for place, name in zip(places, names, strict=True):
            ax.text(float(place), -1.1, name, rotation=90 * upright, **style)
    ax.set(xlim=(-0.7, places[-1] + 0.7), ylim=(-1.35, 1.1))
    scale = np.append(scale, episode.largest_controls)
    colors = [canvas.BODY] * n + [canvas.ACTION] * m

    def draw(x: Vector, u: Vector) -> None:
        heights = np.clip(np.append(x, u) / scale, -1, 1)
        ax.bar(places, heights, 0.8, color=colors, zorder=2)

    return Drawing(draw)


_BY_TYPE: dict[type, Setup] = {
    systems.Acrobot: _mechanics.acrobot,
    systems.BouncingBall: _switches.ball,
    systems.CartPole: _mechanics.cart_pole,
    systems.CompassGait: _walkers.compass_gait,
    systems.DoublePendulumCart: _mechanics.double_pendulum_cart,
    systems.DriftingCar: _vehicles.drifting_car,
    systems.DoubleIntegrator: _mechanics.double_integrator,
    systems.DynamicBicycle: _vehicles.car,
    systems.FurutaPendulum: _vehicles.furuta,
    systems.KinematicBicycle: _vehicles.car,
    # The plane of x and z, which shows the two wings of the attractor.
    systems.Lorenz: functools.partial(plane, columns=(0, 2)),
    systems.MassSpringDamper: _mechanics.mass_spring_damper,
    systems.MountainCar: _mechanics.mountain_car,
    systems.Pendulum: _mechanics.pendulum,
    systems.PermanentMagnetMotor: _machines.motor,
    systems.PlanarQuadrotor: _vehicles.planar_quadrotor,
    systems.Quadrotor: _vehicles.quadrotor,
    systems.Reacher: _mechanics.reacher,
    systems.RimlessWheel: _walkers.rimless_wheel,
    systems.SimplestWalker: _walkers.simplest_walker,
    systems.SlungLoad: _vehicles.slung_load,
    systems.StickSlip: _switches.stick_slip,
    systems.Thermostat: _switches.thermostat,
    systems.TwoTank: _machines.two_tank,
    systems.ValveWithStops: _switches.valve,
    AbstractDynamics: state_space,  # plants without a drawing of their own
}
# Lungs and linear models are known by the names of their states and controls.
_LUNG_CONTROLS = ("u_in", "u_out")
_LINEAR_CART_POLE = ("position", "angle", "velocity", "spin"), ("force",)


def register_drawing(
    system_class: type[AbstractSystem] | type[AbstractDynamics],
    draw: Callable[..., Any],
    setup: Callable[..., Any] | None = None,
) -> None:
    """Register a function by which [`delucax.animate`][] draws plants of a class.

    The drawing is used for environments whose system or dynamics is of the class
    `system_class` or of a subclass. Registering the class again replaces its drawing.

    **Arguments:**

    - `system_class`: a subclass of [`delucax.AbstractSystem`][] or of
        [`delucax.AbstractDynamics`][].
    - `draw`: a function `draw(ax, x, u)` that draws the plant at one moment, on
        Matplotlib axes of equal aspect. `x` is the state, shape `(n,)`, and `u` the
        control, shape `(m,)`, both NumPy arrays. `draw` is called for each frame, after
        the drawing of the previous frame has been removed.
    - `setup`: a function `setup(ax, environment, trajectory)` that is called once.
        `setup` draws the parts that do not move and sets the limits of the axes.
        `setup` may return a dictionary, for example with the lengths of the plant. Then
        `draw` gets the entries of this dictionary as keyword arguments. None by
        default. Without `setup`, the limits of the axes fit everything that is drawn.

    **Raises:** `ValueError` if the class is not a subclass of `AbstractSystem` or
    `AbstractDynamics`, or if `draw` or `setup` is not a function.

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
    if not (isinstance(system_class, type) and issubclass(system_class, kinds)):
        raise ValueError(
            "register_drawing: system_class must be a subclass of AbstractSystem or "
            f"AbstractDynamics, got {system_class!r}."
        )
    check_function(draw, "draw", "register_drawing")
    if setup is not None:
        of = "ax, environment, trajectory"
        check_function(setup, "setup", "register_drawing", of)

    def set_up(canvas: Canvas, episode: Episode) -> Drawing:
        if setup is None:
            return Drawing(functools.partial(draw, canvas.ax), autoscale=True)
        keywords = setup(canvas.ax, episode.environment, episode.trajectory)
        if keywords is not None and not isinstance(keywords, Mapping):
            raise ValueError(
                "animate: the setup of a drawing must return a dictionary or None, got "
                f"{type(keywords).__name__}."
            )
        return Drawing(functools.partial(draw, canvas.ax, **(keywords or {})))

    _BY_TYPE[system_class] = set_up


def drawing_for(environment: Environment) -> Setup:
    """The drawing for the plant of an environment.

    The innermost system is looked up first, then the dynamics around it. Of each of
    these, the class comes first, then its base classes. If none of them has a drawing,
    the default drawing is returned.
    """
    inner, *outer = reversed(layers(environment))
    for layer in (inner, *outer):
        for cls in type(layer).__mro__:
            if cls in _BY_TYPE and cls is not AbstractDynamics:
                return _BY_TYPE[cls]
    states, controls = tuple(inner.state_names), tuple(inner.control_names)
    if controls == _LUNG_CONTROLS:
        return _machines.lung
    if (states, controls) == _LINEAR_CART_POLE:
        return _mechanics.linear_cart_pole
    return _BY_TYPE[AbstractDynamics]
