"""What a program in C needs."""

from typing import NamedTuple


class Report(NamedTuple):
    """What a program in C needs.

    **Attributes:**

    - `files`: the paths that were written.
    - `constants`: bytes of constants.
    - `state`: bytes of the state.
    - `stack`: bytes of arrays and variables of one call, at most; those of the
        functions of `math.h` come on top.
    - `operations`: arithmetic operations of one call at most, a function of `math.h`
        being one.
    - `bounds`: `(line, rounds)` of each loop that may end early.
    - `lines`: of C.

    !!! example

        ```python
        import tempfile
        import delucax as dlx
        import jax.numpy as jnp

        law = dlx.controllers.Linear(jnp.array([[1.0, 2.0]]))
        with tempfile.TemporaryDirectory() as folder:
            report = dlx.export.c(law, folder, name="law")
        assert report.stack < 100
        print(report)
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
            ("constants", f"{self.constants} bytes"),
            ("state", f"{self.state} bytes"),
            ("stack", f"{self.stack} bytes"),
            ("operations", f"{self.operations} a call"),
            ("lines of C", str(self.lines)),
            *(
                (f"loop at {line}" if line else "loop", f"{n} rounds")
                for line, n in self.bounds
            ),
        ]
        width = max(len(name) for name, _ in rows)
        return "\n".join(f"{name:<{width}}  {value}" for name, value in rows)

    __str__ = __repr__
