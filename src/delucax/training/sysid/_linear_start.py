"""A linear state-space model and its encoder, at which the training starts."""

from typing import NamedTuple

import numpy as np

from ..._results import RESULTS
from ._record import Record
from ._subspace import subspace


# The A of a model that is not stable is scaled to this spectral radius.
_STABLE = 0.999
# About this many windows are used to estimate the size of the states.
_WINDOWS = 2000


class LinearStart(NamedTuple):
    """A linear model in normalised units, and an encoder of its state.

    The model is `x_next = A x + B v`, `y = C x + level`, and the encoder is
    `x = matrix z + offset`. If no model could be fitted, `is_good` is false and the
    arrays are zero.
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    level: np.ndarray
    matrix: np.ndarray
    offset: np.ndarray
    units: dict[str, np.ndarray]
    is_good: bool


def linear_start(records: list[Record], states: int, past: int) -> LinearStart:
    """The start from a fit by `subspace`, scaled so that its states have size 1."""
    units = dict[str, np.ndarray]()
    for letter, name in (("y", "outputs"), ("u", "controls")):
        rows = np.concatenate([getattr(record, name) for record in records])
        size = np.std(rows, axis=0)
        units[f"{letter}_mean"] = np.mean(rows, axis=0)
        units[f"{letter}_size"] = np.where(size > 0, size, 1).astype(rows.dtype)
    scaled = [
        Record(
            (np.asarray(r.outputs) - units["y_mean"]) / units["y_size"],
            (np.asarray(r.controls) - units["u_mean"]) / units["u_size"],
            dt=r.dt,
        )
        for r in records
    ]
    p, m = scaled[0].outputs.shape[1], scaled[0].controls.shape[1]
    dtype = np.asarray(scaled[0].outputs).dtype
    zeros = lambda *shape: np.zeros(shape, dtype)
    blank = LinearStart(
        zeros(states, states),
        zeros(states, m),
        zeros(p, states),
        zeros(p),
        zeros(states, past * (p + m)),
        zeros(states),
        units,
        False,
    )
    try:
        fit = subspace(scaled, states, affine=states >= p, throw=False)
    except ValueError:  # too few samples or outputs for this many states
        return blank
    if fit.result != RESULTS.successful:
        return blank
    model = fit.model
    A, B, C, x_ref = (np.asarray(M) for M in (model.A, model.B, model.C, model.x_ref))
    radius = np.max(np.abs(np.linalg.eigvals(A)))
    A = A * min(1, _STABLE / max(radius, _STABLE))
    # The singular values are the variances of the balanced states.
    spread = np.asarray(fit.singular_values)[:states]
    noise = float(np.mean(np.asarray(fit.error) ** 2) + 10 * np.finfo(dtype).eps)
    level = C @ x_ref
    matrix = _encoder(A, B, C, spread, noise, past)
    offset = -matrix[:, : past * p] @ np.tile(level, past)
    windows = _windows(scaled, past)
    size = np.std(windows @ matrix.T, axis=0)
    size = np.where(size > 0, size, 1)
    matrices = A * size / size[:, None], B / size[:, None], C * size
    encoder = matrix / size[:, None], offset / size
    arrays = [array.astype(dtype) for array in (*matrices, level, *encoder)]
    if not all(np.all(np.isfinite(array)) for array in arrays):
        return blank
    return LinearStart._make([*arrays, units, True])


def _encoder(
    A: np.ndarray,
    B: np.ndarray,
    C: np.ndarray,
    spread: np.ndarray,
    noise: float,
    past: int,
) -> np.ndarray:
    """The matrix from past outputs and controls to the mean of the state after them.

    The first state has the variances `spread`, and each output the variance `noise`.
    """
    (n, m), p = B.shape, len(C)
    powers: list[np.ndarray] = [np.eye(n)]
    for _ in range(past):
        powers.append(A @ powers[-1])
    # The outputs are observed x_0 + moved u, and the state after them is
    # powers[past] x_0 + reached u.
    observed = np.concatenate([C @ power for power in powers[:past]])
    reached = np.concatenate([power @ B for power in powers[past - 1 :: -1]], axis=1)
    moved = np.zeros((past * p, past * m))
    for k in range(1, past):
        moved[k * p : (k + 1) * p, : k * m] = C @ reached[:, (past - k) * m :]
    variance = (observed * spread) @ observed.T + noise * np.eye(past * p)
    back = np.linalg.solve(variance, observed * spread).T
    of_outputs = powers[past] @ back
    return np.concatenate([of_outputs, reached - of_outputs @ moved], axis=1)


def _windows(records: list[Record], past: int) -> np.ndarray:
    """Windows of past outputs and controls, in the order that the encoder takes."""
    total = sum(len(record) - past + 1 for record in records)
    stride = max(1, total // _WINDOWS)
    rows = []
    for record in records:
        y, u = np.asarray(record.outputs), np.asarray(record.controls)
        begins = np.arange(0, len(y) - past + 1, stride)[:, None]
        inside = begins + np.arange(past)
        parts = [signal[inside].reshape(len(begins), -1) for signal in (y, u)]
        rows.append(np.concatenate(parts, axis=1))
    return np.concatenate(rows)
