"""The function `export.load`, which compiles and loads exported C."""

import contextlib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .._files import as_path
from .._message import did_you_mean, shortened
from ._compiler import find_compiler, FLAGS, shared_library
from ._description import described, Description
from ._loaded import LoadedController, LoadedFunction


def load(
    directory: str | os.PathLike,
    *,
    name: str | None = None,
    compiler: str | None = None,
    flags: Sequence[str] = FLAGS,
) -> LoadedController | LoadedFunction:
    """Compile the C code that [`delucax.export.c`][] wrote, and load it into Python.

    The compiled library is kept in the cache folder of the user. The library is
    compiled again only if the C code, the compiler or the flags change. Nothing is
    written to `directory`.

    **Arguments:**

    - `directory`: the folder that was given to [`delucax.export.c`][]. It holds
        `NAME.h` and `NAME.c`.
    - `name`: the name of the export, needed if the folder holds several exports.
    - `compiler`: the command of a C compiler. By default the command is the environment
        variable `CC` or, if `CC` is not set, the first of `cc`, `gcc` and `clang` that
        is installed.
    - `flags`: arguments of the compiler. The default flags make the results comparable
        with JAX: `-ffp-contract=off` forbids the compiler to compute a product and a
        sum with a single rounding.

    **Returns:** a [`delucax.export.LoadedController`][] for a controller, or a
    [`delucax.export.LoadedFunction`][] for a function or a plant.

    **Raises:** `ValueError` if the folder holds no export, or holds several exports and
    `name` is not given; if no compiler is found; or if the compiler fails. If the
    compiler fails, the error shows the message of the compiler.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp
        import tempfile

        env = dlx.make("pendulum")
        law = dlx.controllers.Linear(jnp.array([[20.0, 5.0]]))
        with tempfile.TemporaryDirectory() as folder:
            dlx.export.c(law, folder, name="law")
            controller = dlx.export.load(folder)
        dlx.rollout(env, controller, key=jax.random.key(0), x0=[0.1, 0.0]).total_cost
        ```

        ```text
        Array(0.0736, dtype=float32)
        ```
    """
    where = "export.load"
    folder = as_path(directory, "directory", where)
    if not isinstance(flags, Sequence) or isinstance(flags, str):
        raise ValueError(
            f"{where}: flags must be a sequence of the compiler's arguments, such as "
            f"{FLAGS}, got {flags!r}."
        )
    description = _find(folder, name, where)
    source = folder / f"{description.name}.c"
    command = find_compiler(compiler, where)
    library = shared_library(source, command, tuple(map(str, flags)), where)
    kinds: Any = {"controller": LoadedController, "function": LoadedFunction}
    return kinds[description.kind](str(library), description)


def _find(folder: Path, name: str | None, where: str) -> Description:
    """The description of the export `name` in a folder."""
    exports = _exports(folder)
    if not exports:
        # An absolute path shows which working directory a relative path starts from.
        at = folder.absolute()
        fault = "holds no export" if at.is_dir() else "is not a folder"
        fault = fault if at.exists() else "does not exist"
        hint = ""
        if at.stem in _exports(at.parent):
            hint = f" Pass {str(folder.parent)!r} and name={at.stem!r}."
        elif below := sorted({h.parent.name for h in at.glob("*/*.h")}):
            hint = f" Its folders with headers are {shortened(below)}."
        here = "" if folder.is_absolute() else f" ({str(at)!r})"
        raise ValueError(
            f"{where}: directory must be the folder that was given to delucax.export.c,"
            f" got {str(folder)!r}{here}, which {fault}.{hint}"
        )
    if name is None and len(exports) > 1:
        raise ValueError(
            f"{where}: name must say which export to load, because {str(folder)!r} "
            f"holds {', '.join(exports)}."
        )
    which = next(iter(exports)) if name is None else name
    if which not in exports:
        raise ValueError(
            f"{where}: no export is called {which!r} in {str(folder)!r}; "
            f"{did_you_mean(str(which), exports)}"
        )
    return exports[which]


def _exports(folder: Path) -> dict[str, Description]:
    """The descriptions of all exports in a folder, by their names."""
    exports: dict[str, Description] = {}
    for header in sorted(folder.glob("*.h")):
        if header.with_suffix(".c").exists():
            with contextlib.suppress(ValueError):  # the header of another program
                exports[header.stem] = described(header)
    return exports
