"""The C compiler at hand, and what it made, on disk."""

import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

from .._message import shortened
from .._programs import prune, user_folder


FLAGS = ("-std=c99", "-O2", "-ffp-contract=off")
_COMPILERS = ("cc", "gcc", "clang")
# Bytes that all libraries on disk may take.
_LIMIT = 2**28


def find_compiler(compiler: str | None, where: str) -> list[str]:
    """The command of a C compiler: the one that is given, that of the variable `CC`, or
    the first of the usual names that is there.

    **Raises:** `ValueError` if there is none.
    """
    if compiler is not None and not isinstance(compiler, str):
        raise ValueError(
            f"{where}: compiler must be the command of a C compiler, got "
            f"{shortened(compiler)}."
        )
    named = compiler or os.environ.get("CC")
    sought = [named] if named else list(_COMPILERS)
    for command in sought:
        words = shlex.split(command)
        if words and (path := shutil.which(words[0])):
            return [path, *words[1:]]
    raise ValueError(
        f"{where}: no C compiler was found: looked for {', '.join(map(repr, sought))} "
        "on the path. Install one (Debian's package gcc, Xcode's command line tools), "
        "or name one with `compiler` or the variable CC."
    )


def shared_library(
    source: Path, command: Sequence[str], flags: Sequence[str], where: str
) -> Path:
    """The shared library of a C file with a header of the same name beside it.

    It is kept among the user's caches, under a name that follows from what it was made
    of, so that the same files are compiled once.

    **Raises:** `ValueError` with the compiler's words if it fails.
    """
    parts = [part.read_bytes() for part in (source.with_suffix(".h"), source)]
    about = os.stat(command[0])
    made_by = platform.platform(), *command, about.st_size, about.st_mtime_ns, *flags
    key = hashlib.sha256(repr((made_by, parts)).encode()).hexdigest()
    folder = user_folder("exports")
    if (library := folder / f"{key}-cache").exists():
        return library
    try:
        folder.mkdir(parents=True, exist_ok=True)
        prune(folder, _LIMIT)
        building = tempfile.TemporaryDirectory(dir=folder)
    except (OSError, RuntimeError):  # no home, or none that can be written to
        folder = Path(tempfile.mkdtemp(prefix="delucax-"))
        library = folder / library.name
        building = tempfile.TemporaryDirectory(dir=folder)
    with building as inside:
        made = Path(inside) / source.stem
        call = [*command, *flags, "-shared", "-fPIC", "-o", made, source, "-lm"]
        done = subprocess.run(call, capture_output=True, text=True, errors="replace")
        if done.returncode or not made.exists():
            words = (done.stderr or done.stdout).strip()[-2000:]
            raise ValueError(
                f"{where}: {command[0]} could not compile {source.name} with "
                f"{' '.join(flags)}:\n{words}"
            )
        os.replace(made, library)  # at once, for another process may do the same
    return library
