"""The state-space matrices of a linear model."""

from typing import Any, NamedTuple, TypeAlias

import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float, Inexact

from .._check import check_choice
from .._check_models import check_time_invariant
from .._typing import BoolScalar, Scalar, Square
from ..dynamics import LinearDynamics
from ..math import safe_norm
from ..math._linear_solve import lu_solve
from ..systems import LinearSystem


LinearModel: TypeAlias = LinearSystem | LinearDynamics


class StateSpace(NamedTuple):
    """`y = (C (s I - A)^-1 B + D) u`, with `s = z` in discrete time, of step `dt`."""

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
        return jnp.eye(self.A.shape[0], dtype=self.A.dtype)

    @property
    def dual(self) -> "StateSpace":
        """The transposed system, which swaps inputs and outputs."""
        return StateSpace(self.A.T, self.C.T, self.B.T, self.D.T, self.dt)

    def growth(self, poles: Complex[Array, "*poles"]) -> Float[Array, "*poles"]:
        """The real part of poles, or their modulus less 1: negative where stable."""
        return jnp.abs(poles) - 1 if self.is_discrete else jnp.real(poles)

    def is_stable(self) -> BoolScalar:
        """Whether all poles are inside the boundary."""
        poles = jnp.linalg.eigvals(lax.stop_gradient(self.A))
        return jnp.all(self.growth(poles) < 0)

    def stable_or_placeholder(self, stable: BoolScalar) -> "StateSpace":
        """This system, or a stable placeholder for an unstable one, so that results
        that are then discarded have finite derivatives."""
        return self._replace(A=jnp.where(stable, self.A, -self.eye / 2))

    def response(self, omega: Scalar) -> Complex[Array, "p m"]:
        """The complex gain at one finite frequency: at the point `j omega`, or
        `exp(j omega dt)`, of the boundary of stability."""
        s = 1j * omega if self.dt is None else jnp.exp(1j * omega * self.dt)
        resolvent = s * self.eye - self.A
        return self.C @ lu_solve(resolvent, self.B.astype(resolvent.dtype)) + self.D

    def bilinear_transform(self) -> "StateSpace":
        """The bilinear transform `z = (1 + s) / (1 - s)` of a discrete-time system: a
        continuous-time one with the same gains."""
        A, B, C, D, _ = self
        n = A.shape[0]
        both = lu_solve(self.eye + A, jnp.concatenate([A - self.eye, B], axis=1))
        D = D - C @ both[:, n:]
        C = 2**0.5 * lu_solve((self.eye + A).T, C.T).T
        return StateSpace(both[:, :n], 2**0.5 * both[:, n:], C, D, None)


def state_space(model: Any, inputs: str, where: str) -> StateSpace:
    """The checked model from one kind of input to the outputs."""
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
    eye = jnp.eye(model.A.shape[0], dtype=model.A.dtype)
    B = model.B if inputs == "controls" else model.E
    B = eye if B is None else B
    C = eye if model.C is None else model.C
    dtype = jnp.result_type(model.A, B, C)
    A, B, C = (M.astype(dtype) for M in (model.A, B, C))
    D = jnp.zeros((C.shape[0], B.shape[1]), dtype)
    return StateSpace(A, B, C, D, None if dt is None else jnp.asarray(dt, dtype))


def frobenius_norm(M: Inexact[Array, "..."]) -> Scalar:
    """The norm of all entries, complex or real, with gradient 0 at 0."""
    # As one real array: the modulus of a complex zero has no derivative.
    parts = jnp.stack([jnp.real(M), jnp.imag(M)]) if jnp.iscomplexobj(M) else M
    return safe_norm(parts, axis=None)


def largest_gain(G: Inexact[Array, "p m"]) -> Scalar:
    """The largest singular value, with derivatives to second order.

    Those of `jnp.linalg.svd` divide by the gaps between all singular values, which are
    zero as soon as two channels are alike. Here the singular vector follows `G` to
    first order, across the gaps that are open, and the gain is `|G v| / |v|`, which is
    second-order accurate in the error of `v`.
    """
    if 1 in G.shape:
        return frobenius_norm(G)
    frozen = lax.stop_gradient(G)
    # First-order perturbation theory of the top singular vector.
    squares, vectors = jnp.linalg.eigh(frozen.conj().T @ frozen)
    gaps = squares[-1] - squares
    # Across a closed gap any combination of the two vectors is a singular vector.
    open_gaps = gaps > jnp.finfo(gaps.dtype).eps ** 0.5 * squares[-1]
    weights = jnp.where(open_gaps, 1 / jnp.where(open_gaps, gaps, 1), 0)
    top = vectors[:, -1]
    change = vectors.conj().T @ (G.conj().T @ (G @ top))
    vector = top + vectors @ (weights * change)
    return frobenius_norm(G @ vector) / frobenius_norm(vector)
