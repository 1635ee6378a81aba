"""The base classes of discrete-time dynamics, and the states that they lead to."""

import abc
from typing import Any, ClassVar, NamedTuple, TYPE_CHECKING

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from .._check import (
    as_vector,
    check_instance,
    check_step,
    finite_rows,
    finite_vector,
)
from .._jax import (
    by_components,
    join_state,
    split_state,
    stack_steps,
    without_tangents,
)
from .._module import as_float_array, check_parameters
from .._results import (
    choose,
    error_if,
    first_failure,
    first_of,
    or_none,
    plain_errors,
    raise_on_failure,
    Result,
    RESULTS,
)
from .._typing import Control, Numbers, Observation, RealScalar, State, Time
from ..systems import AbstractPlant, AbstractSystem


class AbstractDynamics(AbstractPlant):
    r"""Dynamics in discrete time, $x_{k+1} = F(t_k, x_k, u_k, w_k)$.

    Environments, planners and controllers compute the next state of a plant with these
    dynamics. To define your own dynamics, subclass `AbstractDynamics`, set `dt` and the
    names of the states and controls, and write `advance`.

    **Attributes:**

    - `dt`: the time step, in units of time, a scalar.

    **Raises:** `ValueError` at construction if `dt` is not a positive number, or if a
    [`delucax.parameter`][] is not finite or violates its constraint.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dynamics = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05)
        dynamics(0.0, jnp.array([0.1, 0.0]), jnp.zeros(1))
        ```

        ```text
        Array([0.102, 0.075], dtype=float32)
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
        """The number of Brownian increments that `w` holds, one after the other. The
        increments have the same variance. Each has `disturbance_size / increments`
        entries. By default, the number is 1 if `noise` is `"brownian"`, else 0.
        """
        return 1 if self.noise == "brownian" else 0

    @abc.abstractmethod
    def advance(
        self, t: RealScalar, x: Array, u: Array, w: Array | None
    ) -> tuple[Array, Result]:
        """One step and its status.

        `result` says only whether the solver succeeded. `x_next` is not checked: if the
        state is NaN, or so large that it overflows, `x_next` is not finite although
        `result` is a success. [`delucax.rollout`][] checks for that.

        **Arguments:**

        - `t`: time at the start of the step, a scalar.
        - `x`: state, shape `(state_size,)`.
        - `u`: control, shape `(control_size,)`, held over the step.
        - `w`: disturbance, shape `(disturbance_size,)`; `None` for zero.

        **Returns:** `(x_next, result)`: the next state, shape `(state_size,)`, and one
        of `delucax.RESULTS`.
        """

    @property
    def event_names(self) -> tuple[str, ...]:
        """The names of the events of a hybrid system; none by default."""
        return ()

    def advance_with_events(
        self, t: RealScalar, x: Array, u: Array, w: Array | None
    ) -> tuple[Array, Result, Any]:
        """One step, its status and its events.

        If you wrap dynamics that have events, write this method in addition to
        `advance`.

        **Arguments:** `t`, `x`, `u`, `w`: as in `advance`.

        **Returns:** `(x_next, result, events)`. The first two are as in `advance`;
        `events` is a [`delucax.dynamics.Events`][], or `None` for dynamics without
        events.

        **Raises:** `ValueError` if the dynamics have events but do not define this
        method.
        """
        if self.event_names:
            raise ValueError(
                f"{type(self).__name__}: advance_with_events must be defined for "
                "dynamics with events. Write it besides advance."
            )
        return *self.advance(t, x, u, w), None

    def describe_fault(
        self, times: Array, states: Array, controls: Array, w: Array | None
    ) -> str:
        """A sentence that says where a step of a hybrid system failed, for an error
        message.

        **Arguments:** `times`, `states`, `controls`, `w`: the time, state, control and
            disturbance at the start of each step, with a leading axis over the steps;
            `w` may be `None`.

        **Returns:** the sentence about the first step that failed, or an empty string
        if no step failed.
        """
        _, results, events = _each_step(self, times, states, controls, w)
        bad = np.asarray(results != RESULTS.successful)
        if not bad.any() or events is None:
            return ""
        k = int(bad.argmax())
        kind = int(events.fault_kind[k])
        if kind >= 0:
            name, time = self.event_names[kind], float(events.fault_time[k])
            return f"It was the event {name} at t = {time:g}."
        return f"It was the step from t = {float(times[k]):g} at x = {states[k]}."

    def __call__(
        self, t: RealScalar, x: ArrayLike, u: ArrayLike, w: ArrayLike | None = None
    ) -> Array:
        """The next state.

        **Arguments:** `t`, `x`, `u`, `w`: as in `advance`, with `w` zero by default.
            Shapes are checked.

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
        # Explicit steps cannot fail, so their programs need no check.
        if result is RESULTS.successful:
            return x_next
        failed = result != RESULTS.successful
        return error_if(result, x_next, failed, lambda why: f"{where}: {why}")


def open_loop(
    dynamics: AbstractDynamics,
    x0: Numbers,
    controls: Numbers,
    w: Numbers | None = None,
    t0: RealScalar = 0.0,
) -> Array:
    r"""The trajectory of states under given controls, without feedback.

    $$x_{k+1} = F(t_0 + k\, \Delta t, x_k, u_k, w_k)$$

    Use it for planning and identification. `open_loop` is already compiled: call it
    directly, without `jax.jit`. The states are differentiable with respect to every
    array in the arguments.

    **Arguments:**

    - `dynamics`: the discrete-time dynamics.
    - `x0`: the first state, shape `(n,)`.
    - `controls`: shape `(T, m)`.
    - `w`: disturbances, shape `(T, k)`; zero by default.
    - `t0`: the time of the first state, in units of time; 0 by default.

    **Returns:** the states, shape `(T + 1, n)`.

    **Raises:** `ValueError` on a wrong shape or if an argument is not finite, and an
    error at run time if the solver fails or a state becomes NaN or infinite.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dynamics = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05)
        states = dlx.open_loop(dynamics, jnp.zeros(2), 0.1 * jnp.ones((20, 1)))
        states.shape, states[-1]
        ```

        ```text
        ((21, 2), Array([0.459, 1.84 ], dtype=float32))
        ```
    """
    where = "open_loop"
    check_instance(dynamics, AbstractDynamics, "dynamics", where)
    x0 = finite_vector(x0, dynamics.state_size, "x0", where)
    controls = finite_rows(controls, dynamics.control_size, "controls", where)
    if w is not None:
        w = finite_rows(w, dynamics.disturbance_size, "w", where, controls.shape[0])
    t0 = as_float_array(t0)
    with plain_errors(where):
        run = _open_loop(dynamics, x0, controls, w, t0)

    def facts() -> str:
        given = dynamics, controls, w, t0, run.states
        plant, u, disturbances, start, states = without_tangents(given)
        bad = ~np.all(np.isfinite(states), axis=-1)
        said = f"The state {np.argmax(bad)} is the first that is not finite."
        if not plant.event_names:
            return said if bad.any() else ""
        times = start + jnp.arange(len(u)) * plant.dt
        fault = plant.describe_fault(times, states[:-1], u, disturbances)
        return fault or (said if bad.any() else "")

    return raise_on_failure(run, where, it=None, facts=facts).states


class _Run(NamedTuple):
    states: Array
    result: Result


@eqx.filter_jit
def _each_step(dynamics, times, states, controls, w):
    step = lambda t, x, u, w: dynamics.advance_with_events(t, x, u, w)
    return jax.vmap(step)(times, states, controls, w)


@eqx.filter_jit
def _open_loop(dynamics, x0, controls, w, t0):
    size = x0.shape[0]

    # The gradient then stores only the states, and computes each step again.
    @jax.checkpoint
    @by_components
    def body(parts, inputs):
        k, u, w = inputs
        t = t0 + k * dynamics.dt
        x_next, result = dynamics.advance(t, join_state(parts), u, w)
        return split_state(x_next.astype(x0.dtype)), (parts, or_none(result))

    steps = jnp.arange(controls.shape[0])
    last, (parts, results) = lax.scan(body, split_state(x0), (steps, controls, w))
    states = stack_steps(parts, size, last)
    finite = jnp.all(jnp.isfinite(states))
    end = choose(finite, RESULTS.successful, RESULTS.diverged)
    return _Run(states, first_failure(first_of(results), end))


def _forwarded(name: str) -> Any:
    """A property of the wrapped plant."""
    return property(
        lambda self: getattr(self._inside, name), doc="As in the wrapped plant."
    )


def _forwarded_units(what: str) -> Any:
    """The units of the wrapped plant if the names are unchanged, else `()`."""

    def units(self):
        same = getattr(self, f"{what}_names") == getattr(self._inside, f"{what}_names")
        return getattr(self._inside, f"{what}_units") if same else ()

    doc = "The units of the wrapped plant if its names are the same, else ()."
    return property(units, doc=doc)


class Forwarding(AbstractDynamics):
    """Dynamics whose names, sizes and hooks are by default those of a wrapped plant."""

    @property
    @abc.abstractmethod
    def _inside(self) -> AbstractPlant: ...

    state_names = _forwarded("state_names")
    control_names = _forwarded("control_names")
    disturbance_names = _forwarded("disturbance_names")
    disturbance_size = _forwarded("disturbance_size")
    noise = _forwarded("noise")
    angle_names = _forwarded("angle_names")
    state_units = _forwarded_units("state")
    control_units = _forwarded_units("control")
    time_unit = _forwarded("time_unit")

    @property
    def event_names(self) -> tuple[str, ...]:
        """The event names of the wrapped plant."""
        return tuple(getattr(self._inside, "event_names", ()))

    @property
    def observes_state(self) -> bool:
        """Whether `observe` returns the state itself."""
        # The sensor is traced only if the wrapper overrides it. The wrapped plant may
        # know without tracing.
        own = type(self).observe is not Forwarding.observe
        if own or self.state_size != self._inside.state_size:
            return super().observes_state
        return self._inside.observes_state

    def observe(self, t: Time, x: State) -> Observation:
        return self._inside.observe(t, x)

    def difference(self, x: State, x_ref: State) -> State:
        return self._inside.difference(x, x_ref)

    def equilibrium(self) -> tuple[State, Control]:
        return self._inside.equilibrium()


class AbstractDiscretization(Forwarding):
    """Discrete-time dynamics of a continuous-time system. The field `system` holds the
    continuous-time system. The dynamics take the names, units, sensor and equilibrium
    from this system.

    Subclass `AbstractDiscretization`, declare the fields `system` and `dt`, and write
    `advance`. In `advance`, the disturbance `w` must act in the way that the property
    `noise` of the system names. You rarely need your own subclass, because
    [`delucax.Discretized`][] takes any system and any solver.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp
        from jaxtyping import Array

        class Euler(dlx.dynamics.AbstractDiscretization):
            system: dlx.AbstractSystem
            dt: Array = dlx.parameter(0.05)

            def __check_init__(self):
                if self.noise == "brownian":
                    raise ValueError("Euler: system must have no diffusion.")

            def advance(self, t, x, u, w):
                w = jnp.zeros(self.disturbance_size) if w is None else w
                held, added = (None, w) if self.noise == "additive" else (w, 0.0)
                slope = self.system.vector_field(t, x, u, held)
                return x + self.dt * slope + added, dlx.RESULTS.successful

        Euler(dlx.systems.Pendulum())(0.0, jnp.array([0.1, 0.0]), jnp.ones(1))
        ```

        ```text
        Array([0.1  , 0.225], dtype=float32)
        ```
    """

    if TYPE_CHECKING:  # as in AbstractPlant
        system: ClassVar[Any]
    else:
        system: eqx.AbstractVar[AbstractSystem]

    @property
    def _inside(self):
        return self.system


class AbstractWrapper(Forwarding):
    """Dynamics around other dynamics. The field `dynamics` holds the wrapped dynamics.
    A subclass takes everything that it does not override from the wrapped dynamics.

    Subclass `AbstractWrapper`, declare the field `dynamics`, and write `advance`. If
    the wrapper adds entries to the state, also give `state_names`, `observe`,
    `difference` and `equilibrium`.

    **Raises:** `ValueError` at construction if `dynamics` is not an
    [`delucax.AbstractDynamics`][].

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        class Slippery(dlx.dynamics.AbstractWrapper):
            dynamics: dlx.AbstractDynamics
            grip: jnp.ndarray = dlx.parameter(0.8)

            def advance(self, t, x, u, w):
                return self.dynamics.advance(t, x, self.grip * u, w)

        pendulum = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05)
        Slippery(pendulum)(0.0, jnp.array([0.1, 0.0]), jnp.ones(1))
        ```

        ```text
        Array([0.105, 0.196], dtype=float32)
        ```
    """

    if TYPE_CHECKING:  # as in AbstractPlant
        dynamics: ClassVar[Any]
    else:
        dynamics: eqx.AbstractVar[AbstractDynamics]

    def __check_init__(self):
        check_instance(self.dynamics, AbstractDynamics, "dynamics", type(self).__name__)

    @property
    def _inside(self):
        return self.dynamics

    dt = _forwarded("dt")
    increments = _forwarded("increments")
