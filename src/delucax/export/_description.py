"""What a header says of its program, for a machine to read."""

import json
from pathlib import Path
from typing import Any, NamedTuple


_MARK = "delucax export:"


class Array(NamedTuple):
    """An array that goes in or out, or is kept.

    **Attributes:** `name` in C; `shape`; `dtype`, such as `"float64"`; `path`, where it
    is in the controller's state or in what the function returns.
    """

    name: str
    shape: tuple[int, ...]
    dtype: str
    path: str = ""


class Description(NamedTuple):
    """What a header says of its program.

    **Attributes:** `name`; `kind`, `"controller"` or `"function"`; `dtype` of its real
    numbers; `inputs`, `outputs` and `state`, tuples of arrays; `state_bytes`, the size
    of its struct where each number lies at a multiple of its own size; `macro`, with
    which the names of its macros begin.

    The inputs of a controller are `t` and `y`, and its output is `u`. A function takes
    its inputs, those without an axis by value, then a pointer for each output.
    """

    name: str
    kind: str
    dtype: str
    inputs: tuple[Array, ...]
    outputs: tuple[Array, ...]
    state: tuple[Array, ...] = ()
    state_bytes: int = 0

    @property
    def macro(self) -> str:
        return self.name.upper()

    def comment(self) -> str:
        """A comment of C that `described` reads."""
        text = json.dumps(self._asdict())
        # A slash may be escaped in JSON, and no comment ends early.
        return f"/* {_MARK} {text.replace('*/', '*' + chr(92) + '/')} */"


def described(header: str | Path) -> Description:
    """The description in a header, given its path.

    **Raises:** `ValueError` if there is none.
    """
    for line in Path(header).read_text(encoding="utf-8").splitlines():
        if line.startswith(f"/* {_MARK}"):
            fields: dict[str, Any] = json.loads(line[len(_MARK) + 3 : -2])
            for name in ("inputs", "outputs", "state"):
                arrays = [(n, tuple(s), d, p) for n, s, d, p in fields[name]]
                fields[name] = tuple(Array(*a) for a in arrays)
            return Description(**fields)
    raise ValueError(f"export: {header} was not written by delucax.export.c.")
