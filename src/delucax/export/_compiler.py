"""The C compiler, and the cache on disk of the libraries that it makes."""

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
# The most bytes that all libraries on disk may take.
_LIMIT = 2**28


def find_compiler(compiler: str | None, where: str) -> list[str]:
    """The command of a C compiler: the one that is given, else the environment variable
    `CC`, else the first of the usual names that is installed.

    **Raises:** `ValueError` if no compiler is found.
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
        "or name one with `compiler` or the environment variable CC."
    )


def shared_library(
    source: Path, command: Sequence[str], flags: Sequence[str], where: str
) -> Path:
    """The shared library of a C file, whose header has the same name.

    The library is kept in the user's cache. Its name is a hash of the files, the
    compiler and the flags, so the same files are compiled only once.

    **Raises:** `ValueError` with the message of the compiler if it fails.
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
    except (OSError, RuntimeError):  # no home, or it is read-only
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
        os.replace(made, library)  # atomic: another process may do the same
    return library
