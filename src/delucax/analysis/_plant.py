"""The matrices that every analysis is about."""

from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Inexact

from ..dynamics import LinearDynamics
from ..math import safe_norm
from ..systems import LinearSystem


class Plant(eqx.Module):
    """`y = (C (s I - A)^-1 B + D) u`, with `s = z` if it has a step `dt`."""

    A: Array
    B: Array
    C: Array
    D: Array
    dt: Any

    @property
    def is_discrete(self) -> bool:
        return self.dt is not None


def plant(model: Any, inputs: str, where: str) -> Plant:
    """The matrices from one kind of input to the outputs, or an error."""
    if not isinstance(model, LinearSystem | LinearDynamics):
        raise ValueError(
            f"{where}: model must be a LinearSystem or LinearDynamics "
            "(`delucax.linearize` makes one of any system or dynamics), got "
            f"{type(model).__name__}."
        )
    discrete = isinstance(model, LinearDynamics)
    if discrete and model.is_time_varying:
        raise ValueError(
            f"{where}: model must be time-invariant, got matrices at "
            f"{model.A.shape[0]} times; `dynamics.at(t)` are those at one time."
        )
    eye = jnp.eye(model.A.shape[0], dtype=model.A.dtype)
    if inputs == "controls":
        B = model.B
    elif inputs == "disturbances":
        if model.E is None and not discrete:
            raise ValueError(
                f"{where}: inputs='disturbances' needs a model with E, which says how "
                "they enter the vector field, got a LinearSystem whose E is None."
            )
        B = eye if model.E is None else model.E
    else:
        raise ValueError(
            f"{where}: inputs must be 'controls' or 'disturbances', got {inputs!r}."
        )
    C = eye if model.C is None else model.C
    dtype = jnp.result_type(model.A, B, C)
    A, B, C = (M.astype(dtype) for M in (model.A, B, C))
    D = jnp.zeros((C.shape[0], B.shape[1]), dtype)
    dt = jnp.asarray(model.dt, dtype) if isinstance(model, LinearDynamics) else None
    return Plant(A, B, C, D, dt)


def solve(matrix: Inexact[Array, "n n"], right: Inexact[Array, "n k"]) -> Array:
    """`matrix^-1 right`, with one factorisation; NaN where `matrix` is singular."""
    operator, solver = lx.MatrixLinearOperator(matrix), lx.LU()
    state = solver.init(operator, {})

    def column(b):
        return lx.linear_solve(operator, b, solver, state=state, throw=False).value

    return jax.vmap(column, in_axes=1, out_axes=1)(right)


def on_the_boundary(plant: Plant, omega: Array) -> Array:
    """The point `j omega`, or `exp(j omega dt)`, of the boundary of stability."""
    return jnp.exp(1j * omega * plant.dt) if plant.is_discrete else 1j * omega


def response(plant: Plant, omega: Array) -> Array:
    """The complex gain at one finite frequency, shape `(p, m)`."""
    s = on_the_boundary(plant, omega)
    resolvent = s * jnp.eye(plant.A.shape[0], dtype=plant.A.dtype) - plant.A
    return plant.C @ solve(resolvent, plant.B.astype(resolvent.dtype)) + plant.D


def growth(plant: Plant, poles: Array) -> Array:
    """Below zero for what decays: the real part, or the modulus less 1."""
    return jnp.abs(poles) - 1 if plant.is_discrete else jnp.real(poles)


def is_stable(plant: Plant) -> Array:
    """Whether all poles are inside the boundary."""
    poles = jnp.linalg.eigvals(lax.stop_gradient(plant.A))
    return jnp.all(growth(plant, poles) < 0)


def size(M: Array) -> Array:
    """The Frobenius norm, complex or real, with gradient 0 at 0."""
    parts = jnp.stack([jnp.real(M), jnp.imag(M)]) if jnp.iscomplexobj(M) else M
    return safe_norm(parts, axis=None)


def largest_gain(G: Array) -> Array:
    """The largest singular value, with derivatives to second order.

    Those of `jnp.linalg.svd` divide by the gaps between all singular values, which are
    zero as soon as two channels are alike. Here the singular vector follows `G` to
    first order, across the gaps that are open, and the gain is the length that `G`
    makes of it, which errs with the square of the vector's error.
    """
    if 1 in G.shape:
        return size(G)
    still = lax.stop_gradient(G)
    squares, vectors = jnp.linalg.eigh(still.conj().T @ still)
    gaps = squares[-1] - squares
    open_gaps = gaps > jnp.finfo(gaps.dtype).eps ** 0.5 * squares[-1]
    weights = jnp.where(open_gaps, 1 / jnp.where(open_gaps, gaps, 1), 0)
    top = vectors[:, -1]
    moved = vectors.conj().T @ (G.conj().T @ (G @ top))
    follows = top + vectors @ (weights * moved)
    return size(G @ follows) / size(follows)
