"""How large a disk of perturbations a feedback loop stands."""

import equinox as eqx
import jax.numpy as jnp

from .._message import shortened
from .._results import raise_on_failure, Result
from .._typing import RealScalar, Scalar
from ._norms import peak_gain
from ._state_space import LinearModel, state_space, StateSpace


class DiskMargin(eqx.Module):
    """How large a disk of perturbations, gain and phase at once, a loop stands.

    **Attributes:**

    - `margin`: the radius `alpha` of the disk; zero if the closed loop is not stable.
    - `frequency`: where it is smallest, in radians per unit of time.
    - `gain_low`, `gain_high`: the real factors between which the loop gain may lie.
    - `phase`: the phase, in radians, that the loop may be turned either way.
    - `result`: success, or why not; one of `delucax.RESULTS`.

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
    """

    margin: Scalar
    frequency: Scalar
    gain_low: Scalar
    gain_high: Scalar
    phase: Scalar
    result: Result


def disk_margin(
    loop: LinearModel,
    skew: RealScalar = 0.0,
    *,
    channel: int | None = None,
    throw: bool = True,
) -> DiskMargin:
    r"""How large a disk of perturbations a loop stands, gain and phase at once,

    `alpha = 1 / max over omega of sigma_max(S + (skew - 1)/2 I)`, `S = (I + L)^-1`:
    the closed loop stays stable with the loop gain multiplied by any
    `(2 + (1 - skew) delta) / (2 - (1 + skew) delta)`, `|delta| < alpha`.

    The loop `L` is the linear model from `u` to `y`, closed by `u = -y`. Of several
    channels, all are perturbed at once by one full matrix `delta`: safe for, and in
    general more than, separate factors in each channel.

    **Arguments:**

    - `loop`: a [`delucax.systems.LinearSystem`][], or time-invariant
        [`delucax.LinearDynamics`][], with as many controls as outputs.
    - `skew`: 0 (default) balances `S` and `T`, 1 takes `S` and -1 takes `T`; a number.
    - `channel`: perturb this one alone, the others being closed; all by default.
    - `throw`: raise if the search does not end (default); if false, look at `result`.

    **Returns:** a [`delucax.analysis.DiskMargin`][].

    **Raises:** `ValueError` if `loop` is not linear, is time-varying or is not square,
    or if there is no such `channel`; an error at run time as `throw` says.

    Source: Seiler, Packard and Gahinet, 2020.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[-1.0, 0.5], [0.0, -2.0]])
        loop = dlx.systems.LinearSystem(A, jnp.eye(2), 3 * jnp.eye(2))
        dlx.analysis.disk_margin(loop).margin
        dlx.analysis.disk_margin(loop, channel=0).margin
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
        is_index = isinstance(channel, int) and not isinstance(channel, bool)
        if not is_index or channel not in range(m):
            raise ValueError(
                f"{where}: channel must be a whole number from 0 to {m - 1}, or None "
                f"for all, got {shortened(channel)}."
            )
    disk = disk_of(system, jnp.asarray(skew, system.A.dtype), channel)
    return raise_on_failure(disk, where, throw)


@eqx.filter_jit
def disk_of(loop: StateSpace, skew: Scalar, channel: int | None) -> DiskMargin:
    """The disk margin of a loop, or of one of its channels."""
    A, B, C = loop.A, loop.B, loop.C
    if channel is not None:
        others = [i for i in range(B.shape[1]) if i != channel]
        A = A - B[:, jnp.array(others)] @ C[jnp.array(others)] if others else A
        B, C = B[:, channel, None], C[channel, None]
    eye = jnp.eye(B.shape[1], dtype=A.dtype)
    # S = I - C (s I - (A - B C))^-1 B.
    closed = StateSpace(A - B @ C, B, -C, (1 + skew) / 2 * eye, loop.dt)
    peak = peak_gain(closed)
    # Each branch that is not taken has a harmless number, so that its derivative has.
    stable = jnp.isfinite(peak.gain)
    usual = stable & (peak.gain > 0)
    alpha = 1 / jnp.where(usual, peak.gain, 1)
    up, down = 2 - alpha * (1 + skew), 2 + alpha * (1 + skew)
    low = (2 - alpha * (1 - skew)) / down
    bounded = up > 0
    high = (2 + alpha * (1 - skew)) / jnp.where(bounded, up, 1)
    # With a factor exp(j phase), delta is 2 tan / sqrt(1 + skew^2 tan^2) in size, tan
    # being that of half the phase.
    square = 1 - (skew * alpha / 2) ** 2
    turns = square > 0
    tangent = alpha / 2 / jnp.sqrt(jnp.where(turns, square, 1))
    phase = jnp.where(turns, 2 * jnp.arctan(tangent), jnp.pi)

    def chosen(value, without_loop, unstable):
        value = jnp.where(usual, value, without_loop)
        return jnp.where(stable, value, unstable)

    return DiskMargin(
        chosen(alpha, jnp.inf, 0.0),
        peak.frequency,
        chosen(low, -jnp.inf, 1.0),
        chosen(jnp.where(bounded, high, jnp.inf), jnp.inf, 1.0),
        chosen(phase, jnp.pi, 0.0),
        peak.result,
    )
