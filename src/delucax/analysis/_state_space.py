"""The state-space matrices of a linear model."""

from typing import Any, NamedTuple, TypeAlias

import jax
import lineax as lx
from jaxtyping import Complex, Float, Inexact

from .._check import check_choice
from .._check_models import check_time_invariant
from .._jax import on_host, stop_gradient, xp
from .._typing import Array, BoolScalar, Scalar, Square
from ..dynamics import LinearDynamics
from ..math._linear_solve import eigenvalues, factorised, lu_solve
from ..systems import LinearSystem


LinearModel: TypeAlias = LinearSystem | LinearDynamics


class StateSpace(NamedTuple):
    """The model `y = (C (s I - A)^-1 B + D) u`, with `s = z` in discrete time.

    `dt` is the step in discrete time, and `None` in continuous time.
    """

    A: Square
    B: Float[Array, "n m"]
    C: Float[Array, "p n"]
    D: Float[Array, "p m"]
    dt: Scalar | None

    @property
    def is_discrete(self) -> bool:
        return self.dt is not None

    @property
    def eye(self) -> Square:
        return xp.eye(self.A.shape[0], dtype=self.A.dtype)

    @property
    def dual(self) -> "StateSpace":
        """The transposed system, which swaps inputs and outputs."""
        return StateSpace(self.A.T, self.C.T, self.B.T, self.D.T, self.dt)

    def growth(self, poles: Complex[Array, "*poles"]) -> Float[Array, "*poles"]:
        """The real part of poles, or their modulus minus 1: negative if stable."""
        return xp.abs(poles) - 1 if self.is_discrete else xp.real(poles)

    def is_stable(self) -> BoolScalar:
        """Whether all poles are inside the boundary of stability."""
        poles = eigenvalues(stop_gradient(self.A))
        return xp.all(self.growth(poles) < 0)

    def is_finite(self) -> BoolScalar:
        """Whether all numbers are finite."""
        numbers = [xp.ravel(M) for M in self if M is not None]
        return xp.all(xp.isfinite(xp.concatenate(numbers)))

    def infinity(self) -> Scalar:
        """Infinity, for what a finite model has no finite value of; NaN if the model is
        not finite."""
        return xp.where(self.is_finite(), xp.inf, xp.nan).astype(self.A.dtype)

    def stable_or_placeholder(self, stable: BoolScalar) -> "StateSpace":
        """This system, or a stable placeholder if it is not stable, so that discarded
        results have finite derivatives."""
        return self._replace(A=xp.where(stable, self.A, -self.eye / 2))

    def response(
        self, omega: Float[Array, "*frequencies"]
    ) -> Complex[Array, "*frequencies p m"]:
        """The complex gain at finite frequencies."""
        return self.expansion(omega, 0)[0]

    def expansion(
        self, omega: Float[Array, "*frequencies"], order: int
    ) -> list[Complex[Array, "*frequencies p m"]]:
        """The complex gain and its derivatives with respect to the frequency, at most
        of second order."""
        if omega.ndim and not on_host():
            return jax.vmap(lambda omega: self.expansion(omega, order))(omega)
        # The point on the boundary of stability, and its derivatives.
        if self.dt is None:
            s = (1j * omega)[..., None, None]
            first, second = 1j, 0
        else:
            s = xp.exp(1j * omega * self.dt)[..., None, None]
            first, second = 1j * self.dt * s, -(self.dt**2) * s
        matrix = s * self.eye - self.A
        resolvent = factorised(matrix, lx.LU())
        # The derivatives of the resolvent R with respect to s are -R^2 and 2 R^3.
        X = [resolvent(self.B.astype(matrix.dtype))]
        for _ in range(order):
            X.append(resolvent(X[-1]))
        gains = [self.C @ X[0] + self.D]
        if order > 0:
            gains.append(-first * (self.C @ X[1]))
        if order > 1:
            gains.append(2 * first**2 * (self.C @ X[2]) - second * (self.C @ X[1]))
        return gains

    def bilinear_transform(self) -> "StateSpace":
        """The continuous-time system with the same gains as this discrete-time system,
        by the bilinear transform `z = (1 + s) / (1 - s)`."""
        A, B, C, D, _ = self
        n = A.shape[0]
        both = lu_solve(self.eye + A, xp.concatenate([A - self.eye, B], axis=1))
        D = D - C @ both[:, n:]
        C = 2**0.5 * lu_solve((self.eye + A).T, C.T).T
        return StateSpace(both[:, :n], 2**0.5 * both[:, n:], C, D, None)


def state_space(model: Any, inputs: str, where: str) -> StateSpace:
    """Check a model, and return its matrices from one kind of input to the outputs."""
    if not isinstance(model, LinearModel):
        raise ValueError(
            f"{where}: model must be a LinearSystem or LinearDynamics "
            "(`delucax.linearize` makes one of any system or dynamics), got "
            f"{type(model).__name__}."
        )
    check_choice(inputs, ("controls", "disturbances"), "inputs", where)
    dt = model.dt if isinstance(model, LinearDynamics) else None
    if isinstance(model, LinearDynamics):
        check_time_invariant(model, "model", where)
    if inputs == "disturbances" and model.E is None and dt is None:
        raise ValueError(
            f"{where}: inputs='disturbances' needs a model with E, the input matrix "
            "of disturbances, got a LinearSystem whose E is None."
        )
    eye = xp.eye(model.A.shape[0], dtype=model.A.dtype)
    B = model.B if inputs == "controls" else model.E
    B = eye if B is None else B
    C = eye if model.C is None else model.C
    dtype = xp.result_type(model.A, B, C)
    A, B, C = (M.astype(dtype) for M in (model.A, B, C))
    D = xp.zeros((C.shape[0], B.shape[1]), dtype)
    return StateSpace(A, B, C, D, None if dt is None else xp.asarray(dt, dtype))


def norm(
    M: Inexact[Array, "..."], axes: tuple[int, ...] = (-2, -1)
) -> Float[Array, "..."]:
    """The Frobenius norm of a real or complex matrix, with the gradient 0 at 0."""
    # By real and imaginary parts, because the modulus of zero has no derivative.
    square = xp.sum(xp.real(M) ** 2 + xp.imag(M) ** 2, axis=axes)
    is_zero = square == 0
    return xp.where(is_zero, 0.0, xp.sqrt(xp.where(is_zero, 1.0, square)))


def largest_gain(G: Inexact[Array, "*stack p m"]) -> Float[Array, "*stack"]:
    """The largest singular value, with derivatives to second order.

    Derivatives of `jnp.linalg.svd` divide by the gaps between all singular values,
    which are zero if two channels are equal. Here the singular vector `v` follows `G`
    to first order. The gain is `|G v|`, in which an error of `v` has a second-order
    effect.
    """
    return norm(G) if 1 in G.shape[-2:] else norm(G @ _singular_vectors(G)[0])


def expanded_gain(
    G: Inexact[Array, "p m"], G1: Inexact[Array, "p m"], G2: Inexact[Array, "p m"]
) -> tuple[Scalar, Scalar, Scalar]:
    """The largest singular value of `G + G1 h + G2 h^2 / 2` at `h = 0`, and its first
    and second derivatives with respect to `h`."""
    inner = lambda a, b: xp.sum(xp.real(a.conj() * b))
    if 1 in G.shape:
        G, G1, G2 = (M.reshape(-1, 1) for M in (G, G1, G2))
        vector, mixed = xp.ones((1, 1), G.dtype), 0
    else:
        vector, vectors, weights = _singular_vectors(G)
        # The perturbation of G'G, between the top vector and each of the others.
        coupling = _adjoint(G1 @ vectors) @ (G @ vector)
        coupling = coupling + _adjoint(G @ vectors) @ (G1 @ vector)
        mixed = inner(coupling, weights * coupling)
    at, first, second = G @ vector, G1 @ vector, G2 @ vector
    gain = norm(at)
    divisor = xp.where(gain > 0, gain, 1)
    slope = inner(at, first) / divisor
    curvature = inner(first, first) + inner(at, second) + mixed - slope**2
    return gain, slope, curvature / divisor


def _singular_vectors(G):
    """The right singular vector of the largest gain, which follows `G` to first order,
    all right singular vectors, and the inverse gaps of the squared singular values."""
    frozen = stop_gradient(G)
    product = _adjoint(frozen) @ frozen
    # NumPy raises an error for numbers that are not finite.
    product = xp.where(xp.isfinite(product), product, 0)
    squares, vectors = xp.linalg.eigh(product)
    gaps = (squares[..., -1:] - squares)[..., None]
    # If a gap is zero, any combination of the two vectors is a singular vector.
    is_open = gaps > xp.finfo(gaps.dtype).eps ** 0.5 * squares[..., -1:, None]
    weights = xp.where(is_open, 1 / xp.where(is_open, gaps, 1), 0)
    top = vectors[..., -1:]
    change = _adjoint(vectors) @ (_adjoint(G) @ (G @ top))
    vector = top + vectors @ (weights * change)
    return vector / norm(vector)[..., None, None], vectors, weights


def _adjoint(M):
    return M.conj().mT
