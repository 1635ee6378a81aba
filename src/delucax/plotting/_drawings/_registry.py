"""Which drawing belongs to which plant."""

import functools
from collections.abc import Callable, Mapping
from typing import Any

from ... import systems
from ...dynamics import AbstractDynamics
from ...environments import Environment
from ...systems import AbstractSystem
from . import _arms, _carts, _machines, _state_space, _vehicles
from ._canvas import Canvas, Drawing, Episode, layers, Setup


_BY_TYPE: dict[type, Setup] = {
    systems.Acrobot: _arms.acrobot,
    systems.CartPole: _carts.cart_pole,
    systems.DoubleIntegrator: _carts.double_integrator,
    systems.DynamicBicycle: _vehicles.car,
    systems.KinematicBicycle: _vehicles.car,
    # The plane of x and z, in which the wings are seen.
    systems.Lorenz: functools.partial(_state_space.plane, columns=(0, 2)),
    systems.MassSpringDamper: _carts.mass_spring_damper,
    systems.MountainCar: _carts.mountain_car,
    systems.Pendulum: _arms.pendulum,
    systems.PermanentMagnetMotor: _machines.motor,
    systems.PlanarQuadrotor: _vehicles.planar_quadrotor,
    systems.Quadrotor: _vehicles.quadrotor,
    systems.Reacher: _arms.reacher,
    systems.TwoTank: _machines.two_tank,
    AbstractDynamics: _state_space.state_space,  # what has no drawing of its own
}
_LUNG_CONTROLS = ("u_in", "u_out")
# A linear model keeps the names of what it was made of, and no more.
_BY_NAMES: dict[tuple[tuple[str, ...], tuple[str, ...]], Setup] = {
    (("position", "angle", "velocity", "spin"), ("force",)): _carts.linear_cart_pole,
    **{(names, _LUNG_CONTROLS): _machines.lung for names in _machines.LUNG_STATES},
}


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
    if not (isinstance(system_class, type) and issubclass(system_class, kinds)):
        raise ValueError(
            "register_drawing: system_class must be a subclass of AbstractSystem or "
            f"AbstractDynamics, got {system_class!r}."
        )
    for name, given in (("draw", draw), ("setup", setup)):
        if not (callable(given) or name == "setup" and given is None):
            raise ValueError(
                f"register_drawing: {name} must be a function, got {given!r}."
            )

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
    """The drawing for the plant of an environment, the most particular one first.

    Looks at the dynamics and at what they wrap, the innermost system first. What has no
    drawing of its own has that of all dynamics.
    """
    wrapped = layers(environment)
    for layer in reversed(wrapped):
        for cls in type(layer).__mro__:
            if cls in _BY_TYPE and cls is not AbstractDynamics:
                return _BY_TYPE[cls]
    names = tuple(wrapped[-1].state_names), tuple(wrapped[-1].control_names)
    return _BY_NAMES.get(names, _BY_TYPE[AbstractDynamics])
