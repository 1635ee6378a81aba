"""Programs in C that are compiled together, and called on arrays of NumPy."""

import ctypes
import shutil
import subprocess

import numpy as np
import pytest

from delucax import export
from delucax.export._description import described


COMPILER = shutil.which("cc") or shutil.which("gcc")
STRICT = "-std=c99 -pedantic -Wall -Wextra -Werror -ffp-contract=off".split()
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="There is no C compiler.")


def compiled(folder, names, options=("-O1",)):
    """One library of all these programs."""
    library = folder / "programs.so"
    sources = [str(folder / f"{name}.c") for name in names]
    link = ["-shared", "-fPIC", "-o", str(library), *sources, "-lm"]
    subprocess.run([str(COMPILER), *STRICT, *options, *link], check=True)
    return ctypes.CDLL(str(library))


def exported(folder, functions, **options):
    """Functions of name to `(function, example)`, each as one on arrays of NumPy."""
    for name, (function, example) in functions.items():
        export.c(function, folder, name=name, example=example, **options)
    library = compiled(folder, functions)
    return {name: Function(folder, name, library) for name in functions}


def kind_of(array):
    """The type of an array in C."""
    return np.dtype("uint8" if array.dtype == "bool" else array.dtype)


def pointer(array):
    return array.ctypes.data_as(ctypes.c_void_p)


class Function:
    """A function in C."""

    def __init__(self, folder, name, library):
        self.about = described(folder / f"{name}.h")
        self.call = getattr(library, name)

    def __call__(self, *inputs):
        given, keep = [], []
        for array, value in zip(self.about.inputs, inputs, strict=True):
            value = np.ascontiguousarray(value, kind_of(array))
            keep.append(value)
            by_value = np.ctypeslib.as_ctypes_type(value.dtype)
            given.append(pointer(value) if array.shape else by_value(value.item()))
        outs = [np.zeros(a.shape, kind_of(a)) for a in self.about.outputs]
        flag = self.call(*given, *map(pointer, outs))
        return flag, [
            out.astype(a.dtype) for out, a in zip(outs, self.about.outputs, strict=True)
        ]


class Controller:
    """A controller in C with a state of its own."""

    def __init__(self, folder, name, library):
        self.about = described(folder / f"{name}.h")
        self.library, self.name = library, name
        self.real = np.dtype(self.about.dtype)
        self.number = np.ctypeslib.as_ctypes_type(self.real)
        ends, offset = [], 0
        for array in self.about.state:
            kind = kind_of(array)
            offset = -(-offset // kind.itemsize) * kind.itemsize
            size = kind.itemsize * int(np.prod(array.shape, dtype=int))
            ends.append((offset, offset + size))
            offset += size
        # After the members there is the last control.
        size = offset + 8 + self.real.itemsize * self.about.outputs[0].shape[0]
        self.memory = np.zeros(size, np.uint8)
        self.state = [
            self.memory[a:b].view(kind_of(array)).reshape(array.shape)
            for array, (a, b) in zip(self.about.state, ends, strict=True)
        ]
        self._call("init")

    def _call(self, which, *arguments):
        return getattr(self.library, f"{self.name}_{which}")(
            pointer(self.memory), *arguments
        )

    def step(self, t, y):
        y, u = (
            np.asarray(y, self.real),
            np.zeros(self.about.outputs[0].shape, self.real),
        )
        return self._call("step", self.number(t), pointer(y), pointer(u)), u

    def applied(self, u, cost):
        u = np.asarray(u, self.real)
        self._call("applied", pointer(u), self.number(cost))
