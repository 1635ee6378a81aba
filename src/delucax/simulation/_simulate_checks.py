"""Checks of the arguments of `simulate`."""

from typing import Any

import diffrax
import equinox as eqx
import numpy as np
from jaxtyping import Array

from .._check import check_instance, check_positive, is_concrete
from .._integration import check_adaptive, check_kind
from .._message import shortened
from .._module import as_float_array
from ..systems import AbstractHybridSystem, AbstractSystem


def check_system(system: Any, w: Any, where: str) -> None:
    """Raise unless one solve can integrate `system`."""
    check_instance(system, AbstractSystem, "system", where)
    name = type(system).__name__
    if isinstance(system, AbstractHybridSystem):
        reason = f"system {name} has events, at which its state jumps"
    elif system.projects_state:
        reason = f"system {name} projects its state after each interval"
    elif system.noise == "brownian":
        reason = f"system {name} has a diffusion, whose increments need fixed steps"
    elif w is not None and not system.disturbance_names:
        reason = (
            f"system {name} has no disturbance_names, so w would be added to the state "
            "after each interval"
        )
    else:
        return
    raise ValueError(
        f"{where}: {reason}, so one solve cannot integrate it. Use `delucax.open_loop` "
        "or `delucax.rollout` with delucax.Discretized(system, dt)."
    )


def count_intervals(
    t0: Any, t1: Any, dt: Any, source: Any, w: Array | None, where: str
) -> int | None:
    """The number of intervals on which the arguments agree; `None` if none determines
    it."""
    counts = {}
    if not callable(source):
        counts["controller_or_controls"] = source.shape[0]
    if w is not None:
        counts["w"] = w.shape[0]
    known = is_concrete(t0) and is_concrete(t1) and is_concrete(dt)
    if dt is not None and known:
        check_positive(dt, "dt", where)
        ratio = (t1 - t0) / dt
        # The tolerance allows for the rounding of single precision.
        if round(ratio) < 1 or abs(ratio - round(ratio)) > 1e-6 * ratio:
            raise ValueError(
                f"{where}: t1 - t0 must be a whole multiple of dt, got t0 = {t0}, "
                f"t1 = {t1}, dt = {dt}."
            )
        counts["dt"] = round(ratio)
    elif dt is not None and not counts:
        raise ValueError(
            f"{where}: dt, t0 and t1 must be known numbers, not traced ones, because "
            "they determine the number of intervals. Pass an array of controls, or "
            "use `delucax.rollout`."
        )
    if len(set(counts.values())) > 1:
        said = ", ".join(f"{count} by {name}" for name, count in counts.items())
        raise ValueError(
            f"{where}: the arguments must agree on the number of intervals, got {said}."
        )
    return next(iter(counts.values()), None)


def as_save_times(ts: Any, t0: Any, t1: Any, where: str) -> Any:
    """`ts` as an array of increasing times from `t0` to `t1`; raise if it is not."""
    ts = as_float_array(ts)
    if not eqx.is_inexact_array(ts) or ts.ndim != 1 or ts.shape[0] < 2:
        raise ValueError(
            f"{where}: ts must be a vector of at least two times, got {shortened(ts)}."
        )
    if is_concrete(ts) and is_concrete(t0) and is_concrete(t1):
        values = np.asarray(ts)
        t0, t1 = values.dtype.type(t0), values.dtype.type(t1)
        inside = np.all((values >= t0) & (values <= t1))
        if not inside or not np.all(np.diff(values) > 0):
            raise ValueError(
                f"{where}: ts must increase and lie between t0 = {t0} and t1 = {t1}, "
                f"got {ts}."
            )
    return ts


def check_adjoint(adjoint: Any, adaptive: bool, sampled: bool, where: str) -> None:
    """Raise unless `adjoint` fits the kind of steps and of control."""
    check_kind(adjoint, "adjoint", where)
    if isinstance(adjoint, diffrax.ImplicitAdjoint):
        raise ValueError(
            f"{where}: adjoint must not be ImplicitAdjoint, which is for solves that "
            "end in a steady state. Use diffrax.RecursiveCheckpointAdjoint()."
        )
    if not isinstance(adjoint, diffrax.BacksolveAdjoint):
        return
    if not adaptive:
        raise ValueError(
            f"{where}: adjoint BacksolveAdjoint needs a stepsize_controller, such as "
            "diffrax.PIDController(rtol=1e-6, atol=1e-8)."
        )
    if sampled:
        raise ValueError(
            f"{where}: adjoint BacksolveAdjoint does not fit a held controller, whose "
            "samples and memory cannot run backwards. Use "
            "diffrax.RecursiveCheckpointAdjoint(), hold=None, or an array of controls."
        )
    for name, value in adjoint.kwargs.items():
        if name in ("solver", "stepsize_controller"):
            check_kind(value, name, f"{where}: BacksolveAdjoint")
        if name == "solver":
            check_adaptive(value, f"{where}: BacksolveAdjoint")
