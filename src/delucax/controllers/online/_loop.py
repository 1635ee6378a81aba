"""The plant under its base controller, as a learner on top of it sees it."""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from ..._check import check_count, check_instance, is_concrete
from ..._controller import AbstractController, wrong_observation
from ..._jax import jacobian
from ..._module import parameter
from ...dynamics import AbstractDynamics, LinearDynamics
from ...math import matvec
from .._basic import Constant, Linear, Zero
from .._hinfinity import HInfinity
from .._lqg import LQG
from .._lqi import LQI
from .._lqr import LQR


_AFFINE = (Zero, Constant, Linear, LQR, LQI, LQG, HInfinity)
"""Controllers whose control and state depend on the observation by an affine map that
is the same at all times."""
FORGOTTEN = 0.03
"""What is left of an impulse at the end of a roll-out."""
LEAST_HORIZON, MOST_HORIZON = 10, 1000
FADED = 0.1
"""What is left of an impulse at the end of the default memory. A longer policy reaches
a little less, and costs more to learn: under noise it is worse."""
LEAST_MEMORY, MOST_MEMORY = 10, 50


class Tangents(NamedTuple):
    """Derivatives of one step of the closed loop.

    With `z` the state of the plant and that of the base controller, and `v` what is
    added to the base's control: `z_next = transition z + input v`, and the observation
    and the base's control are `output z`.
    """

    transition: Array
    input: Array
    output: Array


class LoopState(NamedTuple):
    """What is remembered of the closed loop.

    - `base`: the state of the base controller.
    - `t`, `y`, `u_base`: of the current step.
    - `begun`: whether a step was made.
    - `predicted`: where the plant was to be by now without a disturbance; `None` if the
      state is not observed.
    - `added`: what was added to the base's control, newest first.
    - `echo`: the state that those controls alone have brought about; `None` if it is
      not asked for.
    - `now`: the derivatives of the current step, and `impulses`: what is left, in the
      state, of an impulse at each of the last steps. Both are `None` where they are the
      same at all times.
    """

    base: Any
    t: Array
    y: Array
    u_base: Array
    begun: Array
    predicted: Any
    added: Array
    echo: Any
    now: Any
    impulses: Any


class Loop(eqx.Module):
    """A plant and the base controller that a learner adds its own control to.

    - `tangents`: the derivatives of a step, and `response`: that of the observation and
      of the base's control to an impulse; `None` where they change.
    - `reach`: the size of the first change of the observation that a unit of added
      control makes; `None` if the dynamics name no equilibrium.
    - `horizon`: the length of the roll-out.
    - `observed`: whether the observation is the state.
    - `echoes`: whether nature's output is asked for.
    """

    dynamics: AbstractDynamics
    base: AbstractController
    tangents: Tangents | None = parameter()
    response: Float[Array, "h o m"] | None = parameter()
    reach: Float[Array, ""] | None = parameter()
    horizon: int = eqx.field(static=True)
    observed: bool = eqx.field(static=True)
    echoes: bool = eqx.field(static=True)

    def __init__(
        self,
        dynamics: AbstractDynamics,
        base: AbstractController,
        horizon: int | None,
        where: str,
        *,
        echoes: bool,
    ):
        check_control(dynamics, base, where)
        linear = isinstance(dynamics, LinearDynamics)
        self.observed = dynamics.observes_state
        self.echoes = echoes
        same = linear and not dynamics.is_time_varying and isinstance(base, _AFFINE)
        if not same and not self.observed:
            raise ValueError(
                f"{where}: where the state is not observed, dynamics must be linear "
                "and time-invariant, and base an affine controller such as LQG; got "
                f"{type(dynamics).__name__} and {type(base).__name__}."
            )
        self.dynamics, self.base = dynamics, base
        at_rest = _at_rest(dynamics, base)
        self.horizon = _roll_out(at_rest, horizon, where)
        self.tangents = at_rest if same else None
        self.response = self.reach = None
        if at_rest is not None:
            first = at_rest if same else jax.tree.map(_first_matrix, at_rest)
            response = _impulse_response(first, self.horizon)
            self.reach = _first_size(response[:, : dynamics.observation_size])
            self.response = response if same else None

    def __check_init__(self):
        check_control(self.dynamics, self.base, "Loop")
        if self.response is not None:
            m, p = self.dynamics.control_size, self.dynamics.observation_size
            if self.response.shape[1:] != (p + m, m):
                raise ValueError(
                    f"Loop: response must have shape (h, {p + m}, {m}), got "
                    f"{self.response.shape}; build the learner anew for dynamics of "
                    "another size."
                )

    def memory(self) -> int:
        """For how many steps a disturbance matters, as far as that can be seen."""
        # Newton's step, for nature's outputs and for loops that change, pays for each
        # number that it learns.
        if self.tangents is None or self.echoes:
            return LEAST_MEMORY
        radius = _radius(self.tangents)
        return _steps(radius or 0.0, FADED, LEAST_MEMORY, MOST_MEMORY)

    @property
    def dtype(self) -> Any:
        """Of what is remembered."""
        arrays = jax.tree.leaves(eqx.filter(self.dynamics, eqx.is_inexact_array))
        return jnp.result_type(*arrays) if arrays else jnp.zeros(()).dtype

    def init(self, key: Any, horizon: int) -> LoopState:
        """Before the first step; `horizon` is 0 without counterfactuals."""
        dynamics, dtype = self.dynamics, self.dtype
        n, m = dynamics.state_size, dynamics.control_size
        p = dynamics.observation_size
        base = self.base.init(key=key)
        q = n + _vector(base)[0].shape[0]
        zeros = lambda *shape: jnp.zeros(shape, dtype)  # noqa: E731
        varies = self.tangents is None and (horizon > 0 or self.echoes)
        now = Tangents(zeros(q, q), zeros(q, m), zeros(p + m, q))
        return LoopState(
            base,
            t=zeros(),
            y=zeros(p),
            u_base=zeros(m),
            begun=jnp.zeros((), bool),
            predicted=zeros(n) if self.observed else None,
            added=zeros(horizon, m),
            echo=zeros(q) if self.echoes else None,
            now=now if varies else None,
            impulses=zeros(horizon, q, m) if varies else None,
        )

    def act(self, owner: Any, t: Any, y: Array, state: LoopState) -> LoopState:
        """The observation, and the base's control for it."""
        if y.shape != state.y.shape:
            raise wrong_observation(owner, state.y.shape[0], y)
        t, y = jnp.asarray(t, self.dtype), y.astype(self.dtype)
        u, base = self.base(t, y, state.base)
        return state._replace(t=t, y=y, u_base=u.astype(self.dtype), base=base)

    def disturbance(self, state: LoopState) -> Array:
        """What moved the state from where it was to be: the last disturbance."""
        off = self.dynamics.difference(state.y, state.predicted)
        size = jnp.max(jnp.abs(state.y) + jnp.abs(state.predicted))
        # Compiled twice, a step may round differently: of that nothing is learned.
        seen = jnp.abs(off) > 4 * jnp.finfo(off.dtype).eps * size
        return jnp.where(state.begun & seen, off, 0)

    def nature(self, state: LoopState) -> Array:
        """The observation, had nothing been added to the base's control."""
        p = state.y.shape[0]
        if self.tangents is None:
            return state.y - state.echo[:p]
        return state.y - matvec(self.tangents.output[:p], state.echo)

    def linearised(self, v: Array, before: Any, state: LoopState) -> LoopState:
        """The state with the derivatives of a step that adds `v`; `before` is the
        base's state before it acted."""
        if state.now is None:
            return state
        now = _tangents(self.dynamics, self.base, state.t, state.y, before, v)
        return state._replace(now=now)

    def applied(self, u: Array, cost: Array, state: LoopState) -> LoopState:
        """After the step, with the control that was applied."""
        u = u.astype(self.dtype)
        tangents: Any = self.tangents if state.now is None else state.now
        v = u - state.u_base
        predicted, impulses, echo = state.predicted, state.impulses, state.echo
        if predicted is not None:
            predicted, _ = self.dynamics.advance(state.t, state.y, u, None)
        if impulses is not None:
            impulses = shift(tangents.input, tangents.transition @ impulses)
        if echo is not None:
            echo = matvec(tangents.transition, echo) + matvec(tangents.input, v)
        return state._replace(
            base=self.base.applied(u, cost, state.base),
            begun=jnp.ones_like(state.begun),
            predicted=predicted,
            added=shift(v, state.added),
            echo=echo,
            impulses=impulses,
        )

    def counterfactual(
        self, v: Array, v_past: Array, state: LoopState
    ) -> tuple[Array, Array]:
        """The observation and control of this step, had `v` been added at it and
        `v_past` at the steps of the roll-out before, newest first."""
        change = jnp.einsum("hom,hm->o", self.past(state), v_past - state.added)
        p = state.y.shape[0]
        return state.y + change[:p], state.u_base + change[p:] + v

    def past(self, state: LoopState) -> Array:
        """The response of observation and base's control to what was added at each step
        of the roll-out, newest first, shape (horizon, p + m, m)."""
        if self.response is not None:
            return self.response
        return state.now.output @ state.impulses


def shift(new: Array, history: Array) -> Array:
    """A history, newest first, with its oldest entry dropped."""
    return jnp.concatenate([new[None], history])[: history.shape[0]]


def check_control(
    dynamics: AbstractDynamics, base: AbstractController, where: str
) -> None:
    """Raise unless a base controller gives a control that dynamics take."""
    check_instance(base, AbstractController, "base", where)
    y = jnp.zeros(dynamics.observation_size)
    try:
        u, _ = eqx.filter_eval_shape(base, jnp.zeros(()), y, base.init(key=None))
    except ValueError as error:
        raise ValueError(
            f"{where}: base must take an observation of size {y.shape[0]}, as dynamics "
            f"give; {error}"
        ) from error
    if u.shape != (dynamics.control_size,):
        raise ValueError(
            f"{where}: base must give a control of size {dynamics.control_size}, as "
            f"dynamics take, got shape {u.shape}."
        )


def _vector(state: Any) -> tuple[Array, Any]:
    """The floating-point part of a controller's state as a vector, and the way back."""
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
        after = base.applied(u + v, jnp.zeros((), x.dtype), after)
        z_next = jnp.concatenate([x_next, _vector(after)[0].astype(x.dtype)])
        return z_next, jnp.concatenate([y, u.astype(y.dtype)])

    z = jnp.concatenate([x, vector.astype(x.dtype)])
    (transition, input), (output, _) = jacobian(step, (0, 1))(z, v)
    return Tangents(transition, input, output)


def _at_rest(dynamics: AbstractDynamics, base: AbstractController) -> Tangents | None:
    """The derivatives at the operating point, at each time if they depend on it;
    `None` if the dynamics name no such point."""

    def at(t, x, u):
        state = base.init(key=None)
        u_base, _ = base(t, dynamics.observe(t, x), state)
        return _tangents(dynamics, base, t, x, state, u - u_base)

    if isinstance(dynamics, LinearDynamics) and dynamics.is_time_varying:
        times = (jnp.arange(len(dynamics.A)) * dynamics.dt).astype(dynamics.A.dtype)
        return jax.vmap(at)(times, dynamics.x_ref, dynamics.u_ref)
    try:
        x, u = dynamics.equilibrium()
    except ValueError:
        return None
    return at(jnp.zeros((), x.dtype), x, u)


def _roll_out(tangents: Tangents | None, horizon: int | None, where: str) -> int:
    """The length of the roll-out; raise unless the base stabilises the plant."""
    if horizon is not None:
        horizon = check_count(horizon, "horizon", where)
    radius = None if tangents is None else _radius(tangents)
    if radius is not None and not radius < 1:
        raise ValueError(
            f"{where}: base must stabilise dynamics, got a closed loop of spectral "
            f"radius {radius:.6g}."
        )
    if horizon is not None:
        return horizon
    if radius is None:
        raise ValueError(
            f"{where}: horizon must be given where the closed loop cannot be seen: "
            "inside a transformation of JAX, or of dynamics that name no equilibrium."
        )
    return _steps(radius, FORGOTTEN, LEAST_HORIZON, MOST_HORIZON)


def _steps(radius: float, left: float, least: int, most: int) -> int:
    """After how many steps no more than a part `left` is left, between limits."""
    steps = math.log(left) / math.log(radius) if 0 < radius < 1 else 0
    return min(max(least, math.ceil(steps)), most)


def _radius(tangents: Tangents) -> float | None:
    """The largest spectral radius of what an added control can move; `None` if it is
    traced."""
    if not (is_concrete(tangents.transition) and is_concrete(tangents.input)):
        return None
    q, m = tangents.input.shape[-2:]
    transitions = np.asarray(tangents.transition, float).reshape(-1, q, q)
    moved = np.any(np.asarray(tangents.input).reshape(-1, q, m) != 0, axis=(0, 2))
    for _ in range(q):
        moved = moved | np.any(transitions[..., moved] != 0, axis=(0, 2))
    # Numbers that a base only carries along, such as a covariance, do not fade.
    parts = transitions[:, moved][:, :, moved]
    return max(np.max(np.abs(np.linalg.eigvals(part)), initial=0) for part in parts)


def _first_matrix(array: Array) -> Array:
    return array if array.ndim == 2 else array[0]


def _first_size(moved: Array) -> Array:
    """The size of the first response that there is."""
    sizes = jnp.sqrt(jnp.sum(moved**2, axis=(1, 2)))
    slack = jnp.finfo(sizes.dtype).eps ** 0.5 * jnp.max(sizes)
    return sizes[jnp.argmax(sizes > slack)]


def _impulse_response(tangents: Tangents, horizon: int) -> Array:
    def step(z, _):
        return tangents.transition @ z, tangents.output @ z

    return lax.scan(step, tangents.input, length=horizon)[1]
