"""Gains of linear models: at a frequency, and the H2 and H-infinity norms."""

import equinox as eqx
import numpy as np
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
from ..math._norms import one_if_zero
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
    r"""The frequency response: the complex gain from inputs to outputs.

    $$G(s) = C (s I - A)^{-1} B$$

    where $s = j \omega$, or $s = e^{j \omega \Delta t}$ in discrete time. The response
    is infinite at a frequency at which the model has a pole. The response is
    differentiable with respect to the model and to `omega`.

    **Arguments:**

    - `model`: a [`delucax.systems.LinearSystem`][], or time-invariant
        [`delucax.LinearDynamics`][].
    - `omega`: angular frequencies $\omega$, in radians per unit of time, any shape.
    - `inputs`: the inputs of the model, `"controls"` (default) with the matrix $B$, or
        `"disturbances"` with the matrix $E$.

    **Returns:** a complex array, with the shape of `omega` followed by `(p, m)`.

    **Raises:** `ValueError` if `model` is not linear or is time-varying, if `omega` is
    not finite, or `inputs` is unknown.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        system = dlx.systems.LinearSystem(-jnp.eye(1), jnp.eye(1))
        gains = dlx.analysis.frequency_response(system, jnp.array([0.0, 1.0]))
        20 * jnp.log10(jnp.abs(gains[:, 0, 0]))  # in decibels
        ```

        ```text
        Array([ 0.  , -3.01], dtype=float32)
        ```
    """
    where = "frequency_response"
    system = state_space(model, inputs, where)
    # At infinite frequency the response is zero, so it is probably a mistake.
    array = as_float_array(omega)
    real = eqx.is_inexact_array(array) and not xp.iscomplexobj(array)
    if not real or is_concrete(array) and not np.all(np.isfinite(array)):
        raise ValueError(f"{where}: omega must be real and finite, got {array}.")
    return _responses(system, array)


@compiled_unless_on_host
def _responses(
    system: StateSpace, omega: Float[Array, "*frequencies"]
) -> Complex[Array, "*frequencies p m"]:
    gains = system.response(omega.astype(system.A.dtype).reshape(-1))
    # At a pole the gain is infinite.
    gains = xp.where(xp.isfinite(gains), gains, system.infinity())
    return gains.reshape(*omega.shape, *gains.shape[1:])


@host_unless_traced
def dcgain(
    model: LinearModel, *, inputs: str = "controls", throw: bool = True
) -> Float[Array, "p m"]:
    r"""The steady-state (DC) gain from inputs to outputs.

    $$-C A^{-1} B, \quad \text{or in discrete time} \quad C (I - A)^{-1} B$$

    **Arguments:**

    - `model`: a [`delucax.systems.LinearSystem`][], or time-invariant
        [`delucax.LinearDynamics`][]. It need not be stable.
    - `inputs`: the inputs of the model, `"controls"` (default) with the matrix $B$, or
        `"disturbances"` with the matrix $E$.
    - `throw`: raise an error if the model has an integrator, which is a pole at
        frequency zero (default). If false, return infinity.

    **Returns:** the gain, shape `(p, m)`.

    **Raises:** `ValueError` if `model` is not linear or is time-varying, or `inputs` is
    unknown. With `throw`, an error at run time if the model has an integrator.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[0.0, 1.0], [-2.0, -3.0]])
        B = jnp.array([[0.0], [1.0]])
        dlx.analysis.dcgain(dlx.systems.LinearSystem(A, B))
        ```

        ```text
        Array([[0.5],
               [0. ]], dtype=float32)
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
    # With rows and columns of one size, because states and times have any units.
    scaled = stop_gradient(matrix)
    for axis in (1, 0):
        sizes = xp.max(xp.abs(scaled), axis=axis, keepdims=True)
        scaled = scaled / one_if_zero(sizes)
    values = xp.linalg.svd(scaled, compute_uv=False)
    eps = xp.finfo(values.dtype).eps
    singular = ~(values[-1] > len(values) * eps * values[0])
    invertible = xp.where(singular, system.eye, matrix)
    gain = system.C @ lu_solve(invertible, system.B) + system.D
    return xp.where(singular, system.infinity(), gain), singular


_LEVELS = 30
_SWEEP = 64
"""The number of frequencies at the start, besides those of the poles."""
_NEWTON_STEPS = 5


class PeakGain(eqx.Module):
    """The largest gain of a model over all frequencies, and the frequency of the peak.

    **Attributes:**

    - `gain`: the H-infinity norm; infinite if the model is not stable.
    - `frequency`: the frequency of the largest gain, in radians per unit of time. If
        the model is not stable, `frequency` is the frequency of the least stable pole.
    - `result`: success, or the reason for a failure; one of `delucax.RESULTS`.

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

        ```text
        (Array(14.147, dtype=float32), Array(0.999, dtype=float32))
        ```
    """

    gain: Scalar
    frequency: Scalar
    result: Result

    __repr__ = shown


@host_unless_traced
def h2_norm(model: LinearModel, *, inputs: str = "controls") -> Scalar:
    r"""The H2 norm: the root mean square of the outputs under unit white noise.

    $$\sqrt{\mathrm{tr}(C W C^\top)}$$

    with the controllability Gramian $W$. The square of the norm is also the energy of
    the impulse response, summed over all inputs and outputs. The norm is infinite if
    the model is not stable. The norm is differentiable to any order, in forward and
    reverse mode.

    **Arguments:**

    - `model`: a [`delucax.systems.LinearSystem`][], or time-invariant
        [`delucax.LinearDynamics`][].
    - `inputs`: the inputs of the model, `"controls"` (default) with the matrix $B$, or
        `"disturbances"` with the matrix $E$.

    **Returns:** the norm, a scalar. The norm is NaN if a traced model contains a number
    that is not finite.

    **Raises:** `ValueError` if `model` is not linear or is time-varying, or `inputs` is
    unknown.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A, B = jnp.array([[0.5]]), jnp.array([[1.0]])
        dlx.analysis.h2_norm(dlx.LinearDynamics(A, B))
        ```

        ```text
        Array(1.1547, dtype=float32)
        ```
    """
    return _h2_norm(state_space(model, inputs, "h2_norm"))


@compiled_unless_on_host
def _h2_norm(system: StateSpace) -> Scalar:
    stable = system.is_stable()
    W = stable_gramian(system.stable_or_placeholder(stable))
    # The square root has no derivative at zero, so the unused branch uses 1.
    square = xp.trace(system.C @ W @ system.C.T)
    # Negated, so that a NaN stays NaN.
    positive = ~(square <= 0)
    norm = xp.where(positive, xp.sqrt(xp.where(positive, square, 1)), 0)
    norm = xp.where(stable, norm, xp.inf)
    return xp.where(system.is_finite(), norm, xp.nan)


@host_unless_traced
def hinf_norm(
    model: LinearModel, *, inputs: str = "controls", throw: bool = True
) -> PeakGain:
    r"""The H-infinity norm: the largest gain of a model over all frequencies.

    $$\max_\omega \; \sigma_{\max} \left( C (s I - A)^{-1} B \right)$$

    where $s = j \omega$, or $s = e^{j \omega \Delta t}$ in discrete time. The norm is
    infinite if the model is not stable.

    The frequencies at which the gain crosses a level are eigenvalues of a Hamiltonian
    matrix. The search sets a level just above the largest gain found so far, and
    evaluates the gain at the midpoints between the crossings of this level. The search
    stops when the gain crosses the level at no frequency. Newton steps then refine the
    peak.

    The norm has first and second derivatives, in forward and reverse mode, if the
    largest gain occurs at only one frequency and in only one direction of the inputs.
    If the largest gain occurs at several frequencies or in several directions, the
    derivatives are those of one of them.

    **Arguments:**

    - `model`: a [`delucax.systems.LinearSystem`][], or time-invariant
        [`delucax.LinearDynamics`][].
    - `inputs`: the inputs of the model, `"controls"` (default) with the matrix $B$, or
        `"disturbances"` with the matrix $E$.
    - `throw`: raise an error if the search does not converge (default). If false, check
        `result`.

    **Returns:** a [`delucax.analysis.PeakGain`][]. If a traced model contains a number
    that is not finite, the gain is NaN and `result` is `RESULTS.ill_posed`.

    **Raises:** `ValueError` if `model` is not linear or is time-varying, or `inputs` is
    unknown. With `throw`, an error at run time if the search does not converge.

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

        ```text
        (Array(10.0125, dtype=float32), Array(0.9975, dtype=float32))
        ```
    """
    peak = peak_gain(state_space(model, inputs, "hinf_norm"))
    return raise_on_failure(peak, "hinf_norm", throw)


@compiled_unless_on_host
def peak_gain(system: StateSpace) -> PeakGain:
    """The largest gain of a model that may have a feed-through `D`."""
    poles = eigenvalues(stop_gradient(system.A))
    growth = system.growth(poles)
    stable = xp.all(growth < 0)
    safe = system.stable_or_placeholder(stable)
    # The search is not differentiated. The gain is stationary in the frequency at the
    # peak, so its first derivatives are those at a fixed frequency.
    frozen = stop_gradient(safe)
    start, ended = _search(frozen)
    top, curvature, moves = _climb(frozen, start)
    finite = xp.isfinite(top)
    gain, slope, _ = expanded_gain(*safe.expansion(xp.where(finite, top, 1), 2))
    rise = xp.where(moves, slope - stop_gradient(slope), 0)
    # A Newton step whose value is zero. It carries the implicit derivative of the
    # maximiser.
    step = -rise / curvature
    gain = gain + step * slope + step**2 * curvature / 2
    gain, frequency = xp.where(finite, gain, largest_gain(safe.D)), top + step
    # An unstable model has no peak. Take the frequency of the least stable pole.
    least = poles[xp.argmax(growth)]
    if system.dt is None:
        at_pole = xp.abs(xp.imag(least))
    else:
        at_pole = xp.abs(xp.angle(least)) / stop_gradient(system.dt)
    gain = xp.where(stable, gain, xp.inf)
    frequency = xp.where(stable, frequency, at_pole)
    result = choose(ended, RESULTS.successful, RESULTS.not_converged)
    # The search passes over NaN.
    posed = system.is_finite()
    return PeakGain(
        xp.where(posed, gain, xp.nan),
        xp.where(posed, frequency, xp.nan),
        choose(posed, result, RESULTS.ill_posed),
    )


def _climb(system: StateSpace, omega: Scalar) -> tuple[Scalar, Scalar, BoolScalar]:
    """Refine the peak by Newton steps while the gain increases.

    **Returns:** the frequency, the curvature of the gain, and whether the frequency
    depends on the plant. It does not at the ends of the frequency axis.
    """
    rounding = 100 * xp.finfo(omega.dtype).eps

    def step(_, carry):
        best, flattest, top, top_curvature, moves, trial = carry
        # There is no slope at an infinite frequency. The result at 1 is not used.
        finite = xp.isfinite(trial)
        at = xp.where(finite, trial, 1)
        gain, slope, curvature = expanded_gain(*system.expansion(at, 2))
        usable = finite & (curvature < 0) & xp.isfinite(slope) & xp.isfinite(curvature)
        # A Newton step increases the gain only if the curvature is negative.
        curvature = xp.where(usable, curvature, -1)
        # Near the peak gains differ only by rounding, so the slope decides.
        up = usable & (gain >= best) & (xp.abs(slope) < flattest) & (trial >= 0)
        top = xp.where(up, trial, top)
        return (
            # Minus rounding, because the next gain may be equal in exact arithmetic.
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
        """The frequencies of all eigenvalues of the Hamiltonian at a level.

        Eigenvalues off the axis are not crossings, but it does no harm to evaluate the
        gain there too.
        """
        # G(j omega) has the singular value `level` if j omega is an eigenvalue of H.
        m, p = D.shape[1], D.shape[0]
        R = level**2 * xp.eye(m, dtype=D.dtype) - D.T @ D
        S = level**2 * xp.eye(p, dtype=D.dtype) - D @ D.T
        solved = lu_solve(R, xp.concatenate([D.T @ C, B.T], axis=1))
        F = A + B @ solved[:, :n]
        upper, lower = level * B @ solved[:, n:], level * C.T @ lu_solve(S, C)
        H = xp.block([[F, upper], [-lower, -F.T]])
        # Eigenvalues come in pairs s, -s.
        omegas = xp.sort(xp.abs(xp.imag(eigenvalues(H))))[::2]
        return xp.concatenate([xp.zeros(1, A.dtype), omegas])

    def more(carry):
        _, _, ended, k = carry
        return ~ended & (k < _LEVELS)

    def body(carry):
        gain_now, omega_now, _, k = carry
        # The Hamiltonian is not finite at the level of D, and not accurate close to it.
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
