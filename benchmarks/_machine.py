"""What the numbers were measured on: the header of a results file."""

import argparse
import os
import platform
import subprocess
import sys
from collections.abc import Callable
from datetime import datetime, UTC
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any


PACKAGES = ("delucax", "jax", "jaxlib", "equinox", "diffrax", "numpy", "gymnasium")


def limit_cores(count: int) -> None:
    """Keep this process, and those it starts, on `count` cores.

    Call it before JAX starts its threads. Does nothing where the system has no such
    call (macOS, Windows).
    """
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:count])


RESULTS = Path(__file__).parent / "results"
FOLDERS = {"defaults": RESULTS, "pinned": RESULTS / "pinned"}
"""Where each setting's results go. `defaults` is what a user has who sets nothing;
`pinned` says what the arithmetic costs, on one core without threads for products."""
INSIDE = "DELUCAX_BENCHMARK_SETTING"


def run_in_settings(
    parser: argparse.ArgumentParser,
    measure: Callable[[argparse.Namespace, Path], None],
) -> None:
    """Run `measure(options, folder)` under both settings, or under the one asked for.

    Each is a process of its own, as threads are set when JAX and BLAS start.
    """
    parser.add_argument("--setting", choices=tuple(FOLDERS), help="one alone")
    options = parser.parse_args()
    inside = os.environ.get(INSIDE)
    if inside:
        if inside == "pinned":
            limit_cores(1)
        folder = FOLDERS[inside]
        folder.mkdir(parents=True, exist_ok=True)
        measure(options, folder)
        return
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_cpu_multi_thread_eigen=false"
    names = "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"
    one_thread = dict.fromkeys(names, "1") | {"XLA_FLAGS": flags.strip()}
    for name in [options.setting] if options.setting else FOLDERS:
        print(f"\n===== {name} =====", flush=True)
        changed = (one_thread if name == "pinned" else {}) | {INSIDE: name}
        command = [sys.executable, *sys.orig_argv[1:]]
        if code := subprocess.run(command, env=os.environ | changed).returncode:
            sys.exit(code)


def keep_programs() -> None:
    """Keep compiled programs in `.cache/programs`, or as the variables of JAX say.

    Each benchmark calls this, or `compile_anew` if its seconds contain compilation.
    """
    from delucax import _programs

    _programs.keep_programs(otherwise=Path(__file__).parents[1] / ".cache/programs")


def compile_anew() -> None:
    """Compile every program, whatever the variables of JAX say."""
    from delucax import _programs

    _programs.forget_programs()


def describe() -> dict[str, Any]:
    """Processor, cores, device, versions, load and date; no host name."""
    import cpuinfo
    import jax

    usable = (
        len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count()
    )
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "cpu": cpuinfo.get_cpu_info().get("brand_raw", platform.processor()),
        "cores": os.cpu_count(),
        "cores_used": usable,
        "load": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
        "system": f"{platform.system()} {platform.machine()}",
        "device": jax.devices()[0].device_kind,
        "python": platform.python_version(),
        "versions": {name: _version(name) for name in PACKAGES},
    }


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
