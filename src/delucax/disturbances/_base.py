"""Sequences of disturbances, drawn for a whole horizon at once."""

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
from .._module import check_parameters, parameter, parts_of
from .._typing import PRNGKey, Real, RealScalar, Vector
from ..math._steps import reached, step_between


Rows: TypeAlias = Float[Array, "steps size"]
"""The disturbance of each step."""


class AbstractDisturbance(eqx.Module):
    """A sequence `w[0], ..., w[T - 1]`, drawn at once for the whole horizon.

    Add two with `+`; confine one to a part of the time with `between`.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        noise = dlx.disturbances.Gaussian(0.1, size=2)
        gust = dlx.disturbances.Sinusoid(0.2, frequency=1.0, size=2).between(3.0, 6.0)
        w = (noise + gust).sequence(jax.random.key(0), 0.05 * jnp.arange(100))
        ```
    """

    if TYPE_CHECKING:  # a static checker would ask for abstract fields as arguments
        size: ClassVar[Any]
    else:
        size: eqx.AbstractVar[int]

    def __check_init__(self):
        check_parameters(self)

    @property
    def recorded_steps(self) -> int | None:
        """The most steps that `sequence` gives; `None` for any number.

        By default those of the shortest disturbance among its fields.
        """
        steps = [part.recorded_steps for part in parts_of(self, AbstractDisturbance)]
        return min((n for n in steps if n is not None), default=None)

    @abc.abstractmethod
    def sequence(self, key: PRNGKey | None, times: Vector) -> Rows:
        """The disturbances at `times`.

        **Arguments:**

        - `key`: a random key; deterministic disturbances also take `None`.
        - `times`: the start of each step, shape `(T,)`, increasing. A rollout gives
            `0, dt, ...` in the precision of the state, so a time of `k dt` is rounded:
            compare it with another to the nearest step, not exactly.

        **Returns:** shape `(T, size)`.
        """

    def draw(self, key: PRNGKey | None, dt: RealScalar, steps: int, dtype: Any) -> Rows:
        """The disturbances of an episode, as [`delucax.rollout`][] draws them.

        **Arguments:**

        - `key`: of `sequence`.
        - `dt`: the control interval.
        - `steps`: the number of steps.
        - `dtype`: the precision of the times.

        **Returns:** shape `(steps, size)`.

        **Raises:** `ValueError` if `sequence` returns another shape.
        """
        # Two times at least, because Brownian motion infers the interval from them; but
        # no more than are recorded.
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
        """The disturbance inside a time window, `start <= t < stop`, and zero outside.

        An end within rounding error of the time of a step is snapped to it, so that a
        window of 5 steps acts on 5.

        **Arguments:** `start`, `stop`: the ends of the window, in units of time.

        **Returns:** the disturbance.

        **Raises:** `ValueError` if `stop` is before `start`; or for a horizon of more
        than 2^22 steps in single precision, whose times are too coarse for the steps.
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
    """The sum of several disturbances, each drawn with a key of its own.

    **Arguments:** `*terms`: disturbances of one size.

    **Raises:** `ValueError` if none is given, if one is not an
    `AbstractDisturbance`, or if sizes differ.

    !!! example

        ```python
        import delucax as dlx

        both = dlx.disturbances.Sum(
            dlx.disturbances.Gaussian(0.1, size=2),
            dlx.disturbances.Constant(0.5, size=2),
        )
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
            raise ValueError(f"Sum: terms must be of one size, got sizes {sizes}.")

    @property
    def size(self) -> int:
        """The size that the terms share."""
        return self.terms[0].size

    def sequence(self, key: PRNGKey | None, times: Vector) -> Rows:
        n = len(self.terms)
        if key is not None:
            check_key(key, "Sum")
        # A key for each term: with one key for all, equal terms would draw the same
        # noise.
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
        # A step of NaN says that the times are too coarse: the result is then NaN too,
        # and not a window at the wrong place.
        return w if dt is None else jnp.where(jnp.isnan(dt), jnp.nan, w)


class AbstractEntrywise(AbstractDisturbance):
    """A disturbance whose arguments are numbers, the same for each entry, or vectors of
    `size` entries.
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
                        f"{where}: {name} has {array.shape[0]} entries where {size} "
                        "are expected."
                    )
                size = array.shape[0]
        if size is None:
            raise ValueError(
                f"{where}: size must be given when every other argument is a number, "
                f"such as {where}(..., size=2)."
            )
        return check_count(size, "size", where)

    def _rows(self, w: Array, times: Vector) -> Array:
        """`w`, of one step or of all, for all `times`."""
        return jnp.broadcast_to(w, (len(times), self.size)).astype(times.dtype)


def as_size(size: int | None) -> int | None:
    """The size as given: a converter, so that `None` may stand for what the other
    fields say."""
    return size
