"""Stability margins of a feedback loop: gain, phase, delay and disk."""

import equinox as eqx
import jax
from jaxtyping import Bool, Complex, Float, Int

from .._check import check_at_most, check_count
from .._jax import (
    compiled_unless_on_host,
    fori_loop,
    host_unless_traced,
    lax,
    stop_gradient,
    vmap,
    xp,
)
from .._results import first_of, raise_on_failure, Result
from .._typing import Array, BoolScalar, RealScalar, Scalar
from ..math._linear_solve import eigenvalues, lu_solve
from ._gains import peak_gain
from ._state_space import LinearModel, norm, state_space, StateSpace


class DiskMargin(eqx.Module):
    """The disk margin of a feedback loop.

    **Attributes:**

    - `margin`: the radius `alpha` of the disk; zero if the closed loop is not stable.
    - `frequency`: the critical frequency, in radians per unit of time.
    - `gain_low`, `gain_high`: the real factors between which the loop gain may lie.
    - `phase`: the phase change, of either sign, that the loop tolerates, in radians.
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


@host_unless_traced
def disk_margin(
    loop: LinearModel,
    skew: RealScalar = 0.0,
    *,
    channel: int | None = None,
    throw: bool = True,
) -> DiskMargin:
    r"""The disk margin: the size of simultaneous gain and phase perturbations,

    `alpha = 1 / max over omega of sigma_max(S + (skew - 1)/2 I)`, `S = (I + L)^-1`:
    the closed loop stays stable with the loop gain multiplied by any
    `(2 + (1 - skew) delta) / (2 - (1 + skew) delta)`, `|delta| < alpha`.

    The loop `L` is the linear model from `u` to `y`, closed by `u = -y`. Of several
    channels, all are perturbed at once by one full matrix `delta`, which is
    conservative with respect to independent factors in each channel.

    **Arguments:**

    - `loop`: a [`delucax.systems.LinearSystem`][], or time-invariant
        [`delucax.LinearDynamics`][], with as many controls as outputs.
    - `skew`: 0 (default) balances `S` and `T`, 1 takes `S` and -1 takes `T`; a number.
    - `channel`: perturb this one alone, the others being closed; all by default.
    - `throw`: raise if the search does not converge (default); if false, check
        `result`.

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
    disk = _disk(system, xp.asarray(skew, system.A.dtype), channel)
    return raise_on_failure(disk, where, throw)


@compiled_unless_on_host
def _disk(loop: StateSpace, skew: Scalar, channel: int | None) -> DiskMargin:
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
    # Finite values in the branches that are not taken keep their gradients finite.
    # The gain is zero, and the margin infinite, where there is no loop at all.
    stable = xp.isfinite(peak.gain)
    usual = stable & (peak.gain > 0)
    alpha = 1 / xp.where(usual, peak.gain, 1)
    # The extreme real factors are those at delta = -alpha and alpha.
    up, down = 2 - alpha * (1 + skew), 2 + alpha * (1 + skew)
    low = (2 - alpha * (1 - skew)) / down
    bounded = up > 0
    high = (2 + alpha * (1 - skew)) / xp.where(bounded, up, 1)
    # With a factor exp(j phase), delta is 2 tan / sqrt(1 + skew^2 tan^2) in size, tan
    # being that of half the phase.
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


class Margins(eqx.Module):
    """The stability margins of a loop with one input and one output.

    **Attributes:**

    - `gain_margin`: the smallest factor above 1 on the loop gain that brings a pole to
        the boundary of stability; infinite if there is none.
    - `gain_reduction`: the largest such factor below 1; zero if there is none.
    - `phase_margin`: the smallest phase change, of either sign, with that effect, in
        radians; infinite if there is none.
    - `delay_margin`: the smallest delay with that effect, in units of time; infinite if
        there is none.
    - `gain_margin_frequency`, `gain_reduction_frequency`, `phase_margin_frequency`,
        `delay_margin_frequency`: the critical frequencies, in radians per unit of time;
        NaN if there is none.
    - `disk`, `disk_s`, `disk_t`: the [`delucax.analysis.DiskMargin`][] that balances
        `S` and `T`, that of the sensitivity `S = 1 / (1 + L)`, and that of
        `T = L / (1 + L)`.
    - `is_stable`: whether the closed loop is. If not it has no margins: the factors are
        1, the others 0, the frequencies NaN.
    - `result`: success, or why not; one of `delucax.RESULTS`.

    All but `is_stable` and `result` are differentiable.

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


@host_unless_traced
def margins(loop: LinearModel, *, throw: bool = True) -> Margins:
    """The gain, phase, delay and disk margins of a loop with one input and one output.

    The loop `L` is the linear model from `u` to `y`, closed by `u = -y`: for a state
    feedback `u = -K x`, the plant's `A` and `B` with `C = K`.

    The frequencies at which `L` is real, and those at which it is 1 in size, are
    eigenvalues of matrices. Sign changes between these identify the true crossings,
    and each is refined to rounding. First and second derivatives, in either mode, are
    those of the critical crossing.

    **Arguments:**

    - `loop`: a [`delucax.systems.LinearSystem`][], or time-invariant
        [`delucax.LinearDynamics`][], with one control and one output.
    - `throw`: raise if a search does not converge (default); if false, check `result`.

    **Returns:** [`delucax.analysis.Margins`][].

    **Raises:** `ValueError` if `loop` is not linear, is time-varying, or has more than
    one control or output; an error at run time as `throw` says.

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
    """
    where = "margins"
    system = state_space(loop, "controls", where)
    p, m = system.D.shape
    if not p == m == 1:
        raise ValueError(
            f"{where}: loop must have one control and one output, got {m} and {p}; "
            "`disk_margin` takes more."
        )
    return raise_on_failure(_margins(system), where, throw)


@compiled_unless_on_host
def _margins(loop: StateSpace) -> Margins:
    dtype = loop.A.dtype
    stable = loop._replace(A=loop.A - loop.B @ loop.C).is_stable()
    disks = vmap(lambda skew: _disk(loop, skew, None))(xp.array([0, 1, -1], dtype))
    frozen = stop_gradient(loop)
    omegas, crosses = _crossings(frozen)
    values = _scalars(frozen, omegas)[0]

    # Where the loop is real and negative, and where it is 1 in size.
    # A loop gain above `huge` is at a pole on the axis, no crossing.
    real = xp.real(values[0])
    huge = xp.finfo(dtype).eps ** -0.75
    negative = crosses[0] & (real < 0) & (real > -huge)
    # Times these factors the loop gain is -1, and so it is after these turns and lags.
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
    # The kind of crossing of each margin: gain margins at phase crossings.
    kinds = xp.array([0, 0, 1, 1])
    nearest = xp.argmin(candidates, axis=1)
    exists = xp.isfinite(xp.min(candidates, axis=1))
    followed = _follow(loop, kinds, omegas[kinds, nearest], exists)
    # A placeholder where there is no crossing, at which all is finite.
    followed = xp.where(exists, followed, 1)
    L = xp.where(exists, _scalars(loop, followed)[0], 1)
    factor = 1 / norm(L, ())
    angle = xp.arctan2(-xp.imag(L), -xp.real(L))
    lag = xp.where(angle < 0, angle + 2 * xp.pi, angle) / followed
    margins = xp.stack([factor[0], factor[1], xp.abs(angle[2]), lag[3]])
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


def _scalars(
    loop: StateSpace, omega: Float[Array, "*frequencies"], order: int = 0
) -> list[Complex[Array, "*frequencies"]]:
    """The gain of the loop, and its derivatives up to an order."""
    return [gain[..., 0, 0] for gain in loop.expansion(omega, order)]


def _crossing(kind: Int[Array, "..."], L: Complex[Array, "..."]) -> Float[Array, "..."]:
    """Zero where `L` is real, or for the second kind where it is 1 in size."""
    length = norm(L, ())
    return xp.where(kind == 0, xp.imag(L) / length, xp.log(length))


def _follow(
    loop: StateSpace,
    kind: Int[Array, " margins"],
    omega: Float[Array, " margins"],
    exists: Bool[Array, " margins"],
) -> Float[Array, " margins"]:
    """The crossings `omega` with their derivatives in the loop.

    Two Newton steps from a converged point: their values change nothing but rounding,
    and their derivatives are those of the crossing to third order.
    """
    # At zero and at the Nyquist frequency a loop is real whatever its parameters: these
    # crossings do not move, but that pi / dt moves with the step.
    dt, moves = loop.dt, exists & (omega > 0)
    if dt is not None:
        nearly = xp.pi * (1 - 10 * xp.finfo(omega.dtype).eps)
        at_nyquist = omega * stop_gradient(dt) > nearly
        moves = moves & ~at_nyquist
        omega = xp.where(at_nyquist, xp.pi / dt, omega)

    def newton(_, crossed):
        L, change = _scalars(loop, crossed, 1)
        relative = change / L
        turn = xp.real(L) / norm(L, ()) * xp.imag(relative)
        slope = xp.where(kind == 0, turn, xp.real(relative))
        g = _crossing(kind, L)
        return crossed - xp.where(moves, g / xp.where(moves, slope, 1), 0)

    crossed = fori_loop(0, 2, newton, xp.where(moves, omega, 1))
    return xp.where(moves, crossed, omega)


def _crossings(
    loop: StateSpace,
) -> tuple[Float[Array, "2 crossings"], Bool[Array, "2 crossings"]]:
    """Frequencies where the loop is real, and where it is 1 in size.

    **Returns:** two rows of frequencies, and which of them are crossings.
    """
    A, B, C, D, _ = loop
    precision = xp.finfo(A.dtype)
    eps = precision.eps
    if loop.is_discrete:
        scale = xp.ones((), A.dtype)
        # A pole at z = -1 would map to infinity: it is perturbed to stay finite.
        axis = loop._replace(A=loop.A * (1 - 10 * eps)).bilinear_transform()
    else:
        # Frequencies in units of the closed loop's poles: then the angles below, the
        # arc tangents of frequencies, are well spread.
        sizes = xp.abs(eigenvalues(A - B @ C))
        scale = xp.exp(xp.mean(xp.log(xp.where(sizes > 0, sizes, 1))))
        axis = StateSpace(A / scale, B / scale, C, D, None)
    kinds = xp.array([[0], [1]])

    def omega(phi):
        """The frequency of an angle in `[0, pi/2]`, which covers the whole axis."""
        return scale * xp.tan(phi) if loop.dt is None else 2 * phi / loop.dt

    def values(phi):
        """Both crossing functions, at two rows of angles."""
        return _crossing(kinds, _scalars(loop, omega(phi))[0])

    nodes = xp.concatenate([_real_frequencies(axis), _unit_frequencies(axis)])
    nodes = xp.arctan(xp.where(xp.isfinite(nodes), nodes, 0))
    ends = xp.array([0, xp.pi / 2], A.dtype)
    nodes = xp.sort(xp.concatenate([ends, nodes]))
    between = (nodes[1:] + nodes[:-1]) / 2
    between = xp.stack([between, between])
    signs = values(between)
    # Sign changes below rounding error are ignored.
    is_reliable = xp.isfinite(signs) & (xp.abs(signs) > eps**0.5)
    # Each midpoint is compared with the last reliable one before it.
    indices = xp.arange(signs.shape[1])
    last = lax.cummax(xp.where(is_reliable, indices, -1), axis=1)[:, :-1]
    low, high = xp.take_along_axis(between, last, axis=1), between[:, 1:]
    low_sign = xp.sign(xp.take_along_axis(signs, last, axis=1))
    crosses = is_reliable[:, 1:] & (last >= 0) & (low_sign != xp.sign(signs[:, 1:]))
    # A loop of n states crosses at most n times. The other intervals come last.
    order = xp.argsort(indices[1:] + xp.where(crosses, 0, len(nodes)), axis=1)
    low, high, low_sign, crosses = (
        xp.take_along_axis(row, order[:, : len(A)], axis=1)
        for row in (low, high, low_sign, crosses)
    )

    def halve(_, bracket):
        low, high = bracket
        middle = (low + high) / 2
        before = xp.sign(values(middle)) == low_sign
        return xp.where(before, middle, low), xp.where(before, high, middle)

    # Bisection to rounding, as it cannot leave the bracket: Newton's method follows in
    # `_follow`.
    low, high = fori_loop(0, precision.nmant + 8, halve, (low, high))
    phi = (low + high) / 2
    # At a pole or a zero on the axis the sign jumps without a root.
    crosses = crosses & (xp.abs(values(phi)) < eps**0.25)
    # A loop is real at both ends; a strictly proper one is zero at infinity.
    at_ends = xp.array([[True, loop.is_discrete], [False, False]])
    phi = xp.concatenate([phi, xp.stack([ends, ends])], axis=1)
    return omega(phi), xp.concatenate([crosses, at_ends], axis=1)


def _real_frequencies(loop: StateSpace) -> Float[Array, " nodes"]:
    """Zeros of `L(s) - L(-s)`: eigenvalues of an inverse system, at two points."""
    A, B, C, *_ = loop
    # Where g(s) = L(s) - L(-s) is zero, 1 / g has a pole: an eigenvalue of the inverse
    # system, which exists in a variable 1 / (point - s), as g(point) is not zero.
    zero = xp.zeros_like(A)
    both_A = xp.block([[A, zero], [zero, -A]])
    both_B, both_C = xp.concatenate([B, B]), xp.concatenate([C, C], axis=1)
    eye = xp.eye(both_A.shape[0], dtype=A.dtype)
    right = xp.concatenate([eye, both_B], axis=1)
    frequencies = []
    # Two points, neither of which is likely to be a pole or a zero itself.
    for point in (0.7368, 1.3719):
        solved = lu_solve(point * eye - both_A, right)
        F, FB = solved[:, : len(eye)], solved[:, len(eye) :]
        inverse = FB @ (both_C @ F) / (both_C @ FB) - F
        frequencies.append(_distinct(1 / eigenvalues(inverse)))
    return xp.concatenate(frequencies)


def _unit_frequencies(loop: StateSpace) -> Float[Array, " nodes"]:
    """Zeros of `1 - L(-s) L(s)`: eigenvalues of a Hamiltonian."""
    A, B, C, D, _ = loop
    # R = I - D'D of the Hamiltonian at level 1, perturbed where it is singular.
    remainder = 1 - D[0, 0] ** 2
    remainder = xp.where(remainder == 0, xp.finfo(A.dtype).eps, remainder)
    F = A + B @ C * D[0, 0] / remainder
    H = xp.block([[F, B @ B.T / remainder], [-C.T @ C / remainder, -F.T]])
    return _distinct(eigenvalues(H))


def _distinct(points: Complex[Array, " points"]) -> Float[Array, " nodes"]:
    """The sizes of the imaginary parts of pairs of conjugates; of real points zero."""
    return xp.sort(xp.abs(xp.imag(points)))[::2]
