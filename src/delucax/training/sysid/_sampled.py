"""Systems driven by what lies between the samples of a record."""

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


# A step of the dynamics that differs by less than this share from that of the record.
_UNEVEN = 1e-4


class Sampled(AbstractSystemWrapper):
    """A system over one step of a record, of any length h,

    `dx/ds = (h / dt) f(t + h s / dt, x, u(s / dt), w)` for s in [0, dt],

    whose control is a row `(t, h, c_0, ..., c_d)`, with `u(r) = sum_j c_j r^j`. So one
    integrator of a fixed step takes samples at any times and controls of any hold.
    """

    system: AbstractSystem
    dt: Array

    @property
    def control_names(self) -> tuple[str, ...]:
        """One row."""
        return ("row",)

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        share, (begin, step), coefficients = t / self.dt, u[:2], u[2:]
        inner = coefficients.reshape(-1, self.system.control_size)
        powers = share ** jnp.arange(inner.shape[0], dtype=x.dtype)
        slope = self.system.vector_field(begin + step * share, x, powers @ inner, w)
        return step / self.dt * slope


class Sampling(eqx.Module):
    """How the rows of a record drive dynamics."""

    is_plain: bool = eqx.field(static=True)

    def __call__(self, dynamics: AbstractDynamics) -> Any:
        """`(t, x, row) -> x_next`."""
        if self.is_plain:
            return lambda t, x, row: dynamics.advance(t, x, row, None)[0]
        assert isinstance(dynamics, Discretized)
        sampled = Sampled(dynamics.system, dynamics.dt)
        driven = dataclasses.replace(dynamics, system=sampled)
        # A row knows its own time.
        return lambda t, x, row: driven.advance(0.0, x, row, None)[0]


def sampling_of(
    dynamics: AbstractDynamics, records: list[Record], where: str
) -> tuple[Sampling, list[Record], list[Float[Array, "_ _ row"]]]:
    """How these dynamics are driven; stacked records, and the rows of each. Raises if
    the dynamics cannot be driven by them."""
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
            "unless the record has their own dt and hold='zero'; got "
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
    """Whether the step of the dynamics is that of the record, as far as is known."""
    own, dt = dynamics.dt, record.dt
    if not is_concrete(own) or not is_concrete(dt):
        return True
    return bool(np.isclose(float(own), float(dt), rtol=_UNEVEN))
