"""The report on the resources that a program in C needs."""

from typing import NamedTuple


class Report(NamedTuple):
    """The resources that a program in C needs. [`delucax.export.c`][] returns it.

    **Attributes:**

    - `files`: the paths of the files that were written.
    - `constants`: the bytes of constants.
    - `state`: the size of the state in bytes; 0 for a function.
    - `stack`: the largest number of bytes that the arrays and variables of one call
        need. The functions of `math.h` need some more bytes on the stack.
    - `operations`: the largest number of arithmetic operations of one call. A call of a
        `math.h` function counts as one operation.
    - `bounds`: a pair `(line, rounds)` for each loop whose number of iterations is not
        fixed: the line of Python code from which the loop comes, and the largest number
        of iterations.
    - `lines`: the number of lines in `NAME.c`.

    !!! example

        ```python
        import tempfile
        import delucax as dlx
        import jax.numpy as jnp

        law = dlx.controllers.Linear(jnp.array([[1.0, 2.0]]))
        with tempfile.TemporaryDirectory() as folder:
            report = dlx.export.c(law, folder, name="law")
        report
        ```

        ```text
        constants   0 bytes
        state       4 bytes
        stack       72 bytes
        operations  9 a call
        lines of C  36
        ```
    """

    files: tuple[str, ...]
    constants: int
    state: int
    stack: int
    operations: int
    bounds: tuple[tuple[str, int], ...]
    lines: int

    def __repr__(self):
        rows = [
            ("constants", f"{self.constants:,} bytes"),
            ("state", f"{self.state:,} bytes"),
            ("stack", f"{self.stack:,} bytes"),
            ("operations", f"{self.operations:,} a call"),
            ("lines of C", f"{self.lines:,}"),
            *(
                (f"loop at {line}" if line else "loop", f"{n:,} rounds")
                for line, n in self.bounds
            ),
        ]
        width = max(len(name) for name, _ in rows)
        return "\n".join(f"{name:<{width}}  {value}" for name, value in rows)

    __str__ = __repr__
