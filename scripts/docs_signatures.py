"""What signatures of the reference leave out, named as an extension in `mkdocs.yml`.

The package is imported, so that a type alias has become its members, and a default is
what it prints, which need not be Python, and is then not wrapped.
"""

import ast
import re
from typing import Any

import griffe


# The members of `ArrayLike`, and of lists of them, which is what arguments accept.
_ARRAY_LIKE = re.compile(
    r"Array \| ndarray \| bool \| number \| bool \| int \| float \| complex"
    r"( \| list\[Any\] \| tuple\[Any, \.\.\.\])?"
)
_MODULE = re.compile(r"\b(?:[a-z_]\w*\.)+(?=[A-Za-z])")


class Signatures(griffe.Extension):
    """Short annotations, and defaults that are Python."""

    def on_function(self, *, func: griffe.Function, **_: Any) -> None:
        """Shorten each parameter of a function or method."""
        for parameter in func.parameters:
            written = _MODULE.sub("", str(parameter.annotation))
            if _ARRAY_LIKE.search(written):
                parameter.annotation = _ARRAY_LIKE.sub("ArrayLike", written)
            if isinstance(parameter.default, str):
                parameter.default = _default(parameter.default)


def _default(printed: str) -> str:
    printed = " ".join(printed.split())
    member = re.fullmatch(r"<([\w.]+): .*>", printed)
    if member:
        return member.group(1)
    try:
        ast.parse(printed, mode="eval")
    except SyntaxError:
        printed += " " * 88
    call = re.match(r"\w+\(", printed)
    if len(printed) <= 60:
        return printed
    return f"{call.group()}...)" if call else "..."
