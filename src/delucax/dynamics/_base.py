"""The discrete-time map that environments, planners and learners step."""

import abc
from typing import Any, ClassVar, TYPE_CHECKING

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from .._check import as_vector, check_step
from .._module import check_parameters
from .._results import Result, RESULTS
from .._typing import RealScalar
from ..systems import AbstractPlant


class AbstractDynamics(AbstractPlant):
    """Dynamics in discrete time, `x_next = F(t, x, u, w)` over a step of `dt`.

    Subclasses give `dt`, the names of states and controls, and `advance`.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dynamics = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05)
        dynamics(0.0, jnp.array([0.1, 0.0]), jnp.zeros(1))
        ```
    """

    if TYPE_CHECKING:  # a static checker would ask for abstract fields as arguments
        dt: ClassVar[Any]
    else:
        dt: eqx.AbstractVar[Array]

    def __check_init__(self):
        check_step(self.dt, type(self).__name__)
        check_parameters(self)

    @property
    def increments(self) -> int:
        """How many Brownian increments of equal variance `w` holds one after the other,
        each of `disturbance_size / increments` entries: 1 if `noise` is `"brownian"`
        and nothing else is said, and 0 if it is not.
        """
        return 1 if self.noise == "brownian" else 0

    @abc.abstractmethod
    def advance(
        self, t: RealScalar, x: Array, u: Array, w: Array | None
    ) -> tuple[Array, Result]:
        """One step, with what became of it.

        `result` is that of the solver alone. The numbers are not checked: from NaN, or
        from a finite state so large that it overflows, `x_next` is not finite although
        `result` is a success. [`delucax.rollout`][] checks for that.

        **Arguments:**

        - `t`: time at the start of the step.
        - `x`: state, shape `(state_size,)`.
        - `u`: control, shape `(control_size,)`, held over the step.
        - `w`: disturbance, shape `(disturbance_size,)`; `None` for zero.

        **Returns:** `(x_next, result)`, the latter one of `delucax.RESULTS`.
        """

    def __call__(
        self, t: RealScalar, x: ArrayLike, u: ArrayLike, w: ArrayLike | None = None
    ) -> Array:
        """The next state.

        **Arguments:** as `advance`; shapes are checked.

        **Returns:** `x_next`, shape `(state_size,)`.

        **Raises:** `ValueError` on a wrong shape, and an error at run time if the
        solver fails.
        """
        where = type(self).__name__
        x = as_vector(x, self.state_size, "x (the state)", where)
        u = as_vector(u, self.control_size, "u (the control)", where)
        if w is not None:
            w = as_vector(w, self.disturbance_size, "w (the disturbance)", where)
        x_next, result = self.advance(t, x, u, w)
        if result is RESULTS.successful:
            return x_next
        return result.error_if(x_next, result != RESULTS.successful)


def zeros_if_none(w: Array | None, size: int, like: Array) -> Array:
    """A zero disturbance where none is given."""
    return jnp.zeros(size, like.dtype) if w is None else w
