"""Modules as they print: small arrays by their values, large ones by their shapes."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import wadler_lindig as wl
from equinox import Module
from jax.core import Tracer

from ._fields import StaticFunction


_FEW = 6
"""Entries of an array that are shown one by one."""
_LINES, _WIDTH, _INLINE = 12, 88, 70
"""The lines and columns of a text, and the characters of a part that stays whole in a
text that would have more lines."""


def shown(self: Any) -> str:
    """The `__repr__` of modules.

    An array of up to six entries shows its values, to four digits. A larger or a traced
    one shows its dtype and shape. Fields that are `None` are left out, and so are the
    options of a part that are at their default. In a text of more than about twelve
    lines each field has one line, and a part that does not fit there is shortened.
    """
    text = wl.pformat(_module(self, _whole), width=_WIDTH)
    if text.count("\n") >= _LINES:
        text = wl.pformat(_module(self, _line), width=_WIDTH)
    return text


def _module(
    module: Any, custom: Callable[[Any], wl.AbstractDoc | None], is_part: bool = False
) -> wl.AbstractDoc:
    """`Name(field=value, ...)`."""
    shown_fields = []
    for field in dataclasses.fields(module):
        value = getattr(module, field.name, None)
        is_option = isinstance(value, bool | int | float | str)
        is_default = is_option and value == field.default or value is field.default
        # A function that is there by default says nothing.
        if isinstance(value, StaticFunction) and value.function is field.default:
            continue
        if field.repr and value is not None and not (is_part and is_default):
            shown_fields.append((field.name, value))
    begin, end = wl.TextDoc(f"{type(module).__name__}("), wl.TextDoc(")")
    docs = wl.named_objs(shown_fields, custom=custom)
    return wl.bracketed(begin, docs, wl.comma, end, indent=2)


def _whole(node: Any) -> wl.AbstractDoc | None:
    """A part at full length; `None` where `wadler_lindig` knows what to print."""
    if isinstance(node, jax.Array | np.ndarray | jax.ShapeDtypeStruct):
        return _array(node)
    if isinstance(node, float):
        return wl.TextDoc(_number(node))
    if isinstance(node, StaticFunction):
        return wl.pdoc(node.function, custom=_whole)
    method = getattr(node, "__func__", None)
    if method is not None:
        owner = type(getattr(node, "__self__", None))
        return wl.TextDoc(f"{owner.__name__}.{method.__name__}")
    if isinstance(node, Module):
        has_own = type(node).__repr__ not in (Module.__repr__, shown)
        return wl.TextDoc(repr(node)) if has_own else _module(node, _whole, True)
    # A function that JAX has wrapped would print its address.
    inner = None if isinstance(node, type) else getattr(node, "__wrapped__", None)
    return None if inner is None else wl.pdoc(inner, custom=_whole)


def _line(node: Any) -> wl.AbstractDoc | None:
    """A part in one line: whole, or with the names of its own parts, or by its name."""
    if not isinstance(node, Module | tuple | list | dict):
        return _whole(node)
    docs = [wl.pdoc(node, custom=_whole)]
    if isinstance(node, Module):
        docs.append(_module(node, _named, True))
    for text in (wl.pformat(doc, width=10**6) for doc in docs):
        if len(text) <= _INLINE and "\n" not in text:
            return wl.TextDoc(text)
    return _name(node)


def _named(node: Any) -> wl.AbstractDoc | None:
    """A part of a part: its name, unless it has nothing else, as `RK4()` has."""
    if not isinstance(node, Module) or not jax.tree.leaves(node):
        return _whole(node)
    return _name(node)


def _name(node: Any) -> wl.AbstractDoc:
    return wl.TextDoc(f"{type(node).__name__}(...)")


def _array(array: Any) -> wl.AbstractDoc:
    """An array of a few known numbers by its values, another by its dtype and shape."""
    is_known = isinstance(array.dtype, np.dtype) and not isinstance(array, Tracer)
    if isinstance(array, jax.Array) and is_known:
        is_known = array.is_fully_addressable and not array.is_deleted()
    is_known = is_known and not isinstance(array, jax.ShapeDtypeStruct)
    if is_known and 0 < array.size <= _FEW:
        return wl.TextDoc(_number(np.asarray(array).tolist()))
    is_weak = isinstance(array, Tracer) and getattr(array, "weak_type", False)
    weak = "weak_" if is_weak else ""
    return wl.array_summary(array.shape, f"{weak}{array.dtype}", None)


def _number(value: Any) -> str:
    """A number to four digits, or a list of them."""
    if isinstance(value, list):
        return f"[{', '.join(map(_number, value))}]"
    if not isinstance(value, float | complex):
        return str(value)
    text = f"{value:.4g}"
    # So that 1.0 does not read as an integer.
    return f"{text}.0" if text.lstrip("-").isdigit() else text
