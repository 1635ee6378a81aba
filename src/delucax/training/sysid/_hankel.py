"""A linear system from the triangular factor of block Hankel matrices."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..._host import host_unless_traced, scan, xp
from ..._results import RESULTS
from ..._typing import Array
from ...riccati import filter_dare
from ._record import Record


# This many columns of the Hankel matrices are built at a time.
_CHUNK = 4096
# Noise below this many units in the last place counts as rounding.
_ROUNDING = 1e3
# The noise of each state, relative to its size, that is assumed when the first states
# are fitted. It is nearly zero, but lets the predictor of an integrator forget old
# noise within some hundred steps.
_SLIGHT = 1e-3


class Units(NamedTuple):
    """The mean and the size by which each output and control is normalised."""

    outputs: tuple[Float[Array, " p"], Float[Array, " p"]]
    controls: tuple[Float[Array, " m"], Float[Array, " m"]]

    def of(self, group: Record) -> tuple[Array, Array]:
        """The outputs and the controls of stacked records in these units."""
        (y_mean, y_size), (u_mean, u_size) = self
        return (group.outputs - y_mean) / y_size, (group.controls - u_mean) / u_size


class Realised(NamedTuple):
    """The matrices of the system that the factor gives, in the units of `Units`."""

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
    """The units, and A, C and K from the triangular factor of the Hankel matrices."""
    units = _units(groups, affine)
    signals = [units.of(group) for group in groups]
    p, m = (signal.shape[2] for signal in signals[0])
    L = _factor(signals, horizon, affine)
    # The rows of L: 1, all controls, the past outputs, the outputs of the horizon.
    controls, future = affine + 2 * horizon * m, affine + horizon * (2 * m + p)
    eps = float(np.finfo(L.dtype).eps)
    moves = xp.linalg.svd(L[affine:controls, affine:controls], compute_uv=False)
    rank = xp.sum(moves > 10 * len(moves) * eps * moves[0])
    excited = rank >= min(2 * horizon, horizon + order) * m
    # The outputs of the horizon, predicted from the past, less the effect of the
    # controls of the horizon, are the observability matrix times the state.
    past = L[future:, affine + horizon * m : future]
    directions, values, _ = xp.linalg.svd(past, full_matrices=False)
    size = xp.sqrt(xp.maximum(values[:order], eps * values[0]))
    observed = directions[:, :order] * size
    back = xp.linalg.pinv(observed[:-p])
    A, C = back @ observed[p:], observed[:p]
    # An innovation, the part of an output that the past does not predict, moves the
    # later outputs by C K, C A K and so on.
    new, after = L[future : future + p, future:], L[future + p :, future:]
    new, after = new[:, :p], after[:, :p]
    tiny = (_ROUNDING * eps) ** 2
    variance = new @ new.T + tiny * xp.eye(p, dtype=L.dtype)
    gain = back @ xp.linalg.solve(variance, new @ after.T).T
    unit, slight = xp.eye(p, dtype=L.dtype), xp.diag(_SLIGHT * size) ** 2
    start_gain = filter_dare(A, C, slight, unit, throw=False).K
    # Several predictors have errors of the same spectrum. Take the stable one: it is
    # the one with this gain, up to rounding, if that is stable.
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
    # The controls of the horizon come first, so that the factor removes their effect;
    # the first step of the horizon comes last of them.
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
            # Rows of zeros, which fill up the last chunk, change nothing.
            rows = xp.concatenate(parts, axis=1) * counts[:, None]
            return xp.linalg.qr(xp.concatenate([R, rows]), mode="r"), None

        R, _ = scan(updated, R, (begins, counts))
    return R.T / float(np.sqrt(total))
