"""The entry: a function or a controller as a program in C."""

from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np

from .._check import check_count, check_key
from .._controller import AbstractController
from .._files import as_path
from ..dynamics import AbstractDynamics
from ..systems import AbstractPlant, AbstractSystem
from . import _file
from ._cast import dtype_of
from ._controller import export_controller, unit_lines
from ._function import export_function
from ._report import Report


def c(
    function_or_controller: Any,
    directory: Any,
    *,
    name: Any,
    dtype: Any = None,
    example: Any = None,
    fallback: Any = None,
    key: Any = None,
    plant: AbstractPlant | None = None,
    max_iterations: int | None = None,
) -> Report:
    """Write a controller, a plant or a function as a program in C.

    `NAME.h` and `NAME.c` are written to `directory`: C99, which needs `math.h` alone.
    The program takes no memory but the stack, has no recursion and no variable that
    outlives a call, and ends all its loops after a number of rounds that the report
    says. What does not depend on the inputs, such as weights, is in it as constants.

    Of a controller there are `NAME_init(state)`, `NAME_step(state, t, y, u)` and
    `NAME_applied(state, u, cost)`, which do what its `init`, its call and its `applied`
    do. A step returns 0, or a flag if its input or what it computes is not finite:
    `NAME_BAD_INPUT` or `NAME_BAD_RESULT`. The control is the last good one then (zeros
    before there is one), and the state stays as it was before the step. What raises an
    error at run time in Python, such as `equinox.error_if`, gives `NAME_BAD_RESULT`.

    Of a function there is `NAME(inputs..., outputs...)`, which takes numbers by value
    and arrays by pointers to their entries, the last index running fastest, writes its
    outputs in every case, and returns the same flags. The arrays that it closes over
    become constants. Of a plant that is its field or its step, a function of
    `(t, x, u)`, and of `w` where the plant names its disturbances.

    **Arguments:**

    - `function_or_controller`: a [`delucax.AbstractController`][], an
        [`delucax.AbstractSystem`][], an [`delucax.AbstractDynamics`][], or a function
        of arrays.
    - `directory`: where the files go; it is made if need be.
    - `name`: an identifier in C, with which all public names begin.
    - `dtype`: `"float32"` or `"float64"`, of all real numbers; by default that of the
        arrays in what is given. It need not be the one of this process.
    - `example`: the inputs of a function, a tuple of arrays, numbers or
        `jax.ShapeDtypeStruct`, or pytrees of them, of which the shapes count; of a
        controller an observation, where its size cannot be found out.
    - `fallback`: the control where a step fails, shape `(m,)`; by default the last good
        one.
    - `key`: a random key, for a controller that draws, such as
        [`delucax.controllers.BPC`][]. The state holds its two words, and C draws the
        numbers that JAX would: those of `init(key=key)`, each time it starts.
    - `plant`: whose names and units the header of a controller tells; by default those
        of a plant that the controller holds.
    - `max_iterations`: the most rounds of each loop for which no bound is found. A loop
        that would go on is left there, and the flag is `NAME_BAD_RESULT`.

    **Returns:** a [`delucax.export.Report`][].

    **Raises:** `ValueError` for what cannot be written in C, such as eigenvalues,
    calls of Python and random draws of a function, with the line of your code; for a
    name that is no identifier; and for a directory that cannot be written. Then no file
    is changed.

    !!! example

        ```python
        import tempfile
        import delucax as dlx
        import jax.numpy as jnp

        pendulum = dlx.systems.Pendulum()
        law = dlx.controllers.Linear(jnp.array([[20.0, 5.0]]))
        with tempfile.TemporaryDirectory() as folder:
            dlx.export.c(law, folder, name="law")
            dlx.export.c(pendulum, folder, name="pendulum")
            report = dlx.export.c(
                lambda x: jnp.sum(x**2), folder, name="square", example=(jnp.ones(3),)
            )
        ```
    """
    where = "export.c"
    if not isinstance(name, str) or not _file.is_public(name):
        raise ValueError(
            f"{where}: name must be an identifier in C of at most 63 letters, such as "
            "'controller', that neither C and its headers use, nor the routines in the "
            f"file, such as 'minimum_f32', got {name!r}."
        )
    folder = Path(as_path(directory, "directory", where))
    if key is not None:
        check_key(key, where)
    if max_iterations is not None:
        check_count(max_iterations, "max_iterations", where)
    if not callable(function_or_controller) and not isinstance(
        function_or_controller, AbstractSystem
    ):
        raise ValueError(
            f"{where}: function_or_controller must be a controller, a plant or a "
            f"function, got {type(function_or_controller).__name__}."
        )
    real = dtype_of(
        (function_or_controller, example if dtype is None else None), dtype, where
    )
    if isinstance(function_or_controller, AbstractController):
        made = export_controller(
            function_or_controller,
            name,
            real,
            example,
            fallback,
            key,
            plant,
            max_iterations,
        )
    else:
        for given, label in (
            (fallback, "fallback"),
            (key, "key"),
            (plant, "plant"),
        ):
            if given is not None:
                raise ValueError(
                    f"{where}: {label} is given, but there is no controller."
                )
        given = _as_function(function_or_controller, example, where)
        function, example, labels, notes = given
        made = export_function(
            function, name, real, example, labels, notes, max_iterations
        )
    header, text, functions, constants, state = made
    texts = {f"{name}.h": header, f"{name}.c": text}
    files = _file.write_both(folder, texts)
    return _file.report(files, functions, constants, state, text)


def _as_function(given: Any, example: Any, where: str) -> Any:
    """A function, its example, the names of its arguments, and a comment."""
    if not isinstance(given, AbstractSystem | AbstractDynamics):
        if not isinstance(example, tuple | list):
            raise ValueError(
                f"{where}: example must be a tuple of the function's inputs, got "
                f"{type(example).__name__}."
            )
        kind = getattr(given, "__name__", type(given).__name__)
        return given, example, None, [f"The function {kind} in C, made by delucax.", ""]
    if example is not None:
        raise ValueError(f"{where}: example is given, but a plant tells its sizes.")
    n, m, k = given.state_size, given.control_size, given.disturbance_size
    sizes: list[Any] = [0.0, _zeros(n), _zeros(m)]
    labels = ["t", "x", "u"]
    is_step = isinstance(given, AbstractDynamics)
    if given.noise is None or given.noise == "brownian" and is_step:
        sizes.append(_zeros(k))
        labels.append("w")
    does = "time derivative of the state"
    if is_step:
        does = f"state after a step of {float(given.dt):g} {given.time_unit}"
    notes = [
        f"The {does} of a {type(given).__name__} in C, made by delucax.",
        "",
        *unit_lines("x", given.state_names, given.state_units),
        *unit_lines("u", given.control_names, given.control_units),
        "",
    ]
    return _Plant(given), sizes, labels, notes


def _zeros(size: int) -> Any:
    return np.zeros(size)


class _Plant(eqx.Module):
    """The function of a plant."""

    plant: Any

    def __call__(self, t, x, u, w=None):
        if isinstance(self.plant, AbstractSystem):
            return {"dx": self.plant.vector_field(t, x, u, w)}
        return {"x_next": self.plant(t, x, u, w)}
