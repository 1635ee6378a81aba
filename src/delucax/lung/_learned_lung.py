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
    """The first weights of the networks at the beginning of a breath, and two keys."""
    hidden_key, output_key, *keys = jr.split(key, 4)
    shape = boundary, 16
    # Variances of one over the inputs keep what enters a tanh about 1.
    hidden = jr.normal(hidden_key, (*shape, size)) / size**0.5
    return hidden, 0.1 * jr.normal(output_key, shape) / 16**0.5, *keys


@eqx.filter_jit
def _moments(breaths: Breaths) -> tuple[Array, ...]:
    """Means and standard deviations of control and pressure, and the first pressure."""
    inhaling = breaths.u_out < 0.5
    moments = lambda a: (jnp.mean(a, where=inhaling), jnp.std(a, where=inhaling))
    u_mean, u_std = moments(breaths.u_in)
    p_mean, p_std = moments(breaths.pressure)
    start = jnp.mean(breaths.pressure[..., 0])
    # It is divided by, and 0 where all are the same.
    return u_mean, u_std + 1e-3, p_mean, p_std + 1e-3, start


class LearnedLung(AbstractDynamics):
    r"""A lung learned from breaths: a network of the last controls and pressures, and
    networks of their own for the first steps of an inspiration.

    With `u` and `p` the normalised controls and pressures, step `k` of an inspiration
    predicts

    `p[k + 1] = p[k] + line . z + network(z) + output_k . tanh(hidden_k z_all)`,
    `z = (v(u[k]), ..., v(u[k + 1 - u_window]), p[k], ..., p[k + 1 - p_window])`,

    where `v`, a small network of one control, linearises the curve of the valve, and
    `z_all` is the whole history. The last term is included for `k < boundary` only.
    Before an inspiration the valve is closed and the pressure is the start pressure of
    the breaths.

    With `published`, the model of the paper: `p[k + 1] = network(z)` of the raw
    controls, for `k < boundary` the last term alone, and a history of zeros before an
    inspiration.

    The `boundary` networks have 16 hidden units each, and are one stacked array,
    of which a step takes its slice.
    While `u_out` is above 1/2 the lung is as before an inspiration. The state is (the
    controls, the pressures, both newest first, and the count of steps), and the
    observation is the pressure [cmH2O].

    **Arguments:**

    - `breaths`: a [`delucax.lung.Breaths`][], from which the scales and the pressure
        before an inspiration are taken.
    - `width`, `depth`: of the network, 24 and 1 by default.
    - `boundary`: how many first steps have networks of their own, 5 by default.
    - `u_window`, `p_window`: how many controls and pressures the network is given, 8
        and 6 by default.
    - `published`: as published (see above); false by default.
    - `key`: a random key, for the first weights.

    **Attributes:** `line`, `valve`, `network`, `hidden` and `output`, trainable;
    `u_mean`, `u_std`, `p_mean`, `p_std`, `start`.

    **Raises:** `ValueError` if a size is below 1, or there are no breaths or no key.

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
        """The number of controls, and of pressures, in the state."""
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
        """The state with its newest pressure corrected by a measured one.

        **Arguments:** `x`: the state. `pressure`: what a sensor read [cmH2O]. `gain`:
        how much of the difference is made up for, from 0 to 1.

        **Returns:** the state.
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
        # The networks learn the change: for a short step it is small and near linear.
        return predicted if self.published else pressures[0] + self.line @ z + predicted

    def _first_step(
        self, history: Array, late: Any, hidden: Array, output: Array
    ) -> Array:
        """The next pressure in a first step; `late` is that of `_later_step`."""
        own = output @ jnp.tanh(hidden @ history)
        return own if self.published else own + late

    def _bound(self, pressure: Array) -> Array:
        # A control that makes no sense must not drive the state out of all bounds.
        return 20 * jnp.tanh(pressure / 20)

    def advance(
        self, t: RealScalar, x: Array, u: Array, w: Array | None
    ) -> tuple[Array, Result]:
        n = self.window
        x = x if w is None else x + w
        control = jnp.reshape((u[0] - self.u_mean) / self.u_std, (1,)).astype(x.dtype)
        controls, pressures = jnp.concatenate([control, x[: n - 1]]), x[n : 2 * n]
        step, first = x[2 * n], self.hidden.shape[0]
        # The count of steps is a float in the state; past `boundary` a slice is still
        # taken, and not used, because a scan has no branches of other shapes.
        i = jnp.clip(jnp.round(step), 0, first - 1).astype(int)
        late = self._later_step(self._linearised(controls[: self.u_window]), pressures)
        history = jnp.concatenate([controls, pressures])
        early = self._first_step(history, late, self.hidden[i], self.output[i])
        predicted = self._bound(jnp.where(step < first - 0.5, early, late))
        after = jnp.hstack([controls, predicted, pressures[: n - 1], step + 1])
        # Nothing is learned of expirations: an open valve resets the state.
        after = jnp.where(u[1] > 0.5, self.resting(), after)
        return after.astype(x.dtype), RESULTS.successful

    def predict(self, u_in: Array) -> Array:
        """The pressures of an inspiration under recorded controls: open loop.

        **Arguments:** `u_in`: shape `(T,)` [%].

        **Returns:** shape `(T,)` [cmH2O], the first before any control acted.
        """
        return self._predicted(u_in, None)

    def one_step(self, u_in: Array, pressure: Array) -> Array:
        """Each pressure predicted from the recorded ones before it.

        **Arguments:** `u_in`, `pressure`: shape `(T,)`.

        **Returns:** shape `(T,)` [cmH2O], the first before any control acted.
        """
        return self._predicted(u_in, (pressure - self.p_mean) / self.p_std)

    def _predicted(self, u_in: Array, recorded: Array | None) -> Array:
        """The same as by `advance`, but what needs no prediction is computed for all
        steps at once: the windows of controls, and with records the whole."""
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
        # Open loop each step needs the pressure before it; with records none does.
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
    """The last `size` values at each time that has as many, newest first."""
    count = values.shape[0] - size + 1
    shifts = [values[size - 1 - i : size - 1 - i + count] for i in range(size)]
    return jnp.stack(shifts, axis=1)
