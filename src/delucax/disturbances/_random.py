"""Random disturbances."""

from typing import Any

import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array

from .._check import check_count, check_key, check_range, check_step
from .._jax import normal
from .._module import parameter
from .._typing import PRNGKey, Real, Vector
from ..math import clip
from ..math._steps import step_between
from ._base import AbstractDisturbance, AbstractEntrywise, as_size, Rows


class Gaussian(AbstractEntrywise):
    r"""Independent normal noise, $w_k \sim \mathcal{N}(\mu, \sigma^2)$.

    **Arguments:** every argument except `size` is a number or has shape `(size,)`.

    - `std`: the standard deviation $\sigma$.
    - `mean`: $\mu$, 0 by default.
    - `size`: the number of entries of the disturbance at each step. You may leave out
        `size` if another argument is a vector.

    **Raises:** `ValueError` if the size is unknown or does not fit, or `std` is
    negative.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        noise = dlx.disturbances.Gaussian(0.1, size=2)
        noise.sequence(jax.random.key(0), 0.05 * jnp.arange(10)).shape
        ```

        ```text
        (10, 2)
        ```
    """

    std: Real = parameter()
    mean: Real = parameter(0.0)
    size: int = eqx.field(default=None, converter=as_size, static=True, kw_only=True)

    def __check_init__(self):
        check_range(self.std, "std", "Gaussian")

    def sequence(self, key: PRNGKey | None, times: Vector) -> Rows:
        return self._draw(check_key(key, "Gaussian"), times)

    @eqx.filter_jit
    def _draw(self, key: PRNGKey, times: Vector) -> Rows:
        w = normal(key, (times.shape[0], self.size), times.dtype)
        return (self.std * w + self.mean).astype(times.dtype)


class Uniform(AbstractEntrywise):
    r"""Independent uniform noise, $w_k \sim \mathcal{U}(\mathrm{low}, \mathrm{high})$.

    **Arguments:** every argument except `size` is a number or has shape `(size,)`.

    - `low`, `high`: the ends of the interval.
    - `size`: the number of entries of the disturbance at each step. You may leave out
        `size` if another argument is a vector.

    **Raises:** `ValueError` if the size is unknown or does not fit, or `high` is
    below `low`.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        noise = dlx.disturbances.Uniform(-0.1, 0.1, size=2)
        noise.sequence(jax.random.key(0), 0.05 * jnp.arange(10)).shape
        ```

        ```text
        (10, 2)
        ```
    """

    low: Real = parameter()
    high: Real = parameter()
    size: int = eqx.field(default=None, converter=as_size, static=True, kw_only=True)

    def __check_init__(self):
        check_range(self.high, "high", "Uniform", self.low)

    def sequence(self, key: PRNGKey | None, times: Vector) -> Rows:
        return self._draw(check_key(key, "Uniform"), times)

    @eqx.filter_jit
    def _draw(self, key: PRNGKey, times: Vector) -> Rows:
        w = jr.uniform(key, (times.shape[0], self.size), times.dtype)
        return (self.low + (self.high - self.low) * w).astype(times.dtype)


class RandomWalk(AbstractEntrywise):
    r"""A Gaussian random walk that stays inside a bound.

    $$w_k = \operatorname{clip}(w_{k-1} + \sigma e_k, -b, b), \qquad
    e_k \sim \mathcal{N}(0, 1), \qquad w_{-1} = 0$$

    **Arguments:** every argument except `size` is a number or has shape `(size,)`.

    - `std`: $\sigma$, the standard deviation of a step, 0.3 by default.
    - `bound`: $b$, 1 by default.
    - `size`: the number of entries of the disturbance at each step. You may leave out
        `size` if another argument is a vector.

    **Raises:** `ValueError` if the size is unknown or does not fit, or `std` or
    `bound` is negative.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        walk = dlx.disturbances.RandomWalk(size=2)
        walk.sequence(jax.random.key(0), 0.05 * jnp.arange(10)).shape
        ```

        ```text
        (10, 2)
        ```
    """

    std: Real = parameter(0.3)
    bound: Real = parameter(1.0)
    size: int = eqx.field(default=None, converter=as_size, static=True, kw_only=True)

    def __check_init__(self):
        check_range(self.std, "std", "RandomWalk")
        check_range(self.bound, "bound", "RandomWalk")

    def sequence(self, key: PRNGKey | None, times: Vector) -> Rows:
        return self._draw(check_key(key, "RandomWalk"), times)

    @eqx.filter_jit
    def _draw(self, key: PRNGKey, times: Vector) -> Rows:
        e = normal(key, (times.shape[0], self.size), times.dtype)
        # In the precision of the times, because the carry of a scan must keep its type.
        std, bound = self.std.astype(e.dtype), self.bound.astype(e.dtype)

        def step(w, e):
            w = clip(w + std * e, -bound, bound)
            return w, w

        return lax.scan(step, jnp.zeros(self.size, e.dtype), e)[1]


class Brownian(AbstractDisturbance):
    r"""Brownian increments for a system with a diffusion,
    $w_k \sim \mathcal{N}(0, \Delta t / \mathrm{substeps})$.

    Brownian increments are the default disturbance of an environment whose system has a
    diffusion.

    **Arguments:**

    - `size`: the number of Brownian motions.
    - `dt`: the control interval $\Delta t$, in units of time. By default, `sequence`
        takes the interval between the first two of its `times`, so `times` must then
        have at least two entries.
    - `substeps`: the number of solver steps per control interval, 1 by default. The
        disturbance holds the increments of all substeps of an interval, one after the
        other.

    **Raises:** `ValueError` if `size` or `substeps` is below 1 or `dt` is not positive.
    Without `dt`, `sequence` also raises a `ValueError` if `times` has fewer than two
    entries, or if its entries are so large that rounding hides the interval between
    them.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        increments = dlx.disturbances.Brownian(1, dt=0.05)
        increments.sequence(jax.random.key(0), 0.05 * jnp.arange(10)).shape
        ```

        ```text
        (10, 1)
        ```
    """

    dt: Array | None = parameter()
    size: int = eqx.field(static=True)
    substeps: int = eqx.field(static=True)

    def __init__(self, size: int, dt: Any = None, substeps: int = 1):
        self.dt = dt
        self.substeps = check_count(substeps, "substeps", "Brownian")
        self.size = check_count(size, "size", "Brownian") * self.substeps

    def __check_init__(self):
        if self.dt is not None:
            check_step(self.dt, "Brownian")

    def sequence(self, key: PRNGKey | None, times: Vector) -> Rows:
        if self.dt is None and times.shape[0] < 2:
            raise ValueError(
                "Brownian: dt must be given, because it does not follow from fewer "
                f"than two times, got {times.shape[0]}."
            )
        dt = step_between(times, "Brownian") if self.dt is None else self.dt
        return self._increments(check_key(key, "Brownian"), times, dt)

    @eqx.filter_jit
    def _increments(self, key: PRNGKey, times: Vector, dt: Any) -> Rows:
        e = normal(key, (times.shape[0], self.size), times.dtype)
        # The variance of an increment is the length of its substep.
        return (jnp.sqrt(dt / self.substeps) * e).astype(times.dtype)
