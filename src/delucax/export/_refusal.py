"""Errors for what cannot be written in C, with the line of Python it comes from."""

import contextlib
import os
from pathlib import Path
from typing import Any

import diffrax
import equinox
import jax
import jaxtyping
import lineax
import optax
import optimistix


_WHY = {
    "eig": "there is no routine for eigenvalues",
    "eigh": "there is no routine for eigenvalues",
    "svd": "there is no routine for singular values",
    "schur": "there is no routine for Schur factors",
    "conv_general_dilated": "there is no routine for convolutions",
}


class Unsupported(ValueError):
    """The error for something that cannot be written in C."""


def refuse(name: str, why: str, where: str) -> Unsupported:
    """The error for the operation `name`, for the reason `why`."""
    why = _WHY.get(name, why)
    line = f" at {where}" if where else ""
    return Unsupported(f"export.c: {name}{line} cannot be exported: {why}.")


_MODULES = jax, equinox, lineax, diffrax, optax, optimistix, contextlib, jaxtyping
_LIBRARIES = tuple(str(Path(str(m.__file__)).parent) + os.sep for m in _MODULES)
_HERE, _PACKAGE, _ROOT = (str(p) + os.sep for p in Path(__file__).parents[:3])
_NAME = str(Path(_PACKAGE).relative_to(_ROOT)) + os.sep


def line_of(eqn: Any, around: str) -> str:
    """The line of the user's code that an equation comes from. If there is none, the
    line of the call `around` it, or the function of delucax."""
    traceback, ours = eqn.source_info.traceback, ""
    for frame in traceback.frames if traceback else ():
        file = frame.file_name
        if file.startswith(_HERE):
            break  # further frames are the call of export.c
        if not file.startswith((*_LIBRARIES, _PACKAGE, "<")):
            return f"{Path(file).name}:{frame.line_num}"
        if file.startswith(_PACKAGE) and not ours:
            name = frame.function_name.split(".<")[0]
            ours = f"{Path(file).relative_to(_ROOT)}, {name}"
    is_users = around and not around.startswith(_NAME)
    return around if is_users or not ours else ours
