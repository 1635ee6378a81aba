"""Virtual environments of their own, for peers that do not fit beside us."""

import json
import os
import shutil
import subprocess
import sys
import venv
from pathlib import Path


ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "benchmarks" / ".venvs"


def interpreter(name: str, *requirements: str) -> Path:
    """The interpreter of the virtual environment `name`, which is made if need be.

    A stamp file holds what was installed and for which Python; where it doesn't fit,
    the environment is made anew. delucax is installed in it, from this checkout.

    **Raises:** `RuntimeError` with pip's words if the installation fails.
    """
    home = FOLDER / name
    stamp = home / "stamp.json"
    wanted = json.dumps({"python": sys.version, "requirements": requirements})
    folder, file = ("Scripts", "python.exe") if os.name == "nt" else ("bin", "python")
    python = home / folder / file
    if stamp.exists() and stamp.read_text() == wanted:
        return python
    print(f"making {home.relative_to(ROOT)} with {', '.join(requirements)}", flush=True)
    shutil.rmtree(home, ignore_errors=True)
    venv.create(home, with_pip=True, symlinks=os.name != "nt")
    install = [python, "-m", "pip", "install", "--quiet", *requirements]
    done = subprocess.run(
        [*install, "--editable", str(ROOT)], capture_output=True, text=True
    )
    if done.returncode:
        raise RuntimeError(f"pip could not install {name}: {done.stderr[-500:]}")
    stamp.write_text(wanted)
    return python
