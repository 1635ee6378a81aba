"""Quadratic programs without structure."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from .._check import check_instance
from .._module import shown
from .._typing import Array
from ._constraints import (
    as_finite_array,
    as_limits,
    as_matrices,
    check_convex,
    Limits,
    Rows,
    Soft,
    stacked_weights,
    symmetric_part,
)
from ._dense import DenseForm


class DenseMultipliers(eqx.Module):
    """Multipliers of the constraints: at a solution `P x + q + E'equalities` and, of
    bounds and rows, `G'(upper - lower)` add up to zero.

    **Attributes:**

    - `equalities`: shape `(e,)`.
    - `bounds`: a pair `(lower, upper)` of non-negative arrays of shape `(n,)`; `None`
        if there are no bounds.
    - `rows`: likewise, of shape `(p,)`.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        rows = dlx.qp.Rows(jnp.array([[1.0, 1.0]]), upper=1.0)
        P, q = jnp.eye(2), jnp.array([1.0, -2.0])
        problem = dlx.qp.Dense(P, q, bounds=(0.0, 1.0), rows=rows)
        multipliers = dlx.qp.solve(problem).multipliers
        multipliers.bounds, multipliers.rows
        ```
    """

    equalities: Array
    bounds: tuple[Array, Array] | None
    rows: tuple[Array, Array] | None

    __repr__ = shown


class Dense(eqx.Module):
    r"""A convex quadratic program: minimise `1/2 x'P x + q'x` such that

    `E x = b`, `low <= x <= high` and `lower <= G x <= upper`.

    It suits up to some hundreds of variables; a program in stages is a
    [`delucax.qp.Staged`][].

    **Arguments:**

    - `P`: shape `(n, n)`, symmetric, positive semidefinite.
    - `q`: shape `(n,)`.
    - `equalities`: a pair `(E, b)` of shapes `(e, n)` and `(e,)`; none by default.
    - `bounds`: a pair `(low, high)` of numbers or arrays of shape `(n,)`, which may be
        infinite, or a [`delucax.qp.Soft`][]; none by default.
    - `rows`: a [`delucax.qp.Rows`][] of shape `(p, n)`, without a `D`; none by default.

    **Raises:** `ValueError` on an array of the wrong shape, that is NaN, or not finite
    where it must be; on bounds with nothing between them; if `P` is not symmetric and
    positive semidefinite.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        P, q = jnp.eye(2), jnp.array([-1.0, -2.0])
        rows = dlx.qp.Rows(jnp.array([[1.0, 1.0]]), upper=1.0)
        problem = dlx.qp.Dense(P, q, bounds=(0.0, jnp.inf), rows=rows)
        dlx.qp.solve(problem).x
        ```
    """

    P: Array
    q: Array
    E: Array | None
    b: Array | None
    bounds: Limits | None
    G: Array | None
    rows: Limits | None

    __repr__ = shown

    def __init__(
        self,
        P: Any,
        q: Any,
        *,
        equalities: tuple[Any, Any] | None = None,
        bounds: tuple[Any, Any] | Soft | None = None,
        rows: Rows | None = None,
    ):
        where = "Dense"
        # What is given is only checked here; `form` computes with it.
        P, q = as_matrices(P, "P", where), as_finite_array(q, "q", where)
        n = P.shape[-1]
        _check_shape(P, (n, n), "P", where)
        _check_shape(q, (n,), "q", where)
        self.P, self.q = symmetric_part(P, "P", where), q
        check_convex(self.P, "P", where)
        self.E = self.b = self.G = None
        if equalities is not None:
            if not isinstance(equalities, tuple | list) or len(equalities) != 2:
                raise ValueError(
                    f"{where}: equalities must be a pair (E, b), got "
                    f"{type(equalities).__name__}."
                )
            E, b = equalities
            self.E, self.b = as_matrices(E, "E", where), as_finite_array(b, "b", where)
            _check_shape(self.E, (len(self.E), n), "E", where)
            _check_shape(self.b, (len(self.E),), "b", where)
        self.bounds = self.rows = None
        if bounds is not None:
            self.bounds = as_limits(bounds, (n,), "bounds", where)
        if rows is not None:
            check_instance(rows, Rows, "rows", where)
            if rows.D is not None:
                raise ValueError(f"{where}: rows must have no D, which is of stages.")
            self.G = rows.C
            _check_shape(self.G, (len(self.G), n), "C of rows", where)
            self.rows = as_limits(rows, (len(self.G),), "rows", where)

    def form(self) -> DenseForm:
        """The arrays for the method."""
        n, dtype = self.q.shape[0], jnp.result_type(*jax.tree.leaves(self))
        empty = jnp.zeros((0, n), dtype)
        G = empty if self.G is None else self.G
        E = empty if self.E is None else self.E
        b = empty[:, 0] if self.b is None else self.b
        both = (self.bounds, n), (self.rows, len(G))
        parts = [part.broadcast((k,), dtype) for part, k in both if part is not None]
        lower = jnp.concatenate([empty[:, 0], *(part.low for part in parts)])
        upper = jnp.concatenate([empty[:, 0], *(part.high for part in parts)])
        given: Any = [jnp.asarray(a, dtype) for a in (self.P, self.q, E, b, G)]
        given += [lower, upper, stacked_weights(parts, 0), self.bounds is not None]
        return DenseForm(*given)

    def data(self) -> list[Array]:
        """The arrays that must be finite."""
        return [a for a in (self.P, self.q, self.E, self.b, self.G) if a is not None]

    def hessians(self) -> list[Array]:
        """The matrices that must be semidefinite."""
        return [self.P]

    def primal(self, x: Array) -> tuple[Array, None]:
        """The variables and the controls of the unknowns `x` of the form."""
        return x, None

    def multipliers(self, p: Array, sides: Array) -> DenseMultipliers:
        """The multipliers `p` of the equations and those of the `sides` of the form,
        the upper ones first, by name."""
        upper, lower = sides
        n = 0 if self.bounds is None else self.q.shape[0]
        bounds = None if self.bounds is None else (lower[:n], upper[:n])
        rows = None if self.rows is None else (lower[n:], upper[n:])
        return DenseMultipliers(p, bounds, rows)

    def unknowns(
        self, x: Array, u: None, multipliers: Any
    ) -> tuple[Array, Array, Array]:
        """The unknowns of the form and its multipliers, of `x`, `u` and `multipliers`
        as a solution has them."""
        del u
        parts = [p for p in (multipliers.bounds, multipliers.rows) if p is not None]
        empty = jnp.zeros(0, self.q.dtype)
        lower = jnp.concatenate([empty, *(part[0] for part in parts)])
        upper = jnp.concatenate([empty, *(part[1] for part in parts)])
        return x, multipliers.equalities, jnp.stack([upper, lower])

    def equation(self, row: int) -> str:
        """The words for the equation in `row` of the form."""
        return f"row {row} of equalities"

    def place(self, side: int, row: int) -> str:
        """The words for a `side` (1 is the lower one) of a `row` of the form."""
        n = 0 if self.bounds is None else self.q.shape[0]
        end = "lower" if side else "upper"
        return f"the {end} bound of " + (f"x[{row}]" if row < n else f"row {row - n}")


def _check_shape(array: Array, shape: tuple[int, ...], name: str, where: str) -> None:
    if array.shape != shape:
        raise ValueError(
            f"{where}: {name} must have shape {shape}, got shape {array.shape}."
        )
