"""Gains from inputs to outputs: at a frequency, and the H2 and H-infinity norms."""

import equinox as eqx
from jaxtyping import ArrayLike, Complex, Float

from .._check import is_concrete
from .._jax import (
    compiled_unless_on_host,
    fori_loop,
    host_unless_traced,
    stop_gradient,
    while_loop,
    xp,
)
from .._module import as_float_array, shown
from .._results import choose, raise_if, raise_on_failure, Result, RESULTS
from .._typing import Array, BoolScalar, Scalar
from ..math._linear_solve import eigenvalues, lu_solve
from ._gramians import stable_gramian
from ._state_space import (
    expanded_gain,
    largest_gain,
    LinearModel,
    state_space,
    StateSpace,
)


@host_unless_traced
def frequency_response(
    model: LinearModel, omega: ArrayLike, *, inputs: str = "controls"
) -> Complex[Array, "*frequencies p m"]:
    """The complex gain `C (s I - A)^-1 B` from inputs to outputs,

    at `s = j omega`, or in discrete time at `exp(j omega dt)`.

    Differentiable with respect to the model and to `omega`. At a frequency where a pole
    is on the boundary of stability it is infinite.

    **Arguments:**

    - `model`: a [`delucax.systems.LinearSystem`][], or time-invariant
        [`delucax.LinearDynamics`][].
    - `omega`: angular frequencies, in radians per unit of time, any shape.
    - `inputs`: `"controls"` (default), or `"disturbances"`: `E` in the place of `B`.

    **Returns:** the shape of `omega` and then `(p, m)`, complex.

    **Raises:** `ValueError` if `model` is not linear or is time-varying, if `omega` is
    not finite, or `inputs` is unknown.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        upright = dlx.linearize(dlx.systems.Pendulum())
        gains = dlx.analysis.frequency_response(upright, jnp.logspace(-1, 2, 50))
        decibels = 20 * jnp.log10(jnp.abs(gains[:, 0, 0]))
        ```
    """
    where = "frequency_response"
    system = state_space(model, inputs, where)
    # Infinite frequencies are refused: the response there is D alone.
    array = as_float_array(omega)
    real = eqx.is_inexact_array(array) and not xp.iscomplexobj(array)
    if not real or is_concrete(array) and not bool(xp.all(xp.isfinite(array))):
        raise ValueError(f"{where}: omega must be real and finite, got {array}.")
    return _responses(system, array)


@compiled_unless_on_host
def _responses(
    system: StateSpace, omega: Float[Array, "*frequencies"]
) -> Complex[Array, "*frequencies p m"]:
    gains = system.response(omega.astype(system.A.dtype).reshape(-1))
    gains = xp.where(xp.isfinite(gains), gains, xp.inf)
    return gains.reshape(*omega.shape, *gains.shape[1:])


@host_unless_traced
def dcgain(
    model: LinearModel, *, inputs: str = "controls", throw: bool = True
) -> Float[Array, "p m"]:
    """The steady-state (DC) gain from inputs to outputs,

    `-C A^-1 B`, or in discrete time `C (I - A)^-1 B`.

    **Arguments:**

    - `model`: a [`delucax.systems.LinearSystem`][], or time-invariant
        [`delucax.LinearDynamics`][]. It need not be stable.
    - `inputs`: `"controls"` (default), or `"disturbances"`: `E` in the place of `B`.
    - `throw`: raise if there is a pole at frequency zero, an integrator (default); if
        false, return infinity there.

    **Returns:** shape `(p, m)`.

    **Raises:** `ValueError` if `model` is not linear or is time-varying, or `inputs` is
    unknown; an error at run time as `throw` says.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[0.0, 1.0], [-2.0, -3.0]])
        B = jnp.array([[0.0], [1.0]])
        dlx.analysis.dcgain(dlx.systems.LinearSystem(A, B))  # 1/2 and 0
        ```
    """
    gain, has_integrator = _dcgain(state_space(model, inputs, "dcgain"))
    message = (
        "dcgain: a pole is at frequency zero (an integrator), so the DC gain is "
        "infinite. Pass throw=False to return infinity."
    )
    return raise_if(has_integrator, gain, message) if throw else gain


@compiled_unless_on_host
def _dcgain(system: StateSpace) -> tuple[Float[Array, "p m"], BoolScalar]:
    # A pole at frequency zero makes this matrix singular, up to rounding.
    matrix = system.eye - system.A if system.is_discrete else -system.A
    values = xp.linalg.svd(stop_gradient(matrix), compute_uv=False)
    eps = xp.finfo(values.dtype).eps
    singular = ~(values[-1] > len(values) * eps * values[0])
    invertible = xp.where(singular, system.eye, matrix)
    gain = system.C @ lu_solve(invertible, system.B) + system.D
    return xp.where(singular, xp.inf, gain), singular


_LEVELS = 30
_SWEEP = 64
"""Frequencies to begin with, besides those of the poles."""
_NEWTON_STEPS = 5


class PeakGain(eqx.Module):
    """The largest gain over all frequencies, and where it is.

    **Attributes:**

    - `gain`: the H-infinity norm; infinite if the model is not stable.
    - `frequency`: where the gain is largest, in radians per unit of time; of the least
        stable pole if the model is not stable.
    - `result`: success, or why not; one of `delucax.RESULTS`.

    `gain` and `frequency` are differentiable.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[0.0, 1.0], [-1.0, -0.1]])
        B = jnp.array([[0.0], [1.0]])
        peak = dlx.analysis.hinf_norm(dlx.systems.LinearSystem(A, B))
        peak.gain, peak.frequency
        ```
    """

    gain: Scalar
    frequency: Scalar
    result: Result

    __repr__ = shown


@host_unless_traced
def h2_norm(model: LinearModel, *, inputs: str = "controls") -> Scalar:
    """The H2 norm: the root of the outputs' mean square under unit white noise,

    `sqrt(trace(C W C'))`, `W` being the controllability Gramian; the same as the root
    of the sum, over inputs, of the energy of the outputs after an impulse.

    Infinite if a pole is on or outside the boundary of stability. Differentiable to any
    order, in either mode.

    **Arguments:**

    - `model`: a [`delucax.systems.LinearSystem`][], or time-invariant
        [`delucax.LinearDynamics`][].
    - `inputs`: `"controls"` (default), or `"disturbances"`: `E` in the place of `B`.

    **Returns:** a scalar.

    **Raises:** `ValueError` if `model` is not linear or is time-varying, or `inputs` is
    unknown.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A, B = jnp.array([[0.5]]), jnp.array([[1.0]])
        dlx.analysis.h2_norm(dlx.LinearDynamics(A, B))  # sqrt(4/3)
        ```
    """
    return _h2_norm(state_space(model, inputs, "h2_norm"))


@compiled_unless_on_host
def _h2_norm(system: StateSpace) -> Scalar:
    stable = system.is_stable()
    W = stable_gramian(system.stable_or_placeholder(stable))
    # The square root has no derivative at zero: the branch not taken is that of 1.
    square = xp.trace(system.C @ W @ system.C.T)
    positive = square > 0
    norm = xp.where(positive, xp.sqrt(xp.where(positive, square, 1)), 0)
    return xp.where(stable, norm, xp.inf)


@host_unless_traced
def hinf_norm(
    model: LinearModel, *, inputs: str = "controls", throw: bool = True
) -> PeakGain:
    r"""The H-infinity norm: the largest gain that any sinusoid meets,

    `max over omega of sigma_max(C (s I - A)^-1 B)`, at `s = j omega`, or in discrete
    time at `exp(j omega dt)`.

    The frequencies at which the gain crosses a level just above the largest one so far
    are eigenvalues of a Hamiltonian matrix. The gain is evaluated again at their
    midpoints until no crossing remains, and Newton steps refine the peak. Infinite if a
    pole is on or outside the boundary of stability.

    It has first and second derivatives, in either mode, where the maximum is attained
    at one frequency in one direction alone; elsewhere the derivatives of one maximiser
    are returned.

    **Arguments:**

    - `model`: a [`delucax.systems.LinearSystem`][], or time-invariant
        [`delucax.LinearDynamics`][].
    - `inputs`: `"controls"` (default), or `"disturbances"`: `E` in the place of `B`.
    - `throw`: raise if the search does not converge (default); if false, check
        `result`.

    **Returns:** a [`delucax.analysis.PeakGain`][].

    **Raises:** `ValueError` if `model` is not linear or is time-varying, or `inputs` is
    unknown; an error at run time as `throw` says.

    Source: Bruinsma and Steinbuch, 1990; Boyd and Balakrishnan, 1990.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A, B = jnp.array([[0.0, 1.0], [-1.0, -0.1]]), jnp.array([[0.0], [1.0]])
        system = dlx.systems.LinearSystem(A, B, C=jnp.array([[1.0, 0.0]]))
        peak = dlx.analysis.hinf_norm(system)
        peak.gain, peak.frequency
        ```
    """
    peak = peak_gain(state_space(model, inputs, "hinf_norm"))
    return raise_on_failure(peak, "hinf_norm", throw)


@compiled_unless_on_host
def peak_gain(system: StateSpace) -> PeakGain:
    """The largest gain of a model with a feed-through `D`."""
    poles = eigenvalues(stop_gradient(system.A))
    growth = system.growth(poles)
    stable = xp.all(growth < 0)
    safe = system.stable_or_placeholder(stable)
    # The search is not differentiated: the peak is stationary in the frequency, so that
    # the gain's derivatives are those at a fixed frequency (the envelope theorem).
    frozen = stop_gradient(safe)
    start, ended = _search(frozen)
    top, curvature, moves = _climb(frozen, start)
    finite = xp.isfinite(top)
    gain, slope, _ = expanded_gain(*safe.expansion(xp.where(finite, top, 1), 2))
    rise = xp.where(moves, slope - stop_gradient(slope), 0)
    # One Newton step, numerically zero: it carries the implicit derivative of the
    # maximiser.
    step = -rise / curvature
    gain = gain + step * slope + step**2 * curvature / 2
    gain, frequency = xp.where(finite, gain, largest_gain(safe.D)), top + step
    # An unstable model has no peak: the frequency is that of its least stable pole.
    least = poles[xp.argmax(growth)]
    if system.dt is None:
        at_pole = xp.abs(xp.imag(least))
    else:
        at_pole = xp.abs(xp.angle(least)) / stop_gradient(system.dt)
    return PeakGain(
        xp.where(stable, gain, xp.inf),
        xp.where(stable, frequency, at_pole),
        choose(ended, RESULTS.successful, RESULTS.not_converged),
    )


def _climb(system: StateSpace, omega: Scalar) -> tuple[Scalar, Scalar, BoolScalar]:
    """The peak, refined by Newton steps while the gain rises.

    **Returns:** its frequency, the curvature of the gain there, and whether its
    frequency depends on the plant, which at the ends of the axis it does not.
    """
    rounding = 100 * xp.finfo(omega.dtype).eps

    def step(_, carry):
        best, flattest, top, top_curvature, moves, trial = carry
        # At an infinite frequency there is no slope: the placeholder 1 is not used.
        finite = xp.isfinite(trial)
        at = xp.where(finite, trial, 1)
        gain, slope, curvature = expanded_gain(*system.expansion(at, 2))
        usable = finite & (curvature < 0) & xp.isfinite(slope) & xp.isfinite(curvature)
        # Newton's step on the slope goes up only where the curvature is negative.
        curvature = xp.where(usable, curvature, -1)
        # Near the peak gains differ by rounding alone, and the slope decides.
        up = usable & (gain >= best) & (xp.abs(slope) < flattest) & (trial >= 0)
        top = xp.where(up, trial, top)
        return (
            # Less its rounding: the next gain may be equal in exact arithmetic.
            xp.where(up, gain * (1 - rounding), best),
            xp.where(up, xp.abs(slope), flattest),
            top,
            xp.where(up, curvature, top_curvature),
            xp.where(up, top > 0, moves),
            xp.where(up, at - slope / curvature, trial),
        )

    low, steep = xp.zeros_like(omega), xp.full_like(omega, xp.inf)
    start = (low, steep, omega, -xp.ones_like(omega), xp.asarray(False), omega)
    *_, top, curvature, moves, _ = fori_loop(0, _NEWTON_STEPS, step, start)
    return top, curvature, moves


def _search(system: StateSpace) -> tuple[Scalar, BoolScalar]:
    """The frequency of the largest gain, and whether the search converged."""
    # In discrete time the bilinear transform maps the unit circle to the axis.
    axis = system.bilinear_transform() if system.is_discrete else system
    A, B, C, D, _ = axis
    n = A.shape[0]
    eps = xp.finfo(A.dtype).eps
    at_infinity = largest_gain(D)

    def best_of(gain_now, omega_now, omegas):
        gains = largest_gain(axis.response(omegas))
        gains = xp.where(xp.isnan(gains), -1, gains)
        k = xp.argmax(gains)
        better = gains[k] > gain_now
        gain_now = xp.where(better, gains[k], gain_now)
        return gain_now, xp.where(better, omegas[k], omega_now)

    # Resonances are near the poles. The sweep guards against a flat start.
    poles = eigenvalues(A)
    at_poles = xp.concatenate([xp.abs(poles), xp.abs(xp.imag(poles))])
    low, high = xp.log(xp.min(at_poles[:n]) / 100), xp.log(xp.max(at_poles) * 100)
    sweep = xp.exp(xp.linspace(low, high, _SWEEP, dtype=A.dtype))
    starts = xp.concatenate([xp.zeros(1, A.dtype), at_poles, sweep])
    infinity = xp.asarray(xp.inf, A.dtype)
    best = best_of(at_infinity, infinity, starts)

    def crossings(level):
        """Frequencies of the eigenvalues of the Hamiltonian at a level.

        Those of all eigenvalues: off the axis they are no crossings, but evaluating the
        gain there as well is cheap and harmless.
        """
        # A singular value of G(j omega) is `level` where j omega is an eigenvalue of H.
        m, p = D.shape[1], D.shape[0]
        R = level**2 * xp.eye(m, dtype=D.dtype) - D.T @ D
        S = level**2 * xp.eye(p, dtype=D.dtype) - D @ D.T
        solved = lu_solve(R, xp.concatenate([D.T @ C, B.T], axis=1))
        F = A + B @ solved[:, :n]
        upper, lower = level * B @ solved[:, n:], level * C.T @ lu_solve(S, C)
        H = xp.block([[F, upper], [-lower, -F.T]])
        # Eigenvalues come in pairs, s and -s.
        omegas = xp.sort(xp.abs(xp.imag(eigenvalues(H))))[::2]
        return xp.concatenate([xp.zeros(1, A.dtype), omegas])

    def more(carry):
        _, _, ended, k = carry
        return ~ended & (k < _LEVELS)

    def body(carry):
        gain_now, omega_now, _, k = carry
        # At the level of D the Hamiltonian is not finite, and close to it not accurate.
        is_close = gain_now < (1 + eps**0.375) * at_infinity
        # A smaller step would lose the crossings next to the peak in rounding.
        step = xp.where(is_close, eps**0.375, eps**0.625)
        level = (1 + step) * xp.where(gain_now > 0, gain_now, 1)
        nodes = crossings(level)
        between = (nodes[1:] + nodes[:-1]) / 2
        gain_next, omega_next = best_of(gain_now, omega_now, between)
        return gain_next, omega_next, ~(gain_next > level), k + 1

    start = (*best, xp.asarray(False), xp.asarray(0))
    _, omega, ended, _ = while_loop(more, body, start)
    return omega if system.dt is None else 2 * xp.arctan(omega) / system.dt, ended
