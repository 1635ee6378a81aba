"""The header and the source of a program in C: their text, and how they are written."""

import contextlib
import keyword
import re
import secrets
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from . import _layout
from ._description import Description
from ._emit import Line, Scope, Shared
from ._expressions import c_type
from ._program import Program
from ._report import Report


_RESERVED = frozenset(
    """
    alignas alignof and and_eq asm auto bitand bitor bool break case catch char class
    compl complex const const_cast constexpr continue decltype default delete do double
    dynamic_cast else enum explicit export extern false float for friend goto if inline
    int int16_t int32_t int64_t int8_t long main mutable namespace new noexcept not
    not_eq nullptr operator or or_eq private protected public register
    reinterpret_cast restrict return short signed sizeof static static_assert
    static_cast struct switch template this thread_local throw true try typedef typeid
    typename uint16_t uint32_t uint64_t uint8_t union unsigned using virtual void
    volatile wchar_t while xor xor_eq state flag memcpy memset work
    acos acosh asin asinh atan atan2 atanh cbrt ceil copysign cos cosh erf erfc exp exp2
    expm1 fabs fdim floor fma fmax fmin fmod frexp gamma hypot ilogb isfinite isinf
    isnan j0 j1 jn ldexp lgamma log log10 log1p log2 logb lrint lround modf nan
    nearbyint nextafter pow remainder rint round scalbn signbit signgam sin sinh sqrt
    tan tanh tgamma trunc y0 y1 yn
    HUGE_VAL HUGE_VALF HUGE_VALL I INFINITY NAN NULL errno linux math_errhandling
    ptrdiff_t size_t unix
    """.split()
)
_LIBRARY = frozenset(
    """
    abort abs alloca atexit atof atoi atol bcmp bcopy bsearch bzero calloc div drem exit
    exp10 ffs fprintf fputc fputs free getenv index isalnum isalpha isdigit islower
    isspace isupper labs ldiv malloc memchr memcmp memmove pow10 printf putc putchar
    puts qsort rand realloc rindex scanf signal significand sincos snprintf sprintf
    srand sscanf strcat strchr strcmp strcpy strcspn strlen strncat strncmp strncpy
    strrchr strspn strstr system time tolower toupper
    """.split()
)
_HEADERS = frozenset(["math", "string", "stdint", "stddef", "stdio", "stdlib"])
_LONGEST = 63
"""C99 tells names apart by this many letters."""
_OWN = re.compile(r"[vbci][0-9]+|work_.*|.*_[fiub][0-9]+|.*_b")
_MACROS = re.compile(r"(FP|M|MATH|SIZE|U?INT\w*)_[A-Z0-9_]+")


def is_free(name: str) -> bool:
    """Whether a name may be used inside a function in C."""
    simple = re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name) is not None
    taken = _OWN.fullmatch(name) or _MACROS.fullmatch(name)
    return simple and not _is_in(name, _RESERVED) and not taken


def is_public(name: str) -> bool:
    """Whether a program may have this name. It must not be a name of C, of its library
    and headers, or of a routine in the file, because other code links with it."""
    simple = re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name) is not None
    ours = re.fullmatch(r".*_[fiu](8|16|32|64)|work", name) is not None
    fits = simple and not ours and not _MACROS.fullmatch(name)
    taken = _is_in(name, _RESERVED | _LIBRARY) or name in _HEADERS
    return fits and not taken and len(name) <= _LONGEST


def _is_in(name: str, names: frozenset[str]) -> bool:
    """Whether a name is taken, also as a variant of a function for `float` or `long
    double`, such as `sinf`."""
    single = name[:-1] if name[-1:] in ("f", "l") else name
    return not names.isdisjoint((name, single))


def free_names(names: Iterable[str], taken: Iterable[str] = ()) -> list[str]:
    """Names in C that are like those given, and all different."""
    used, made = set(taken), []
    for name in names:
        name = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_") or "value"
        if name[0].isdigit():
            name = f"value_{name}"
        if not is_free(name) or keyword.iskeyword(name):
            name += "_"
        base, k = name, 1
        while name in used:
            k += 1
            name = f"{base}_{k}"
        used.add(name)
        made.append(name)
    return made


class Function:
    """A function of the file: its signature and its program."""

    def __init__(self, signature: str, program: Program, roots: set[str], exits: str):
        self.signature, self.program, self.exits = signature, program, exits
        self.needed = _layout.eliminate_dead_stores(program.top, roots)
        self.memory, self.bytes = _layout.placed(program.buffers, program.top)

    @property
    def stack(self) -> int:
        """The bytes of its arrays and variables."""
        return self.bytes + _variables(self.program.top)

    def text(self, arguments: Iterable[str]) -> list[str]:
        """The lines of the definition."""
        body = _layout.printed(self.program.top)
        everything = "\n".join(body)
        unused = [
            a for a in arguments if not re.search(rf"\b{a}\b", everything + self.exits)
        ]
        lines = [f"{self.signature} {{", *(f"  {line}" for line in self.memory)]
        lines += body
        lines += [f"  (void){a};" for a in unused]
        if self.exits:
            lines.append(f"  {self.exits}")
        return [*lines, "}"]


def _variables(scope: Scope) -> int:
    total = 0
    for item in scope.items:
        if isinstance(item, Line):
            declared = item.writes is not None and item.writes.startswith("v")
            total += 8 * (declared and " = " in item.text or item.text.endswith(";"))
        else:
            total += sum(map(_variables, item.scopes))
    return total


def source(name: str, functions: list[tuple[Function, list[str]]], shared: Shared):
    """The text of the C file, and the bytes of its constants."""
    used = frozenset().union(*(f.needed for f, _ in functions))
    tables, size = _layout.constants(shared, used)
    bodies = [f.text(arguments) for f, arguments in functions]
    lines = [
        f'#include "{name}.h"',
        "",
        "#if defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__",
        '#error "compile this without -ffast-math, which removes the tests for NaN"',
        "#endif",
        "",
        "#include <math.h>",
        "#include <string.h>",
        "",
        *tables,
    ]
    everything = "\n".join("\n".join(b) for b in bodies)
    for routine, text in shared.routines.items():
        if re.search(rf"\b{routine}\(", everything):
            lines += ["", *text.strip().splitlines()]
    for body in bodies:
        lines += ["", *body]
    return "\n".join(lines) + "\n", size


def header(description: Description, comment: list[str], body: list[str]) -> str:
    """The text of the header."""
    name = description.macro
    lines = [
        "/*",
        *(f" * {line}".rstrip().replace("*/", "* /") for line in comment),
        " */",
        description.comment(),
        f"#ifndef {name}_H",
        f"#define {name}_H",
        "",
        "#include <stdint.h>",
        "",
        "#ifdef __cplusplus",
        'extern "C" {',
        "#endif",
        "",
        f"typedef {c_type(description.dtype)} {description.name}_real;",
        "",
        *body,
        "",
        "#ifdef __cplusplus",
        "}",
        "#endif",
        "",
        "#endif",
    ]
    return "\n".join(lines) + "\n"


def write_both(directory: Path, texts: dict[str, str]) -> tuple[str, ...]:
    """Write all files, or none of them if there is an error."""
    beside = {
        directory / name: directory / f".{name}.{secrets.token_hex(4)}"
        for name in texts
    }
    try:
        directory.mkdir(parents=True, exist_ok=True)
        for (target, path), text in zip(beside.items(), texts.values(), strict=True):
            if target.is_dir():
                raise IsADirectoryError(f"{target} is a directory")
            path.write_text(text, encoding="utf-8")
        for target, path in beside.items():
            path.replace(target)
    except OSError as error:
        raise ValueError(
            f"export.c: directory must be one that can be written to, got {directory}: "
            f"{error}."
        ) from error
    finally:
        for path in beside.values():
            with contextlib.suppress(OSError):
                path.unlink()
    return tuple(map(str, beside))


def report(
    files: tuple[str, ...], functions: list[Any], constants: int, state: int, text: str
) -> Report:
    """The report on the functions of a file."""
    bounds = dict.fromkeys(b for f in functions for b in f.program.bounds)
    return Report(
        files,
        constants,
        state,
        max(f.stack for f in functions),
        max(f.program.top.cost for f in functions),
        tuple(bounds),
        text.count("\n"),
    )
