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

    Between events `dx/dt = f(t, x, u, w)`. Event i fires where its guard
    `g_i(t, x, u)` crosses zero while it is enabled, and the state becomes
    `x+ = r_i(t, x-, u)`. Subclass it, name the events, and write `vector_field`,
    `guards` and `resets`. Everything that takes a system takes it, by
    [`delucax.Discretized`][].

    A guard that falls, as most do, is a distance: the plant lives where it is positive,
    and the event is what happens when it is used up. A state that is beyond an enabled
    guard at the start of an interval or after a reset is a fault of the model,
    `RESULTS.beyond_guard`, unless the event is urgent; one that is on the guard and
    moves beyond it fires at once.

    **Class attributes** (or properties), besides those of [`delucax.AbstractSystem`][]:

    - `event_names`: a tuple of strings.
    - `event_directions`: for each event -1 if its guard falls (the default), +1 if it
        rises, or 0 for both, which allows either side.
    - `urgent_events`: those that also fire at once where the state is beyond their
        guard at the start of an interval or after a reset, none by default. A guard
        that depends on the control needs it, as a control may jump between intervals.
    - `crossing_events`: those with a direction that only tell that the guard crosses
        zero, such as the tick of a clock, a switch or the top of a flight: the state
        may be on either side of the guard, and the reset may leave it there. None by
        default.
    - `mode_names`: the names of discrete modes, none by default. With them one of the
        states is named `"mode"`; it holds 0.0, 1.0, ..., resets change it, and its
        derivative is zero. `mode` reads it.

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
        dlx.open_loop(dynamics, jnp.array([1.0, 0.0]), jnp.zeros((20, 1)))
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
                f"{where}: {both[0]!r} must not be both in urgent_events and in "
                "crossing_events."
            )
        if self.mode_names and "mode" not in self.state_names:
            raise ValueError(
                f"{where}: with mode_names one of state_names must be 'mode', got "
                f"{self.state_names}."
            )
        if self.noise == "brownian":
            raise ValueError(f"{where}: a hybrid system must have no diffusion.")
        self._check_events()

    def _check_events(self) -> None:
        """Raise unless there are a guard and a reset for each event."""
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
        """What is zero at each event.

        **Arguments:** `t`: time. `x`: state. `u`: control, held over the interval.

        **Returns:** a number for each of `event_names`, as a tuple or an array.
        """

    @abc.abstractmethod
    def resets(self, t: Time, x: State, u: Control) -> Sequence[State] | Array:
        """The state after each event, from that just before.

        **Arguments:** `t`: time. `x`: state before the event. `u`: control.

        **Returns:** a state for each of `event_names`, as a tuple or an array.
        """

    def enabled(self, t: Time, x: State, u: Control) -> Sequence[BoolScalar] | Array:
        """Whether each event may fire, judged at its crossing; true by default.

        **Arguments:** `t`: time. `x`: state. `u`: control.

        **Returns:** a boolean for each of `event_names`, as a tuple or an array.
        """
        del t, x, u
        return jnp.ones(len(self.event_names), bool)

    def mode(self, x: State) -> Array:
        """The mode of a state, as a whole number.

        **Arguments:** `x`: state.

        **Returns:** the index in `mode_names`.

        **Raises:** `ValueError` without `mode_names`.
        """
        if not self.mode_names:
            raise ValueError(f"{type(self).__name__}: mode needs mode_names.")
        # Rounded, for code that gets a mode from an estimate.
        return jnp.round(x[..., self.state_names.index("mode")]).astype(int)
