"""Parameters that are estimated together with the state, as random walks."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .._check import bounds_field, check_finite, check_range, number_at
from .._message import shortened
from .._module import by_path, get_path, parameter, shown, with_values
from .._results import Result
from .._typing import Real, RealScalar
from ..dynamics import AbstractDynamics, AbstractWrapper


class RandomWalk(eqx.Module):
    r"""The random-walk model of a parameter that [`delucax.estimators.MHE`][]
    estimates.

    $$\theta_0 \sim N(\theta_\mathrm{start}, \mathrm{variance}), \qquad
    \theta_{k+1} = \theta_k + e_k, \quad e_k \sim N(0, \mathrm{step})$$

    $\theta_\mathrm{start}$ is the value of the parameter in the dynamics.

    **Arguments:**

    - `variance`: the variance of the first value $\theta_0$, either one number, or one
        number for each entry of the parameter. If the variance is 0, the estimate
        starts exactly at $\theta_\mathrm{start}$.
    - `step`: the variance of the change of the parameter in one time step, either one
        number, or one number for each entry of the parameter. The default is 0, which
        means that the parameter is constant.
    - `bounds`: bounds of the parameter, a pair `(low, high)` of numbers or vectors;
        none by default.

    **Raises:** `ValueError` if a variance is negative or not finite, or `bounds` is not
    a pair with `low <= high`.

    Source: Rawlings, Mayne and Diehl, 2017, chapter 4.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        pendulum = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05)
        length = dlx.estimators.RandomWalk(0.1, step=1e-5, bounds=(0.1, 5.0))
        mhe = dlx.estimators.MHE(
            pendulum,
            1e-4 * jnp.eye(2),
            1e-2 * jnp.eye(2),
            10,
            parameters={"system.length": length},
        )
        mhe.estimated_parameters(mhe.init())["system.length"].mean
        ```

        ```text
        Array([1.], dtype=float32)
        ```
    """

    variance: Real = parameter()
    step: Real = parameter(0.0)
    bounds: tuple[Array, Array] | None = bounds_field("RandomWalk", default=None)

    __repr__ = shown

    def __check_init__(self):
        where = "RandomWalk"
        for name in ("variance", "step"):
            check_range(getattr(self, name), name, where)
            check_finite(getattr(self, name), name, where)


class WithParameters(AbstractWrapper):
    """Dynamics with some of their parameters, given by paths, as additional states."""

    dynamics: AbstractDynamics
    paths: tuple[str, ...] = eqx.field(static=True)

    @property
    def _values(self) -> list[Array]:
        return [get_path(self.dynamics, path) for path in self.paths]

    @property
    def start(self) -> Array:
        """The values of the parameters in the dynamics, flattened and joined."""
        return jnp.concatenate([jnp.ravel(value) for value in self._values])

    @property
    def state_names(self) -> tuple[str, ...]:
        more = (f"parameter[{i}]" for i in range(sum(a.size for a in self._values)))
        return (*self.dynamics.state_names, *more)

    @property
    def disturbance_size(self) -> int:
        own = self.state_size - self.dynamics.state_size
        return self.dynamics.disturbance_size + own

    def values(self, flat: Array) -> dict[str, Array]:
        """The parameters in `flat`, by their paths."""
        shapes = (value.shape for value in self._values)
        return by_path(flat, dict(zip(self.paths, shapes, strict=True)))

    def _opened(self, x: Array) -> tuple[AbstractDynamics, Array, Array]:
        """The dynamics with the parameters in `x`, the plant's own state, and the
        parameters."""
        n = self.dynamics.state_size
        return with_values(self.dynamics, self.values(x[n:])), x[:n], x[n:]

    def advance(
        self, t: RealScalar, x: Array, u: Array, w: Array | None
    ) -> tuple[Array, Result]:
        dynamics, own, flat = self._opened(x)
        k = self.dynamics.disturbance_size
        held = None if w is None else w[:k]
        after, result = dynamics.advance(t, own, u, held)
        return jnp.concatenate([after, flat if w is None else flat + w[k:]]), result

    def observe(self, t: RealScalar, x: Array) -> Array:
        dynamics, own, _ = self._opened(x)
        return dynamics.observe(t, own)

    def difference(self, x: Array, x_ref: Array) -> Array:
        n = self.dynamics.state_size
        own = self.dynamics.difference(x[:n], x_ref[:n])
        return jnp.concatenate([own, x[n:] - x_ref[n:]])


def check_walks(parameters: Any, dynamics: AbstractDynamics, where: str) -> None:
    """Raise unless `parameters` are random walks that fit numbers in the dynamics."""
    if not isinstance(parameters, dict) or not all(
        isinstance(walk, RandomWalk) for walk in parameters.values()
    ):
        raise ValueError(
            f"{where}: parameters must be a dictionary from paths to RandomWalk, got "
            f"{shortened(parameters)}."
        )
    for path, walk in parameters.items():
        name = f"parameters[{path!r}]"
        value = number_at(dynamics, path, "parameters", "dynamics", where)
        for what, array in (
            ("variance", walk.variance),
            ("step", walk.step),
            *(("bounds", end) for end in walk.bounds or ()),
        ):
            if array.shape not in ((), (value.size,)):
                raise ValueError(
                    f"{where}: {what} of {name} must be a number or have shape "
                    f"({value.size},), got shape {array.shape}."
                )
