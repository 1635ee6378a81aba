"""A lung learned from breaths."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, Float

from .._check import check_bool, check_count, check_instance, check_key
from .._jax import host_unless_traced, xp
from .._module import mlp, parameter, positive, weight
from .._results import Result, RESULTS
from .._typing import Observation, PRNGKey, RealScalar, Scalar, State, Time
from ..dynamics import AbstractDynamics
from ._breaths import Breaths


@eqx.filter_jit
def _boundary(key: PRNGKey, boundary: int, size: int) -> tuple[Array, ...]:
    """The first weights of the networks of the first steps, and two keys."""
    hidden_key, output_key, *keys = jr.split(key, 4)
    shape = boundary, 16
    # A variance of 1 over the number of inputs keeps the input of tanh about 1.
    hidden = jr.normal(hidden_key, (*shape, size)) / size**0.5
    return hidden, 0.1 * jr.normal(output_key, shape) / 16**0.5, *keys


@eqx.filter_jit
def _moments(breaths: Breaths) -> tuple[Array, ...]:
    """Means and standard deviations of control and pressure, and the mean pressure at
    the first sample."""
    inhaling = breaths.u_out < 0.5
    moments = lambda a: (jnp.mean(a, where=inhaling), jnp.std(a, where=inhaling))
    u_mean, u_std = moments(breaths.u_in)
    p_mean, p_std = moments(breaths.pressure)
    start = jnp.mean(breaths.pressure[..., 0])
    # The standard deviations are divisors, and are 0 if all values are the same.
    return u_mean, u_std + 1e-3, p_mean, p_std + 1e-3, start


class LearnedLung(AbstractDynamics):
    r"""A lung learned from breaths: a neural network that predicts the next pressure.

    For each of the first steps of an inspiration, there is one more small network,
    which is used only at this step. At step $k$ of an inspiration, the normalised
    pressure is predicted as

    $$p_{k + 1} = p_k + \ell^\top z + \mathrm{network}(z)
    + o_k^\top \tanh(H_k z_\mathrm{all})$$

    $$z = (v(u_k), \dots, v(u_{k + 1 - n_u}), p_k, \dots, p_{k + 1 - n_p})$$

    Here $u$ are the normalised controls, $\ell$ is `line`, and $v$ is a small network
    of one control that linearises the curve of the valve. The last term is the small
    network of step $k$, and is present only for $k < \mathrm{boundary}$. Its weights
    are `output` ($o_k$) and `hidden` ($H_k$), and its input $z_\mathrm{all}$ holds the
    whole history. In the part of the history before the inspiration, the valve is
    closed and the pressure is the start pressure of the breaths.

    If `published` is `True`, the model is the one in the paper:
    $p_{k + 1} = \mathrm{network}(z)$, where $z$ holds the controls without $v$. For
    $k < \mathrm{boundary}$, the published model consists of the last term only. The
    history before an inspiration is zero, except for the start pressure.

    The networks of the first steps have 16 hidden units each and are stacked in one
    array. While `u_out` is above 1/2, the state is reset to the state before an
    inspiration. The state holds the last controls and the last pressures, both with the
    newest first, and the number of steps since the start of the inspiration. The
    observation is the pressure [cmH2O].

    **Arguments:**

    - `breaths`: a [`delucax.lung.Breaths`][], from which the model takes the means and
        standard deviations for the normalisation, and the pressure before an
        inspiration.
    - `width`, `depth`: the hidden units and hidden layers of the network, 24 and 1 by
        default.
    - `boundary`: the number of steps at the start of an inspiration that have a network
        of their own, 5 by default.
    - `u_window`, `p_window`: $n_u$ and $n_p$, the numbers of last controls and of last
        pressures that enter the network, 8 and 6 by default.
    - `published`: whether to use the model in the paper (see above); `False` by
        default.
    - `key`: a random key, for the first weights.

    **Attributes:** `line`, `valve`, `network`, `hidden` and `output`, trainable;
    `u_mean`, `u_std`, `p_mean`, `p_std`, `start`.

    **Raises:** `ValueError` if a size is below 1, or if `breaths` or `key` is missing.

    Source: Suo, Agarwal, Xia, Chen, Ghai, Yu, Gradu, Singh, Zhang, Minasyan, LaChance,
    Zajdel, Schottdorf, Cohen and Hazan, 2021.

    !!! example

        ```python
        import jax
        import jax.numpy as jnp
        from delucax.lung import Breaths, LearnedLung

        u = jnp.linspace(0.0, 50.0, 290).reshape(10, 29)
        breaths = Breaths(u, 0 * u, 5 + u / 2, dt=0.03)
        lung = LearnedLung(breaths, key=jax.random.key(0))
        lung.pressure(lung.resting())
        ```

        ```text
        Array(16.289, dtype=float32)
        ```
    """

    line: Float[Array, " inputs"] = weight()
    valve: eqx.nn.MLP = weight()
    network: eqx.nn.MLP = weight()
    hidden: Float[Array, "boundary width windows"] = weight()
    output: Float[Array, "boundary width"] = weight()
    u_mean: Array = parameter()
    u_std: Array = parameter(constraint=positive)
    p_mean: Array = parameter()
    p_std: Array = parameter(constraint=positive)
    start: Array = parameter()
    dt: Array = parameter(constraint=positive)
    u_window: int = eqx.field(static=True)
    p_window: int = eqx.field(static=True)
    published: bool = eqx.field(static=True)

    control_names = ("u_in", "u_out")

    def __init__(
        self,
        breaths: Breaths,
        width: int = 24,
        depth: int = 1,
        *,
        boundary: int = 5,
        u_window: int = 8,
        p_window: int = 6,
        published: bool = False,
        key: PRNGKey,
    ):
        where = "LearnedLung"
        check_instance(breaths, Breaths, "breaths", where)
        check_key(key, where)
        sizes = dict(width=width, depth=depth, boundary=boundary)
        sizes |= dict(u_window=u_window, p_window=p_window)
        for name, value in sizes.items():
            check_count(value, name, where)
        inputs, size = u_window + p_window, 2 * max(u_window, p_window, boundary)
        self.hidden, self.output, valve_key, key = _boundary(key, boundary, size)
        self.line = jnp.zeros(inputs)
        self.valve = mlp("scalar", "scalar", 8, 1, key=valve_key)
        self.network = mlp(inputs, "scalar", width, depth, key=key)
        self.u_mean, self.u_std, self.p_mean, self.p_std, self.start = _moments(breaths)
        self.dt = breaths.dt
        self.u_window, self.p_window = u_window, p_window
        self.published = check_bool(published, "published", where)

    @property
    def window(self) -> int:
        """The number of controls in the state, which is also the number of
        pressures."""
        return self.hidden.shape[-1] // 2

    @property
    def state_names(self) -> tuple[str, ...]:
        n = self.window
        controls = [f"u_in[-{i + 1}]" for i in range(n)]
        pressures = ["pressure", *(f"pressure[-{i}]" for i in range(1, n))]
        return (*controls, *pressures, "step")

    @host_unless_traced
    def resting(self) -> State:
        """The state before an inspiration."""
        n = self.window
        first = (self.start - self.p_mean) / self.p_std
        if self.published:
            return xp.concatenate([xp.zeros(n), first[None], xp.zeros(n)])
        closed = xp.full(n, -self.u_mean / self.u_std)
        return xp.concatenate([closed, xp.full(n, first), xp.zeros(1)])

    def pressure(self, x: State) -> Scalar:
        """The pressure now.

        **Arguments:** `x`: the state.

        **Returns:** a scalar [cmH2O].
        """
        return self.p_mean + self.p_std * x[self.window]

    def corrected(self, x: State, pressure: RealScalar, gain: RealScalar) -> State:
        """Correct the newest pressure in the state with a measurement.

        **Arguments:** `x`: the state. `pressure`: the reading of a sensor [cmH2O].
        `gain`: the share of the difference to correct, from 0 to 1.

        **Returns:** the corrected state.
        """
        innovation = (pressure - self.pressure(x)) / self.p_std
        return x.at[self.window].add((gain * innovation).astype(x.dtype))

    def observe(self, t: Time, x: State) -> Observation:
        return jnp.reshape(self.pressure(x), (1,)).astype(x.dtype)

    def _linearised(self, controls: Array) -> Array:
        """The controls, with the curve of the valve linearised."""
        return controls if self.published else controls + jax.vmap(self.valve)(controls)

    def _later_step(self, linearised: Array, pressures: Array) -> Array:
        """The next pressure, after the first steps."""
        z = jnp.concatenate([linearised, pressures[: self.p_window]])
        predicted = self.network(z)
        # The networks learn the change, which is small and almost linear.
        return predicted if self.published else pressures[0] + self.line @ z + predicted

    def _first_step(
        self, history: Array, late: Any, hidden: Array, output: Array
    ) -> Array:
        """The next pressure in one of the first steps. `late` is the result of
        `_later_step`."""
        own = output @ jnp.tanh(hidden @ history)
        return own if self.published else own + late

    def _bound(self, pressure: Array) -> Array:
        # Keep the state bounded, even if a control makes no sense.
        return 20 * jnp.tanh(pressure / 20)

    def advance(
        self, t: RealScalar, x: Array, u: Array, w: Array | None
    ) -> tuple[Array, Result]:
        n = self.window
        x = x if w is None else x + w
        control = jnp.reshape((u[0] - self.u_mean) / self.u_std, (1,)).astype(x.dtype)
        controls, pressures = jnp.concatenate([control, x[: n - 1]]), x[n : 2 * n]
        step, first = x[2 * n], self.hidden.shape[0]
        # The number of steps is a float in the state. Past `boundary` a slice is taken
        # but not used, because both predictions are computed.
        i = jnp.clip(jnp.round(step), 0, first - 1).astype(int)
        late = self._later_step(self._linearised(controls[: self.u_window]), pressures)
        history = jnp.concatenate([controls, pressures])
        early = self._first_step(history, late, self.hidden[i], self.output[i])
        predicted = self._bound(jnp.where(step < first - 0.5, early, late))
        after = jnp.hstack([controls, predicted, pressures[: n - 1], step + 1])
        # Expirations are not learned: an open valve resets the state.
        after = jnp.where(u[1] > 0.5, self.resting(), after)
        return after.astype(x.dtype), RESULTS.successful

    def predict(self, u_in: Array) -> Array:
        """Predict the pressures of an inspiration from its controls, in open loop.

        **Arguments:** `u_in`: the controls [%], shape `(T,)`.

        **Returns:** the pressures [cmH2O], shape `(T,)`. The first pressure is the one
        before any control acted.
        """
        return self._predicted(u_in, None)

    def one_step(self, u_in: Array, pressure: Array) -> Array:
        """Predict each pressure from the recorded pressures before it.

        **Arguments:** `u_in`: the controls [%], shape `(T,)`. `pressure`: the recorded
            pressures [cmH2O], shape `(T,)`.

        **Returns:** the pressures [cmH2O], shape `(T,)`. The first pressure is the one
        before any control acted.
        """
        return self._predicted(u_in, (pressure - self.p_mean) / self.p_std)

    def _predicted(self, u_in: Array, recorded: Array | None) -> Array:
        """Predict as `advance` does, but compute for all steps at once what needs no
        prediction: the windows of controls, or everything if pressures are recorded."""
        n, last = self.window, u_in.shape[0] - 1
        first = min(self.hidden.shape[0], last)
        x0 = self.resting().astype(u_in.dtype)
        u = (u_in - self.u_mean) / self.u_std
        before = jnp.zeros(n - 1) if self.published else x0[: n - 1]
        u = jnp.concatenate([before.astype(u.dtype), u])
        controls = _windows(u, n)[:-1]
        linearised = _windows(self._linearised(u), n)[:-1, : self.u_window]
        weights = self.hidden[:first], self.output[:first]

        def begin(pressures, inputs):
            controls, linearised, hidden, output = inputs
            late = 0.0 if self.published else self._later_step(linearised, pressures)
            history = jnp.concatenate([controls, pressures])
            return self._bound(self._first_step(history, late, hidden, output))

        def go_on(pressures, linearised):
            return self._bound(self._later_step(linearised, pressures))

        inputs = controls[:first], linearised[:first], *weights
        start = x0[n : 2 * n]
        # In open loop each step needs the pressure before it. With recorded pressures
        # all steps are independent.
        if recorded is None:

            def scan(step, pressures, inputs):
                def body(pressures, inputs):
                    after = step(pressures, inputs)
                    return jnp.append(after, pressures[:-1]), after

                return jax.lax.scan(body, pressures, inputs)

            pressures, early = scan(begin, start, inputs)
            _, late = scan(go_on, pressures, linearised[first:])
        else:
            known = _windows(jnp.append(start[:0:-1], recorded), n)[:-1]
            early = jax.vmap(begin)(known[:first], inputs)
            late = jax.vmap(go_on)(known[first:], linearised[first:])
        return self.p_mean + self.p_std * jnp.concatenate([start[:1], early, late])


def _windows(values: Array, size: int) -> Array:
    """The last `size` values, newest first, at each time that has enough values."""
    count = values.shape[0] - size + 1
    shifts = [values[size - 1 - i : size - 1 - i + count] for i in range(size)]
    return jnp.stack(shifts, axis=1)
