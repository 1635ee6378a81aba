"""The discrete-time map that environments, planners and learners step."""

import abc
from typing import Any, ClassVar, TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from .._check import check_step, output_of
from .._module import check_parameters
from .._results import Result, RESULTS
from .._typing import RealScalar
from ..systems._base import validate_io


class AbstractDynamics(eqx.Module):
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
        state_names: ClassVar[Any]
        control_names: ClassVar[Any]
    else:
        dt: eqx.AbstractVar[Array]
        state_names: eqx.AbstractVar[tuple[str, ...]]
        control_names: eqx.AbstractVar[tuple[str, ...]]
    state_units: ClassVar[Any] = ()
    control_units: ClassVar[Any] = ()
    time_unit: ClassVar[Any] = "s"

    def __check_init__(self):
        check_step(self.dt, type(self).__name__)
        check_parameters(self)

    @property
    def state_size(self) -> int:
        """The number of states."""
        return len(self.state_names)

    @property
    def control_size(self) -> int:
        """The number of controls."""
        return len(self.control_names)

    @property
    def disturbance_size(self) -> int:
        """The size of `w`; that of the state by default."""
        return self.state_size

    @property
    def increments(self) -> int:
        """How many Brownian increments of equal variance `w` holds one after the other,
        each of `disturbance_size / increments` entries; 0, the default, if `w` is not
        Brownian. Dynamics that hold stochastic ones, or a system with a diffusion, must
        say which it is: environments do not take the default from them."""
        return 0

    @property
    def is_stochastic(self) -> bool:
        """Whether `w` holds Brownian increments, so that no noise is the exception."""
        return self.increments > 0

    @property
    def observes_state(self) -> bool:
        """Whether what `observe` returns is the state itself, as its program shows."""
        x = jnp.zeros(self.state_size)
        traced = jax.make_jaxpr(self.observe)(jnp.zeros(()), x).jaxpr
        return list(traced.outvars) == [traced.invars[1]]

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
        x_next, result = self.advance(t, *validate_io(self, x, u, w))
        if result is RESULTS.successful:
            return x_next
        return result.error_if(x_next, result != RESULTS.successful)

    def observe(self, t: RealScalar, x: Array) -> Array:
        """What the plant's sensor reads; the state by default.

        **Arguments:** `t`: time. `x`: state.

        **Returns:** the observation, rank 1.
        """
        del t
        return x

    def difference(self, x: Array, x_ref: Array) -> Array:
        """The deviation of `x` from `x_ref`; angles wrap where the system says so.

        **Arguments:** `x`: state. `x_ref`: the state to measure from.

        **Returns:** the deviation, a vector.
        """
        return x - x_ref

    def equilibrium(self) -> tuple[Array, Array]:
        """A state and a control at which the dynamics rest.

        **Returns:** `(x, u)`.

        **Raises:** `ValueError` if none is named.
        """
        raise ValueError(
            f"{type(self).__name__} names no equilibrium: give the state and control "
            "yourself."
        )

    @property
    def observation_size(self) -> int:
        """The size of what `observe` returns."""
        y = output_of(self.observe, (), (self.state_size,))
        shape = getattr(y, "shape", None)
        if shape is None or len(shape) != 1:
            got = type(y).__name__ if shape is None else f"an array of shape {shape}"
            raise ValueError(
                f"{type(self).__name__}: observe must return a vector, got {got}."
            )
        return shape[0]


def check_dynamics(value: Any, where: str) -> None:
    """Raise unless `value` is discrete-time dynamics."""
    if not isinstance(value, AbstractDynamics):
        raise ValueError(
            f"{where}: dynamics must be an AbstractDynamics (discretise a system with "
            f"`delucax.Discretized`; of an environment give its `dynamics`), got "
            f"{type(value).__name__}."
        )
