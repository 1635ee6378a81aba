"""Calls of exported C on NumPy arrays, through `ctypes`."""

import ctypes
import functools
from typing import Any

import numpy as np

from .._message import shortened
from ._description import Description


def address(array: np.ndarray) -> ctypes.c_void_p:
    """A pointer to the numbers of an array. Make it once if calls must be fast: a
    function takes the same pointer again."""
    return ctypes.c_void_p(array.__array_interface__["data"][0])


def passed(array: np.ndarray) -> Any:
    """An input of a function: a number by value, or an array by pointer."""
    if array.shape:
        return address(array)
    return np.ctypeslib.as_ctypes_type(array.dtype)(array.item())


def function_of(path: str, name: str, *, quick: bool = False) -> Any:
    """A function of a shared library that returns an `int`.

    With `quick`, calls keep Python's global interpreter lock, because releasing it
    takes as long as the arithmetic of a small step.
    """
    library = ctypes.PyDLL(path) if quick else ctypes.CDLL(path)
    return library[name]


def as_input(
    value: Any, shape: tuple[int, ...], dtype: Any, name: str, where: str
) -> np.ndarray:
    """The argument as a contiguous array of the given shape and type."""
    try:
        array = np.asarray(value)
    except ValueError:  # ragged
        array = np.asarray(None)
    kinds = "iub" if np.dtype(dtype).kind in "iub" else "iubf"
    if array.dtype.kind not in kinds or array.shape != shape:
        kind = "whole" if kinds == "iub" else "real"
        got = f"shape {array.shape} and dtype {array.dtype}"
        got = shortened(value) if array.dtype.kind == "O" else got
        raise ValueError(
            f"{where}: {name} must be {kind} numbers of shape {shape}, got {got}."
        )
    converted = np.asarray(array, dtype, order="C")
    if kinds == "iub" and not np.array_equal(converted, array):
        raise ValueError(
            f"{where}: {name} must fit in {dtype}, got {shortened(value)}."
        )
    return converted


class ControllerCalls:
    """The functions of an exported controller. They do not change their arguments."""

    def __init__(self, path: str, about: Description):
        (_, (_, y, *_)), ((_, self.controls, *_),) = about.inputs, about.outputs
        self.observations, self.dtype = y, np.dtype(about.dtype)
        self._real = np.ctypeslib.as_ctypes_type(self.dtype)
        self._init = function_of(path, f"{about.name}_init")
        self._step = function_of(path, f"{about.name}_step")
        self._applied = function_of(path, f"{about.name}_applied")
        self.state_bytes = about.state_bytes

    def init(self) -> np.ndarray:
        """The bytes of a new state, from `NAME_init`."""
        memory = np.zeros(self.state_bytes, np.uint8)
        self._init(address(memory))
        return memory

    def in_place(self, memory: np.ndarray, y: np.ndarray, u: np.ndarray) -> Any:
        """The functions `step(t) -> flag` and `applied(cost)` on the given arrays."""
        real, at = self._real, [address(array) for array in (memory, y, u)]
        state, observation, control = at
        step, applied = self._step, self._applied
        return (
            lambda t: step(state, real(t), observation, control),
            lambda cost: applied(state, control, real(cost)),
        )

    def step(self, t: Any, y: Any, memory: Any) -> tuple[np.ndarray, np.ndarray, int]:
        """The control, the bytes of the next state, and the flag."""
        y, memory = np.ascontiguousarray(y, self.dtype), np.array(memory)
        u = np.empty(self.controls, self.dtype)
        step, _ = self.in_place(memory, y, u)
        return u, memory, step(t)

    def applied(self, u: Any, cost: Any, memory: Any) -> np.ndarray:
        """The bytes of the state after `NAME_applied`."""
        u, memory = np.ascontiguousarray(u, self.dtype), np.array(memory)
        self._applied(address(memory), address(u), self._real(cost))
        return memory


class FunctionCall:
    """The call of an exported function of arrays."""

    def __init__(self, path: str, about: Description):
        self.about = about
        self._function = function_of(path, about.name)

    def __call__(self, *inputs: np.ndarray) -> tuple[list[np.ndarray], int]:
        """The outputs, and the flag."""
        outputs = [np.empty(shape, dtype) for _, shape, dtype, _ in self.about.outputs]
        return outputs, self._function(*map(passed, inputs), *map(address, outputs))


@functools.lru_cache(maxsize=256)
def calls_of(path: str, about: Description) -> Any:
    """The calls of a library. The same object is returned every time."""
    kinds: Any = {"controller": ControllerCalls, "function": FunctionCall}
    return kinds[about.kind](path, about)
