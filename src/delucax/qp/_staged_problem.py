"""Quadratic programs in stages."""

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
    check_stage_weights,
    common_horizon,
    Limits,
    Rows,
    Soft,
    stacked_weights,
    symmetric_part,
)
from ._staged import StagedForm


Pair = tuple[Array, Array] | None
"""The multipliers of the lower and of the upper bounds, non-negative."""


class StagedMultipliers(eqx.Module):
    r"""The multipliers of the constraints of a staged program.

    **Attributes:**

    - `costates`: the multipliers of the dynamics, shape `(T+1, n)`. The first costate
        is the multiplier of the given start. It is zero if the start is free. Costate
        $k + 1$ is the multiplier of the equation $x_{k+1} = A x_k + B u_k + d_k$. The
        derivative of the optimal cost with respect to $d_k$ is `-costates[k + 1]`.
    - `states`: the multipliers of the bounds of the states, a pair `(lower, upper)` of
        non-negative arrays of shape `(T+1, n)`; `None` if there are no bounds.
    - `controls`: the multipliers of the bounds of the controls, a pair of arrays of
        shape `(T, m)`, like `states`.
    - `rows`: the multipliers of `rows`, a pair of arrays of shape `(T, p)`, like
        `states`.
    - `final_rows`: the multipliers of `final_rows`, a pair of arrays of shape `(p,)`,
        like `states`.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[1.0, 0.1], [0.0, 1.0]])
        B = jnp.array([[0.0], [0.1]])
        problem = dlx.qp.Staged(
            A,
            B,
            jnp.eye(2),
            0.1 * jnp.eye(1),
            start=jnp.array([1.0, 0.0]),
            horizon=20,
            controls=(-1.0, 1.0),
            states=(jnp.array([-jnp.inf, -0.3]), jnp.inf),
        )
        dlx.qp.solve(problem).multipliers.costates[0]
        ```

        ```text
        Array([-15.558,  -4.702], dtype=float32)
        ```
    """

    costates: Array
    states: Pair
    controls: Pair
    rows: Pair
    final_rows: Pair

    __repr__ = shown


class Staged(eqx.Module):
    r"""A convex quadratic program in stages, for the control of a linear system.

    $$\min \; \sum_{k=0}^{T-1} \left( \tfrac12 x_k^\top Q x_k + x_k^\top S u_k
    + \tfrac12 u_k^\top R u_k + q^\top x_k + r^\top u_k \right)
    + \tfrac12 x_T^\top Q_T x_T + q_T^\top x_T$$

    The constraints are the dynamics $x_{k+1} = A x_k + B u_k + d_k$, bounds of states
    and controls, and general linear constraints. The start $x_0$ is given or free.

    An argument without a time axis applies to all stages. Bounds of the states hold at
    stages 1 to T. These bounds also hold at stage 0 if the start is free. The bounds do
    not apply to a given start, because the program cannot change a given start. A
    Riccati recursion solves the program, so the computing time is linear in the
    horizon.

    **Arguments:**

    - `A`: shape `(n, n)`, or `(T, n, n)`.
    - `B`: shape `(n, m)`, or `(T, n, m)`.
    - `Q`: shape `(n, n)`, or `(T, n, n)`, symmetric.
    - `R`: shape `(m, m)`, or `(T, m, m)`, symmetric.
    - `S`: shape `(n, m)`, or `(T, n, m)`; zero by default. `[[Q, S], [S', R]]` must be
        positive semidefinite.
    - `d`: an offset that is added to the next state, shape `(n,)` or `(T, n)`; zero by
        default.
    - `q`, `r`: the linear weights of the state, shape `(n,)` or `(T, n)`, and of the
        control, shape `(m,)` or `(T, m)`; zero by default.
    - `final`: the final weight $Q_T$, shape `(n, n)`, symmetric, positive semidefinite;
        zero by default.
    - `final_q`: the linear weight $q_T$ of the final state, shape `(n,)`; zero by
        default.
    - `start`: $x_0$, shape `(n,)`; free by default.
    - `horizon`: the number of stages $T$; needed if no argument has a time axis.
    - `states`: bounds of the states: a pair `(low, high)` of numbers or arrays of shape
        `(n,)` or `(T+1, n)`, which may be infinite, or a [`delucax.qp.Soft`][]; none by
        default. Equal bounds are an equation.
    - `controls`: bounds of the controls, given like `states`, of shape `(m,)` or
        `(T, m)`.
    - `rows`: the general constraints at stages 0 to T - 1, a [`delucax.qp.Rows`][];
        none by default.
    - `final_rows`: the general constraints at stage T, a [`delucax.qp.Rows`][] without
        a `D`; none by default.

    **Raises:** `ValueError` if an array has the wrong shape or has NaN, if it is not
    finite (only bounds may be infinite), if arrays are for different horizons, if there
    is no finite number between two bounds, or if the weights are not symmetric and
    positive semidefinite. The error message names the stage, and for a bound also the
    entry.

    Source: Rao, Wright and Rawlings, 1998.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[1.0, 0.1], [0.0, 1.0]])
        B = jnp.array([[0.0], [0.1]])
        problem = dlx.qp.Staged(
            A,
            B,
            jnp.eye(2),
            0.1 * jnp.eye(1),
            start=jnp.array([1.0, 0.0]),
            horizon=20,
            controls=(-1.0, 1.0),
            states=(jnp.array([-jnp.inf, -0.3]), jnp.inf),
        )
        dlx.qp.solve(problem).u[:3]
        ```

        ```text
        Array([[-1.   ],
               [-1.   ],
               [-0.933]], dtype=float32)
        ```
    """

    A: Array
    B: Array
    Q: Array
    R: Array
    S: Array | None
    d: Array | None
    q: Array | None
    r: Array | None
    final: Array | None
    final_q: Array | None
    start: Array | None
    states: Limits | None
    controls: Limits | None
    C: Array | None
    D: Array | None
    rows: Limits | None
    final_C: Array | None
    final_rows: Limits | None
    horizon: int = eqx.field(static=True)

    __repr__ = shown

    def __init__(
        self,
        A: Any,
        B: Any,
        Q: Any,
        R: Any,
        S: Any = None,
        *,
        d: Any = None,
        q: Any = None,
        r: Any = None,
        final: Any = None,
        final_q: Any = None,
        start: Any = None,
        horizon: int | None = None,
        states: tuple[Any, Any] | Soft | None = None,
        controls: tuple[Any, Any] | Soft | None = None,
        rows: Rows | None = None,
        final_rows: Rows | None = None,
    ):
        where = "Staged"
        # The arguments are only checked here. `form` computes with them.
        matrices = dict(A=A, B=B, Q=Q, R=R, S=S)
        vectors = dict(d=d, q=q, r=r, final_q=final_q, start=start)
        given = {
            name: as_matrices(value, name, where)
            for name, value in matrices.items()
            if value is not None or name != "S"
        }
        given |= {
            name: as_finite_array(value, name, where)
            for name, value in vectors.items()
            if value is not None
        }
        if final is not None:
            given["final"] = as_matrices(final, "final", where)
        for kind, value in (("rows", rows), ("final_rows", final_rows)):
            if value is not None:
                check_instance(value, Rows, kind, where)
        p = 0
        if rows is not None:
            given["C"], p = rows.C, rows.C.shape[-2]
            if rows.D is not None:
                given["D"] = rows.D
        n, m = given["B"].shape[-2:]
        sizes = dict(A=(n, n), B=(n, m), Q=(n, n), R=(m, m), S=(n, m), d=(n,), q=(n,))
        sizes |= dict(r=(m,), final_q=(n,), start=(n,), final=(n, n))
        if rows is not None:
            sizes |= dict(C=(p, n), D=(p, m))
        self.horizon = T = common_horizon(
            given, sizes, horizon, states, controls, rows, where
        )
        for name in ("Q", "R", "final"):
            if name in given:
                given[name] = symmetric_part(given[name], name, where)
        for name in (*matrices, *vectors, "final", "C", "D"):
            setattr(self, name, given.get(name))
        check_stage_weights(given, where)
        of = lambda value, shape, name: (
            None if value is None else as_limits(value, shape, name, where)
        )
        self.states = of(states, (T + 1, n), "states")
        self.controls = of(controls, (T, m), "controls")
        self.rows = None if rows is None else of(rows, (T, p), "rows")
        self.final_C = self.final_rows = None
        if final_rows is not None:
            self.final_C = final_rows.C
            if final_rows.D is not None or self.final_C.ndim != 2:
                raise ValueError(
                    f"{where}: final_rows must have one matrix C, and no D."
                )
            self.final_rows = of(final_rows, (len(self.final_C),), "final_rows")
            if self.final_C.shape[1] != n:
                raise ValueError(
                    f"{where}: C of final_rows must have {n} columns, got shape "
                    f"{self.final_C.shape}."
                )

    def form(self) -> StagedForm:
        """The program as the method takes it."""
        T, (n, m) = self.horizon, self.B.shape[-2:]
        dtype = jnp.result_type(*jax.tree.leaves(self))

        def stages(array, *shape, steps=T):
            if array is None:
                return jnp.zeros((steps, *shape), dtype)
            return jnp.broadcast_to(array, (steps, *shape)).astype(dtype)

        # The last stage has no control.
        at_end = lambda M: jnp.pad(M, ((0, 0), *((0, m),) * (M.ndim - 1)))
        S = stages(self.S, n, m)
        H = [[stages(self.Q, n, n), S], [S.mT, stages(self.R, m, m)]]
        last = at_end(stages(self.final, n, n, steps=1))
        H = jnp.concatenate([jnp.block(H), last])
        q = jnp.concatenate([stages(self.q, n), stages(self.r, m)], axis=1)
        q = jnp.concatenate([q, at_end(stages(self.final_q, n, steps=1))])
        F = jnp.concatenate([stages(self.A, n, n), stages(self.B, n, m)], axis=2)
        f = jnp.concatenate([stages(self.start, n, steps=1), stages(self.d, n)])
        G, limits = self._sides(stages)
        lower = jnp.concatenate([part.low for part in limits], axis=1)
        upper = jnp.concatenate([part.high for part in limits], axis=1)
        first = 0 if self.states is not None else n
        bounded = first, n if self.controls is None else n + m
        soft = stacked_weights(limits, 1)
        sides = lower, upper, soft, bounded
        free = tuple(range(n)) if self.start is None else ()
        parts: Any = H, q, F, f, G, *sides, free
        return StagedForm(*parts)

    def _sides(self, stages: Any) -> tuple[Array, list[Limits]]:
        """The matrix of the general rows, and the limits of all rows."""
        T, (n, m) = self.horizon, self.B.shape[-2:]
        dtype = jnp.result_type(*jax.tree.leaves(self))
        none = lambda steps, size: _unlimited(steps, size, dtype)
        limits = [none(T + 1, 0)]
        if self.states is not None:
            states = self.states.broadcast((T + 1, n), dtype)
            if self.start is not None:
                states = _joined([none(1, n), _cut(states, slice(1, None))])
            limits.append(states)
        if self.controls is not None:
            controls = self.controls.broadcast((T, m), dtype)
            limits.append(_joined([controls, none(1, m)]))
        p, end = (0 if C is None else C.shape[-2] for C in (self.C, self.final_C))
        size = max(p, end)
        G = jnp.concatenate([stages(self.C, p, n), stages(self.D, p, m)], axis=2)
        G = jnp.pad(G, ((0, 0), (0, size - p), (0, 0)))
        final = stages(self.final_C, end, n, steps=1)
        G = jnp.concatenate([G, jnp.pad(final, ((0, 0), (0, size - end), (0, m)))])
        along, at_end = none(T, 0), none(1, 0)
        if self.rows is not None:
            along = self.rows.broadcast((T, p), dtype)
        if self.final_rows is not None:
            at_end = self.final_rows.broadcast((1, end), dtype)
        along = _beside(along, none(T, size - p))
        limits.append(_joined([along, _beside(at_end, none(1, size - end))]))
        return G, limits

    def data(self) -> list[Array]:
        """The arrays that must be finite."""
        data = self.A, self.B, self.d, self.C, self.D, self.final_C
        return [array for array in data if array is not None]

    def hessians(self) -> list[Array]:
        """The matrices that must be semidefinite; a stack if they vary in time."""
        S = self.S
        if S is None:
            S = jnp.zeros(self.B.shape[-2:], self.Q.dtype)
        leading = jnp.broadcast_shapes(*(M.shape[:-2] for M in (self.Q, S, self.R)))
        full = lambda M: jnp.broadcast_to(M, (*leading, *M.shape[-2:]))
        Q, S, R = map(full, (self.Q, S, self.R))
        stage = jnp.block([[Q, S], [S.mT, R]])
        return [stage] if self.final is None else [stage, self.final]

    def primal(self, x: Array) -> tuple[Array, Array]:
        """The states and the controls, from the unknowns `x` of the standard form."""
        n = self.B.shape[-2]
        return x[:, :n], x[:-1, n:]

    def _parts(self, at: Array) -> list[Array | None]:
        """The states, controls, rows and final rows of an array like a side."""
        n, m = self.B.shape[-2:]
        k, parts = 0, []
        for limits, size, stages in (
            (self.states, n, slice(None)),
            (self.controls, m, slice(-1)),
        ):
            parts.append(None if limits is None else at[stages, k : k + size])
            k += 0 if limits is None else size
        along = None if self.C is None else at[:-1, k : k + self.C.shape[-2]]
        end = None if self.final_C is None else at[-1, k : k + len(self.final_C)]
        return [*parts, along, end]

    def multipliers(self, p: Array, sides: Array) -> StagedMultipliers:
        """The multipliers by name, from those of the equations, `p`, and those of the
        `sides` of the form, upper sides first."""
        upper, lower = map(self._parts, sides)
        pairs: Any = zip(lower, upper, strict=True)
        return StagedMultipliers(p, *(None if a is None else (a, b) for a, b in pairs))

    def unknowns(
        self, x: Array, u: Array, multipliers: Any
    ) -> tuple[Array, Array, Array]:
        """The unknowns and multipliers of the form, from those of a solution: `x`, `u`
        and `multipliers`."""
        y = multipliers
        x = jnp.concatenate([x, jnp.pad(u, ((0, 1), (0, 0)))], axis=1)

        def side(k):
            parts = [jnp.zeros((len(x), 0), x.dtype)]
            if y.states is not None:
                parts.append(y.states[k])
            if y.controls is not None:
                parts.append(jnp.pad(y.controls[k], ((0, 1), (0, 0))))
            along = jnp.zeros((len(x) - 1, 0)) if y.rows is None else y.rows[k]
            end = jnp.zeros(0) if y.final_rows is None else y.final_rows[k]
            size = max(along.shape[1], len(end))
            along = jnp.pad(along, ((0, 0), (0, size - along.shape[1])))
            end = jnp.pad(end, (0, size - len(end)))
            return jnp.concatenate([*parts, jnp.vstack([along, end])], axis=1)

        return x, y.costates, jnp.stack([side(1), side(0)])

    def equation(self, stage: int, row: int) -> str:
        """The words for the equation in `row` of a `stage`, for an error message."""
        return f"entry {row} of the step to stage {stage}" if stage else "the start"

    def place(self, side: int, stage: int, row: int) -> str:
        """The words for a `side` of a `row` of a `stage` (1: the lower side), for an
        error message."""
        n, m = self.B.shape[-2:]
        end = "lower" if side else "upper"
        for name, limits, size in (("x", self.states, n), ("u", self.controls, m)):
            if limits is not None:
                if row < size:
                    return f"the {end} bound of {name}[{row}] at stage {stage}"
                row -= size
        kind = "final row" if stage == self.horizon else "row"
        return f"the {end} bound of {kind} {row} at stage {stage}"


def _unlimited(steps: int, size: int, dtype: Any) -> Limits:
    infinite = jnp.full((steps, size), jnp.inf, dtype)
    return Limits(-infinite, infinite, None)


def _joined(parts: list[Limits], axis: int = 0) -> Limits:
    """Concatenate bounds, by default along the stages."""
    low = jnp.concatenate([part.low for part in parts], axis)
    high = jnp.concatenate([part.high for part in parts], axis)
    weights = stacked_weights(parts, axis)
    return Limits(
        low, high, None if weights is None else (weights[0][0], weights[1][0])
    )


def _beside(first: Limits, second: Limits) -> Limits:
    return _joined([first, second], 1)


def _cut(limits: Limits, stages: slice) -> Limits:
    return jax.tree.map(lambda a: a[stages], limits)
