"""Bounds and rows as the user gives them, and their checks."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._check import as_float_array, check_count, check_real, is_concrete
from .._module import shown
from .._typing import Array


class Soft(eqx.Module):
    r"""Bounds that may be violated at a cost.

    A violation $t \ge 0$ of a bound costs $v\, t + \tfrac12 W t^2$. If $v$ is larger
    than the multiplier that the bound would have as a hard bound, the penalty is exact.
    Then the solution violates the bound only if no feasible point satisfies the bound.
    If both weights are 0, the bound has no effect.

    **Arguments:**

    - `low`, `high`: the bounds, numbers or arrays, which may be infinite.
    - `linear`: the weight $v$, at least 0: a number, or an array of the shape of the
        bounds; 0 by default. If the weight is infinite, the bound is hard.
    - `quadratic`: the weight $W$, like `linear`.

    **Raises:** `ValueError` if a weight is negative or NaN, or if no finite number lies
    between the bounds.

    Source: Kerrigan and Maciejowski, 2000.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        soft = dlx.qp.Soft(0.0, 1.0, quadratic=4.0)
        problem = dlx.qp.Dense(jnp.eye(1), jnp.array([-6.0]), bounds=soft)
        dlx.qp.solve(problem).x
        ```

        ```text
        Array([2.], dtype=float32)
        ```
    """

    low: Array
    high: Array
    linear: Array
    quadratic: Array

    __repr__ = shown

    def __init__(self, low: Any, high: Any, linear: Any = 0.0, quadratic: Any = 0.0):
        self.low, self.high = (
            _as_array(low, "low", "Soft"),
            _as_array(high, "high", "Soft"),
        )
        _check_order(self.low, self.high, "bounds", "Soft")
        self.linear = _as_weight(linear, "linear", "Soft")
        self.quadratic = _as_weight(quadratic, "quadratic", "Soft")


class Rows(eqx.Module):
    r"""General linear constraints, $l \le C x + D u \le h$.

    If the two bounds of a row are equal, the row is an equality constraint. If a row
    has no bound on one side, give an infinite bound for this side.

    **Arguments:**

    - `C`: shape `(p, n)`; in a staged program also `(T, p, n)`.
    - `D`: shape `(p, m)`, or `(T, p, m)`; zero by default.
    - `lower`, `upper`: the bounds $l$ and $h$, numbers or arrays of shape `(p,)` or
        `(T, p)`; infinite by default.
    - `linear`, `quadratic`: the weights of a violation, as in [`delucax.qp.Soft`][];
        the rows are hard by default.

    **Raises:** `ValueError` if an array has the wrong shape or has NaN, or if a weight
    is negative.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        rows = dlx.qp.Rows(jnp.array([[1.0, 1.0]]), upper=1.0)
        problem = dlx.qp.Dense(jnp.eye(2), jnp.array([-1.0, -1.0]), rows=rows)
        dlx.qp.solve(problem).x
        ```

        ```text
        Array([0.5, 0.5], dtype=float32)
        ```
    """

    C: Array
    D: Array | None
    lower: Array
    upper: Array
    linear: Array | None
    quadratic: Array | None

    __repr__ = shown

    def __init__(
        self,
        C: Any,
        D: Any = None,
        *,
        lower: Any = -np.inf,
        upper: Any = np.inf,
        linear: Any = None,
        quadratic: Any = None,
    ):
        self.C = as_matrices(C, "C", "Rows")
        self.D = None if D is None else as_matrices(D, "D", "Rows")
        if self.D is not None and self.D.shape[-2] != self.C.shape[-2]:
            raise ValueError(
                "Rows: C and D must have the same number of rows, got shapes "
                f"{self.C.shape} and {self.D.shape}."
            )
        self.lower = _as_array(lower, "lower", "Rows")
        self.upper = _as_array(upper, "upper", "Rows")
        is_soft = linear is not None or quadratic is not None
        weights = (0.0 if w is None else w for w in (linear, quadratic))
        names = "linear", "quadratic"
        weights = (
            _as_weight(w, n, "Rows") for w, n in zip(weights, names, strict=True)
        )
        self.linear, self.quadratic = weights if is_soft else (None, None)


class Limits(eqx.Module):
    """Bounds as the user gave them, and their weights, `None` for hard bounds."""

    low: Array
    high: Array
    weights: tuple[Array, Array] | None

    def broadcast(self, shape: tuple[int, ...], dtype: Any) -> "Limits":
        """The same limits with all arrays broadcast to one shape."""
        return jax.tree.map(lambda a: jnp.broadcast_to(a, shape).astype(dtype), self)


def as_limits(value: Any, shape: tuple[int, ...], name: str, where: str) -> Limits:
    """Check bounds of any kind. They must broadcast to `shape`."""
    low, high, *weights = _parts(value, name, where)
    shapes = [shape[k:] for k in reversed(range(len(shape) + 1))]
    for array in (low, high, *(w for w in weights if w is not None)):
        if array.shape not in shapes:
            rule = " or ".join(map(str, shapes[1:]))
            raise ValueError(
                f"{where}: each bound and each weight of {name} must be a number or "
                f"have shape {rule}, got shape {array.shape}."
            )
    _check_order(low, high, name, where)
    if not weights or weights[0] is None:
        return Limits(low, high, None)
    return Limits(low, high, (weights[0], weights[1]))


def _parts(value: Any, name: str, where: str) -> tuple[Any, ...]:
    if isinstance(value, Soft):
        return value.low, value.high, value.linear, value.quadratic
    if isinstance(value, Rows):
        return value.lower, value.upper, value.linear, value.quadratic
    if not isinstance(value, tuple | list) or len(value) != 2:
        raise ValueError(
            f"{where}: {name} must be a pair (low, high) or a `delucax.qp.Soft`, got "
            f"{type(value).__name__}."
        )
    return tuple(_as_array(end, name, where) for end in value)


def _check_order(low: Array, high: Array, name: str, where: str) -> None:
    """Raise an error if no finite number is between two bounds."""
    if not (is_concrete(low) and is_concrete(high)):
        return
    least, most = np.broadcast_arrays(np.asarray(low), np.asarray(high))
    bad = (least > most) | (least == np.inf) | (most == -np.inf)
    if bad.any():
        index = tuple(int(i) for i in np.argwhere(bad)[0])
        at = f" of entry {index[-1]}" if index else ""
        at += f" of stage {index[0]}" if len(index) > 1 else ""
        raise ValueError(
            f"{where}: {name} must have a finite number between the bounds, but those"
            f"{at} are {least[index]} and {most[index]}."
        )


def _as_array(value: Any, name: str, where: str) -> Array:
    """Check that `value` is a real array without NaN."""
    array = as_float_array(value)
    if not eqx.is_inexact_array(array):
        raise ValueError(
            f"{where}: {name} must be an array of numbers, got {type(value).__name__}."
        )
    check_real(array, name, where)
    if is_concrete(array) and np.isnan(np.asarray(array)).any():
        raise ValueError(f"{where}: {name} must not be NaN{_place(array)}.")
    return array


def _place(array: Array) -> str:
    """The words for the first NaN of an array."""
    index = np.argwhere(np.isnan(np.asarray(array)))[0]
    return f", but its entry {tuple(map(int, index))} is" if index.size else ""


def _as_weight(value: Any, name: str, where: str) -> Array:
    weight = _as_array(value, name, where)
    if is_concrete(weight) and (np.asarray(weight) < 0).any():
        raise ValueError(f"{where}: {name} must be at least 0, got {value}.")
    return weight


def as_finite_array(value: Any, name: str, where: str) -> Array:
    """Check that `value` is a real array of finite entries."""
    array = _as_array(value, name, where)
    if is_concrete(array) and not np.isfinite(np.asarray(array)).all():
        raise ValueError(f"{where}: {name} must be finite.")
    return array


def as_matrices(value: Any, name: str, where: str) -> Array:
    """Check that `value` is a matrix, or a stack of one matrix for each stage."""
    array = as_finite_array(value, name, where)
    if array.ndim not in (2, 3):
        raise ValueError(
            f"{where}: {name} must be a matrix"
            f"{'' if where == 'Dense' else ', or a stack of matrices for the stages'}, "
            f"got shape {array.shape}."
        )
    return array


def check_convex(hessian: Array, name: str, where: str) -> None:
    """Raise an error unless each symmetric matrix of a stack is semidefinite."""
    if not is_concrete(hessian):
        return
    stack = np.asarray(hessian)
    stack = stack.reshape(-1, *stack.shape[-2:])
    least = np.linalg.eigvalsh(stack)
    size = np.max(np.abs(least), axis=1, initial=0)
    slack = 100 * stack.shape[-1] * np.finfo(stack.dtype).eps * size
    bad = np.flatnonzero(least.min(axis=1, initial=0) < -slack)
    if bad.size:
        k = int(bad[0])
        at = f" at stage {k}" if hessian.ndim == 3 else ""
        raise ValueError(
            f"{where}: the problem is not convex: {name} must be positive "
            f"semidefinite, but{at} its smallest eigenvalue is {least[k].min():.3g}."
        )


def symmetric_part(matrix: Array, name: str, where: str) -> Array:
    """Check that the matrices of a stack are symmetric, and remove their rounding."""
    if matrix.shape[-1] != matrix.shape[-2]:
        raise ValueError(f"{where}: {name} must be square, got shape {matrix.shape}.")
    if is_concrete(matrix):
        array = np.asarray(matrix)
        off = np.abs(array - np.swapaxes(array, -1, -2))
        if np.any(
            off > 100 * np.finfo(array.dtype).eps * np.max(np.abs(array), initial=0)
        ):
            raise ValueError(f"{where}: {name} must be symmetric.")
        if not off.any():
            return matrix
        return jax.device_put((array + np.swapaxes(array, -1, -2)) / 2)
    return (matrix + matrix.mT) / 2


def stacked_weights(parts: list[Limits], axis: int) -> tuple[Array, Array] | None:
    """The weights of several bounds for both sides, concatenated; `None` if all are
    hard."""
    if all(part.weights is None for part in parts):
        return None

    def of(part, k):
        if part.weights is None:
            return jnp.full(part.low.shape, jnp.inf, part.low.dtype)
        return part.weights[k]

    joined = [jnp.concatenate([of(p, k) for p in parts], axis=axis) for k in range(2)]
    # A side is hard if either weight is infinite.
    return jax.tree.map(lambda w: jnp.stack([w, w]), tuple(joined))


_ONCE = "final_q", "start", "final"


def common_horizon(
    given: dict[str, Array],
    sizes: dict[str, tuple[int, ...]],
    horizon: Any,
    states: Any,
    controls: Any,
    rows: Any,
    where: str,
) -> int:
    """The number of stages. All arrays with a time axis must have the same."""
    lengths: dict[str, int] = {}
    for name, array in given.items():
        size = sizes[name]
        varies = array.ndim == len(size) + 1 and name not in _ONCE
        if array.shape[varies:] != size:
            rule = f"{size}"
            if name not in _ONCE:
                rule += f" or {('T', *size)}".replace("'", "")
            raise ValueError(
                f"{where}: {name} must have shape {rule}, got shape {array.shape}."
            )
        if varies:
            lengths[name] = len(array)
    if horizon is not None:
        lengths["horizon"] = check_count(horizon, "horizon", where)
    ends: Any = ()
    if rows is not None:
        ends = rows.lower, rows.upper, rows.linear, rows.quadratic
    for name, value, extra in (
        ("states", states, 1),
        ("controls", controls, 0),
        ("rows", ends, 0),
    ):
        # A bound may be a list of lists.
        is_pair = isinstance(value, tuple | list)
        for array in value if is_pair else jax.tree.leaves(value):
            if array is not None and np.ndim(array) == 2:
                lengths[name] = np.shape(array)[0] - extra
    if not lengths:
        raise ValueError(
            f"{where}: horizon must be given if no argument has a time axis."
        )
    if len(set(lengths.values())) > 1:
        words = ", ".join(f"{name}: {length}" for name, length in lengths.items())
        raise ValueError(
            f"{where}: all arguments must have the same number of stages, got {words}."
        )
    return next(iter(lengths.values()))


def check_stage_weights(given: dict[str, Array], where: str) -> None:
    """Raise an error unless the cost of every stage is convex."""
    parts = [given[name] for name in ("Q", "R", "S") if name in given]
    if all(map(is_concrete, parts)):
        Q, R, *cross = map(np.asarray, parts)
        S = cross[0] if cross else np.zeros((Q.shape[-1], R.shape[-1]), Q.dtype)
        stages = np.broadcast_shapes(Q.shape[:-2], R.shape[:-2], S.shape[:-2])
        Q, S, R = (np.broadcast_to(M, (*stages, *M.shape[-2:])) for M in (Q, S, R))
        check_convex(
            np.block([[Q, S], [np.swapaxes(S, -1, -2), R]]), "[[Q, S], [S', R]]", where
        )
    if "final" in given:
        check_convex(given["final"], "final", where)
