"""Estimation problems: the rates of chemical reactions from measurements.

They are least-squares problems with a differential equation. The rates are unknown, and
there is no control.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._check import check_positive
from .._module import indexed_names, parameter
from .._results import Result
from .._typing import Control, Disturbance, Observation, RealScalar, State, Time
from ..costs import AbstractCost
from ..dynamics import AbstractWrapper, Discretized
from ..math._steps import row_at
from ..planning import Unknowns
from ..systems import AbstractSystem
from ._base import OptimalControl


class Reactions(AbstractSystem):
    r"""A system of chemical reactions, without controls.

    $$\dot y = f(\mathrm{rates}, y)$$

    **Arguments:**

    - `rates`: the rates of the reactions, shape `(p,)`.
    - `function`: the function $f$. This function returns a vector of the size of `y`.
    - `size`: the size of `y`.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        decay = dlx.problems.Reactions(jnp.ones(1), lambda rates, y: -rates * y, 1)
        decay.vector_field(0.0, jnp.ones(1), jnp.zeros(0), None)
        ```

        ```text
        Array([-1.], dtype=float32)
        ```
    """

    rates: Float[Array, " p"] = parameter()
    function: Callable[..., Any] = eqx.field(static=True)
    size: int = eqx.field(static=True)

    control_names = ()

    @property
    def state_names(self) -> tuple[str, ...]:
        return indexed_names("y", self.size)

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        return self.function(self.rates, x)


class Sampled(AbstractWrapper):
    """A discretised system whose step `k` has the length `widths[k]`.

    These dynamics measure time in steps, so `dt` is 1 by default. The time of the
    system inside is the sum of the lengths of all earlier steps.

    **Arguments:**

    - `inner`: a [`delucax.Discretized`][] system. Its `dt` is not used.
    - `widths`: the lengths of the steps, shape `(T,)`.
    - `dt`: the time by which these dynamics advance in one step, 1 by default.

    **Raises:** `ValueError` if the system has a diffusion, because its Brownian
    increments are drawn for steps of equal length.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        pendulum = dlx.Discretized(dlx.systems.Pendulum(), dt=1.0)
        sampled = dlx.problems.Sampled(pendulum, jnp.array([0.1, 0.3]))
        dlx.open_loop(sampled, jnp.array([0.1, 0.0]), jnp.zeros((2, 1)))
        ```

        ```text
        Array([[0.1  , 0.   ],
               [0.108, 0.153],
               [0.244, 0.858]], dtype=float32)
        ```
    """

    inner: Discretized
    widths: Float[Array, " T"] = parameter()
    dt: Array = parameter(1.0)

    def __check_init__(self):
        check_positive(self.widths, "widths", "Sampled")
        if self.noise == "brownian":
            raise ValueError(
                "Sampled: the system of inner must have no diffusion, because its "
                "Brownian increments are drawn for steps of one length."
            )

    @property
    def dynamics(self) -> Discretized:
        """The wrapped dynamics, `inner`."""
        return self.inner

    @property
    def event_names(self) -> tuple[str, ...]:
        """None, because the times of events would not be those of the steps."""
        return ()

    def observe(self, t: Time, x: State) -> Observation:
        return self.inner.observe(self._start(self._step_at(t)), x)

    def advance(
        self, t: RealScalar, x: Array, u: Array, w: Array | None
    ) -> tuple[Array, Result]:
        k = self._step_at(t)
        at = lambda inner: inner.dt
        inner = eqx.tree_at(at, self.inner, row_at(self.widths, k).astype(x.dtype))
        return inner.advance(self._start(k), x, u, w)

    def _step_at(self, t: Time) -> Array:
        return jnp.round(jnp.asarray(t / self.dt)).astype(int)

    def _start(self, k: Array) -> Array:
        """The time of the system at the start of step `k`."""
        return row_at(jnp.pad(jnp.cumsum(self.widths), (1, 0)), k)

    def refined(self, points: int, inner: Callable[[Any], Any]) -> "Sampled":
        """The same dynamics with each step cut into parts, and with new inner dynamics.

        **Arguments:** `points`: the number of parts. `inner`: a function that takes the
        old inner dynamics and returns the new inner dynamics.

        **Returns:** a [`delucax.problems.Sampled`][].
        """
        widths = jnp.repeat(self.widths / points, points)
        return Sampled(inner(self.inner), widths, self.dt / points)


class Residuals(AbstractCost):
    """The squared differences between the states and the measurements."""

    data: Float[Array, "points n"] = parameter()

    def __call__(self, t: Any, x: Array, u: Array) -> Array:
        return self._at(t, x)

    def final(self, t: Any, x: Array) -> Array:
        return self._at(t, x)

    def _at(self, t: Any, x: Array) -> Array:
        return jnp.sum((x - self.data[jnp.round(jnp.asarray(t)).astype(int)]) ** 2)


def _estimated(
    function: Callable[..., Any],
    times: list[float],
    data: Any,
    rates: list[float],
    substeps: int,
    reference: float,
) -> OptimalControl:
    """The problem of estimating nonnegative rates from measurements. The measurements
    are also the first state and the first guess of the states."""
    data = jnp.asarray(np.asarray(data, float))
    system = Reactions(jnp.array(rates), function, data.shape[1])
    inner = Discretized(system, 1.0, substeps=substeps)
    return OptimalControl(
        Sampled(inner, jnp.asarray(np.diff(times))),
        Residuals(data),
        data[0],
        jnp.zeros((len(times) - 1, 0)),
        reference,
        data,
        unknowns=Unknowns(parameters={"dynamics.inner.system.rates": (0.0, np.inf)}),
    )


def gas_oil_cracking() -> OptimalControl:
    r"""Estimate the rates $(a, b, c)$ of the cracking of gas oil from 20 measurements.

    $$\dot y_1 = -(a + c) y_1^2, \qquad \dot y_2 = a y_1^2 - b y_2, \qquad
    y(0) = (1, 0)$$

    The published sum of squares is 5.2366e-3. The first guess is the measurements for
    the states and 1 for each rate.

    **Returns:** a [`delucax.problems.OptimalControl`][].

    Source: Tjoa and Biegler, 1991; Dolan, More and Munson, 2004.

    !!! example

        ```python
        import delucax as dlx

        dlx.problems.gas_oil_cracking().x0
        ```

        ```text
        Array([1., 0.], dtype=float32)
        ```
    """
    times = [0.0, 0.025, 0.05, 0.075, 0.1, 0.125, 0.15, 0.175, 0.2, 0.225, 0.25, 0.3]
    times += [0.35, 0.4, 0.45, 0.5, 0.55, 0.65, 0.75, 0.85, 0.95]
    y_1 = [1.0, 0.8105, 0.6208, 0.5258, 0.4345, 0.3903, 0.3342, 0.3034, 0.2735, 0.2405]
    y_1 += [0.2283, 0.2071, 0.1669, 0.1530, 0.1339, 0.1265, 0.1200, 0.0990, 0.0870]
    y_1 += [0.0770, 0.0690]
    y_2 = [0.0, 0.2, 0.2886, 0.3010, 0.3215, 0.3123, 0.2716, 0.2551, 0.2258, 0.1959]
    y_2 += [0.1789, 0.1457, 0.1198, 0.0909, 0.0719, 0.0561, 0.0460, 0.0280, 0.0190]
    y_2 += [0.0140, 0.0100]
    data = np.stack([y_1, y_2], axis=1)
    return _estimated(_gas_oil, times, data, [1.0, 1.0, 1.0], 4, 5.2366e-3)


def _gas_oil(rates: Array, y: Array) -> Array:
    a, b, c = rates
    return jnp.stack([-(a + c) * y[0] ** 2, a * y[0] ** 2 - b * y[1]])


def methanol_to_hydrocarbons() -> OptimalControl:
    r"""Estimate the rates of the conversion of methanol to hydrocarbons.

    $$\dot y_1 = -\left(2 b - \frac{a y_2}{q} + c + d\right) y_1, \quad
    \dot y_2 = \frac{a y_1 (b y_1 - y_2)}{q} + c y_1, \quad
    \dot y_3 = \frac{a y_1 (y_2 + e y_1)}{q} + d y_1$$

    Here $q = (b + e) y_1 + y_2$ and $y(0) = (1, 0, 0)$. The rates $(a, b, c, d, e)$ are
    estimated from 16 measurements. The published sum of squares is 9.02229e-3. The
    first guess is the measurements for the states and 1 for each rate.

    **Returns:** a [`delucax.problems.OptimalControl`][].

    Source: Maria, 1989; Dolan, More and Munson, 2004.

    !!! example

        ```python
        import delucax as dlx

        dlx.problems.methanol_to_hydrocarbons().dynamics.widths[:3]
        ```

        ```text
        Array([0.05 , 0.015, 0.015], dtype=float32)
        ```
    """
    times = [0.0, 0.05, 0.065, 0.08, 0.123, 0.233, 0.273, 0.354, 0.397, 0.418, 0.502]
    times += [0.553, 0.681, 0.75, 0.916, 0.937, 1.122]
    y_1 = [1.0, 0.7085, 0.5971, 0.5537, 0.3684, 0.1712, 0.1198, 0.0747, 0.0529, 0.0415]
    y_1 += [0.0261, 0.0208, 0.0085, 0.0053, 0.0019, 0.0018, 0.0006]
    y_2 = [0.0, 0.1621, 0.1855, 0.1989, 0.2845, 0.3491, 0.3098, 0.3576, 0.3347, 0.3388]
    y_2 += [0.3557, 0.3483, 0.3836, 0.3611, 0.3609, 0.3485, 0.3698]
    y_3 = [0.0, 0.0811, 0.0965, 0.1198, 0.1535, 0.2097, 0.2628, 0.2467, 0.2884, 0.2757]
    y_3 += [0.3167, 0.2954, 0.2950, 0.2937, 0.2831, 0.2846, 0.2899]
    data = np.stack([y_1, y_2, y_3], axis=1)
    return _estimated(_methanol, times, data, [1.0] * 5, 4, 9.02229e-3)


def _methanol(rates: Array, y: Array) -> Array:
    a, b, c, d, e = rates
    q = (b + e) * y[0] + y[1]
    return jnp.stack(
        [
            -(2 * b - a * y[1] / q + c + d) * y[0],
            a * y[0] * (b * y[0] - y[1]) / q + c * y[0],
            a * y[0] * (y[1] + e * y[0]) / q + d * y[0],
        ]
    )


def alpha_pinene() -> OptimalControl:
    r"""Estimate the rates of the thermal isomerisation of alpha-pinene.

    $$\dot y_1 = -(a + b) y_1, \quad \dot y_2 = a y_1, \quad
    \dot y_3 = b y_1 - (c + d) y_3 + e y_5, \quad \dot y_4 = c y_3, \quad
    \dot y_5 = d y_3 - e y_5$$

    The first state is $(100, 0, 0, 0, 0)$. The rates $(a, b, c, d, e)$ are estimated
    from 8 measurements. The published sum of squares is 19.8721. The first guess is the
    measurements for the states and 1e-5 per minute for each rate.

    **Returns:** a [`delucax.problems.OptimalControl`][].

    Source: Box, Hunter, MacGregor and Erjavec, 1973; Dolan, More and Munson, 2004.

    !!! example

        ```python
        import delucax as dlx

        dlx.problems.alpha_pinene().states[1]
        ```

        ```text
        Array([88.35,  7.3 ,  2.3 ,  0.4 ,  1.75], dtype=float32)
        ```
    """
    times = [0.0, 1230.0, 3060.0, 4920.0, 7800.0, 10680.0, 15030.0, 22620.0, 36420.0]
    data = [
        [100.0, 0.0, 0.0, 0.0, 0.0],
        [88.35, 7.3, 2.3, 0.4, 1.75],
        [76.4, 15.6, 4.5, 0.7, 2.8],
        [65.1, 23.1, 5.3, 1.1, 5.8],
        [50.4, 32.9, 6.0, 1.5, 9.3],
        [37.5, 42.7, 6.0, 1.9, 12.0],
        [25.9, 49.1, 5.9, 2.2, 17.0],
        [14.0, 57.4, 5.1, 2.6, 21.0],
        [4.5, 63.1, 3.8, 2.9, 25.7],
    ]
    return _estimated(_pinene, times, data, [1e-5] * 5, 8, 19.8721)


def _pinene(rates: Array, y: Array) -> Array:
    a, b, c, d, e = rates
    return jnp.stack(
        [
            -(a + b) * y[0],
            a * y[0],
            b * y[0] - (c + d) * y[2] + e * y[4],
            c * y[2],
            d * y[2] - e * y[4],
        ]
    )
