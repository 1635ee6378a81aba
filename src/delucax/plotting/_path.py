"""The path of a run: its states, with the jumps at events."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ..dynamics import Events
from ..environments import Environment
from ..simulation import Trajectory


class Path(NamedTuple):
    """The path of one run: its samples, and the states before and after each event.

    - `times`, `states`: shapes `(rows,)` and `(rows, n)`.
    - `steps`: the step that starts at each row or contains it.
    - `samples`: the rows of the samples.
    - `jumps`: the rows just after the events. The row before each of these is just
        before the event.
    - `kinds`: the kinds of the events.
    """

    times: Float[np.ndarray, " rows"]
    states: Float[np.ndarray, "rows n"]
    steps: Int[np.ndarray, " rows"]
    samples: Int[np.ndarray, " times"]
    jumps: Int[np.ndarray, " events"]
    kinds: Int[np.ndarray, " events"]

    def broken(self) -> tuple[np.ndarray, np.ndarray]:
        """Times and states, with NaN at each event so that a line breaks there."""
        times = np.insert(self.times, self.jumps, np.nan)
        return times, np.insert(self.states, self.jumps, np.nan, axis=0)


def path_of(
    times: Float[np.ndarray, " times"],
    states: Float[np.ndarray, "times n"],
    events: Events | None,
) -> Path:
    """The path of one run through its samples and the events between them."""
    steps = np.arange(len(times))
    if events is None:
        none = np.zeros(0, int)
        return Path(times, states, steps, steps, none, none)
    at = np.asarray(events.kinds) >= 0
    where, _ = np.nonzero(at)
    fired = np.asarray(events.times, float)[at]
    # Events hold the plant's own states. Other states, such as delayed controls, do not
    # jump: interpolate them.
    share = (fired - times[where]) / (times[where + 1] - times[where])
    between = states[where] + share[:, None] * (states[where + 1] - states[where])
    ends = []
    for each in (events.before, events.after):
        each = np.asarray(each, float)[at]
        ends.append(np.concatenate([each, between[:, each.shape[1] :]], axis=1))
    pairs = np.stack(ends, axis=1).reshape(-1, states.shape[1])
    behind, two = np.repeat(where + 1, 2), np.repeat(fired, 2)
    jumps = where + 2 * np.arange(1, len(where) + 1)
    rows = np.arange(len(times) + 2 * len(where))
    return Path(
        np.insert(times, behind, two),
        np.insert(states, behind, pairs, axis=0),
        np.insert(steps, behind, behind - 1),
        np.delete(rows, np.concatenate([jumps - 1, jumps])),
        jumps,
        np.asarray(events.kinds)[at],
    )


def with_events(environment: Environment, trajectory: Trajectory) -> Trajectory:
    """One trajectory with its events. If they were not kept, its steps are computed
    again, unless the disturbances are unknown."""
    dynamics, w = environment.dynamics, trajectory.disturbances
    if not dynamics.event_names or trajectory.recorded_events is not None or w is None:
        return trajectory
    assert trajectory.states is not None
    given = trajectory.times[:-1], trajectory.states[:-1], trajectory.controls, w
    over = jnp.arange(trajectory.steps) >= trajectory.length
    events = _events_of(dynamics, given, over)
    names = tuple(dynamics.event_names)
    return dataclasses.replace(trajectory, recorded_events=events, event_names=names)


@eqx.filter_jit
def _events_of(dynamics, given, over) -> Events:
    def events(over, t, x, u, w):
        return dynamics.advance_with_events(t, x, u, w)[2].unless(over)

    return jax.vmap(events)(over, *given)
