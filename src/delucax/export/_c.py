"""The function `export.c`, which writes programs in C."""

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

    The files are `NAME.h` and `NAME.c` in `directory`. The files are C99 and need only
    the C standard library. The program uses the stack only: it allocates no memory. The
    program has no recursion, and no variable keeps its value from one call to the next.
    Every loop has a bound. Every value that does not depend on the inputs, such as the
    weights of a network, becomes a constant.

    A controller becomes three functions, `NAME_init(state)`,
    `NAME_step(state, t, y, u)` and `NAME_applied(state, u, cost)`. These C functions do
    the same as the methods `init`, `__call__` and `applied` of the controller.
    `NAME_step` returns 0 if all numbers are finite, `NAME_BAD_INPUT` if an input is not
    finite, and `NAME_BAD_RESULT` if a result is not finite. If `NAME_step` does not
    return 0, the control is `fallback`, and the state stays as it was before the step.
    A step in which Python would raise an error, for example with `equinox.error_if`,
    returns `NAME_BAD_RESULT`.

    A function becomes `NAME(inputs..., outputs...)`. The C function takes numbers by
    value, and arrays as pointers to their entries in row-major order. The C function
    always writes its outputs, and returns the same flags as `NAME_step`. Arrays in the
    closure of the function become constants.

    A plant is exported as a function. For a system, this function is the vector field.
    For dynamics, it is the step to the next state. The inputs are `(t, x, u)`. The
    disturbance `w` is a fourth input if it occurs in the equations of the plant, or if
    it holds the increments of a Brownian motion.

    **Arguments:**

    - `function_or_controller`: a [`delucax.AbstractController`][], an
        [`delucax.AbstractSystem`][], a [`delucax.AbstractDynamics`][], or a function
        of arrays.
    - `directory`: the folder to write to. The folder is created if it does not exist.
    - `name`: an identifier in C. All public names in the C code begin with `name`.
    - `dtype`: the type of all real numbers, `"float32"` or `"float64"`. By default the
        type is the type of the arrays in `function_or_controller` and `example`. You
        can choose `"float64"` even if JAX computes in float32 in this process, and the
        other way round.
    - `example`: if you export a function, a tuple of example inputs, which may be
        arrays, numbers, `jax.ShapeDtypeStruct`, or pytrees of them. Only the shapes and
        types of these inputs are used. If you export a controller, `example` is an
        observation. It is needed only if the controller itself does not determine the
        size of its observation.
    - `fallback`: the control that a step returns if it fails, shape `(m,)`. By default
        the fallback is the control of the last step that succeeded, or zeros if no step
        has succeeded yet.
    - `key`: a random key, for a controller that draws random numbers, such as
        [`delucax.controllers.BPC`][]. The state in C holds this key. The C code draws
        the same random numbers as the controller in JAX draws after `init(key=key)`.
        Each call of `NAME_init` restarts the same sequence of random numbers.
    - `plant`: a plant whose names and units are written into the header of a
        controller. By default the plant is taken from the controller, if it holds one.
    - `max_iterations`: the largest number of iterations of a loop, for loops whose
        number of iterations cannot be bounded in advance. A loop that would need more
        iterations stops after `max_iterations`, and the flag is `NAME_BAD_RESULT`.

    **Returns:** a [`delucax.export.Report`][].

    **Raises:** `ValueError` if something cannot be written in C, such as eigenvalues,
    callbacks to Python, or random numbers in a function. The message names the line of
    your code. A `ValueError` is also raised if `name` is not an identifier in C, or
    `directory` cannot be written to. If an error is raised, no file is changed.

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
        report
        ```

        ```text
        constants   0 bytes
        state       0 bytes
        stack       68 bytes
        operations  12 a call
        lines of C  24
        ```
    """
    where = "export.c"
    if not isinstance(name, str) or not _file.is_public(name):
        raise ValueError(
            f"{where}: name must be an identifier in C of at most 63 letters, such as "
            "'controller', and must not be a name of C, of its headers or of a routine "
            f"in the file, such as 'minimum_f32', got {name!r}."
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
                    f"{where}: {label} is given, but only a controller takes it, and "
                    "function_or_controller is a "
                    f"{type(function_or_controller).__name__}."
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
    """The function, its example, the names of its arguments, and lines of a comment."""
    if not isinstance(given, AbstractSystem | AbstractDynamics):
        if not isinstance(example, tuple | list):
            raise ValueError(
                f"{where}: example must be a tuple of the function's inputs, got "
                f"{type(example).__name__}."
            )
        kind = getattr(given, "__name__", type(given).__name__)
        return given, example, None, [f"The function {kind} in C, made by delucax.", ""]
    if example is not None:
        raise ValueError(
            f"{where}: example is given, but a plant knows its sizes: leave it out."
        )
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
    """The vector field of a system, or the step of dynamics, as a function."""

    plant: Any

    def __call__(self, t, x, u, w=None):
        if isinstance(self.plant, AbstractSystem):
            return {"dx": self.plant.vector_field(t, x, u, w)}
        return {"x_next": self.plant(t, x, u, w)}
