"""Recorded breaths."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array

from .._check import check_count, check_finite, check_key, check_range
from .._module import check_parameters, parameter, positive, shown
from .._typing import PRNGKey
from ._waveform import LENGTH


class Breaths(eqx.Module):
    """Recorded breaths, `B` of them, each of `T` samples.

    The pressure at a sample is what the sensor read before the control of that sample
    acted.

    **Arguments:**

    - `u_in`: opening of the inspiratory valve [%], shape `(B, T)`.
    - `u_out`: whether the expiratory valve was open, shape `(B, T)`.
    - `pressure`: what the sensor read [cmH2O], shape `(B, T)`.
    - `dt`: the time between samples [s].
    - `resistance`: of the lung of each breath [cmH2O s/L], shape `(B,)`; not known by
        default.
    - `compliance`: of the lung of each breath [mL/cmH2O], shape `(B,)`; not known by
        default.
    - `truth`: what a sensor without noise would have read, shape `(B, T)`; not known by
        default.

    **Raises:** `ValueError` if shapes do not fit each other, a value is not finite, or
    `dt` is not positive.

    !!! example

        ```python
        import jax
        import jax.numpy as jnp
        from delucax.lung import Breaths

        zeros = jnp.zeros((4, 29))
        breaths = Breaths(zeros, zeros, zeros + 5.0, dt=0.03)
        train, test = breaths.split(0.25, key=jax.random.key(0))
        ```
    """

    u_in: Array = parameter()
    u_out: Array = parameter()
    pressure: Array = parameter()
    dt: Array = parameter(constraint=positive)
    resistance: Array | None = parameter(None)
    compliance: Array | None = parameter(None)
    truth: Array | None = parameter(None)

    __repr__ = shown

    def __check_init__(self):
        check_parameters(self)
        shape = jnp.shape(self.pressure)
        if len(shape) < 2:
            raise ValueError(
                f"Breaths: pressure must have shape (breaths, samples), got {shape}."
            )
        for names, fits, which in (
            (("u_in", "u_out", "truth"), shape, " like pressure"),
            (("resistance", "compliance"), shape[:-1], ", an entry for each breath"),
        ):
            for name in names:
                value = getattr(self, name)
                if value is not None and jnp.shape(value) != fits:
                    raise ValueError(
                        f"Breaths: {name} must have shape {fits}{which}, got "
                        f"{jnp.shape(value)}."
                    )

    def __len__(self) -> int:
        return self.pressure.shape[0]

    def __getitem__(self, index: Any) -> "Breaths":
        """The breaths of an index, a slice or booleans."""
        return jax.tree.map(lambda a: a[index] if a.ndim else a, self)

    @classmethod
    def from_recording(
        cls, u_in: Any, u_out: Any, pressure: Any, *, dt: Any, length: int = LENGTH
    ) -> "Breaths":
        """The inspirations of a recording, cut out of it.

        An inspiration is a longest stretch with the expiratory valve closed. Those
        shorter than `length` are left out, and the others cut to it.

        **Arguments:**

        - `u_in`, `u_out`, `pressure`: the recording, vectors of one size.
        - `dt`: the time between samples [s].
        - `length`: samples per inspiration, 29 by default.

        **Returns:** a [`delucax.lung.Breaths`][].

        **Raises:** `ValueError` if sizes differ, a value is not finite, or there is no
        inspiration as long.

        !!! example

            ```python
            import jax.numpy as jnp
            from delucax.lung import Breaths

            u_out = jnp.tile(jnp.repeat(jnp.array([0.0, 1.0]), 30), 3)
            Breaths.from_recording(0 * u_out, u_out, 0 * u_out, dt=0.03)
            ```
        """
        where = "from_recording"
        length = check_count(length, "length", where)
        columns = [np.asarray(column, float) for column in (u_in, u_out, pressure)]
        if columns[0].ndim != 1 or len({column.shape for column in columns}) != 1:
            raise ValueError(
                f"{where}: u_in, u_out and pressure must be vectors of one size, got "
                f"shapes {[column.shape for column in columns]}."
            )
        for name, column in zip(("u_in", "u_out", "pressure"), columns, strict=True):
            check_finite(column, name, where)
        edges = np.diff((columns[1] < 0.5).astype(int), prepend=0, append=0)
        starts, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
        fits = starts[ends - starts >= length]
        if not len(fits):
            longest = int(np.max(ends - starts, initial=0))
            raise ValueError(
                f"{where}: u_out must be 0 for at least length = {length} samples in a "
                f"row, but the longest inspiration of {len(starts)} has {longest}."
            )
        rows = fits[:, None] + np.arange(length)
        return cls(*(jnp.asarray(column[rows]) for column in columns), dt=dt)

    def split(self, test: float = 0.1, *, key: PRNGKey) -> tuple["Breaths", "Breaths"]:
        """Breaths to train on and breaths to test on, drawn at random.

        **Arguments:**

        - `test`: the share to test on, between 0 and 1; 0.1 by default.
        - `key`: a random key.

        **Returns:** `(train, test)`.

        **Raises:** `ValueError` if either would be empty.
        """
        check_key(key, "split")
        check_range(test, "test", "split", 0, 1)
        cut = round(test * len(self))
        if not 0 < cut < len(self):
            raise ValueError(
                f"split: test must leave breaths on both sides, got {test} of "
                f"{len(self)} breaths."
            )
        order = jr.permutation(key, len(self))
        return self[order[cut:]], self[order[:cut]]

    def open_loop_error(self, model: Any) -> Array:
        """The mean absolute error of a lung that is given the recorded controls alone.

        Against the truth of the breaths where it is known, else against what the sensor
        read.

        **Arguments:** `model`: a [`delucax.lung.LearnedLung`][] or
            [`delucax.lung.LungModel`][].

        **Returns:** a scalar [cmH2O].
        """
        truth = self.pressure if self.truth is None else self.truth
        return jnp.mean(jnp.abs(jax.vmap(model.predict)(self.u_in) - truth))
