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
    """`B` recorded breaths with `T` samples each.

    The pressure of a sample is the reading of the sensor before the control of that
    sample acted.

    **Arguments:**

    - `u_in`: the opening of the inspiratory valve [%], shape `(B, T)`.
    - `u_out`: whether the expiratory valve was open, shape `(B, T)`.
    - `pressure`: the reading of the sensor [cmH2O], shape `(B, T)`.
    - `dt`: the time between samples [s].
    - `resistance`: the resistance of the lung of each breath [cmH2O s/L], shape `(B,)`;
        `None` by default.
    - `compliance`: the compliance of the lung of each breath [mL/cmH2O], shape `(B,)`;
        `None` by default.
    - `truth`: the pressure that a sensor without noise would read [cmH2O], shape
        `(B, T)`; `None` by default.

    **Raises:** `ValueError` if shapes do not match, a value is not finite, or `dt` is
    not positive.

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
        """The breaths at an index, a slice or a mask of booleans."""
        return jax.tree.map(lambda a: a[index] if a.ndim else a, self)

    @classmethod
    def from_recording(
        cls, u_in: Any, u_out: Any, pressure: Any, *, dt: Any, length: int = LENGTH
    ) -> "Breaths":
        """Cut the inspirations out of a recording.

        An inspiration lasts as long as the expiratory valve is closed. Inspirations
        shorter than `length` are left out, and the others are cut to `length`.

        **Arguments:**

        - `u_in`, `u_out`, `pressure`: the recording, vectors of one size.
        - `dt`: the time between samples [s].
        - `length`: the number of samples per inspiration, 29 by default.

        **Returns:** a [`delucax.lung.Breaths`][].

        **Raises:** `ValueError` if the sizes differ, a value is not finite, or no
        inspiration is long enough.

        !!! example

            ```python
            import jax.numpy as jnp
            from delucax.lung import Breaths

            u_out = jnp.tile(jnp.repeat(jnp.array([0.0, 1.0]), 30), 3)
            Breaths.from_recording(0 * u_out, u_out, 0 * u_out, dt=0.03)
            ```

            ```text
            Breaths(u_in=f32[3,29], u_out=f32[3,29], pressure=f32[3,29], dt=0.03)
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
        """Split the breaths at random into breaths to train on and breaths to test on.

        **Arguments:**

        - `test`: the share of breaths to test on, between 0 and 1; 0.1 by default.
        - `key`: a random key.

        **Returns:** `(train, test)`.

        **Raises:** `ValueError` if one of the two parts would be empty.
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
        """The mean absolute error of a lung that is given only the recorded controls.

        The error is measured against `truth` if it is known, else against `pressure`.

        **Arguments:** `model`: a [`delucax.lung.LearnedLung`][] or
            [`delucax.lung.LungModel`][].

        **Returns:** a scalar [cmH2O].
        """
        truth = self.pressure if self.truth is None else self.truth
        return jnp.mean(jnp.abs(jax.vmap(model.predict)(self.u_in) - truth))
