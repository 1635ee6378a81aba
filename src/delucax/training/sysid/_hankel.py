"""What the triangular factor of block Hankel matrices tells of a linear system."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..._host import host_unless_traced, scan, xp
from ..._results import RESULTS
from ..._typing import Array
from ...riccati import filter_dare
from ._record import Record


# Columns of the Hankel matrices that are made at once.
_CHUNK = 4096
# Noise of this many units in the last place is rounding.
_ROUNDING = 1e3
# The noise of each state, in parts of its size, against which first states are held.
# About zero, and enough to forget in some hundred steps what an integrator has summed.
_SLIGHT = 1e-3


class Units(NamedTuple):
    """What is subtracted from each output and control, and what that is divided by."""

    outputs: tuple[Float[Array, " p"], Float[Array, " p"]]
    controls: tuple[Float[Array, " m"], Float[Array, " m"]]

    def of(self, group: Record) -> tuple[Array, Array]:
        """The outputs and the controls of stacked records in these units."""
        (y_mean, y_size), (u_mean, u_size) = self
        return (group.outputs - y_mean) / y_size, (group.controls - u_mean) / u_size


class Realised(NamedTuple):
    """What the triangular factor tells, in the units of `Units`."""

    A: Float[Array, "n n"]
    C: Float[Array, "p n"]
    gain: Float[Array, "n p"]
    start_gain: Float[Array, "n p"]
    singular_values: Float[Array, " values"]
    excited: Array


@host_unless_traced
def realised(
    groups: list[Record], order: int, horizon: int, affine: bool
) -> tuple[Units, Realised]:
    """A, C and K, from the triangular factor of the block Hankel matrices."""
    units = _units(groups, affine)
    signals = [units.of(group) for group in groups]
    p, m = (signal.shape[2] for signal in signals[0])
    L = _factor(signals, horizon, affine)
    # Its rows: 1, all controls, past outputs, and those of the horizon.
    controls, future = affine + 2 * horizon * m, affine + horizon * (2 * m + p)
    eps = float(np.finfo(L.dtype).eps)
    moves = xp.linalg.svd(L[affine:controls, affine:controls], compute_uv=False)
    rank = xp.sum(moves > 10 * len(moves) * eps * moves[0])
    excited = rank >= min(2 * horizon, horizon + order) * m
    # What the past tells of the outputs, beside the controls of the horizon, is the
    # observability matrix times the state.
    past = L[future:, affine + horizon * m : future]
    directions, values, _ = xp.linalg.svd(past, full_matrices=False)
    size = xp.sqrt(xp.maximum(values[:order], eps * values[0]))
    observed = directions[:, :order] * size
    back = xp.linalg.pinv(observed[:-p])
    A, C = back @ observed[p:], observed[:p]
    # How the part of an output that nothing before tells moves those after it: by C K,
    # C A K and so on.
    new, after = L[future : future + p, future:], L[future + p :, future:]
    new, after = new[:, :p], after[:, :p]
    tiny = (_ROUNDING * eps) ** 2
    variance = new @ new.T + tiny * xp.eye(p, dtype=L.dtype)
    gain = back @ xp.linalg.solve(variance, new @ after.T).T
    unit, slight = xp.eye(p, dtype=L.dtype), xp.diag(_SLIGHT * size) ** 2
    start_gain = filter_dare(A, C, slight, unit, throw=False).K
    # Of all predictors of which the errors have the same spectrum, the stable one:
    # that with this gain itself, up to rounding, if it is.
    scale = xp.mean(xp.diag(variance))
    given = A - gain @ C, C, xp.diag(tiny * size**2) / scale, variance / scale
    more = filter_dare(*given, throw=False)
    good = more.result == RESULTS.successful
    gain = xp.where(good, gain + more.K, start_gain)
    return units, Realised(A, C, gain, start_gain, values, excited)


def _units(groups: list[Record], affine: bool) -> Units:
    def of(arrays):
        rows = xp.concatenate([array.reshape(-1, array.shape[2]) for array in arrays])
        mean = xp.mean(rows, axis=0) * affine
        size = xp.sqrt(xp.mean((rows - mean) ** 2, axis=0))
        return mean, xp.where(size > 0, size, xp.ones_like(size))

    return Units(of([g.outputs for g in groups]), of([g.controls for g in groups]))


def _factor(
    signals: list[tuple[Array, Array]], horizon: int, affine: bool
) -> Float[Array, "rows rows"]:
    """The lower triangular factor of the block Hankel matrices of all records."""
    p, m = (signal.shape[2] for signal in signals[0])
    width, dtype = affine + 2 * horizon * (m + p), signals[0][0].dtype
    # The controls of the horizon come before those of the past, whose part beside
    # them is looked for; its first step comes last.
    order = np.r_[horizon + 1 : 2 * horizon, horizon, :horizon]
    R, total = xp.zeros((width, width), dtype), 0
    for y, u in signals:
        runs, count = y.shape[:2]
        columns = count - 2 * horizon + 1
        if columns < 1:
            continue
        total += runs * columns
        y, u = y.reshape(-1, p), u.reshape(-1, m)
        begins = (np.arange(runs)[:, None] * count + np.arange(columns)).ravel()
        size = min(max(_CHUNK, 2 * width), len(begins))
        fill = -len(begins) % size
        counts = np.pad(np.ones(len(begins), dtype), (0, fill)).reshape(-1, size)
        begins = np.pad(begins, (0, fill)).reshape(-1, size)

        def updated(R, chunk, y=y, u=u, size=size):
            begins, counts = chunk
            inside = begins[:, None] + np.arange(2 * horizon)
            parts = [xp.ones((size, 1), dtype)] * affine
            parts += [u[inside[:, order]].reshape(size, -1)]
            parts += [y[inside].reshape(size, -1)]
            # Rows of zeros, where there is no stretch, change nothing.
            rows = xp.concatenate(parts, axis=1) * counts[:, None]
            return xp.linalg.qr(xp.concatenate([R, rows]), mode="r"), None

        R, _ = scan(updated, R, (begins, counts))
    return R.T / float(np.sqrt(total))
