"""Hybrid systems: a vector field, and events at which the state jumps."""

import abc
from collections.abc import Sequence
from typing import Any, ClassVar, TYPE_CHECKING

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .._check_models import output_of
from .._typing import BoolScalar, Control, Scalar, State, Time
from ._base import AbstractSystem


class AbstractHybridSystem(AbstractSystem):
    r"""A system in continuous time whose state jumps at events.

    Between events, $\dot x = f(t, x, u, w)$. Event $i$ fires when its guard
    $g_i(t, x, u)$ crosses zero while the event is enabled. The state then becomes
    $x^+ = r_i(t, x^-, u)$.

    Subclass `AbstractHybridSystem`, name the events, and write `vector_field`, `guards`
    and `resets`. [`delucax.Discretized`][] computes the steps of a hybrid system like
    those of any other system, so environments, planners and controllers take hybrid
    systems too.

    Think of a guard as a distance, such as the height of a ball: the guard is normally
    positive, and the event fires when the guard falls to zero. If the guard is exactly
    zero and then becomes negative, the event fires at once. If the guard of an enabled
    event is already negative at the start of an interval or just after a reset, the
    model is wrong, and the simulation returns the status `RESULTS.beyond_guard`. An
    urgent event fires instead.

    **Class attributes** (or properties), besides those of [`delucax.AbstractSystem`][]:

    - `event_names`: a tuple of strings.
    - `event_directions`: for each event, -1 if it fires when its guard falls through
        zero (the default), +1 if it fires when the guard rises, or 0 for both. If the
        direction is 0, the guard may be positive or negative between events.
    - `urgent_events`: the events that also fire if their guard already has the wrong
        sign at the start of an interval or just after a reset; none by default. List an
        event in `urgent_events` if its guard depends on the control, because the
        control may jump between intervals.
    - `crossing_events`: the events that only report that their guard crosses zero, such
        as the tick of a clock or the top of a flight. They need a direction. The guard
        of such an event may be positive or negative, before and after the reset. None
        by default.
    - `mode_names`: the names of discrete modes, none by default. With modes, one of the
        states is named `"mode"` and holds 0.0, 1.0, ...; resets change it, and its
        derivative is zero. Read it with `mode`.

    **Raises:** `ValueError` at construction if the lists of names, directions and modes
    contradict each other, if there is not one guard and one reset for each event, or if
    the system has a diffusion.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp
        from jaxtyping import Array

        class Ball(dlx.systems.AbstractHybridSystem):
            state_names = ("height", "velocity")
            control_names = ("force",)
            event_names = ("bounce",)
            restitution: Array = dlx.parameter(0.8)

            def vector_field(self, t, x, u, w):
                return jnp.stack([x[1], u[0] - 9.81])

            def guards(self, t, x, u):
                return (x[0],)

            def resets(self, t, x, u):
                return (jnp.stack([x[0], -self.restitution * x[1]]),)

        dynamics = dlx.Discretized(Ball(), dt=0.05)
        dlx.open_loop(dynamics, jnp.array([1.0, 0.0]), jnp.zeros((20, 1)))[-1]
        ```

        ```text
        Array([ 0.468, -1.837], dtype=float32)
        ```
    """

    if TYPE_CHECKING:  # a static checker would ask for abstract fields as arguments
        event_names: ClassVar[Any]
    else:
        event_names: eqx.AbstractVar[tuple[str, ...]]
    event_directions: ClassVar[Any] = ()
    urgent_events: ClassVar[Any] = ()
    crossing_events: ClassVar[Any] = ()
    mode_names: ClassVar[Any] = ()

    def __check_init__(self):
        where, names = type(self).__name__, self.event_names
        if isinstance(names, str) or not isinstance(names, tuple | list) or not names:
            raise ValueError(
                f"{where}: event_names must be a tuple of strings, such as "
                f"('bounce',), got {names!r}."
            )
        directions = self.event_directions or (-1,) * len(names)
        if len(directions) != len(names) or not set(directions) <= {-1, 0, 1}:
            raise ValueError(
                f"{where}: event_directions must be -1, 0 or 1 for each of "
                f"{tuple(names)}, got {self.event_directions!r}."
            )
        one_way = [n for n, way in zip(names, directions, strict=True) if way != 0]
        for kind in ("urgent_events", "crossing_events"):
            given = getattr(self, kind)
            if not set(given) <= set(one_way):
                raise ValueError(
                    f"{where}: {kind} must be among the events that have a direction, "
                    f"{tuple(one_way)}, got {given!r}."
                )
        if both := sorted(set(self.urgent_events) & set(self.crossing_events)):
            raise ValueError(
                f"{where}: {both[0]!r} must be in urgent_events or in crossing_events, "
                "not in both."
            )
        if self.mode_names and "mode" not in self.state_names:
            raise ValueError(
                f"{where}: state_names must contain 'mode', because there are "
                f"mode_names, got {self.state_names}."
            )
        if self.noise == "brownian":
            raise ValueError(
                f"{where}: diffusion must be left out of a system with events."
            )
        self._check_events()

    def _check_events(self) -> None:
        """Raise unless there is a guard, a reset and a flag for each event."""
        where, count, n = type(self).__name__, len(self.event_names), self.state_size
        given = (), (n,), (self.control_size,)
        for hook, shape, what in (
            (self.guards, (), "a scalar"),
            (self.resets, (n,), "a state"),
            (self.enabled, (), "a boolean"),
        ):
            rows = output_of(hook, *given)
            listed = rows if isinstance(rows, tuple | list) else [rows]
            shapes = [getattr(row, "shape", ()) for row in listed]
            if not isinstance(rows, tuple | list):
                shapes = [s[1:] for s in shapes for _ in range(s[0] if s else 0)]
            if shapes != [shape] * count:
                raise ValueError(
                    f"{where}: {hook.__name__} must return {what} for each of "
                    f"{count} events, such as (one,), got shapes {shapes}."
                )

    @abc.abstractmethod
    def guards(self, t: Time, x: State, u: Control) -> Sequence[Scalar] | Array:
        """The guard of each event: a number that crosses zero when the event happens.

        **Arguments:** `t`: time, a scalar. `x`: state, shape `(state_size,)`. `u`:
            control, shape `(control_size,)`, held over the interval.

        **Returns:** one number for each of `event_names`, as a tuple or an array.
        """

    @abc.abstractmethod
    def resets(self, t: Time, x: State, u: Control) -> Sequence[State] | Array:
        """The state just after each event.

        **Arguments:** `t`: time, a scalar. `x`: state just before the event, shape
            `(state_size,)`. `u`: control, shape `(control_size,)`.

        **Returns:** one state for each of `event_names`, as a tuple or an array.
        """

    def enabled(self, t: Time, x: State, u: Control) -> Sequence[BoolScalar] | Array:
        """Whether each event may fire, evaluated where its guard crosses zero; true by
        default.

        **Arguments:** `t`: time, a scalar. `x`: state, shape `(state_size,)`. `u`:
            control, shape `(control_size,)`.

        **Returns:** one boolean for each of `event_names`, as a tuple or an array.
        """
        del t, x, u
        return jnp.ones(len(self.event_names), bool)

    def mode(self, x: State) -> Array:
        """The mode of a state, as an integer.

        **Arguments:** `x`: state, shape `(state_size,)`; leading axes are kept.

        **Returns:** the index in `mode_names`.

        **Raises:** `ValueError` if the system has no `mode_names`.
        """
        if not self.mode_names:
            raise ValueError(
                f"{type(self).__name__}: mode needs a system with mode_names."
            )
        # Rounded, because an estimated state has a mode between two integers.
        return jnp.round(x[..., self.state_names.index("mode")]).astype(int)
