"""What a solve over a whole horizon asks of its arguments."""

from typing import Any

import diffrax
import equinox as eqx
import numpy as np

from .._check import check_finite, check_instance, check_positive, is_concrete
from .._controller import AbstractController
from .._message import shortened
from .._module import as_float_array
from ..dynamics._solvers import (
    check_adaptive,
    check_adjoint,
    check_solver,
    check_stepsize_controller,
)
from ..systems import AbstractSystem


def check_system(system: Any, where: str) -> None:
    """Raise unless one solve can integrate `system`."""
    check_instance(system, AbstractSystem, "system", where)
    name = type(system).__name__
    if type(system).project is not AbstractSystem.project:
        raise ValueError(
            f"{where}: system {name} projects its state after each interval, which one "
            "solve cannot do; use `delucax.open_loop` or `delucax.rollout` with "
            "delucax.Discretized(system, dt)."
        )
    if system.noise == "brownian":
        raise ValueError(
            f"{where}: system {name} has a diffusion; use `delucax.open_loop` or "
            "`delucax.rollout` with delucax.Discretized(system, dt), which takes its "
            "Brownian increments."
        )


def as_sequence(value: Any, size: int, name: str, where: str) -> Any:
    """`value` as an array of shape `(T, size)`, or an error."""
    array = as_float_array(value)
    if not eqx.is_inexact_array(array) or array.ndim != 2 or array.shape[1] != size:
        got = f"shape {array.shape}" if eqx.is_array(array) else shortened(value)
        raise ValueError(f"{where}: {name} must have shape (T, {size}), got {got}.")
    if array.shape[0] == 0:
        raise ValueError(f"{where}: {name} must have at least one interval.")
    check_finite(array, name, where)
    return array


def count_intervals(
    t0: Any, t1: Any, dt: Any, source: Any, w: Any, where: str
) -> int | None:
    """The number of intervals that the arguments agree on; `None` if none says."""
    counts = {}
    if not callable(source):
        counts["controller_or_controls"] = source.shape[0]
    if w is not None:
        counts["w"] = w.shape[0]
    if dt is not None:
        known = is_concrete(t0) and is_concrete(t1) and is_concrete(dt)
        if not known and not counts:
            raise ValueError(
                f"{where}: dt, t0 and t1 must be known numbers, not traced ones, as "
                "they say how many intervals there are; give an array of controls, or "
                "use `delucax.rollout`."
            )
        if known:
            check_positive(dt, "dt", where)
            ratio = (t1 - t0) / dt
            # Single precision rounds the quotient by a few parts in 1e7.
            if round(ratio) < 1 or abs(ratio - round(ratio)) > 1e-6 * ratio:
                raise ValueError(
                    f"{where}: t1 - t0 must be a whole multiple of dt, got t0 = {t0}, "
                    f"t1 = {t1}, dt = {dt}."
                )
            counts["dt"] = round(ratio)
    if len(set(counts.values())) > 1:
        said = ", ".join(f"{name} says {count}" for name, count in counts.items())
        raise ValueError(f"{where}: the numbers of intervals differ: {said}.")
    return next(iter(counts.values()), None)


def as_save_times(ts: Any, t0: Any, t1: Any, where: str) -> Any:
    """`ts` as an array of increasing times from `t0` to `t1`, or an error."""
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


def check_adjoint_fits(
    adjoint: Any, adaptive: bool, hold: str | None, source: Any, where: str
) -> None:
    """Raise unless `adjoint` fits the solve."""
    check_adjoint(adjoint, where)
    if isinstance(adjoint, diffrax.ImplicitAdjoint):
        raise ValueError(
            f"{where}: adjoint ImplicitAdjoint is for solves that end in a steady "
            "state; use diffrax.RecursiveCheckpointAdjoint()."
        )
    if not isinstance(adjoint, diffrax.BacksolveAdjoint):
        return
    if not adaptive:
        raise ValueError(
            f"{where}: adjoint BacksolveAdjoint needs a stepsize_controller, such as "
            "diffrax.PIDController(rtol=1e-6, atol=1e-8)."
        )
    if hold == "zero" and isinstance(source, AbstractController):
        raise ValueError(
            f"{where}: adjoint BacksolveAdjoint does not fit a held controller: its "
            "samples and memory cannot be run backwards. Use "
            "diffrax.RecursiveCheckpointAdjoint(), hold=None, or an array of controls."
        )
    if "solver" in adjoint.kwargs:
        check_solver(adjoint.kwargs["solver"], f"{where}: BacksolveAdjoint")
        check_adaptive(adjoint.kwargs["solver"], f"{where}: BacksolveAdjoint")
    backwards = adjoint.kwargs.get("stepsize_controller")
    if backwards is not None:
        check_stepsize_controller(backwards, f"{where}: BacksolveAdjoint")
