"""The events of an interval."""

import dataclasses

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array

from .._module import shown


class Events(eqx.Module):
    """The events of one control interval, in the order in which they fired.

    **Attributes:**

    - `times`: the time of each event, in units of time, shape `(max_events,)`; NaN
        after the last event.
    - `kinds`: the kind of each event, as an index into `event_names`, shape
        `(max_events,)`; -1 after the last event.
    - `before`, `after`: the states of the plant just before and just after each event,
        shape `(max_events, n)`; NaN after the last event.
    - `fault_time`, `fault_kind`: the time of the first failure in the interval, and the
        event whose guard failed, as an index into `event_names`. Without a failure,
        `fault_time` is NaN and `fault_kind` is -1.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dynamics = dlx.Discretized(dlx.systems.BouncingBall(), dt=1.0)
        falling = 0.0, jnp.array([1.0, 0.0]), jnp.zeros(1), None
        _, _, events = dynamics.advance_with_events(*falling)
        events.times[0], events.kinds[:3], events.after[0]
        ```

        ```text
        (Array(0.452, dtype=float32),
         Array([ 0, -1, -1], dtype=int32, weak_type=True),
         Array([0.   , 3.544], dtype=float32))
        ```
    """

    times: Array
    kinds: Array
    before: Array
    after: Array
    fault_time: Array
    fault_kind: Array

    __repr__ = shown

    @classmethod
    def none(cls, max_events: int, x: Array) -> "Events":
        """A record without events.

        **Arguments:** `max_events`: the number of events that it has room for. `x`: a
            state of the plant, shape `(n,)`.

        **Returns:** the empty record.
        """
        nan, none = jnp.full((), jnp.nan, x.dtype), jnp.asarray(-1)
        states = jnp.full((max_events, x.size), nan)
        rows = jnp.full(max_events, nan), jnp.full(max_events, none)
        return cls(*rows, states, states, nan, none)

    def then(self, later: "Events") -> "Events":
        """A record of the events of two intervals, one after the other. The record
        keeps its size: if there are more events than it has room for, the last ones are
        dropped.

        **Arguments:** `later`: the events of the second interval.

        **Returns:** the joint record.
        """
        count = jnp.sum(self.kinds >= 0)
        behind = jnp.arange(self.kinds.size) - count

        def join(a, b):
            own = (behind < 0).reshape(-1, *[1] * (a.ndim - 1))
            return jnp.where(own, a, b[jnp.maximum(behind, 0)])

        first = lambda a, b: jnp.where(self.fault_kind < 0, b, a)
        return Events(
            join(self.times, later.times),
            join(self.kinds, later.kinds),
            join(self.before, later.before),
            join(self.after, later.after),
            first(self.fault_time, later.fault_time),
            first(self.fault_kind, later.fault_kind),
        )

    def noted(
        self, fires: Array, time: Array, kind: Array, before: Array, after: Array
    ) -> "Events":
        """The record with one more event.

        **Arguments:** `fires`: whether an event happened; if not, nothing is added.
            `time`, `kind`, `before`, `after`: the time, kind, state before and state
            after the event.

        **Returns:** the new record.
        """
        row = jnp.sum(self.kinds >= 0)
        put = lambda a, b: a.at[row].set(jnp.where(fires, b, _blank(a.dtype)))
        return dataclasses.replace(
            self,
            times=put(self.times, time),
            kinds=put(self.kinds, kind),
            before=put(self.before, before),
            after=put(self.after, after),
        )

    def unless(self, over: Array) -> "Events":
        """The record, or an empty record if a flag is set.

        **Arguments:** `over`: whether to empty the record.

        **Returns:** the new record.
        """
        return jax.tree.map(lambda a: jnp.where(over, _blank(a.dtype), a), self)

    def with_fault(self, failed: Array, kind: Array, time: Array) -> "Events":
        """The record with a fault.

        **Arguments:** `failed`: whether there is a fault; if not, nothing changes.
            `kind`, `time`: the event whose guard failed, and the time of the fault.

        **Returns:** the new record.
        """
        time = jnp.where(failed, lax.stop_gradient(time), self.fault_time)
        kind = jnp.where(failed, kind, self.fault_kind).astype(self.kinds.dtype)
        return dataclasses.replace(self, fault_time=time, fault_kind=kind)


def _blank(dtype: DTypeLike) -> Array:
    """The entry for no event: NaN, or -1 for integers."""
    is_number = jnp.issubdtype(dtype, jnp.inexact)
    return jnp.asarray(jnp.nan if is_number else -1, dtype)
