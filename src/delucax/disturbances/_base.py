"""The base class of disturbances, their sums and windows."""

import abc
import dataclasses
import functools
import operator
from typing import Any, ClassVar, TYPE_CHECKING, TypeAlias

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, ArrayLike, Float

from .._check import as_entries, check_count, check_instance, check_key, check_range
from .._module import check_parameters, parameter, parts_of, shown
from .._typing import PRNGKey, Real, RealScalar, Vector
from ..math._steps import reached, step_between


Rows: TypeAlias = Float[Array, "steps size"]
"""The disturbance of each step."""


class AbstractDisturbance(eqx.Module):
    r"""A disturbance: a sequence $w_0, \dots, w_{T-1}$, drawn for the whole episode at
    once.

    To define your own disturbance, subclass `AbstractDisturbance`, set `size` and write
    `sequence`. Add two disturbances with `+`, and limit one to a window of time with
    `between`.

    **Attributes:**

    - `size`: the number of entries of the disturbance at each step.

    **Raises:** `ValueError` at construction if a [`delucax.parameter`][] is not finite
    or violates its constraint.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        noise = dlx.disturbances.Gaussian(0.1, size=2)
        gust = dlx.disturbances.Sinusoid(0.2, frequency=1.0, size=2).between(3.0, 6.0)
        w = (noise + gust).sequence(jax.random.key(0), 0.05 * jnp.arange(100))
        w.shape
        ```

        ```text
        (100, 2)
        ```
    """

    if TYPE_CHECKING:  # a static checker would ask for abstract fields as arguments
        size: ClassVar[Any]
    else:
        size: eqx.AbstractVar[int]

    __repr__ = shown

    def __check_init__(self):
        check_parameters(self)

    @property
    def recorded_steps(self) -> int | None:
        """The largest number of steps that `sequence` can give, or `None` if there is
        no limit. By default, it is the smallest number among the disturbances in the
        fields.
        """
        steps = [part.recorded_steps for part in parts_of(self, AbstractDisturbance)]
        return min((n for n in steps if n is not None), default=None)

    @abc.abstractmethod
    def sequence(self, key: PRNGKey | None, times: Vector) -> Rows:
        """The disturbances at `times`.

        **Arguments:**

        - `key`: a random key, or `None` for a deterministic disturbance.
        - `times`: the start of each step, shape `(T,)`, increasing. A rollout passes
            `0, dt, 2 dt, ...`, rounded to the precision of the state. Because of this
            rounding, compare times to the nearest step, not exactly.

        **Returns:** shape `(T, size)`.
        """

    def draw(self, key: PRNGKey | None, dt: RealScalar, steps: int, dtype: Any) -> Rows:
        """The disturbances of an episode, as [`delucax.rollout`][] draws them.

        **Arguments:**

        - `key`: a random key, or `None`; `draw` passes it to `sequence`.
        - `dt`: the control interval, a scalar.
        - `steps`: the number of steps.
        - `dtype`: the dtype of the times.

        **Returns:** shape `(steps, size)`.

        **Raises:** `ValueError` if `sequence` returns an array of another shape.
        """
        # At least two times, because Brownian motion infers the interval from them,
        # unless a recording has only one.
        recorded = self.recorded_steps
        count = max(steps, 2 if recorded is None else min(recorded, 2))
        w = self.sequence(key, (jnp.arange(count) * dt).astype(dtype))
        shape = (count, self.size)
        if getattr(w, "shape", None) != shape:
            got = getattr(w, "shape", f"a {type(w).__name__}")
            raise ValueError(
                f"{type(self).__name__}: sequence must return an array of shape "
                f"{shape}, got {got}."
            )
        return w[:steps]

    def between(self, start: ArrayLike, stop: ArrayLike) -> "AbstractDisturbance":
        r"""A disturbance that is this one inside a window of time,
        $\mathrm{start} \le t < \mathrm{stop}$, and zero outside.

        An end of the window that differs from the time of a step only by rounding is
        moved to that step, so that a window of 5 steps acts on 5 steps.

        **Arguments:** `start`, `stop`: the ends of the window, in units of time.

        **Returns:** the disturbance.

        **Raises:** `ValueError` if `stop` is before `start`. The disturbance also
        raises a `ValueError` if the horizon has more than 2^22 steps in single
        precision, because the times are then too coarse to resolve a step.
        """
        return _Window(self, start, stop)

    def __add__(self, other: "AbstractDisturbance") -> "AbstractDisturbance":
        if not isinstance(other, AbstractDisturbance):
            return NotImplemented
        return Sum(self, other)

    def __radd__(self, other: Any) -> "AbstractDisturbance":
        # The built-in `sum` starts at 0.
        return self if isinstance(other, int) and other == 0 else NotImplemented


class Sum(AbstractDisturbance):
    """The sum of several disturbances. Each term is drawn with its own random key.
    `disturbance + other` makes one.

    **Arguments:**

    - `*terms`: disturbances of the same size, at least one.

    **Raises:** `ValueError` if no disturbance is given, if an argument is not an
    `AbstractDisturbance`, or if the sizes differ.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        offset = dlx.disturbances.Constant(0.5, size=2)
        wave = dlx.disturbances.Sinusoid(jnp.array([0.0, 1.0]), frequency=0.25)
        dlx.disturbances.Sum(offset, wave).sequence(None, jnp.arange(3.0))
        ```

        ```text
        Array([[0.5, 0.5],
               [0.5, 1.5],
               [0.5, 0.5]], dtype=float32)
        ```
    """

    terms: tuple[AbstractDisturbance, ...]

    def __init__(self, *terms: AbstractDisturbance):
        self.terms = terms

    def __check_init__(self):
        for term in self.terms:
            check_instance(term, AbstractDisturbance, "every term", "Sum")
        sizes = [term.size for term in self.terms]
        if len(set(sizes)) != 1:
            raise ValueError(f"Sum: terms must have the same size, got sizes {sizes}.")

    @property
    def size(self) -> int:
        """The size that the terms share."""
        return self.terms[0].size

    def sequence(self, key: PRNGKey | None, times: Vector) -> Rows:
        n = len(self.terms)
        if key is not None:
            check_key(key, "Sum")
        # With one key for all, equal terms would draw the same noise.
        keys = [None] * n if key is None else list(jr.split(key, n))
        drawn = (w.sequence(k, times) for w, k in zip(self.terms, keys, strict=True))
        return functools.reduce(operator.add, drawn)


class _Window(AbstractDisturbance):
    disturbance: AbstractDisturbance
    start: Real = parameter()
    stop: Real = parameter()

    def __check_init__(self):
        check_instance(self.disturbance, AbstractDisturbance, "disturbance", "between")
        check_range(self.stop, "stop", "between", self.start)

    @property
    def size(self) -> int:
        """The size of the disturbance inside."""
        return self.disturbance.size

    def sequence(self, key: PRNGKey | None, times: Vector) -> Rows:
        w = self.disturbance.sequence(key, times)
        return self._cut(w, times, step_between(times, "between"))

    @eqx.filter_jit
    def _cut(self, w: Rows, times: Vector, dt: Any) -> Rows:
        inside = reached(times, self.start, dt) & ~reached(times, self.stop, dt)
        w = jnp.where(inside[:, None], w, jnp.zeros((), w.dtype))
        # A step of NaN means that the times are too coarse. The result is then NaN too,
        # not a window in the wrong place.
        return w if dt is None else jnp.where(jnp.isnan(dt), jnp.nan, w)


class AbstractEntrywise(AbstractDisturbance):
    """A disturbance whose arguments are vectors of `size` entries, or numbers that hold
    for every entry.
    """

    def __post_init__(self):
        self.size = self._common_size()  # pyright: ignore[reportAttributeAccessIssue]

    def __check_init__(self):
        self._common_size()

    def _common_size(self) -> int:
        """The size that arrays share; numbers fit any size."""
        where, size = type(self).__name__, self.size
        for name in [f.name for f in dataclasses.fields(self) if f.name != "size"]:
            value = getattr(self, name)
            array = as_entries(value, None, name, where, "disturbance")
            if array.ndim == 1:
                if size is not None and array.shape[0] != size:
                    raise ValueError(
                        f"{where}: {name} must have {size} entries, got "
                        f"{array.shape[0]}."
                    )
                size = array.shape[0]
        if size is None:
            raise ValueError(
                f"{where}: size must be given if every other argument is a number, as "
                f"in {where}(..., size=2)."
            )
        return check_count(size, "size", where)

    def _rows(self, w: Array, times: Vector) -> Array:
        """`w`, for one step or for all, broadcast to all `times`."""
        return jnp.broadcast_to(w, (len(times), self.size)).astype(times.dtype)


def as_size(size: int | None) -> int | None:
    """The size unchanged. As a converter, it lets a field of type `int` be `None` until
    the other fields have given the size."""
    return size
