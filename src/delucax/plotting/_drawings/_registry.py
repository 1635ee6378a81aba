"""Which drawing belongs to which plant."""

import inspect
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes

from ...dynamics import AbstractDynamics
from ...environments import Environment
from ...simulation import Trajectory
from ...systems import AbstractSystem


class Drawing(NamedTuple):
    """A draw function, what prepares the axes for it, and the path that it leaves.

    `trace(states, **keywords)` is where the plant has been, shape `(n, 2)`, with the
    keywords that `setup` returned.
    """

    draw: Callable[..., Any]
    setup: Callable[[Axes, Environment, Trajectory], Mapping[str, Any] | None] | None
    trace: Callable[..., np.ndarray] | None = None


_DRAWINGS: dict[type, Drawing] = {}
# A linear model keeps the names of what it was made of, and no more.
_LINEAR: dict[tuple[tuple[str, ...], tuple[str, ...]], Drawing] = {}


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


def add_drawing(drawing: Drawing, *kinds: type) -> None:
    """Register a drawing that leaves a path too, for several kinds of plants."""
    for kind in kinds:
        _DRAWINGS[kind] = drawing


def add_linear_drawing(
    drawing: Drawing, states: tuple[str, ...], controls: tuple[str, ...]
) -> None:
    """Register a drawing for linear models whose states and controls are called so."""
    _LINEAR[states, controls] = drawing


def _layers(environment: Environment) -> list[Any]:
    """The dynamics and what they wrap, the innermost system last."""
    layers: list[Any] = [environment.dynamics]
    while True:
        inner = getattr(layers[-1], "system", getattr(layers[-1], "dynamics", None))
        if not isinstance(inner, AbstractSystem | AbstractDynamics):
            return layers
        layers.append(inner)


def system_of(environment: Environment) -> Any:
    """The innermost system of an environment; its dynamics if they hold none."""
    return _layers(environment)[-1]


def drawing_for(environment: Environment) -> Drawing:
    """The drawing for the plant of an environment, the most particular one first.

    Looks at the dynamics and at what they wrap, the innermost system first. What has no
    drawing of its own has that of all dynamics.
    """
    layers = _layers(environment)
    for layer in reversed(layers):
        for cls in type(layer).__mro__:
            if cls in _DRAWINGS and cls is not AbstractDynamics:
                return _DRAWINGS[cls]
    names = tuple(layers[-1].state_names), tuple(layers[-1].control_names)
    return _LINEAR.get(names, _DRAWINGS[AbstractDynamics])
