"""Frequencies at which a loop gain is real, and at which it has the modulus 1."""

from jaxtyping import Bool, Complex, Float, Int

from .._jax import fori_loop, lax, stop_gradient, xp
from .._typing import Array
from ..math._linear_solve import eigenvalues, lu_solve
from ._state_space import norm, StateSpace


ANYWHERE = 0.7368
"""A frequency in place of one that does not exist. It has many digits, because at 1 a
loop might have a pole."""


def gains(
    loop: StateSpace, omega: Float[Array, "*frequencies"], order: int = 0
) -> list[Complex[Array, "*frequencies"]]:
    """The gain of the loop, and its derivatives up to `order`."""
    return [gain[..., 0, 0] for gain in loop.expansion(omega, order)]


def _crossing(kind: Int[Array, "..."], L: Complex[Array, "..."]) -> Float[Array, "..."]:
    """Zero if `L` is real (kind 0), or if it has the modulus 1 (kind 1)."""
    length = norm(L, ())
    return xp.where(kind == 0, xp.imag(L) / length, xp.log(length))


def follow(
    loop: StateSpace,
    kind: Int[Array, " margins"],
    omega: Float[Array, " margins"],
    exists: Bool[Array, " margins"],
) -> Float[Array, " margins"]:
    """The crossings `omega` with their derivatives with respect to the loop.

    These are two Newton steps from a converged point. Their values change only by
    rounding, and their derivatives are those of the crossing, up to third order.
    """
    # At zero and at the Nyquist frequency the loop is real for any parameters, so these
    # crossings do not move. But pi / dt depends on the step dt.
    dt, moves = loop.dt, exists & (omega > 0)
    if dt is not None:
        nearly = xp.pi * (1 - 10 * xp.finfo(omega.dtype).eps)
        at_nyquist = omega * stop_gradient(dt) > nearly
        moves = moves & ~at_nyquist
        omega = xp.where(at_nyquist, xp.pi / dt, omega)

    def newton(_, crossed):
        L, change = gains(loop, crossed, 1)
        # The loop may be zero there.
        L = xp.where(moves, L, 1)
        relative = change / L
        turn = xp.real(L) / norm(L, ()) * xp.imag(relative)
        slope = xp.where(kind == 0, turn, xp.real(relative))
        g = _crossing(kind, L)
        return crossed - xp.where(moves, g / xp.where(moves, slope, 1), 0)

    crossed = fori_loop(0, 2, newton, xp.where(moves, omega, ANYWHERE))
    return xp.where(moves, crossed, omega)


def crossings(
    loop: StateSpace,
) -> tuple[Float[Array, "2 crossings"], Bool[Array, "2 crossings"]]:
    """Frequencies at which the loop is real, and at which it has the modulus 1.

    **Returns:** two rows of frequencies, and which of them are crossings.
    """
    A, B, C, D, _ = loop
    precision = xp.finfo(A.dtype)
    eps = precision.eps
    if loop.is_discrete:
        scale = xp.ones((), A.dtype)
        # A pole at z = -1 would map to infinity, so A is perturbed by rounding.
        axis = loop._replace(A=loop.A * (1 - 10 * eps)).bilinear_transform()
    else:
        # In units of the poles of the closed loop, the angles below, which are the arc
        # tangents of frequencies, are well spread.
        sizes = xp.abs(eigenvalues(A - B @ C))
        scale = xp.exp(xp.mean(xp.log(xp.where(sizes > 0, sizes, 1))))
        axis = StateSpace(A / scale, B / scale, C, D, None)
    kinds = xp.array([[0], [1]])

    def omega(phi):
        """The frequency for an angle; `[0, pi/2]` covers all frequencies."""
        return scale * xp.tan(phi) if loop.dt is None else 2 * phi / loop.dt

    def values(phi):
        """The two crossing functions, each at its row of angles."""
        return _crossing(kinds, gains(loop, omega(phi))[0])

    nodes = xp.concatenate([_real_frequencies(axis), _unit_frequencies(axis)])
    nodes = xp.arctan(xp.where(xp.isfinite(nodes), nodes, 0))
    ends = xp.array([0, xp.pi / 2], A.dtype)
    nodes = xp.sort(xp.concatenate([ends, nodes]))
    between = (nodes[1:] + nodes[:-1]) / 2
    between = xp.stack([between, between])
    signs = values(between)
    # Values that are only rounding have no reliable sign.
    is_reliable = xp.isfinite(signs) & (xp.abs(signs) > eps**0.5)
    # Each midpoint is compared with the last reliable midpoint before it.
    indices = xp.arange(signs.shape[1])
    last = lax.cummax(xp.where(is_reliable, indices, -1), axis=1)[:, :-1]
    low, high = xp.take_along_axis(between, last, axis=1), between[:, 1:]
    low_sign = xp.sign(xp.take_along_axis(signs, last, axis=1))
    crosses = is_reliable[:, 1:] & (last >= 0) & (low_sign != xp.sign(signs[:, 1:]))
    # A loop with n states has at most n crossings. The other intervals come last.
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

    # Bisection to rounding, because it cannot leave the bracket. `follow` adds Newton
    # steps.
    low, high = fori_loop(0, precision.nmant + 8, halve, (low, high))
    phi = (low + high) / 2
    # At a pole or zero on the axis the sign changes, but there is no crossing.
    crosses = crosses & (xp.abs(values(phi)) < eps**0.25)
    # A loop is real at both ends, but zero at infinity in continuous time.
    at_ends = xp.array([[True, loop.is_discrete], [False, False]])
    phi = xp.concatenate([phi, xp.stack([ends, ends])], axis=1)
    return omega(phi), xp.concatenate([crosses, at_ends], axis=1)


def _real_frequencies(loop: StateSpace) -> Float[Array, " nodes"]:
    """Frequencies of the zeros of `L(s) - L(-s)`, as eigenvalues of inverse systems."""
    A, B, C, *_ = loop
    # A zero of g(s) = L(s) - L(-s) is a pole of 1 / g, so an eigenvalue of the inverse
    # system. It exists in the variable 1 / (point - s), because g(point) is not zero.
    zero = xp.zeros_like(A)
    both_A = xp.block([[A, zero], [zero, -A]])
    both_B, both_C = xp.concatenate([B, B]), xp.concatenate([C, C], axis=1)
    eye = xp.eye(both_A.shape[0], dtype=A.dtype)
    right = xp.concatenate([eye, both_B], axis=1)
    frequencies = []
    # Two points, because one might be a pole or a zero itself.
    for point in (0.7368, 1.3719):
        solved = lu_solve(point * eye - both_A, right)
        F, FB = solved[:, : len(eye)], solved[:, len(eye) :]
        inverse = FB @ (both_C @ F) / (both_C @ FB) - F
        frequencies.append(_distinct(1 / eigenvalues(inverse)))
    return xp.concatenate(frequencies)


def _unit_frequencies(loop: StateSpace) -> Float[Array, " nodes"]:
    """Frequencies of the zeros of `1 - L(-s) L(s)`, as eigenvalues of a Hamiltonian."""
    A, B, C, D, _ = loop
    # R = I - D'D of the Hamiltonian at level 1, perturbed if it is singular.
    remainder = 1 - D[0, 0] ** 2
    remainder = xp.where(remainder == 0, xp.finfo(A.dtype).eps, remainder)
    F = A + B @ C * D[0, 0] / remainder
    H = xp.block([[F, B @ B.T / remainder], [-C.T @ C / remainder, -F.T]])
    return _distinct(eigenvalues(H))


def _distinct(points: Complex[Array, " points"]) -> Float[Array, " nodes"]:
    """The absolute imaginary parts of the points, one for each conjugate pair."""
    return xp.sort(xp.abs(xp.imag(points)))[::2]
