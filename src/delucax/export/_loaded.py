"""Exported C as a controller and as a function in Python."""

import functools
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._controller import AbstractController, Tally
from .._message import shortened
from .._typing import Array, PRNGKey, RealScalar
from ._description import Description
from ._library import address, as_input, calls_of, function_of, passed


class LoadedState(NamedTuple):
    """The state of a controller in C.

    - `memory`: the bytes of its struct.
    - `declared`: the number of steps in which a number was not finite, so that the
        control was the fallback.
    """

    memory: Any
    declared: Tally


class LoadedController(AbstractController):
    """A controller in C. [`delucax.export.load`][] returns one.

    Use it like any other controller. [`delucax.rollout`][] accepts this controller,
    also under `jit` and `vmap`: Python then calls the C code at each step. With NumPy
    arrays, the controller calls the C code directly and returns NumPy arrays. The
    controller computes in the precision that was chosen in the export. It has no
    derivative.

    If an input or a result of a step is not finite, the control is the `fallback` that
    was given to [`delucax.export.c`][], by default the control of the last step that
    succeeded. A rollout records each step that used the fallback in
    `trajectory.incidents` as `"declared_answer"`. [`delucax.export.Running`][] gives a
    warning at such a step.

    **Arguments:**

    - `library`: the path of the compiled library.
    - `description`: the description of the program, as read from its header file.
        [`delucax.export.load`][] sets both.

    **Raises:** `ValueError` if the controller is called with an argument of the wrong
    shape, or with a state that does not come from `init`.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp
        import numpy as np
        import tempfile

        law = dlx.controllers.Linear(jnp.array([[20.0, 5.0]]))
        with tempfile.TemporaryDirectory() as folder:
            dlx.export.c(law, folder, name="law")
            controller = dlx.export.load(folder)
        state = controller.init()
        u, state = controller(0.0, np.array([0.1, 0.0]), state)
        u
        ```

        ```text
        array([-2.], dtype=float32)
        ```
    """

    library: str = eqx.field(static=True)
    description: Description = eqx.field(static=True)

    @property
    def _calls(self) -> Any:
        return calls_of(self.library, self.description)

    def init(self, *, key: PRNGKey | None = None) -> LoadedState:
        del key
        return LoadedState(self._calls.init(), Tally("declared_answer"))

    def __call__(
        self, t: RealScalar, y: Any, state: LoadedState
    ) -> tuple[Any, LoadedState]:
        calls, memory = self._calls, self._memory_of(state)
        if jnp.shape(y) != calls.observations:
            raise ValueError(
                f"{self.description.name}: y must have shape {calls.observations}, got "
                f"shape {jnp.shape(y)}."
            )
        if _on_host(t, y, memory):
            u, memory, flag = calls.step(t, y, memory)
            declared = state.declared.add(jnp.array(True)) if flag else state.declared
            return u, LoadedState(memory, declared)
        dtype = jnp.result_type(y, jnp.float32)
        shapes = (
            jax.ShapeDtypeStruct(calls.controls, dtype),
            jax.ShapeDtypeStruct(memory.shape, memory.dtype),
            jax.ShapeDtypeStruct((), jnp.int32),
        )
        u, memory, flag = _called(calls.step, shapes, t, y, memory)
        return u, LoadedState(memory, state.declared.add(flag != 0))

    def applied(self, u: Any, cost: Any, state: LoadedState) -> LoadedState:
        memory, size = self._memory_of(state), self._calls.controls
        if jnp.shape(u) != size:
            raise ValueError(
                f"{self.description.name}: u must have shape {size}, got shape "
                f"{jnp.shape(u)}."
            )
        if _on_host(u, cost, memory):
            return state._replace(memory=self._calls.applied(u, cost, memory))
        shapes = (jax.ShapeDtypeStruct(memory.shape, memory.dtype),)
        call = lambda *given: (self._calls.applied(*given),)
        (memory,) = _called(call, shapes, u, cost, memory)
        return state._replace(memory=memory)

    def _memory_of(self, state: Any) -> Any:
        """The bytes of a state. Raises if it is not a state of this controller, because
        the C would read beyond its end."""
        if not isinstance(state, LoadedState) or (
            state.memory.shape != (self._calls.state_bytes,)
        ):
            raise ValueError(
                f"{self.description.name}: state must be one that init returned, got "
                f"{shortened(state)}."
            )
        return state.memory

    def running(self) -> "Running":
        """The controller with its state inside, for a loop in Python.

        **Returns:** a [`delucax.export.Running`][].
        """
        return Running(self)


class Running:
    """A controller in C that keeps its state between steps, as a program on a board
    does.

    **Arguments:**

    - `controller`: a [`delucax.export.LoadedController`][].

    **Attributes:**

    - `flag`: the flag of the last step. The flag is 0 if all numbers were finite, 1 if
        an input was not finite, and 2 if a result was not finite.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp
        import numpy as np
        import tempfile

        law = dlx.controllers.Linear(jnp.array([[20.0, 5.0]]))
        with tempfile.TemporaryDirectory() as folder:
            dlx.export.c(law, folder, name="law")
            law = dlx.export.load(folder).running()
        law.step(0.0, np.array([0.1, 0.0]))
        ```

        ```text
        array([-2.], dtype=float32)
        ```
    """

    def __init__(self, controller: LoadedController):
        self._name, self._calls = controller.description.name, controller._calls
        self._y = np.zeros(self._calls.observations, self._calls.dtype)
        self._u = np.zeros(self._calls.controls, self._calls.dtype)
        self.reset()

    def reset(self) -> None:
        """Start again from the first state."""
        self._memory, self.flag = self._calls.init(), 0
        self._step, self._applied = self._calls.in_place(self._memory, self._y, self._u)

    def step(self, t: float, y: Any) -> np.ndarray:
        """One step. If a number is not finite, warn and return the fallback.

        **Arguments:** `t`: time, a number. `y`: observation, a vector.

        **Returns:** the control, shape `(m,)`.

        **Raises:** `ValueError` if `y` has the wrong shape.
        """
        self._y[...] = as_input(y, self._y.shape, self._y.dtype, "y", self._name)
        self.flag = self._step(t)
        if self.flag:
            _warn(self._name, self.flag, ", and the control is the fallback")
        return self._u.copy()

    def applied(self, u: Any, cost: float) -> None:
        """Tell the controller which control was applied, and its cost.

        **Arguments:** `u`: control, shape `(m,)`. `cost`: its stage cost, a number.

        **Raises:** `ValueError` if `u` has the wrong shape.
        """
        self._u[...] = as_input(u, self._u.shape, self._u.dtype, "u", self._name)
        self._applied(cost)


class LoadedFunction:
    """A function in C. [`delucax.export.load`][] returns one.

    It takes and returns NumPy arrays. If one of the arguments is a JAX array, the
    function returns JAX arrays, also under `jit` and `vmap`. The results are those of
    the exported function, as a flat tuple if there are several results. It has no
    derivative. A result that is not finite is returned unchanged. If the arguments are
    NumPy arrays, the function also warns about such a result.

    **Arguments:**

    - `library`: the path of the compiled library.
    - `description`: the description of the program, as read from its header file.
        [`delucax.export.load`][] sets both.

    **Raises:** `ValueError` if the function is called with the wrong number of
    arguments, or with an argument of the wrong shape or type.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp
        import numpy as np
        import tempfile

        with tempfile.TemporaryDirectory() as folder:
            dlx.export.c(jnp.sin, folder, name="sine", example=(jnp.zeros(3),))
            sine = dlx.export.load(folder)
        sine(np.ones(3))
        ```

        ```text
        array([0.8415, 0.8415, 0.8415], dtype=float32)
        ```
    """

    def __init__(self, library: str, description: Description):
        self.library, self.description = library, description

    def __call__(self, *inputs: Any) -> Any:
        about = self.description
        if len(inputs) != len(about.inputs):
            names = ", ".join(name for name, *_ in about.inputs)
            raise ValueError(
                f"{about.name}: the arguments must be {names}, got {len(inputs)} "
                "arguments."
            )
        if _on_host(*inputs):
            results, flag = self._call(*inputs)
            if flag:
                _warn(about.name, flag)
        else:
            for (name, shape, *_), value in zip(about.inputs, inputs, strict=True):
                if jnp.shape(value) != shape:
                    raise ValueError(
                        f"{about.name}: {name} must have shape {shape}, got shape "
                        f"{jnp.shape(value)}."
                    )
            canonical = jax.dtypes.canonicalize_dtype
            shapes = [
                jax.ShapeDtypeStruct(shape, canonical(dtype))
                for _, shape, dtype, _ in about.outputs
            ]
            results = _called(lambda *given: self._call(*given)[0], shapes, *inputs)
        return results[0] if len(results) == 1 else tuple(results)

    def bind(self, *arrays: np.ndarray) -> Callable[[], int]:
        """Bind the function to arrays that it reads and writes. A call of the bound
        function takes a fraction of a microsecond.

        **Arguments:** `*arrays`: the arrays to read, then the arrays to write the
        results to. The arrays must be contiguous NumPy arrays with the types of the C
        code, and must not overlap. Pass a number as an array of shape `()`. An input of
        shape `()` is read only once, when you call `bind`: to change it, call `bind`
        again, or export the function with an input of shape `(1,)` in its place.

        **Returns:** a function without arguments, which returns the flag. The returned
        function holds Python's global interpreter lock while it runs.

        **Raises:** `ValueError` if an array has the wrong shape or type.
        """
        about = self.description
        parts = (*about.inputs, *about.outputs)
        if len(arrays) != len(parts):
            raise ValueError(
                f"{about.name}: bind takes {len(parts)} arrays, got {len(arrays)}."
            )
        for (name, shape, dtype, _), array in zip(parts, arrays, strict=True):
            fits = isinstance(array, np.ndarray) and array.flags.c_contiguous
            if not fits or (array.dtype, array.shape) != (np.dtype(dtype), shape):
                raise ValueError(
                    f"{about.name}: {name} must be a contiguous NumPy array of dtype "
                    f"{dtype} and shape {shape}, got {shortened(array)}."
                )
        function = function_of(self.library, about.name, quick=True)
        count = len(about.inputs)
        given = *map(passed, arrays[:count]), *map(address, arrays[count:])
        call: Any = functools.partial(function, *given)
        call.arrays = arrays  # keeps the memory
        return call

    def _call(self, *inputs: Any) -> tuple[list[np.ndarray], int]:
        about = self.description
        given = [
            as_input(value, shape, dtype, name, about.name)
            for (name, shape, dtype, _), value in zip(about.inputs, inputs, strict=True)
        ]
        return calls_of(self.library, about)(*given)


def _warn(name: str, flag: int, then: str = "") -> None:
    what = "an input" if flag == 1 else "a result"
    warnings.warn(f"{name}: {what} is not finite{then}.", RuntimeWarning, 3)


def _on_host(*given: Any) -> bool:
    """Whether none of the arguments is a JAX array."""
    return not any(isinstance(value, jax.Array) for value in given)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _called(call: Callable, shapes: Any, *inputs: Array) -> Any:
    """`call` of the inputs, as a callback: Python calls it when the compiled program
    runs."""
    like = lambda leaf: np.shape(leaf)

    def each(*given):
        given = [np.asarray(value) for value in given]
        lead = given[0].shape[: given[0].ndim - len(inner[0])]
        if not lead:
            return _cast(call(*given), shapes)
        rows = [g.reshape(-1, *shape) for g, shape in zip(given, inner, strict=True)]
        answers = [_cast(call(*row), shapes) for row in zip(*rows, strict=True)]
        return tuple(
            np.stack(part).reshape(*lead, *shape.shape)
            for part, shape in zip(zip(*answers, strict=True), shapes, strict=True)
        )

    inner = [like(value) for value in inputs]
    return jax.pure_callback(each, tuple(shapes), *inputs, vmap_method="broadcast_all")


def _cast(answers: Any, shapes: Any) -> tuple[np.ndarray, ...]:
    pairs = zip(answers, shapes, strict=True)
    return tuple(np.asarray(answer, shape.dtype) for answer, shape in pairs)


@_called.defjvp
def _no_derivative(call: Any, shapes: Any, primals: Any, tangents: Any) -> Any:
    raise ValueError(
        "export.load: what runs in C has no derivative. Differentiate the original in "
        "Python, or put jax.lax.stop_gradient around the arguments."
    )
