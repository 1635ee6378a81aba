"""`python -m benchmarks`: all of them."""

import subprocess
import sys


def main() -> int:
    """Each in a process of its own, so that none warms another's caches."""
    for name in ("pendulum", "wall_clock", "environments"):
        print(f"===== {name} =====", flush=True)
        command = [sys.executable, "-u", "-m", f"benchmarks.{name}"]
        if subprocess.run(command).returncode:
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
