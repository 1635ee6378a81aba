"""Exported controllers on a Cortex-M4F under QEMU, and the same program on the host.

Needs the Debian packages `gcc-arm-none-eabi`, `libnewlib-arm-none-eabi` and
`qemu-system-arm`.

QEMU counts: with `-icount shift=0` each instruction takes one nanosecond of virtual
time, and SysTick counts the 25 MHz clock of the board in it, 40 instructions a tick.
The program times a loop of a million instructions first, from which those of a
tick follow, and an empty step, which is taken off. The stack is painted before a step:
what is no longer paint afterwards was used.
"""

import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np


PREFIX = "arm-none-eabi-"
QEMU = "qemu-system-arm"
COMMON = ("-O2", "-ffp-contract=off", "-std=c99")
TARGET = ("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16")
AGREEMENT = {"float32": 2e-6, "float64": 1e-13}
"""Of `max(1, |u|)`, where a function of `math.h` that rounds as it likes is called."""
EXACT = {"ceil", "copysign", "fabs", "floor", "fma", "fmax", "fmin", "fmod", "lrint"}
EXACT |= {"nearbyint", "rint", "round", "sqrt", "trunc"}
"""Functions of `math.h` that have one right answer."""
SECONDS = 300.0
HERE = Path(__file__).parent


@dataclass(frozen=True)
class Run:
    """A controller on the board and on the host.

    - `board`, `host`: the controls of each row, shape `(rows, controls)`.
    - `flags`: what each step returned on the board.
    - `rom`: bytes of code and constants of the controller's object alone.
    - `library`: bytes of the functions of the C library that it calls, and theirs.
    - `state`, `stack`: bytes of RAM.
    - `instructions`: of each step.
    - `transcendental`: the functions it calls that may round differently.
    """

    board: np.ndarray
    host: np.ndarray
    flags: np.ndarray
    rom: int
    state: int
    stack: int
    instructions: np.ndarray
    transcendental: tuple[str, ...]

    @property
    def difference(self) -> float:
        """The largest difference to the host, of `max(1, |u|)`; NaN equals NaN."""
        same = (self.board == self.host) | (np.isnan(self.board) & np.isnan(self.host))
        scale = np.maximum(1.0, np.abs(self.host))
        return float(
            np.max(np.where(same, 0.0, np.abs(self.board - self.host) / scale))
        )

    @property
    def allowed(self) -> float:
        """The difference that may be: none without a transcendental function."""
        return AGREEMENT[self.board.dtype.name] if self.transcendental else 0.0


def missing() -> str | None:
    """What is not installed here, in words."""
    absent = [name for name in (f"{PREFIX}gcc", QEMU) if shutil.which(name) is None]
    return f"{' and '.join(absent)} not found" if absent else None


def run(folder: Path, name: str, table: np.ndarray, dtype: str) -> Run:
    """The controller `name` in a folder over the rows `t, y, u, cost` of a table.

    Each row is one step, and a call of `applied` with its last entries.
    """
    with tempfile.TemporaryDirectory() as made:
        build = Path(made)
        write_headers(build, name, table)
        sources = HERE / "main.c", folder / f"{name}.c"
        flags = (*COMMON, f"-DNAME={name}", f"-I{build}", f"-I{folder}")
        host = _host(build, sources, flags)
        board = _board(build, sources, flags)
        rom, called = _object(build, folder / f"{name}.c", flags)
    about, rows = _read(board)
    controls, flagged, ticks = _decoded(rows, dtype)
    controls_host, _, _ = _decoded(_read(host)[1], dtype)
    million, empty = map(int, about["calibration"])
    in_a_tick = 1e6 / million
    return Run(
        board=controls,
        host=controls_host,
        flags=flagged,
        rom=rom,
        state=int(about["state"][0]),
        stack=int(about["stack"][0]),
        instructions=in_a_tick * (ticks - empty / 1000),
        transcendental=called,
    )


def write_headers(folder: Path, name: str, table: np.ndarray) -> None:
    """The headers that a program needs to run a controller over a table."""
    sizes = "OBSERVATION_SIZE", "CONTROL_SIZE"
    lines = [f'#include "{name}.h"']
    lines += [f"#define {size} {name.upper()}_{size}" for size in sizes]
    (folder / "controller.h").write_text("\n".join([*lines, ""]))
    (folder / "table.h").write_text(_in_c(table, name))


def _in_c(table: np.ndarray, name: str) -> str:
    """The rows as C."""
    rows = ["    {" + ", ".join(map(_number, row)) + "}," for row in table.tolist()]
    head = f"#define ROWS {len(table)}\n"
    return "\n".join(
        [
            head,
            f"static const {name}_real table[ROWS][{table.shape[1]}] = {{",
            *rows,
            "};\n",
        ]
    )


def _number(value: float) -> str:
    if not np.isfinite(value):
        return "(0.0 / 0.0)" if np.isnan(value) else f"({np.sign(value)} / 0.0)"
    return float(value).hex()


def _host(build: Path, sources: tuple[Path, ...], flags: tuple[str, ...]) -> str:
    program = build / "host"
    call("cc", *flags, *sources, "-o", program, "-lm")
    return call(program)


def _board(build: Path, sources: tuple[Path, ...], flags: tuple[str, ...]) -> str:
    program = build / "board.elf"
    link = ("-nostartfiles", "--specs=rdimon.specs", f"-T{HERE / 'link.ld'}")
    startup = HERE / "startup.c"
    call(
        f"{PREFIX}gcc", *TARGET, *flags, "-DBOARD", startup, *sources, *link,
        "-o", program, "-lm",
    )  # fmt: skip
    return call(
        QEMU, "-machine", "mps2-an386", "-nographic", "-monitor", "none",
        "-serial", "none", "-icount", "shift=0", "-semihosting-config",
        "enable=on,target=native", "-kernel", program,
    )  # fmt: skip


def _object(
    build: Path, source: Path, flags: tuple[str, ...]
) -> tuple[int, tuple[str, ...]]:
    """Bytes in ROM of one object, and the functions it calls that may round."""
    made = build / "alone.o"
    call(f"{PREFIX}gcc", *TARGET, *flags, "-c", source, "-o", made)
    sections = [line.split() for line in call(f"{PREFIX}size", "-A", made).splitlines()]
    kept = (".text", ".rodata", ".data")
    rom = sum(int(s[1]) for s in sections if s and s[0].startswith(kept))
    names = [line.split()[-1] for line in call(f"{PREFIX}nm", "-u", made).splitlines()]
    plain = lambda name: name.removesuffix("f")
    own = {"memcpy", "memset"}
    rounding = [
        n for n in names if not n.startswith("__aeabi_") and n not in own
        and n not in EXACT and plain(n) not in EXACT
    ]  # fmt: skip
    return rom, tuple(rounding)


def call(*command: object) -> str:
    """What a command prints on standard output.

    **Raises:** `RuntimeError` with its words if it fails.
    """
    words = [str(word) for word in command]
    done = subprocess.run(words, capture_output=True, text=True, timeout=SECONDS)
    if done.returncode:
        said = (done.stderr + done.stdout)[-2000:]
        raise RuntimeError(f"{words[0]} ended with {done.returncode}:\n{said}")
    return done.stdout


def _read(printed: str) -> tuple[dict[str, list[str]], list[list[str]]]:
    """The lines that begin with a word, and those of the rows."""
    lines = [line.split() for line in printed.splitlines() if line.strip()]
    about = {words[0]: words[1:] for words in lines if words[0].isalpha()}
    return about, [words for words in lines if not words[0].isalpha()]


def _decoded(
    rows: list[list[str]], dtype: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Controls, flags and ticks."""
    little = np.dtype(dtype).newbyteorder("<")
    controls = np.frombuffer(
        bytes.fromhex("".join("".join(r[2:]) for r in rows)), little
    )
    flags, ticks = np.array([[int(r[0]), int(r[1])] for r in rows]).T
    return controls.reshape(len(rows), -1).astype(dtype), flags, ticks
