"""Dynamics driven by the samples of a record, at any times and with any hold."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._check import is_concrete
from ..._typing import Control, Disturbance, State, Time
from ...dynamics import AbstractDynamics, Discretized
from ...systems import AbstractHybridSystem, AbstractSystem, AbstractSystemWrapper
from ._record import grouped, Record


# The step of the dynamics fits the record if it differs by less than this share.
_UNEVEN = 1e-4


class Sampled(AbstractSystemWrapper):
    r"""A system whose time is scaled, so that a step of length $h$ takes the time `dt`.

    $$\frac{dx}{ds} = \frac{h}{dt} f\left(t + \frac{h s}{dt}, x,
    u\left(\frac{s}{dt}\right), w\right), \quad s \in [0, dt], \qquad
    u(r) = \sum_j c_j r^j$$

    The control is a row `(t, h, c_0, ..., c_d)`. An integrator with a fixed step can
    therefore handle samples at any times, and controls with any hold.
    """

    system: AbstractSystem
    dt: Array

    @property
    def control_names(self) -> tuple[str, ...]:
        """The control is one row."""
        return ("row",)

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        share, (begin, step), coefficients = t / self.dt, u[:2], u[2:]
        inner = coefficients.reshape(-1, self.system.control_size)
        powers = share ** jnp.arange(inner.shape[0], dtype=x.dtype)
        slope = self.system.vector_field(begin + step * share, x, powers @ inner, w)
        return step / self.dt * slope


class Sampling(eqx.Module):
    """How the rows of a record drive dynamics: as controls, or as in `Sampled`."""

    is_plain: bool = eqx.field(static=True)

    def __call__(self, dynamics: AbstractDynamics) -> Any:
        """The step of the dynamics, a function `(t, x, row) -> x_next`."""
        if self.is_plain:
            return lambda t, x, row: dynamics.advance(t, x, row, None)[0]
        assert isinstance(dynamics, Discretized)
        sampled = Sampled(dynamics.system, dynamics.dt)
        driven = dataclasses.replace(dynamics, system=sampled)
        # A row holds its own time.
        return lambda t, x, row: driven.advance(0.0, x, row, None)[0]


def sampling_of(
    dynamics: AbstractDynamics, records: list[Record], where: str
) -> tuple[Sampling, list[Record], list[Float[Array, "_ _ row"]]]:
    """The sampling of these dynamics, the stacked records, and the rows of each. Raise
    if the records cannot drive the dynamics."""
    groups = grouped(records)
    plain = [r.is_uniform and r.hold == "zero" and _fits(dynamics, r) for r in records]
    if all(plain):
        return Sampling(True), groups, _rows(groups, True)
    is_continuous = isinstance(dynamics, Discretized) and not isinstance(
        dynamics.system, AbstractHybridSystem
    )
    if not is_continuous:
        record = records[plain.index(False)]
        got = "samples that are not uniform in time"
        if record.is_uniform:
            got = f"dt={float(record.dt):g} and hold={record.hold!r}"
        raise ValueError(
            f"{where}: dynamics must be a delucax.Discretized system without events, "
            "unless the record has the dt of the dynamics and hold='zero'. Got "
            f"{type(dynamics).__name__} with dt={float(dynamics.dt):g}, and {got}."
        )
    return Sampling(False), groups, _rows(groups, False)


@eqx.filter_jit
def _rows(groups: list[Record], is_plain: bool) -> list[Float[Array, "_ _ row"]]:
    def of(record):
        if is_plain:
            return record.controls[:-1]
        parts = record.times[:-1], record.steps, record.coefficients()
        steps = len(record) - 1
        return jnp.concatenate([p.reshape(steps, -1) for p in parts], axis=1)

    return [jax.vmap(of)(group) for group in groups]


def _fits(dynamics: AbstractDynamics, record: Record) -> bool:
    """Whether the dynamics and the record have the same step. Traced steps count as
    the same."""
    own, dt = dynamics.dt, record.dt
    if not is_concrete(own) or not is_concrete(dt):
        return True
    return bool(np.isclose(float(own), float(dt), rtol=_UNEVEN))
