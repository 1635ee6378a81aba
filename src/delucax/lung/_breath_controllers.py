"""Controllers of the valves during a breath."""

from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, PyTree

from .._check import check_choice, check_count, check_key, check_step
from .._controller import AbstractController, check_controller, Tally
from .._module import mlp, parameter, positive, weight
from .._typing import PRNGKey, Real, RealScalar
from ..math import clip
from ._waveform import BreathWaveform, check_waveform


class _Phases(NamedTuple):
    inner: PyTree
    first: PyTree
    valve: PyTree
    inhaling: Array


class Breathing(AbstractController):
    r"""A controller of both valves in all phases of a breath, made from a controller of
    the inspiratory valve.

    In the inspiratory phase, the controller `inspiratory` sets the inspiratory valve,
    and its control is clipped to [0, 100]. In the expiratory phase the inspiratory
    valve is closed. If `expiratory_opening` $u_e$ is not 0, the inspiratory valve is
    instead opened to $u_e (1 - e^{-5 s})$ in the second half of each breath, where $s$
    is the time since the middle of the breath [s]. This flow keeps the airway open in
    spite of a leak.

    The inspiratory controller is reset at the start of each breath. The state of the
    inspiratory controller does not change in the expiratory phase.

    **Arguments:**

    - `inspiratory`: any controller whose control has one entry, such as a
        [`delucax.controllers.PID`][] whose reference is the waveform.
    - `waveform`: a [`delucax.lung.BreathWaveform`][].
    - `expiratory_opening`: $u_e$, the opening of the inspiratory valve late in the
        breath [%], 0 by default; 5 in the code of Deluca.
    - `valve`: a controller of the expiratory valve. By default the expiratory valve is
        closed in the inspiratory phase and open in the expiratory phase.

    **Raises:** `ValueError` if `inspiratory` or `valve` is not a controller, or
    `waveform` is not a `BreathWaveform`.

    Source: Gradu, Hallman, Suo, Yu, Agarwal, Ghai, Singh, Zhang, Majumdar and Hazan,
    2021 (Deluca).

    !!! example

        ```python
        import delucax as dlx
        import jax
        from delucax import lung

        env = dlx.make("lung/single_compartment")
        waveform = env.cost.waveform
        pid = dlx.controllers.PID(1.0, 3.0, dt=env.dt, reference=waveform)
        controller = lung.Breathing(pid, waveform)
        dlx.rollout(env, controller, key=jax.random.key(0)).total_cost
        ```
    """

    inspiratory: AbstractController
    waveform: BreathWaveform
    expiratory_opening: Array = parameter(0.0)
    valve: AbstractController | None = None

    def __check_init__(self):
        check_waveform(self.waveform, "Breathing")
        check_controller(self.inspiratory, "inspiratory", "Breathing")
        if self.valve is not None:
            check_controller(self.valve, "valve", "Breathing")

    def init(self, *, key: PRNGKey | None = None) -> PyTree:
        valve, valve_key = None, None
        if self.valve is not None:
            key, valve_key = (None, None) if key is None else jr.split(key)
            valve = self.valve.init(key=valve_key)
        first = self.inspiratory.init(key=key)
        return _Phases(first, first, valve, jnp.zeros((), bool))

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        inhale = self.waveform.is_inspiration(t)
        begins = inhale & ~state.inhaling
        inner = _restarted(begins, state.first, state.inner)
        u_in, after = self.inspiratory(t, y, inner)
        # The valve opens with a time constant of 0.2 s.
        late = jnp.maximum(self.waveform.share(t) - 0.5, 0) * self.waveform.period
        held = self.expiratory_opening * (1 - jnp.exp(-5 * late))
        u_in = jnp.where(inhale, clip(u_in[0], 0, 100), held)
        u_out, valve = jnp.where(inhale, 0.0, 1.0), None
        if self.valve is not None:
            (u_out,), valve = self.valve(t, y, state.valve)
        u = jnp.stack([u_in, u_out]).astype(y.dtype)
        inner = _where(inhale, after, inner)
        return u, _Phases(inner, state.first, valve, inhale)

    def applied(self, u: Array, cost: Array, state: PyTree) -> PyTree:
        inner = self.inspiratory.applied(u[:1], cost, state.inner)
        state = state._replace(inner=_where(state.inhaling, inner, state.inner))
        if self.valve is None:
            return state
        return state._replace(valve=self.valve.applied(u[1:], cost, state.valve))


def _where(condition: Array, yes: PyTree, no: PyTree) -> PyTree:
    """Select one of two states."""

    def where(yes, no):
        if not eqx.is_array(no):
            return no
        chosen = jnp.where(condition, yes, no)
        return chosen if _is_key(no) else chosen.astype(no.dtype)

    return jax.tree.map(where, yes, no)


def _restarted(begins: Array, first: PyTree, now: PyTree) -> PyTree:
    """The first state where a breath begins. Random keys and tallies go on, so that no
    key is used twice and no incident is forgotten."""
    goes_on = lambda leaf: isinstance(leaf, Tally) or _is_key(leaf)
    choose = lambda a, b: b if goes_on(b) else _where(begins, a, b)
    return jax.tree.map(choose, first, now, is_leaf=goes_on)


def _is_key(leaf: Any) -> bool:
    return eqx.is_array(leaf) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


class BangBang(AbstractController):
    """Opens the inspiratory valve fully if the pressure is below the target, and closes
    the valve if the pressure is above the target.

    **Arguments:**

    - `waveform`: the target, a [`delucax.lung.BreathWaveform`][].
    - `high`: the control if the pressure is below the target [%], 100 by default.

    **Raises:** `ValueError` if `waveform` is not a `BreathWaveform`.

    !!! example

        ```python
        import jax.numpy as jnp
        from delucax.lung import BangBang, BreathWaveform

        bang = BangBang(BreathWaveform())
        bang(0.1, jnp.array([20.0]), bang.init())
        ```

        ```text
        (Array([100.], dtype=float32), None)
        ```
    """

    waveform: BreathWaveform
    high: Array = parameter(100.0)

    def __check_init__(self):
        check_waveform(self.waveform, "BangBang")

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        return jnp.where(y > self.waveform(t), 0, self.high).astype(y.dtype), state


class BreathPolicy(AbstractController):
    r"""A policy of the inspiratory valve: a neural network whose inputs are past
    errors, targets and past controls.

    $$u_k = 100 \, \sigma(\mathrm{network}(e_k, \dots, e_{k + 1 - n_e},
    r_{k + 1}, r_{k + 2}, r_k, u_{k - 1}, \dots, u_{k - n_u}) + \mathrm{shift})$$

    The inputs are the last errors $e$, the target $r$ now and at the next two steps,
    and the last controls $u$. All inputs are scaled to a size of about 1. Errors and
    controls from before the breath are set to zero. The sigmoid $\sigma$ enforces the
    bounds of the valve, and its gradient is never zero.

    The kind `"mlp"` is a fully connected network. The kind `"cnn"` first computes the
    mean of the last error, of the last 2 errors, and so on up to all `errors` errors,
    and then applies a convolution to these means.

    **Arguments:**

    - `waveform`: the target, a [`delucax.lung.BreathWaveform`][].
    - `dt`: the control interval [s].
    - `kind`: `"mlp"` (default) or `"cnn"`.
    - `width`: the number of hidden units of the `"mlp"`, or of channels of the `"cnn"`,
        32 by default.
    - `depth`: the number of hidden layers of the `"mlp"`, 2 by default; may be 0. The
        `"cnn"` has none.
    - `errors`: $n_e$, the number of past errors that enter the network, 10 by default.
        A `"cnn"` needs at least 5.
    - `controls`: $n_u$, the number of past controls that enter the network, 4 by
        default; may be 0. In the published networks, neither past controls nor the
        target $r_k$ were inputs.
    - `key`: a random key, for the first weights.

    **Attributes:** `network`, trainable; `shift`, which is -2, so that the valve is
    open a little before training.

    **Raises:** `ValueError` if a size is too small, the kind is unknown, `waveform` is
    not a `BreathWaveform`, or `key` is missing.

    Source: Suo, Agarwal, Xia, Chen, Ghai, Yu, Gradu, Singh, Zhang, Minasyan, LaChance,
    Zajdel, Schottdorf, Cohen and Hazan, 2021.

    !!! example

        ```python
        import jax
        import jax.numpy as jnp
        from delucax.lung import BreathPolicy, BreathWaveform

        policy = BreathPolicy(BreathWaveform(), 0.03, key=jax.random.key(0))
        policy(0.0, jnp.array([5.0]), policy.init())
        ```
    """

    network: eqx.nn.MLP = weight()
    convolution: Array | None = weight()
    waveform: BreathWaveform
    dt: Real = parameter(constraint=positive)
    shift: Real = parameter()
    kind: Literal["mlp", "cnn"] = eqx.field(static=True)
    errors: int = eqx.field(static=True)
    controls: int = eqx.field(static=True)

    def __init__(
        self,
        waveform: BreathWaveform,
        dt: Any,
        kind: Literal["mlp", "cnn"] = "mlp",
        width: int = 32,
        depth: int = 2,
        *,
        errors: int = 10,
        controls: int = 4,
        key: PRNGKey,
    ):
        where = "BreathPolicy"
        check_choice(kind, ("mlp", "cnn"), "kind", where)
        key, filter_key = jr.split(check_key(key, where))
        width = check_count(width, "width", where)
        self.waveform, self.dt, self.kind = waveform, dt, kind
        self.errors = check_count(errors, "errors", where, 5 if kind == "cnn" else 1)
        self.controls = check_count(controls, "controls", where, least=0)
        size = self.errors + 3 + self.controls
        self.convolution = None
        if kind == "cnn":
            self.convolution = jr.normal(filter_key, (5, width)) / 5**0.5
            size += (self.errors - 4) * width - self.errors
            depth = 0
        check_count(depth, "depth", where, least=0)
        self.network = mlp(size, "scalar", width, depth, key=key)
        self.shift = -2.0

    def __check_init__(self):
        check_waveform(self.waveform, "BreathPolicy")
        check_step(self.dt, "BreathPolicy")

    def init(self, *, key: PRNGKey | None = None) -> PyTree:
        dtype = jnp.result_type(self.dt)
        return jnp.zeros(self.errors, dtype), jnp.zeros(self.controls, dtype)

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        errors, controls = state
        now = self.waveform.pressure(t)
        # Scaled so that the inputs of the network are about 1: errors by 10 cmH2O,
        # targets by 15 cmH2O, controls by 50 %.
        error = ((now - y) / 10).astype(errors.dtype)
        errors = jnp.concatenate([error, errors[:-1]])
        ahead = [self.waveform.pressure(t + k * self.dt) for k in (1, 2)]
        targets = (jnp.stack([*ahead, now]) - self.waveform.peep) / 15
        features = errors
        if self.convolution is not None:
            # Means over the last 1, 2, ... errors, convolved with filters of width 5.
            means = jnp.cumsum(errors) / jnp.arange(1, self.errors + 1)
            windows = [means[i : self.errors - 4 + i] for i in range(5)]
            convolved = jnp.stack(windows, 1) @ self.convolution
            features = jnp.ravel(jnp.maximum(0, convolved))
        z = jnp.concatenate([features, targets, controls]).astype(y.dtype)
        u = 100 * jax.nn.sigmoid(self.network(z) + self.shift)
        return jnp.reshape(u, (1,)).astype(y.dtype), (errors, controls)

    def applied(self, u: Array, cost: Array, state: PyTree) -> PyTree:
        if not self.controls:
            return state
        errors, controls = state
        last = (u[:1] / 50).astype(controls.dtype)
        return errors, jnp.concatenate([last, controls[:-1]])
