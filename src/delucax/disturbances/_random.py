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
    """Independent normal noise, `w[k] ~ N(mean, std^2)`.

    **Arguments:** each a number or a vector of `size` entries.

    - `std`: standard deviation.
    - `mean`: 0 by default.
    - `size`: entries per step; follows from the others if one is a vector.

    **Raises:** `ValueError` if the size is unknown or does not fit, or `std` is
    negative.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        noise = dlx.disturbances.Gaussian(0.1, size=2)
        noise.sequence(jax.random.key(0), 0.05 * jnp.arange(10))
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
    """Independent uniform noise, `w[k] ~ U(low, high)`.

    **Arguments:** each a number or a vector of `size` entries.

    - `low`, `high`: the ends.
    - `size`: entries per step; follows from the others if one is a vector.

    **Raises:** `ValueError` if the size is unknown or does not fit, or `high` is
    below `low`.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        noise = dlx.disturbances.Uniform(-0.1, 0.1, size=2)
        noise.sequence(jax.random.key(0), 0.05 * jnp.arange(10))
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
    """A Gaussian random walk kept inside a bound:
    `w[k + 1] = clip(w[k] + std e[k], -bound, bound)`, `e[k] ~ N(0, 1)`, `w[-1] = 0`.

    **Arguments:** each a number or a vector of `size` entries.

    - `std`: standard deviation of a step, 0.3 by default.
    - `bound`: 1 by default.
    - `size`: entries per step; follows from the others if one is a vector.

    **Raises:** `ValueError` if the size is unknown or does not fit, or `std` or
    `bound` is negative.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        walk = dlx.disturbances.RandomWalk(size=2)
        walk.sequence(jax.random.key(0), 0.05 * jnp.arange(10))
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
        # In the precision of the times, as the carry of a scan must keep its type.
        std, bound = self.std.astype(e.dtype), self.bound.astype(e.dtype)

        def step(w, e):
            w = clip(w + std * e, -bound, bound)
            return w, w

        return lax.scan(step, jnp.zeros(self.size, e.dtype), e)[1]


class Brownian(AbstractDisturbance):
    """Brownian increments for a system with a diffusion, `w[k] ~ N(0, dt / substeps)`.

    An environment whose system has a diffusion uses it by default.

    **Arguments:**

    - `size`: Brownian motions.
    - `dt`: the control interval; by default the distance between the times of the
        sequence, of which there must be two then.
    - `substeps`: solver steps an interval, 1 by default; the increments of all of them
        follow one another in `w`.

    **Raises:** `ValueError` if `dt` is not positive or `substeps` is below 1, or if
    `dt` is left out and the precision of late times is too coarse for it.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        increments = dlx.disturbances.Brownian(1, dt=0.05)
        increments.sequence(jax.random.key(0), 0.05 * jnp.arange(10))
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
                f"Brownian: dt must be given for {times.shape[0]} times, which do not "
                "define it."
            )
        dt = step_between(times, "Brownian") if self.dt is None else self.dt
        return self._increments(check_key(key, "Brownian"), times, dt)

    @eqx.filter_jit
    def _increments(self, key: PRNGKey, times: Vector, dt: Any) -> Rows:
        e = normal(key, (times.shape[0], self.size), times.dtype)
        # Increments of each substep: their variance is its length.
        return (jnp.sqrt(dt / self.substeps) * e).astype(times.dtype)
