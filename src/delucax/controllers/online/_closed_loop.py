"""The closed loop of a plant and a base controller, to which a learner adds."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, ArrayLike, Float

from ..._check import check_count, check_instance, check_step, is_concrete
from ..._controller import AbstractController, wrong_observation
from ..._jax import host_unless_traced, scan, value_and_jacobians, xp
from ..._module import parameter
from ...dynamics import AbstractDynamics, LinearDynamics
from ...math import matvec
from .._basic import Constant, Linear, Zero
from .._hinfinity import HInfinity
from .._lqr import LQI, LQR
from .._output_feedback import LQG


_AFFINE = (Zero, Constant, Linear, LQR, LQI, LQG, HInfinity)
"""Controllers whose control and next state are an affine map of the observation and the
state, the same map at all times."""
_IMPULSE_DECAY, _HORIZON_RANGE = 0.03, (10, 1000)
"""The part of an impulse that is left after the default horizon, and its limits."""
_MEMORY_DECAY, _MEMORY_RANGE = 0.1, (10, 50)
"""The part that is left after the default memory, and its limits. A longer memory gains
little, and takes longer to learn. Under noise it is worse."""


class Tangents(NamedTuple):
    """The derivatives of one step of the closed loop.

    With `z` the state of the plant and of the base controller, and `v` the added
    control: `z_next = transition z + input v`. The observation and the control of the
    base are `output z`.
    """

    transition: Float[Array, "*T q q"]
    input: Float[Array, "*T q m"]
    output: Float[Array, "*T o q"]


class ClosedLoopState(NamedTuple):
    """The state of the closed loop.

    - `base`: the state of the base controller.
    - `t`, `y`, `u_base`: the time, observation and control of the base at this step.
    - `started`: whether a step has been made.
    - `signal`: the last values of the signal, newest first.
    - `predicted`: the next state without a disturbance, by the model; `None` if the
        state is not observed.
    - `terms`: the size of the terms of which each entry of `predicted` is a sum; `None`
        with `predicted`.
    - `added`: the last added controls, newest first.
    - `forced`: the forced response, which is the state due to the added controls alone;
        `None` if the signal is not nature's output.
    - `now`: the derivatives of this step. `impulses`: the responses of the state to an
        impulse at each of the last steps. Both are `None` if they are the same at all
        times.
    """

    base: Any
    t: Float[Array, ""]
    y: Float[Array, " p"]
    u_base: Float[Array, " m"]
    started: Array
    signal: Float[Array, "memory p"]
    predicted: Float[Array, " n"] | None
    terms: Float[Array, " n"] | None
    added: Float[Array, "h m"]
    forced: Float[Array, " q"] | None
    now: Tangents | None
    impulses: Float[Array, "h q m"] | None


class ClosedLoop(eqx.Module):
    """A plant and its base controller, to whose control a learner adds its own.

    The added control is a function of features. These are the last values of a signal
    that does not depend on the added control, or filters of these values, in one
    vector.

    - `tangents`: the derivatives of a step. `response`: the response of the observation
        and the control of the base to an impulse. Both are `None` if they change with
        time.
    - `first_response`: the size of the first response of the observation to a unit of
        added control; `None` if the dynamics define no equilibrium.
    - `filters`: shape `(f, memory)`, newest value first; `None` for the values
        themselves.
    - `horizon`: the length of the counterfactual roll-out.
    - `memory`: the number of values of the signal that are kept.
    - `observed`: whether the observation is the state.
    - `nature`: whether the signal is nature's output, the observation that the closed
        loop would give without the added control. Otherwise it is the last disturbance.
    """

    dynamics: AbstractDynamics
    base: AbstractController
    tangents: Tangents | None = parameter()
    response: Float[Array, "h o m"] | None = parameter()
    first_response: Float[Array, ""] | None = parameter()
    filters: Float[Array, "f memory"] | None = parameter()
    horizon: int = eqx.field(static=True)
    memory: int = eqx.field(static=True)
    observed: bool = eqx.field(static=True)
    nature: bool = eqx.field(static=True)

    def __init__(
        self,
        dynamics: AbstractDynamics,
        base: AbstractController,
        horizon: int | None,
        where: str,
        *,
        memory: int | None = None,
        filters: np.ndarray | None = None,
        nature: bool | None = None,
    ):
        _check_control(dynamics, base, where)
        self.dynamics, self.base = dynamics, base
        self.observed = dynamics.observes_state
        self.nature = not self.observed if nature is None else nature
        is_lti = isinstance(dynamics, LinearDynamics) and not dynamics.is_time_varying
        # Over a finite horizon the gain of H-infinity control varies.
        varies = isinstance(base, HInfinity) and base.K.ndim > 2
        is_constant = is_lti and isinstance(base, _AFFINE) and not varies
        if not is_constant and not self.observed:
            raise ValueError(
                f"{where}: if the state is not observed, dynamics must be linear and "
                "time-invariant, and base an affine controller such as LQG, got "
                f"{type(dynamics).__name__} and {type(base).__name__}."
            )
        tangents = _equilibrium_tangents(dynamics, base)
        radius = None if tangents is None else _spectral_radius(tangents)
        self.horizon = _roll_out_length(radius, horizon, where)
        self.tangents = tangents if is_constant else None
        self.filters = None if filters is None else jnp.asarray(filters, self.dtype)
        if filters is not None:
            memory = filters.shape[1]
        elif memory is None:
            # Nature's outputs and loops that change use Newton's method, whose cost
            # grows with the square of the weights: so their memory is the shortest.
            is_cheap = is_constant and not self.nature
            rate = radius if is_cheap and radius is not None else 0.0
            memory = _steps(rate, _MEMORY_DECAY, *_MEMORY_RANGE)
        self.memory = check_count(memory, "memory", where)
        self.response = self.first_response = None
        if tangents is not None:
            p = dynamics.observation_size
            response, self.first_response = _responses(tangents, self.horizon, p)
            self.response = response if is_constant else None

    def __check_init__(self):
        _check_control(self.dynamics, self.base, "ClosedLoop")
        if self.response is not None:
            m, p = self.dynamics.control_size, self.dynamics.observation_size
            if self.response.shape[1:] != (p + m, m):
                raise ValueError(
                    f"ClosedLoop: response must have shape (h, {p + m}, {m}), got "
                    f"{self.response.shape}. For dynamics of another size, make a new "
                    "learner."
                )

    @property
    def dtype(self) -> Any:
        """The dtype of the state."""
        arrays = jax.tree.leaves(eqx.filter(self.dynamics, eqx.is_inexact_array))
        return jnp.result_type(*arrays) if arrays else jnp.zeros(()).dtype

    @property
    def feature_size(self) -> int:
        """The size of the vector of features."""
        count = self.memory if self.filters is None else self.filters.shape[0]
        return count * self.dynamics.observation_size

    def init(self, key: Any, horizon: int) -> ClosedLoopState:
        """The state before the first step. `horizon` is 0 without counterfactuals."""
        dynamics, dtype = self.dynamics, self.dtype
        n, m, p = dynamics.state_size, dynamics.control_size, dynamics.observation_size
        base = self.base.init(key=key)
        q = n + _vector(base)[0].shape[0]
        zeros = lambda *shape: jnp.zeros(shape, dtype)  # noqa: E731
        varies = self.tangents is None
        now = Tangents(zeros(q, q), zeros(q, m), zeros(p + m, q))
        return ClosedLoopState(
            base,
            t=zeros(),
            y=zeros(p),
            u_base=zeros(m),
            started=jnp.zeros((), bool),
            signal=zeros(self.memory, p),
            predicted=zeros(n) if self.observed else None,
            terms=zeros(n) if self.observed else None,
            added=zeros(horizon, m),
            forced=zeros(q) if self.nature else None,
            now=now if varies else None,
            impulses=zeros(horizon, q, m) if varies else None,
        )

    def act(
        self,
        owner: Any,
        t: Any,
        y: Float[Array, " p"],
        state: ClosedLoopState,
        policy: Callable[[Array], Array],
    ) -> tuple[Float[Array, " f"], Float[Array, " m"], ClosedLoopState]:
        """The features of this step, the control that `policy` adds, and the state."""
        if y.shape != state.y.shape:
            raise wrong_observation(owner, state.y.shape[0], y)
        t, y, before = jnp.asarray(t, self.dtype), y.astype(self.dtype), state.base
        u, base = self.base(t, y, before)
        state = state._replace(t=t, y=y, u_base=u.astype(self.dtype), base=base)
        value = self._nature(state) if self.nature else self._disturbance(state)
        signal = shift(value, state.signal)
        features = (signal if self.filters is None else self.filters @ signal).ravel()
        v, now = policy(features), state.now
        if now is not None:
            now = _tangents(self.dynamics, self.base, t, y, before, v)
        return features, v, state._replace(signal=signal, now=now)

    def _disturbance(self, state: ClosedLoopState) -> Float[Array, " n"]:
        """The last disturbance: the state minus the state that the model predicted."""
        assert state.predicted is not None and state.terms is not None
        # w_{t-1} = x_t - F(x_{t-1}, u_{t-1}), with wrapped angles.
        off = self.dynamics.difference(state.y, state.predicted)
        size = jnp.abs(state.y) + state.terms
        # A step that is compiled twice may differ in rounding, which is no disturbance.
        is_more = jnp.abs(off) > 4 * jnp.finfo(off.dtype).eps * size
        return jnp.where(state.started & is_more, off, 0)

    def _nature(self, state: ClosedLoopState) -> Float[Array, " p"]:
        """Nature's output: the observation under the base controller alone."""
        p = state.y.shape[0]
        assert state.forced is not None
        if self.tangents is None:
            return state.y - state.forced[:p]
        return state.y - matvec(self.tangents.output[:p], state.forced)

    def applied(
        self, u: Float[Array, " m"], cost: Array, state: ClosedLoopState
    ) -> ClosedLoopState:
        """The state after the step, given the control that was applied."""
        u = u.astype(self.dtype)
        tangents: Any = self.tangents if state.now is None else state.now
        v = u - state.u_base
        predicted, impulses, forced = state.predicted, state.impulses, state.forced
        terms = state.terms
        if predicted is not None:
            predicted, _ = self.dynamics.advance(state.t, state.y, u, None)
            n = predicted.shape[0]
            # The derivatives of the plant alone: of the closed loop, less the base.
            B = tangents.input[:n]
            A = tangents.transition[:n, :n] - B @ tangents.output[n:, :n]
            terms = jnp.abs(predicted) + matvec(jnp.abs(A), jnp.abs(state.y))
            terms = lax.stop_gradient(terms + matvec(jnp.abs(B), jnp.abs(u)))
        if impulses is not None:
            # The state after an impulse j steps ago is A_t ... A_{t-j+1} B_{t-j}. Each
            # product is updated by one factor.
            impulses = shift(tangents.input, tangents.transition @ impulses)
        if forced is not None:
            # With the applied control, so that clipping is not taken for a disturbance.
            forced = matvec(tangents.transition, forced) + matvec(tangents.input, v)
        return state._replace(
            base=self.base.applied(u, cost, state.base),
            started=jnp.ones_like(state.started),
            predicted=predicted,
            terms=terms,
            added=shift(v, state.added),
            forced=forced,
            impulses=impulses,
        )

    def counterfactual(
        self,
        v: Float[Array, " m"],
        v_past: Float[Array, "h m"],
        state: ClosedLoopState,
    ) -> tuple[Float[Array, " p"], Float[Array, " m"]]:
        """The observation and control of this step if other controls had been added.

        These are `v` at this step, and `v_past` at the previous steps, newest first.
        """
        # Superposition about the true run, with its noise and clipping. This is exact
        # for a linear loop, and otherwise to first order.
        change = jnp.einsum("hom,hm->o", self.past(state), v_past - state.added)
        p = state.y.shape[0]
        return state.y + change[:p], state.u_base + change[p:] + v

    def past(self, state: ClosedLoopState) -> Float[Array, "h o m"]:
        """The response of observation and control to an impulse at each past step."""
        if self.response is not None:
            return self.response
        assert state.now is not None and state.impulses is not None
        return state.now.output @ state.impulses


def shift(new: Array, history: Array) -> Array:
    """A history, newest first, with a new entry, and without its oldest one."""
    return jnp.concatenate([new[None], history])[: history.shape[0]]


def in_first_responses(
    loop: ClosedLoop, where: str, given: ArrayLike | None, name: str, units: float
) -> Any:
    """A step size or radius: the `given` one, or `units / first_response`.

    One over the first response is the control that undoes a unit of the observation.
    """
    if given is not None:
        check_step(given, where, name)
        return given
    if loop.first_response is None:
        raise ValueError(
            f"{where}: {name} must be given, because dynamics define no equilibrium."
        )
    return _quotient(units, loop.first_response)


@host_unless_traced
def _quotient(units, size):
    # If no control has an effect, there is no unit. 1 keeps the quotient finite.
    return units / xp.where(size > 0, size, xp.ones_like(size))


def _check_control(
    dynamics: AbstractDynamics, base: AbstractController, where: str
) -> None:
    """Raise unless the base controller gives a control that fits the dynamics."""
    check_instance(base, AbstractController, "base", where)
    size = dynamics.observation_size
    act = lambda base: base(jnp.zeros(()), jnp.zeros(size), base.init(key=None))
    try:
        u, _ = eqx.filter_eval_shape(act, base)
    except ValueError as error:
        raise ValueError(
            f"{where}: base must take the observation of dynamics, of size {size}: "
            f"{error}"
        ) from error
    if u.shape != (dynamics.control_size,):
        raise ValueError(
            f"{where}: base must give a control of size {dynamics.control_size} for "
            f"dynamics, got shape {u.shape}."
        )


def _vector(state: Any) -> tuple[Array, Any]:
    """The floating-point part of a state as a vector, and the inverse map."""
    floats, rest = eqx.partition(state, eqx.is_inexact_array)
    vector, unravel = ravel_pytree(floats)
    return vector, lambda z: eqx.combine(unravel(z.astype(vector.dtype)), rest)


def _tangents(dynamics, base, t, x, state, v) -> Tangents:
    vector, back = _vector(state)
    n = x.shape[0]

    def step(z, v):
        x = z[:n]
        y = dynamics.observe(t, x)
        u, after = base(t, y, back(z[n:]))
        x_next, _ = dynamics.advance(t, x, u + v, None)
        # With `applied`, so that the anti-windup of the base is part of the loop.
        after = base.applied(u + v, jnp.zeros((), x.dtype), after)
        z_next = jnp.concatenate([x_next, _vector(after)[0].astype(x.dtype)])
        return jnp.concatenate([z_next, y.astype(x.dtype), u.astype(x.dtype)])

    z = jnp.concatenate([x, vector.astype(x.dtype)])
    _, (by_state, by_control) = value_and_jacobians(step, z, v)
    return Tangents(by_state[: z.size], by_control[: z.size], by_state[z.size :])


def _equilibrium_tangents(
    dynamics: AbstractDynamics, base: AbstractController
) -> Tangents | None:
    """The derivatives at the operating point, or at each time if they depend on time.

    `None` if the dynamics define no operating point.
    """
    if isinstance(dynamics, LinearDynamics) and dynamics.is_time_varying:
        return _tangents_along(dynamics, base, dynamics.x_ref, dynamics.u_ref)
    try:
        x, u = dynamics.equilibrium()
    except ValueError:
        return None
    return _tangents_along(dynamics, base, x, u)


@eqx.filter_jit
def _tangents_along(dynamics, base, x, u) -> Tangents:
    """The derivatives at one point, or at one point for each time."""

    def at(t, x, u):
        # After a step, because the first one of a PID has no derivative of the error.
        y = dynamics.observe(t, x)
        u_base, state = base(t, y, base.init(key=None))
        state = base.applied(u_base, jnp.zeros((), x.dtype), state)
        u_base, _ = base(t, y, state)
        return _tangents(dynamics, base, t, x, state, u - u_base)

    if x.ndim == 1:
        return at(jnp.zeros((), x.dtype), x, u)
    times = (jnp.arange(len(x)) * dynamics.dt).astype(x.dtype)
    return jax.vmap(at)(times, x, u)


@host_unless_traced
def _responses(tangents, horizon, p):
    """The response to an impulse, and the size of its first nonzero row.

    Only the first `p` entries of a row, the observation, count. If the response depends
    on time, it is the one at the first step.
    """
    transition, now, output = (M if M.ndim == 2 else M[0] for M in tangents)
    # Row j, a Markov parameter, is the response to an impulse j + 1 steps ago.
    step = lambda z, _: (transition @ z, output @ z)
    response = scan(step, now, xp.arange(horizon))[1]
    sizes = xp.sqrt(xp.sum(response[:, :p] ** 2, axis=(1, 2)))
    # A control may need several steps to have an effect. Smaller rows are rounding.
    slack = xp.finfo(sizes.dtype).eps ** 0.5 * xp.max(sizes)
    return response, sizes[xp.argmax(sizes > slack)]


def _roll_out_length(radius: float | None, horizon: int | None, where: str) -> int:
    """The `horizon`, by default the number of steps until an impulse has faded.

    It raises unless the base stabilises the plant.
    """
    given = None if horizon is None else check_count(horizon, "horizon", where)
    if radius is not None and not radius < 1:
        raise ValueError(
            f"{where}: base must stabilise dynamics, got a closed loop of spectral "
            f"radius {radius:.6g}."
        )
    if given is not None:
        return given
    if radius is None:
        raise ValueError(
            f"{where}: horizon must be given inside a JAX transformation, or if "
            "dynamics define no equilibrium, because its default needs the closed loop."
        )
    return _steps(radius, _IMPULSE_DECAY, *_HORIZON_RANGE)


def _steps(radius: float, left: float, least: int, most: int) -> int:
    """The number of steps after which a part `left` is left, within limits."""
    # Solves radius^steps = left.
    steps = math.log(left) / math.log(radius) if 0 < radius < 1 else 0
    return min(max(least, math.ceil(steps)), most)


def _spectral_radius(tangents: Tangents) -> float | None:
    """The largest spectral radius of the states that an added control can move.

    `None` if they are traced.
    """
    if not (is_concrete(tangents.transition) and is_concrete(tangents.input)):
        return None
    q, m = tangents.input.shape[-2:]
    transitions = np.asarray(tangents.transition, float).reshape(-1, q, q)
    reached = np.any(np.asarray(tangents.input).reshape(-1, q, m) != 0, axis=(0, 2))
    # Which states the added control reaches, in a graph: q sweeps are enough.
    for _ in range(q):
        reached = reached | np.any(transitions[..., reached] != 0, axis=(0, 2))
    # Other states, such as a covariance in the base, need not decay.
    parts = transitions[:, reached][:, :, reached]
    return max(np.max(np.abs(np.linalg.eigvals(part)), initial=0) for part in parts)
