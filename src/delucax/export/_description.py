"""The description of a program that its header holds in a form for machines."""

import json
from pathlib import Path
from typing import Any, NamedTuple


_MARK = "delucax export:"


class Array(NamedTuple):
    """An input, an output, or a member of the state.

    **Attributes:**

    - `name`: its name in C.
    - `shape`: its shape.
    - `dtype`: its type, such as `"float64"`.
    - `path`: its place in the state of the controller, or in what the function returns.
    """

    name: str
    shape: tuple[int, ...]
    dtype: str
    path: str = ""


class Description(NamedTuple):
    """The description of a program, as its header holds it.

    **Attributes:**

    - `name`: the name of the program.
    - `kind`: `"controller"` or `"function"`.
    - `dtype`: the type of its real numbers.
    - `inputs`, `outputs`, `state`: tuples of arrays. The inputs of a controller are `t`
        and `y`, and its output is `u`. A function takes its inputs, numbers by value
        and arrays by pointer, then a pointer for each output.
    - `state_bytes`: the size of the struct of the state, if each number is aligned to
        its own size.
    - `macro`: the start of the names of its macros.
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
        """The comment in C that `described` reads."""
        text = json.dumps(self._asdict())
        # JSON may escape a slash. Without this, `*/` in a name would end the comment.
        return f"/* {_MARK} {text.replace('*/', '*' + chr(92) + '/')} */"


def described(header: str | Path) -> Description:
    """The description in the header at this path.

    **Raises:** `ValueError` if the header has no description.
    """
    for line in Path(header).read_text(encoding="utf-8").splitlines():
        if line.startswith(f"/* {_MARK}"):
            fields: dict[str, Any] = json.loads(line[len(_MARK) + 3 : -2])
            for name in ("inputs", "outputs", "state"):
                arrays = [(n, tuple(s), d, p) for n, s, d, p in fields[name]]
                fields[name] = tuple(Array(*a) for a in arrays)
            return Description(**fields)
    raise ValueError(f"export: {header} was not written by delucax.export.c.")
