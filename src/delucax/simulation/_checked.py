"""The fields of a trajectory that describe its plant, and the check of its result."""

from typing import Any

import equinox as eqx
import numpy as np

from .._check import is_concrete
from .._jax import without_tangents
from .._results import RESULTS
from ..dynamics import AbstractDynamics
from ..systems import AbstractPlant
from ._trajectory import Trajectory


def plant_fields(plant: AbstractPlant) -> dict[str, Any]:
    """The fields of a trajectory that describe its plant."""
    names = ("disturbance_size", "state_names", "control_names")
    names += ("state_units", "control_units", "time_unit")
    fields = {name: getattr(plant, name) for name in names}
    fields["event_names"] = getattr(plant, "event_names", ())
    # A class may have lists of names, which cannot be static fields.
    as_tuple = lambda value: tuple(value) if isinstance(value, list) else value
    return {name: as_tuple(value) for name, value in fields.items()}


def checked(
    trajectory: Trajectory, where: str, dynamics: AbstractDynamics | None = None
) -> Trajectory:
    """Raise if the trajectory failed: now if its values are known, else at run time.

    If `dynamics` are hybrid and states and controls are kept, the error names the
    event.
    """
    failed = trajectory.failed
    if not is_concrete(failed):
        # Only numbers, because a run-time check does not take random keys, which a
        # controller's state may hold.
        numbers, rest = eqx.partition(trajectory, eqx.is_inexact_array)
        return eqx.combine(trajectory.result.error_if(numbers, failed), rest)
    if failed:
        # Under `jax.grad` without a jit the arrays have values, but NumPy cannot read
        # them.
        trajectory, dynamics = without_tangents((trajectory, dynamics))
        message = f"{where}: {RESULTS[trajectory.result]}"
        if trajectory.states is not None:
            bad = ~np.all(np.isfinite(trajectory.states), axis=-1)
            if bad.any():
                k = int(np.argmax(bad))
                message += (
                    f" The state after step {k} (t = {float(trajectory.times[k]):g}) "
                    "is the first that is not finite."
                )
        events = trajectory.recorded_events
        if events is not None and np.any(np.asarray(events.fault_kind) >= 0):
            k = int(np.argmax(np.asarray(events.fault_kind) >= 0))
            name = trajectory.event_names[int(events.fault_kind[k])]
            message += f" It was the event {name} at t = {events.fault_time[k]:g}."
        elif dynamics is not None and dynamics.event_names:
            states, controls, w = trajectory.states, trajectory.controls, None
            if states is not None and controls is not None:
                if trajectory.disturbance_size:
                    w = trajectory.disturbances
                steps = trajectory.times[:-1], states[:-1], controls, w
                message = f"{message} {dynamics.describe_fault(*steps)}".rstrip()
        raise RuntimeError(message + " Pass throw=False to look at the trajectory.")
    return trajectory
