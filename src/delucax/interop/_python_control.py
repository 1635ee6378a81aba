"""Linear models as `control.StateSpace`, and back."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from .._check import is_concrete
from .._extras import extra
from .._module import indexed_names
from ..dynamics import LinearDynamics
from ..systems import LinearSystem
from ._linear_model import check_no_feed_through, linear_model


def to_control(
    model: LinearSystem | LinearDynamics, *, disturbances: bool = False
) -> Any:
    """A linear model as a `control.StateSpace` of python-control,

    for its Bode, Nyquist and root-locus plots. Needs the extra `delucax[control]`. The
    matrices are about the operating point, which `StateSpace` has no place for. States
    and inputs keep their names; outputs are named after the states where the state is
    observed, and `y[0]`, ... else.

    **Arguments:**

    - `model`: a [`delucax.systems.LinearSystem`][], or time-invariant
        [`delucax.LinearDynamics`][].
    - `disturbances`: append the columns of `E` to the inputs, named `w0`, ... (default:
        controls alone).

    **Returns:** a `control.StateSpace`, with the step of the dynamics.

    **Raises:** `ImportError` without python-control; `ValueError` if `model` is not
    linear, is time-varying or is being traced, or if there is no `E` to append.

    !!! example

        ```python
        import delucax as dlx

        upright = dlx.linearize(dlx.systems.Pendulum())
        dlx.interop.to_control(upright).poles()
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
    if discrete and model.is_time_varying:
        raise ValueError(
            f"{where}: model must be time-invariant, got matrices at "
            f"{model.A.shape[0]} times; `dynamics.at(t)` are those at one time."
        )
    if not is_concrete(model.A):
        raise ValueError(
            f"{where}: model must be concrete, got one that is being traced (by "
            "jax.jit, jax.vmap or jax.grad); python-control computes in NumPy."
        )
    inputs, columns = list(model.control_names), [np.asarray(model.B)]
    if disturbances:
        if model.E is None and not discrete:
            raise ValueError(
                f"{where}: disturbances=True needs a model with E, which says how they "
                "enter the vector field, got a LinearSystem whose E is None."
            )
        E = np.eye(model.state_size) if model.E is None else np.asarray(model.E)
        columns.append(E)
        inputs += indexed_names("w", E.shape[1])
    eye = np.eye(model.state_size)
    C = eye if model.C is None else np.asarray(model.C, float)
    states = list(model.state_names)
    B = np.concatenate(columns, axis=1).astype(float)
    return control.StateSpace(
        np.asarray(model.A, float),
        B,
        C,
        np.zeros((C.shape[0], B.shape[1])),
        float(model.dt) if isinstance(model, LinearDynamics) else 0,
        states=states,
        inputs=inputs,
        outputs=states if np.array_equal(C, eye) else C.shape[0],
        remove_useless_states=False,
    )


def from_control(
    system: Any, *, disturbances: Sequence[str | int] = ()
) -> LinearSystem | LinearDynamics:
    """A `control.StateSpace` of python-control as a linear model,

    about the origin. Needs the extra `delucax[control]`. States and controls keep their
    names. A `C` that is the identity is left out: the state is observed.

    **Arguments:**

    - `system`: a `control.StateSpace` without feed-through: its `D` must be zero.
    - `disturbances`: the inputs, by name or index, that are disturbances: the columns
        of `E`, in this order; none by default.

    **Returns:** [`delucax.systems.LinearSystem`][] if its step is 0, and
    [`delucax.LinearDynamics`][] if it has one (`True`, a step that is not given, is the
    default of 1).

    **Raises:** `ImportError` without python-control; `ValueError` if `system` is no
    `StateSpace`, has a `D` that is not zero, states neither continuous nor discrete
    time, has no states, or has no such input.

    !!! example

        ```python
        import control
        import delucax as dlx

        integrator = control.ss([[0.0]], [[1.0]], [[1.0]], 0, inputs=["force"])
        dlx.interop.from_control(integrator).control_names
        ```
    """
    where = "from_control"
    control = extra("control", "control")
    if not isinstance(system, control.StateSpace):
        raise ValueError(
            f"{where}: system must be a control.StateSpace (`control.ss` makes one of "
            f"a transfer function), got {type(system).__name__}."
        )
    check_no_feed_through(system.D, where)
    if system.dt is None:
        raise ValueError(
            f"{where}: system must say its time base: dt=0 for continuous time, or its "
            "step, got dt=None."
        )
    if system.nstates == 0:
        raise ValueError(f"{where}: system must have states, got none.")
    labels = list(system.input_labels)
    chosen = [_index(d, labels, where) for d in disturbances]
    if len(set(chosen)) != len(chosen):
        raise ValueError(
            f"{where}: disturbances must be different inputs, got {disturbances!r}."
        )
    rest = [i for i in range(len(labels)) if i not in chosen]
    n = system.nstates
    identity = system.C.shape == (n, n) and np.array_equal(system.C, np.eye(n))
    return linear_model(
        system.A,
        system.B[:, rest],
        None if identity else system.C,
        system.B[:, chosen] if chosen else None,
        float(system.dt),
        state_names=tuple(system.state_labels),
        control_names=tuple(labels[i] for i in rest),
    )


def _index(disturbance: Any, labels: list[str], where: str) -> int:
    if isinstance(disturbance, str) and disturbance in labels:
        return labels.index(disturbance)
    if isinstance(disturbance, int) and disturbance in range(len(labels)):
        return disturbance
    raise ValueError(
        f"{where}: disturbances must be among the inputs {labels}, by name or index, "
        f"got {disturbance!r}."
    )
