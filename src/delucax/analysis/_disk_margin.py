"""Disk margins: simultaneous changes of gain and phase."""

import equinox as eqx

from .._check import check_at_most, check_count, check_number
from .._jax import compiled_unless_on_host, host_unless_traced, xp
from .._module import shown
from .._results import raise_on_failure, Result
from .._typing import RealScalar, Scalar
from ._gains import peak_gain
from ._state_space import LinearModel, state_space, StateSpace


class DiskMargin(eqx.Module):
    r"""The disk margin of a feedback loop.

    **Attributes:**

    - `margin`: the radius $\alpha$ of the disk; zero if the closed loop is not stable.
    - `frequency`: the critical frequency, in radians per unit of time.
    - `gain_low`, `gain_high`: the loop stays stable if its gain is multiplied by a real
        factor between `gain_low` and `gain_high`.
    - `phase`: the phase change, of either sign, that the loop tolerates, in radians.
    - `result`: success, or the reason for a failure; one of `delucax.RESULTS`.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        loop = dlx.systems.LinearSystem(
            jnp.array([[0.0, 1.0], [0.0, -1.0]]), jnp.array([[0.0], [2.0]]),
            jnp.array([[1.0, 0.0]]),
        )
        dlx.analysis.disk_margin(loop).gain_high
        ```

        ```text
        Array(2., dtype=float32)
        ```
    """

    margin: Scalar
    frequency: Scalar
    gain_low: Scalar
    gain_high: Scalar
    phase: Scalar
    result: Result

    __repr__ = shown


@host_unless_traced
def disk_margin(
    loop: LinearModel,
    skew: RealScalar = 0.0,
    *,
    channel: int | None = None,
    throw: bool = True,
) -> DiskMargin:
    r"""The disk margin of a loop: how much its gain and its phase may change together.

    $$\frac{1}{\alpha} = \max_\omega
    \left\| S(j\omega) + \tfrac{\sigma - 1}{2} I \right\|,
    \qquad S = (I + L)^{-1}$$

    where $\sigma$ is the skew, and the norm is the largest singular value. The closed
    loop stays stable if the loop gain is multiplied by any complex factor

    $$\frac{2 + (1 - \sigma)\, \delta}{2 - (1 + \sigma)\, \delta}, \qquad
    |\delta| < \alpha.$$

    The open loop $L$ is the linear model from $u$ to $y$, and the feedback $u = -y$
    closes this loop. If the loop has several channels, a full matrix $\delta$ perturbs
    all of them at once. If in reality each channel is perturbed by its own factor, the
    disk margin is conservative.

    **Arguments:**

    - `loop`: a [`delucax.systems.LinearSystem`][], or time-invariant
        [`delucax.LinearDynamics`][], with as many controls as outputs.
    - `skew`: the skew $\sigma$, a number, 0 by default. With 0 the margin takes the
        sensitivity $S$ and the complementary sensitivity $T = I - S$ into account
        equally. With 1 the margin is that of $S$, and with -1 that of $T$.
    - `channel`: the index of the only channel that is perturbed. The other channels
        stay closed and are not perturbed. By default all channels are perturbed.
    - `throw`: raise an error if the search does not converge (default). If false, check
        `result`.

    **Returns:** a [`delucax.analysis.DiskMargin`][].

    **Raises:** `ValueError` if `loop` is not linear, is time-varying or is not square,
    or if `channel` is out of range. With `throw`, an error at run time if the search
    does not converge.

    Source: Seiler, Packard and Gahinet, 2020.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[-1.0, 0.5], [0.0, -2.0]])
        loop = dlx.systems.LinearSystem(A, jnp.eye(2), 3 * jnp.eye(2))
        dlx.analysis.disk_margin(loop).margin
        ```

        ```text
        Array(2., dtype=float32)
        ```
    """
    where = "disk_margin"
    system = state_space(loop, "controls", where)
    p, m = system.D.shape
    if p != m:
        raise ValueError(
            f"{where}: loop must have as many outputs as controls, got {p} and {m}."
        )
    if channel is not None:
        channel = check_count(channel, "channel", where, least=0)
        check_at_most(channel, m - 1, "channel", where)
    check_number(skew, "skew", where)
    disk = disk_of(system, xp.asarray(skew, system.A.dtype), channel)
    return raise_on_failure(disk, where, throw)


@compiled_unless_on_host
def disk_of(loop: StateSpace, skew: Scalar, channel: int | None) -> DiskMargin:
    """The disk margin of a loop, or of one of its channels."""
    A, B, C, *_ = loop
    if channel is not None:
        # The other channels are closed by u = -y before the loop is opened at this one.
        others = [i for i in range(B.shape[1]) if i != channel]
        A = A - B[:, xp.array(others)] @ C[xp.array(others)] if others else A
        B, C = B[:, channel, None], C[channel, None]
    eye = xp.eye(B.shape[1], dtype=A.dtype)
    # S = I - C (s I - (A - B C))^-1 B.
    closed = StateSpace(A - B @ C, B, -C, (1 + skew) / 2 * eye, loop.dt)
    peak = peak_gain(closed)
    # Finite values in the branches that are not taken keep gradients finite. If the
    # loop is zero, its peak gain is zero and the margin is infinite.
    stable = xp.isfinite(peak.gain)
    usual = stable & (peak.gain > 0)
    alpha = 1 / xp.where(usual, peak.gain, 1)
    # The extreme real factors have delta = -alpha and delta = alpha.
    up, down = 2 - alpha * (1 + skew), 2 + alpha * (1 + skew)
    low = (2 - alpha * (1 - skew)) / down
    bounded = up > 0
    high = (2 + alpha * (1 - skew)) / xp.where(bounded, up, 1)
    # For a factor exp(j phase), |delta| = 2 tan / sqrt(1 + skew^2 tan^2), with the
    # tangent of half the phase.
    square = 1 - (skew * alpha / 2) ** 2
    turns = square > 0
    tangent = alpha / 2 / xp.sqrt(xp.where(turns, square, 1))
    phase = xp.where(turns, 2 * xp.arctan(tangent), xp.pi)

    def chosen(value, without_loop, unstable):
        value = xp.where(usual, value, without_loop)
        return xp.where(stable, value, unstable)

    return DiskMargin(
        chosen(alpha, xp.inf, 0.0),
        peak.frequency,
        chosen(low, -xp.inf, 1.0),
        chosen(xp.where(bounded, high, xp.inf), xp.inf, 1.0),
        chosen(phase, xp.pi, 0.0),
        peak.result,
    )
