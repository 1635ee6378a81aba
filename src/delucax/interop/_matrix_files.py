"""Linear models from files of matrices."""

import os
from pathlib import Path
from typing import Any

import numpy as np

from .._check import as_path
from ..dynamics import LinearDynamics
from ..systems import LinearSystem
from ._linear_model import check_no_feed_through, linear_model


def read_linear(
    path: str | os.PathLike, *, dt: Any = None
) -> LinearSystem | LinearDynamics:
    """A linear model from a file of its matrices, `.npz` of NumPy or `.mat` of MATLAB.

    The file holds `A` and `B`, and may hold `C`, `E` (how disturbances enter), `D` if
    it is zero, and the step `dt`.

    **Arguments:**

    - `path`: the file.
    - `dt`: the step, 0 for continuous time; by default the one that the file holds.

    **Returns:** [`delucax.LinearDynamics`][] with a step, and
    [`delucax.systems.LinearSystem`][] in continuous time.

    **Raises:** `ValueError` if the file is of another kind, lacks `A`, `B` or a step,
    has one that differs from `dt`, has a `D` that is not zero, or if shapes do not fit;
    `OSError` if it cannot be read.

    !!! example

        ```python
        import delucax as dlx
        import numpy as np

        np.savez("plant.npz", A=[[0.9, 0.1], [0.0, 0.8]], B=[[0.0], [1.0]], dt=0.1)
        env = dlx.make("lds", system=dlx.interop.read_linear("plant.npz"))
        ```
    """
    where = "read_linear"
    held = _matrices(as_path(path, "path", where), where)
    if not {"A", "B"} <= held.keys():
        raise ValueError(
            f"{where}: '{path}' must hold A and B, got {', '.join(held) or 'none'}."
        )
    check_no_feed_through(held.get("D", np.zeros(())), where)
    if dt is None and "dt" not in held:
        raise ValueError(
            f"{where}: '{path}' holds no dt; give it: 0 for continuous time, or the "
            "step."
        )
    step = float(np.reshape(held.get("dt", dt), ()))
    if dt is not None and float(dt) != step:
        raise ValueError(
            f"{where}: dt must be that of '{path}', {step}, or left out, got {dt}."
        )
    return linear_model(held["A"], held["B"], held.get("C"), held.get("E"), step)


def _matrices(path: Path, where: str) -> dict[str, Any]:
    """The matrices in a file, by name."""
    names = ("A", "B", "C", "D", "E", "dt")
    if path.suffix in (".npz", ".mat") and not path.is_file():
        raise FileNotFoundError(f"{where}: path must be a file, got '{path}'.")
    if path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as archive:
            file = {name: archive[name] for name in names if name in archive}
    elif path.suffix == ".mat":
        from scipy.io import loadmat

        try:
            file = loadmat(path, variable_names=names)
        except NotImplementedError as error:
            raise ValueError(
                f"{where}: '{path}' is a .mat file of version 7.3; save it with "
                "'-v7' in MATLAB."
            ) from error
    else:
        raise ValueError(f"{where}: path must end in .npz or .mat, got '{path}'.")
    return {name: np.asarray(file[name], float) for name in names if name in file}
