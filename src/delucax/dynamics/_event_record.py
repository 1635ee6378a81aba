"""The events of an interval."""

import dataclasses

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array


class Events(eqx.Module):
    """The events of an interval, in the order in which they fired.

    **Attributes:**

    - `times`: shape `(max_events,)`, NaN behind the last.
    - `kinds`: indices in `event_names`, shape `(max_events,)`, -1 behind the last.
    - `before`, `after`: the states of the plant at each, before and after its reset,
        shape `(max_events, n)`, NaN behind the last.
    - `fault_time`, `fault_kind`: when and by which guard the interval first failed;
        NaN and -1 where it did not.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dynamics = dlx.Discretized(dlx.systems.BouncingBall(), dt=1.0)
        falling = 0.0, jnp.array([1.0, 0.0]), jnp.zeros(1), None
        _, _, events = dynamics.advance_with_events(*falling)
        events.times[:2], events.kinds[:2], events.after[:2]
        ```
    """

    times: Array
    kinds: Array
    before: Array
    after: Array
    fault_time: Array
    fault_kind: Array

    @classmethod
    def none(cls, max_events: int, x: Array) -> "Events":
        """No events yet.

        **Arguments:** `max_events`: how many there is room for. `x`: a state of the
            plant.

        **Returns:** empty events.
        """
        nan, none = jnp.full((), jnp.nan, x.dtype), jnp.asarray(-1)
        states = jnp.full((max_events, x.size), nan)
        rows = jnp.full(max_events, nan), jnp.full(max_events, none)
        return cls(*rows, states, states, nan, none)

    def then(self, later: "Events") -> "Events":
        """The events of two intervals, one after the other, of which as many are kept
        as one of them has room for.

        **Arguments:** `later`: those of the second.

        **Returns:** all of them.
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
        """These and one more.

        **Arguments:** `fires`: whether there is one. `time`, `kind`, `before`, `after`:
            what is known of it.

        **Returns:** all of them.
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
        """These, or none.

        **Arguments:** `over`: whether there are none.

        **Returns:** the events.
        """
        return jax.tree.map(lambda a: jnp.where(over, _blank(a.dtype), a), self)

    def with_fault(self, failed: Array, kind: Array, time: Array) -> "Events":
        """These with the first fault.

        **Arguments:** `failed`: whether there is a fault. `kind`, `time`: by which
            guard and when.

        **Returns:** the events.
        """
        time = jnp.where(failed, lax.stop_gradient(time), self.fault_time)
        kind = jnp.where(failed, kind, self.fault_kind).astype(self.kinds.dtype)
        return dataclasses.replace(self, fault_time=time, fault_kind=kind)


def _blank(dtype: DTypeLike) -> Array:
    """What stands where there is no event: no number, or no kind."""
    is_number = jnp.issubdtype(dtype, jnp.inexact)
    return jnp.asarray(jnp.nan if is_number else -1, dtype)
