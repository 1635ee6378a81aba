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
    r"""The multipliers of the constraints of a dense program.

    At the solution the gradient of the Lagrangian is zero. If $y$ are the multipliers
    of the equalities, $\lambda$ those of the bounds and $\mu$ those of the rows,

    $$P x + q + E^\top y + \lambda_\mathrm{upper} - \lambda_\mathrm{lower}
    + G^\top (\mu_\mathrm{upper} - \mu_\mathrm{lower}) = 0.$$

    **Attributes:**

    - `equalities`: $y$, shape `(e,)`.
    - `bounds`: $\lambda$, a pair `(lower, upper)` of non-negative arrays of shape
        `(n,)`; `None` without bounds.
    - `rows`: $\mu$, a pair `(lower, upper)` of non-negative arrays of shape `(p,)`;
        `None` without rows.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        P, q = jnp.eye(2), jnp.array([1.0, -2.0])
        problem = dlx.qp.Dense(P, q, bounds=(0.0, 1.0))
        dlx.qp.solve(problem).multipliers.bounds
        ```

        ```text
        (Array([1., 0.], dtype=float32), Array([0., 1.], dtype=float32))
        ```
    """

    equalities: Array
    bounds: tuple[Array, Array] | None
    rows: tuple[Array, Array] | None

    __repr__ = shown


class Dense(eqx.Module):
    r"""A convex quadratic program.

    $$\min_x \; \tfrac12 x^\top P x + q^\top x \quad \text{such that} \quad
    E x = b, \quad \mathit{low} \le x \le \mathit{high}, \quad
    \mathit{lower} \le G x \le \mathit{upper}$$

    The dense form is suitable for up to a few hundred variables. Write a problem of
    optimal control as a [`delucax.qp.Staged`][] program instead, because the time to
    solve a staged program is linear in the horizon.

    **Arguments:**

    - `P`: shape `(n, n)`, symmetric, positive semidefinite.
    - `q`: shape `(n,)`.
    - `equalities`: a pair `(E, b)` of shapes `(e, n)` and `(e,)`; none by default.
    - `bounds`: a pair `(low, high)` of numbers or arrays of shape `(n,)`, which may be
        infinite, or a [`delucax.qp.Soft`][]; none by default.
    - `rows`: a [`delucax.qp.Rows`][] with the matrix `G` of shape `(p, n)` as its `C`,
        and no `D`; none by default.

    **Raises:** `ValueError` if an array has the wrong shape, has NaN, or is not finite
    (only bounds may be infinite), if no finite number lies between two bounds, or if
    `P` is not symmetric and positive semidefinite.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        P, q = jnp.eye(2), jnp.array([-1.0, -2.0])
        rows = dlx.qp.Rows(jnp.array([[1.0, 1.0]]), upper=1.0)
        problem = dlx.qp.Dense(P, q, bounds=(0.0, jnp.inf), rows=rows)
        dlx.qp.solve(problem).x
        ```

        ```text
        Array([0., 1.], dtype=float32)
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
        # The arguments are only checked here. `form` computes with them.
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
                raise ValueError(
                    f"{where}: rows must have no D, which is for staged programs."
                )
            self.G = rows.C
            _check_shape(self.G, (len(self.G), n), "C of rows", where)
            self.rows = as_limits(rows, (len(self.G),), "rows", where)

    def form(self) -> DenseForm:
        """The program in the standard form of the solver."""
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
        """The variables for the unknowns `x`, and `None` for the controls."""
        return x, None

    def multipliers(self, p: Array, sides: Array) -> DenseMultipliers:
        """The multipliers by name, from those of the equations, `p`, and those of the
        `sides` of the form, upper sides first."""
        upper, lower = sides
        n = 0 if self.bounds is None else self.q.shape[0]
        bounds = None if self.bounds is None else (lower[:n], upper[:n])
        rows = None if self.rows is None else (lower[n:], upper[n:])
        return DenseMultipliers(p, bounds, rows)

    def unknowns(
        self, x: Array, u: None, multipliers: Any
    ) -> tuple[Array, Array, Array]:
        """The unknowns and multipliers of the form, from those of a solution: `x`, `u`
        and `multipliers`."""
        del u
        parts = [p for p in (multipliers.bounds, multipliers.rows) if p is not None]
        empty = jnp.zeros(0, self.q.dtype)
        lower = jnp.concatenate([empty, *(part[0] for part in parts)])
        upper = jnp.concatenate([empty, *(part[1] for part in parts)])
        return x, multipliers.equalities, jnp.stack([upper, lower])

    def equation(self, row: int) -> str:
        """The words for the equation in `row`, for an error message."""
        return f"row {row} of equalities"

    def place(self, side: int, row: int) -> str:
        """The words for a `side` of a `row` (1: the lower side), for an error
        message."""
        n = 0 if self.bounds is None else self.q.shape[0]
        end = "lower" if side else "upper"
        return f"the {end} bound of " + (f"x[{row}]" if row < n else f"row {row - n}")


def _check_shape(array: Array, shape: tuple[int, ...], name: str, where: str) -> None:
    if array.shape != shape:
        raise ValueError(
            f"{where}: {name} must have shape {shape}, got shape {array.shape}."
        )
