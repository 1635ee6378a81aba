"""Linear models from files, and from and to python-control."""

import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .._check import as_path, is_concrete
from .._check_models import check_time_invariant
from .._extras import extra
from .._module import indexed_names
from ..dynamics import LinearDynamics
from ..systems import LinearSystem


def read_linear(
    path: str | os.PathLike, *, dt: Any = None
) -> LinearSystem | LinearDynamics:
    r"""Read a linear model from a file with its matrices, `.npz` of NumPy or `.mat` of
    MATLAB.

    The model is $\dot x = A x + B u + E w$ in continuous time, or
    $x_{k+1} = A x_k + B u_k + E w_k$, with the observation $y = C x$. The file must
    hold `A` and `B`. The file may also hold `C`, `E`, the step `dt`, and a `D` that is
    zero.

    **Arguments:**

    - `path`: the path of the file.
    - `dt`: the step, or 0 for continuous time. By default the step is the `dt` of the
        file.

    **Returns:** a [`delucax.systems.LinearSystem`][] if the step is 0, otherwise
    [`delucax.LinearDynamics`][].

    **Raises:** `ValueError` if the file has another format, if it lacks `A`, `B` or a
    step, if its step differs from `dt`, if its `D` is not zero, or if the shapes of the
    matrices do not match. `OSError` if the file cannot be read.

    !!! example

        ```python
        import delucax as dlx
        import numpy as np

        np.savez("plant.npz", A=[[0.9, 0.1], [0.0, 0.8]], B=[[0.0], [1.0]], dt=0.1)
        model = dlx.interop.read_linear("plant.npz")
        env = dlx.make("lds", system=model)
        model.A
        ```

        ```text
        Array([[0.9, 0.1],
               [0. , 0.8]], dtype=float32)
        ```
    """
    where = "read_linear"
    held = _matrices(as_path(path, "path", where), where)
    if not {"A", "B"} <= held.keys():
        raise ValueError(
            f"{where}: '{path}' must hold A and B, got {', '.join(held) or 'none'}."
        )
    _check_no_feed_through(held.get("D", np.zeros(())), where)
    if dt is None and "dt" not in held:
        raise ValueError(
            f"{where}: '{path}' holds no dt; give it: 0 for continuous time, or the "
            "step."
        )
    step = float(np.reshape(held.get("dt", dt), ()))
    if dt is not None and float(dt) != step:
        raise ValueError(
            f"{where}: dt must be {step}, the one in '{path}', or left out, got {dt}."
        )
    return _linear_model(held["A"], held["B"], held.get("C"), held.get("E"), step)


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
            with warnings.catch_warnings():
                # About the class of sparse matrices, which plays no part here.
                warnings.simplefilter("ignore", DeprecationWarning)
                file = loadmat(path, variable_names=names)
        except NotImplementedError as error:
            raise ValueError(
                f"{where}: '{path}' is a .mat file of version 7.3; save it with "
                "'-v7' in MATLAB."
            ) from error
    else:
        raise ValueError(f"{where}: path must end in .npz or .mat, got '{path}'.")
    return {name: _real(file[name], name, where) for name in names if name in file}


def _real(matrix: Any, name: str, where: str) -> np.ndarray:
    """A matrix from a file, which may be sparse."""
    matrix = np.asarray(matrix.toarray() if hasattr(matrix, "toarray") else matrix)
    if np.iscomplexobj(matrix):
        raise ValueError(f"{where}: {name} must be real, but is complex in the file.")
    return matrix.astype(float)


def to_control(
    model: LinearSystem | LinearDynamics, *, disturbances: bool = False
) -> Any:
    """Convert a linear model to a `control.StateSpace` of python-control.

    Use the result for the Bode, Nyquist and root-locus plots of python-control. The
    conversion needs the extra `delucax[control]`. The result describes deviations from
    the operating point of the model: `StateSpace` cannot store that point. States and
    inputs keep their names. If the whole state is observed, outputs have the names of
    the states, otherwise the names are `y[0]`, `y[1]`, ...

    **Arguments:**

    - `model`: a [`delucax.systems.LinearSystem`][], or time-invariant
        [`delucax.LinearDynamics`][].
    - `disturbances`: whether the disturbances become inputs too, named `w0`, `w1`, ...,
        with the columns of `E`. By default the inputs are the controls only. For
        dynamics without `E`, the columns of the identity are appended.

    **Returns:** a `control.StateSpace`. The `dt` of the result is the step of the
    dynamics, or 0 for a system.

    **Raises:** `ImportError` without python-control. `ValueError` if `model` is not
    linear, is time-varying or is being traced, or if `disturbances` is true for a
    system without `E`.

    !!! example

        ```python
        import delucax as dlx

        upright = dlx.linearize(dlx.systems.Pendulum())
        dlx.interop.to_control(upright).poles().real
        ```

        ```text
        array([ 3.873, -3.873])
        ```
    """
    where = "to_control"
    control = extra("control", "control")
    if not isinstance(model, LinearSystem | LinearDynamics):
        raise ValueError(
            f"{where}: model must be a LinearSystem or LinearDynamics "
            "(`delucax.linearize` makes one of any system or dynamics), got "
            f"{type(model).__name__}."
        )
    discrete = isinstance(model, LinearDynamics)
    if discrete:
        check_time_invariant(model, "model", where)
    if not is_concrete(model.A):
        raise ValueError(
            f"{where}: model must be concrete, got one that is being traced (by "
            "jax.jit, jax.vmap or jax.grad); python-control computes in NumPy."
        )
    n, names = model.state_size, list(model.state_names)
    inputs, B = list(model.control_names), np.asarray(model.B)
    if disturbances:
        if model.E is None and not discrete:
            raise ValueError(
                f"{where}: disturbances=True needs a model with E, which says how they "
                "enter the vector field, got a LinearSystem whose E is None."
            )
        E = np.eye(n) if model.E is None else np.asarray(model.E)
        B = np.concatenate([B, E], axis=1)
        inputs += indexed_names("w", E.shape[1])
    C = np.eye(n) if model.C is None else np.asarray(model.C, float)
    outputs = names if np.array_equal(C, np.eye(n)) else len(C)
    signals: Any = dict(states=names, inputs=inputs, outputs=outputs)
    dt = float(model.dt) if isinstance(model, LinearDynamics) else 0
    matrices = np.asarray(model.A, float), B.astype(float), C, 0
    return control.StateSpace(*matrices, dt, **signals, remove_useless_states=False)


def from_control(
    system: Any, *, disturbances: Sequence[str | int | np.integer] = ()
) -> LinearSystem | LinearDynamics:
    """Convert a `control.StateSpace` of python-control to a linear model.

    The operating point of the model is the origin. The conversion needs the extra
    `delucax[control]`. States and controls keep their names. If `C` is the identity,
    the model needs no `C`, because the observation is the state itself.

    **Arguments:**

    - `system`: a `control.StateSpace` without feed-through: its `D` must be zero.
    - `disturbances`: the inputs that are disturbances, by name or index; none by
        default. The columns of `system.B` that belong to these inputs become the
        columns of `E`, in this order.

    **Returns:** a [`delucax.systems.LinearSystem`][] if `system.dt` is 0, otherwise
    [`delucax.LinearDynamics`][] with the step `system.dt`. A `dt` of `True`, which
    means discrete time with an unspecified step, becomes a step of 1.

    **Raises:** `ImportError` without python-control. `ValueError` if `system` is not a
    `StateSpace`, has a `D` that is not zero, has no time base or no states, or if one
    of `disturbances` is not an input.

    !!! example

        ```python
        import control
        import delucax as dlx

        integrator = control.ss([[0.0]], [[1.0]], [[1.0]], 0, inputs=["force"])
        dlx.interop.from_control(integrator).control_names
        ```

        ```text
        ('force',)
        ```
    """
    where = "from_control"
    control = extra("control", "control")
    if not isinstance(system, control.StateSpace):
        raise ValueError(
            f"{where}: system must be a control.StateSpace (`control.ss` makes one of "
            f"a transfer function), got {type(system).__name__}."
        )
    _check_no_feed_through(system.D, where)
    if system.dt is None:
        raise ValueError(
            f"{where}: system must say its time base: dt=0 for continuous time, or its "
            "step, got dt=None."
        )
    if system.nstates == 0:
        raise ValueError(f"{where}: system must have states, got none.")
    labels = list(system.input_labels)
    for d in disturbances:
        is_index = isinstance(d, int | np.integer) and not isinstance(d, bool)
        is_known = isinstance(d, str) and d in labels
        if not (is_known or is_index and d in range(len(labels))):
            raise ValueError(
                f"{where}: disturbances must be among the inputs {labels}, by name or "
                f"index, got {d!r}."
            )
    chosen = [labels.index(d) if isinstance(d, str) else d for d in disturbances]
    if len(set(chosen)) != len(chosen):
        raise ValueError(
            f"{where}: disturbances must be different inputs, got {disturbances!r}."
        )
    rest = [i for i in range(len(labels)) if i not in chosen]
    n = system.nstates
    identity = system.C.shape == (n, n) and np.array_equal(system.C, np.eye(n))
    return _linear_model(
        system.A,
        system.B[:, rest],
        None if identity else system.C,
        system.B[:, chosen] if chosen else None,
        float(system.dt),
        state_names=tuple(system.state_labels),
        control_names=tuple(labels[i] for i in rest),
    )


def _check_no_feed_through(D: Any, where: str) -> None:
    """Raise if `D` is not zero."""
    if np.any(D):
        raise ValueError(
            f"{where}: D must be zero, because delucax has no feed-through, got "
            f"{D.tolist()}."
        )


def _linear_model(
    A: Any, B: Any, C: Any, E: Any, dt: float, **names: Any
) -> LinearSystem | LinearDynamics:
    """A system if the step is 0 (continuous time), else dynamics."""
    if dt == 0:
        return LinearSystem(A, B, C, E, **names)
    return LinearDynamics(A, B, C, E, dt=dt, **names)
