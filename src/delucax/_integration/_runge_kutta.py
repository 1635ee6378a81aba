"""Explicit Runge-Kutta steps with their stages written out.

A Diffrax solver runs its stages in a loop over arrays. The states of control problems
are small. For these it is several times faster, forward and in the gradient, to write
the stages out and to combine the state one component at a time: each component of a
batch is then a vector of its own, which stays in registers.
"""

from collections.abc import Callable, Sequence
from typing import ClassVar

import diffrax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._jax import COMPONENTS_UP_TO, fence, join_state, split_state
from .._typing import RealScalar


class RK4(diffrax.AbstractERK):
    """The classical Runge-Kutta method of order 4, as a Diffrax solver.

    The method has no error estimate, so it takes fixed steps. For dense output the
    method uses cubic Hermite interpolation.

    **Arguments:**

    - `scan_kind`: how Diffrax loops over the stages of a step, as in every
        `diffrax.AbstractERK`; `None` by default. The argument only matters if Diffrax
        itself takes the steps. Leave it out.

    Source: Kutta, 1901.

    !!! example

        ```python
        import delucax as dlx

        pendulum = dlx.systems.Pendulum()
        dynamics = dlx.Discretized(pendulum, dt=0.05, solver=dlx.dynamics.RK4())
        ```
    """

    tableau: ClassVar[diffrax.ButcherTableau] = diffrax.ButcherTableau(
        a_lower=(np.array([0.5]), np.array([0.0, 0.5]), np.array([0.0, 0.0, 1.0])),
        b_sol=np.array([1 / 6, 1 / 3, 1 / 3, 1 / 6]),
        # The classical method has no embedded estimate of its error.
        b_error=np.array([0.0, 0.0, 0.0, 0.0]),
        c=np.array([0.5, 0.5, 1.0]),
    )
    interpolation_cls: ClassVar[
        Callable[..., diffrax.ThirdOrderHermitePolynomialInterpolation]
    ] = diffrax.ThirdOrderHermitePolynomialInterpolation.from_k

    def order(self, terms):
        """The order of convergence, 4.

        **Arguments:** `terms`: not used.
        """
        del terms
        return 4


_EULER = diffrax.ButcherTableau(
    a_lower=(np.array([1.0]),),
    b_sol=np.array([1.0, 0.0]),
    b_error=np.array([0.0, 0.0]),
    c=np.array([1.0]),
)


def tableau_of(solver: diffrax.AbstractSolver) -> diffrax.ButcherTableau | None:
    """The tableau of an explicit Runge-Kutta solver; `None` for any other."""
    if type(solver) is diffrax.Euler:
        return _EULER
    # A wrapped solver is an instance too, but has no tableau.
    is_wrapped = isinstance(solver, diffrax.AbstractWrappedSolver)
    if is_wrapped or not isinstance(solver, diffrax.AbstractERK):
        return None
    tableau = solver.tableau
    return tableau if isinstance(tableau, diffrax.ButcherTableau) else None


def runge_kutta_step(
    tableau: diffrax.ButcherTableau,
    field: Callable[[RealScalar, Array], Array],
    t: RealScalar,
    x: Array,
    h: RealScalar,
) -> Array:
    """One explicit step of size `h` of `dx/dt = field(t, x)`."""
    # Stages without a weight in the solution are left out: they only serve the error
    # estimate, or the first slope of the next step.
    used = max(np.flatnonzero(tableau.b_sol)) + 1
    rows = [(), *(tuple(map(float, row)) for row in tableau.a_lower)][:used]
    nodes = [0.0, *map(float, tableau.c)][:used]
    weights = tuple(map(float, tableau.b_sol))[:used]
    size = x.shape[0]
    base = split_state(x)
    slopes: list[Sequence[Array]] = []
    for row, node in zip(rows, nodes, strict=True):
        stage = join_state(_combine(base, row, slopes, h))
        # No sum at the start, so that the time is exact.
        slope = field(t + node * h if node else t, stage)
        # Every component of the next stage needs the whole slope. The fence keeps XLA
        # from computing it again for each.
        slopes.append(fence(*slope) if size <= COMPONENTS_UP_TO else (slope,))
    return join_state(_combine(base, weights, slopes, h)).astype(x.dtype)


def runge_kutta_step_in_loop(
    tableau: diffrax.ButcherTableau,
    field: Callable[[RealScalar, Array], Array],
    t: RealScalar,
    x: Array,
    h: RealScalar,
) -> Array:
    """Like `runge_kutta_step`, but with the stages in a loop. It runs more slowly, and
    compiles faster if the field is large."""
    stages = max(np.flatnonzero(tableau.b_sol)) + 1
    A = np.zeros((stages, stages))
    for i, row in enumerate(tableau.a_lower[: stages - 1], 1):
        A[i, :i] = row
    nodes = np.array([0.0, *tableau.c])[:stages]
    given = jnp.asarray(A, x.dtype), jnp.asarray(nodes, x.dtype), jnp.arange(stages)

    def stage(slopes, of):
        row, node, i = of
        slope = field(t + node * h, x + h * (row @ slopes))
        return slopes.at[i].set(slope.astype(x.dtype)), None

    slopes, _ = lax.scan(stage, jnp.zeros((stages, x.size), x.dtype), given)
    return x + h * (jnp.asarray(tableau.b_sol[:stages], x.dtype) @ slopes)


def _combine(base, weights, slopes, h):
    """`base + h sum_i weights_i slopes_i`, one component at a time."""
    terms = [(a, k) for a, k in zip(weights, slopes, strict=True) if a != 0]
    if not terms:
        return base
    combined = []
    for j, start in enumerate(base):
        # The slopes are summed first, so that each product rounds only once.
        total = terms[0][0] * terms[0][1][j]
        for a, k in terms[1:]:
            total = total + a * k[j]
        combined.append(start + h * total)
    return tuple(combined)
