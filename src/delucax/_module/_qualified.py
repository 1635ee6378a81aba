"""The names of functions and classes, `"module:qualified.name"`, and their import."""

import importlib
import sys
import types
from typing import Any

import numpy as np


_TRUSTED = ("delucax", "diffrax", "equinox", "lineax", "optax", "optimistix")

# JAX and NumPy hold helpers that read files or run strings, so only their functions for
# arrays are trusted.
_JAX = (
    "jax.nn",
    "jax.numpy",
    "jax.lax",
    "jax",
    "jax.nn.initializers",
    "jax.numpy.fft",
    "jax.numpy.linalg",
    "jax.random",
    "jax.scipy.linalg",
    "jax.scipy.special",
    "jax.tree_util",
)


def qualified_name(thing: Any) -> str | None:
    """The importable name of `thing`; `None` if it has none.

    A public name is preferred, because a later version of a library may move the
    private module in which a thing is defined.
    """
    module = getattr(thing, "__module__", None)
    name = getattr(thing, "__qualname__", None) or getattr(thing, "__name__", None)
    if not isinstance(module, str) or not isinstance(name, str):
        module, name = type(thing).__module__, ""
    places = _candidate_modules(module)
    for place in places:
        if name and _look_up(place, name) is thing:
            return f"{place}:{name}"
    # A constant of a module, or a lambda that a module binds to a name. Not in a
    # notebook or script, where names may be bound again.
    for place in places if module != "__main__" else ():
        for name, value in list(vars(sys.modules.get(place, types)).items()):
            if value is thing:
                return f"{place}:{name}"
    return None


def import_named(name: str, trust: tuple[str, ...]) -> Any:
    """Import the function or class called `name`.

    **Raises:** `ValueError` if its module is not trusted, or if it does not exist.
    """
    module, _, path = name.partition(":")
    package = module.partition(".")[0]
    is_asked_for = _is_in(module, trust)
    fail = lambda why: ValueError(f"it needs {name!r}, {why}")
    if not is_asked_for and package not in (*_TRUSTED, "jax", "numpy", "__main__"):
        raise fail(
            f"and the package {package!r} is not trusted. If you trust it, pass "
            f"trust=({package!r},)."
        )
    try:
        importlib.import_module(module)
    except ImportError as error:
        raise fail(f"which cannot be imported: {error}.") from None
    thing = _look_up(module, path)
    if thing is None:
        hint = " Define it before you load." if package == "__main__" else ""
        moved = "which does not exist: it may have been renamed or moved since."
        raise fail(f"{moved}{hint}")
    origin = getattr(thing, "__module__", None) or type(thing).__module__
    if package == "jax":
        fits = module in _JAX and _is_in(origin, ("jax", "jaxlib"))
    elif package == "numpy":
        fits = module == "numpy" and isinstance(thing, np.ufunc | type)
    else:
        others = _TRUSTED if package in _TRUSTED else ()
        fits = _is_in(origin, (*others, *trust, package))
    if not fits and not is_asked_for:
        hint = f"If you trust it, pass trust=({module!r},)."
        raise fail(f"which is not trusted. {hint}")
    return thing


def _is_in(module: str, packages: tuple[str, ...]) -> bool:
    return any(f"{module}.".startswith(f"{package}.") for package in packages)


def _candidate_modules(module: str) -> tuple[str, ...]:
    """Modules to import an object of `module` from, the preferred one first."""
    if module.partition(".")[0] in ("jax", "jaxlib"):
        return (*_JAX, module)
    public = module.partition("._")[0]
    return (public, module) if public != module else (module,)


def _look_up(module: str, path: str) -> Any:
    """The thing at `path` in an imported module; `None` if it does not exist.

    A path goes from a class to its members. It never goes into a module that another
    one imports, nor into a function.
    """
    thing = sys.modules.get(module)
    for i, part in enumerate(path.split(".")):
        if i > 0 and not isinstance(thing, type):
            return None
        thing = getattr(thing, part, None)
    return None if isinstance(thing, types.ModuleType) else thing
