"""Stability margins of a feedback loop: gain, phase, delay and disk."""

import equinox as eqx
import jax

from .._jax import (
    compiled_unless_on_host,
    host_unless_traced,
    stop_gradient,
    vmap,
    xp,
)
from .._module import shown
from .._results import first_of, raise_on_failure, Result
from .._typing import BoolScalar, Scalar
from ._crossings import ANYWHERE, crossings, follow, gains
from ._disk_margin import disk_of, DiskMargin
from ._state_space import LinearModel, norm, state_space, StateSpace


class Margins(eqx.Module):
    """The stability margins of a loop with one input and one output.

    **Attributes:**

    - `gain_margin`: the smallest factor above 1 on the loop gain that moves a pole to
        the boundary of stability; infinite if no factor does.
    - `gain_reduction`: the largest factor below 1 that moves a pole to the boundary of
        stability; zero if no factor does.
    - `phase_margin`: the smallest phase change, of either sign, that moves a pole to
        the boundary of stability, in radians; infinite if no phase change does.
    - `delay_margin`: the smallest delay that moves a pole to the boundary of stability,
        in units of time; infinite if no delay does.
    - `gain_margin_frequency`, `gain_reduction_frequency`, `phase_margin_frequency`,
        `delay_margin_frequency`: the critical frequencies, in radians per unit of time;
        NaN if the loop has no such margin.
    - `disk`, `disk_s`, `disk_t`: the disk margins, each a
        [`delucax.analysis.DiskMargin`][]. `disk_s` is the margin of the sensitivity
        $S = 1 / (1 + L)$, `disk_t` is the margin of the complementary sensitivity
        $T = L / (1 + L)$, and `disk` takes $S$ and $T$ into account equally.
    - `is_stable`: whether the closed loop is stable. If the closed loop is not stable,
        `gain_margin` and `gain_reduction` are 1, the other margins are 0, and the
        frequencies are NaN.
    - `result`: success, or the reason for a failure; one of `delucax.RESULTS`.

    All attributes except `is_stable` and `result` are differentiable.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        loop = dlx.systems.LinearSystem(
            jnp.array([[0.0, 1.0], [0.0, -1.0]]), jnp.array([[0.0], [2.0]]),
            jnp.array([[1.0, 0.0]]),
        )
        margins = dlx.analysis.margins(loop)
        margins.phase_margin, margins.phase_margin_frequency
        ```

        ```text
        (Array(0.6749, dtype=float32), Array(1.2496, dtype=float32))
        ```
    """

    gain_margin: Scalar
    gain_margin_frequency: Scalar
    gain_reduction: Scalar
    gain_reduction_frequency: Scalar
    phase_margin: Scalar
    phase_margin_frequency: Scalar
    delay_margin: Scalar
    delay_margin_frequency: Scalar
    disk: DiskMargin
    disk_s: DiskMargin
    disk_t: DiskMargin
    is_stable: BoolScalar
    result: Result

    __repr__ = shown


@host_unless_traced
def margins(loop: LinearModel, *, throw: bool = True) -> Margins:
    r"""The gain, phase, delay and disk margins of a loop with one input and one output.

    The open loop $L$ is the linear model from $u$ to $y$, and the feedback $u = -y$
    closes this loop. To analyse a state feedback $u = -K x$, pass a model with $A$ and
    $B$ of the plant and with $C = K$.

    The frequencies at which $L$ is real or $|L| = 1$ are computed as eigenvalues of
    matrices. Sign changes of $\operatorname{Im} L$ and of $\log |L|$ show which of
    these frequencies are crossings, and each crossing is then computed to the accuracy
    of rounding. The margins have first and second derivatives in forward and reverse
    mode. The derivatives are those at the critical crossing.

    **Arguments:**

    - `loop`: a [`delucax.systems.LinearSystem`][], or time-invariant
        [`delucax.LinearDynamics`][], with one control and one output.
    - `throw`: raise an error if a search does not converge (default). If false, check
        `result`.

    **Returns:** [`delucax.analysis.Margins`][].

    **Raises:** `ValueError` if `loop` is not linear, is time-varying, or has more than
    one control or output. With `throw`, an error at run time if a search does not
    converge.

    Source: Seiler, Packard and Gahinet, 2020 (disk margins).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        upright = dlx.linearize(dlx.systems.Pendulum())
        K = dlx.riccati.care(upright.A, upright.B, jnp.eye(2), jnp.eye(1)).K
        loop = dlx.systems.LinearSystem(upright.A, upright.B, C=K)
        dlx.analysis.margins(loop).phase_margin
        ```

        ```text
        Array(1.107, dtype=float32)
        ```
    """
    where = "margins"
    system = state_space(loop, "controls", where)
    p, m = system.D.shape
    if not p == m == 1:
        raise ValueError(
            f"{where}: loop must have one control and one output, got {m} and {p}. "
            "For more, use `disk_margin`."
        )
    return raise_on_failure(_margins(system), where, throw)


@compiled_unless_on_host
def _margins(loop: StateSpace) -> Margins:
    dtype = loop.A.dtype
    stable = loop._replace(A=loop.A - loop.B @ loop.C).is_stable()
    disks = vmap(lambda skew: disk_of(loop, skew, None))(xp.array([0, 1, -1], dtype))
    frozen = stop_gradient(loop)
    omegas, crosses = crossings(frozen)
    values = gains(frozen, omegas)[0]

    # A loop gain above `huge` is at a pole on the axis and is not a crossing.
    real = xp.real(values[0])
    huge = xp.finfo(dtype).eps ** -0.75
    negative = crosses[0] & (real < 0) & (real > -huge)
    # The loop gain becomes -1 after these factors, turns and lags.
    factors = -1 / xp.where(negative, real, -1)
    turns = xp.angle(-values[1])
    lags = xp.mod(turns, 2 * xp.pi) / xp.where(crosses[1], omegas[1], 1)
    candidates = xp.stack(
        [
            xp.where(negative & (factors >= 1), factors, xp.inf),
            xp.where(negative & (factors < 1), 1 / factors, xp.inf),
            xp.where(crosses[1], xp.abs(turns), xp.inf),
            xp.where(crosses[1], lags, xp.inf),
        ]
    )
    # The kind of crossing of each margin. Gain margins are where the loop is real.
    kinds = xp.array([0, 0, 1, 1])
    nearest = xp.argmin(candidates, axis=1)
    exists = xp.isfinite(xp.min(candidates, axis=1))
    followed = follow(loop, kinds, omegas[kinds, nearest], exists)
    followed = xp.where(exists, followed, ANYWHERE)
    L = xp.where(exists, gains(loop, followed)[0], 1)
    factor = 1 / norm(L, ())
    angle = xp.arctan2(-xp.imag(L), -xp.real(L))
    # Only here: a gain margin may be at frequency zero.
    turn = xp.where(angle[3] < 0, angle[3] + 2 * xp.pi, angle[3])
    lag = turn / followed[3]
    margins = xp.stack([factor[0], factor[1], xp.abs(angle[2]), lag])
    none = xp.array([xp.inf, 0, xp.inf, xp.inf], dtype)
    unstable = xp.array([1, 1, 0, 0], dtype)
    margins = xp.where(stable, xp.where(exists, margins, none), unstable)
    frequencies = xp.where(stable & exists, followed, xp.nan)
    names = ("gain_margin", "gain_reduction", "phase_margin", "delay_margin")
    disk, disk_s, disk_t = (jax.tree.map(lambda a, i=i: a[i], disks) for i in range(3))
    return Margins(
        **dict(zip(names, margins, strict=True)),
        **{f"{name}_frequency": w for name, w in zip(names, frequencies, strict=True)},
        disk=disk,
        disk_s=disk_s,
        disk_t=disk_t,
        is_stable=stable,
        result=first_of(disks.result),
    )
