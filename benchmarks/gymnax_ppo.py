"""`python -m benchmarks.gymnax_ppo`: rejax's PPO trains on our tasks.

rejax, unmodified, sees them through `delucax.interop.gymnax.to_gymnax`, in a virtual
environment of its own that is made on first use. Prints the mean return along the way,
and writes `benchmarks/results/gymnax_ppo.json`.
"""

import argparse
import json
import os
import subprocess
from pathlib import Path

from benchmarks._machine import compile_anew, describe, limit_cores
from benchmarks._venv import interpreter, ROOT


# gymnax imports six but doesn't ask for it.
REQUIREMENTS = ("rejax==0.1.3", "gymnax==1.0.1", "six")
OUT = Path(__file__).parent / "results" / "gymnax_ppo.json"
TASKS = ("pendulum", "cartpole")


def main() -> None:
    """Train, print and write."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gymnax_ppo")
    parser.add_argument("--tasks", nargs="+", default=TASKS, choices=TASKS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--share", type=float, default=1.0, help="of rejax's budget")
    parser.add_argument("--out", default=str(OUT))
    parser.add_argument("--cores", type=int, default=1)
    options = parser.parse_args()
    limit_cores(options.cores)
    compile_anew()
    python = interpreter("rejax", *REQUIREMENTS)
    outside = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    command = [python, "-m", "benchmarks._peers._rejax_worker"]
    request = {"tasks": options.tasks, "seed": options.seed, "share": options.share}
    results = []
    with subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        env=outside,
    ) as process:
        assert process.stdin is not None and process.stdout is not None
        process.stdin.write(json.dumps(request) + "\n")
        process.stdin.close()
        for line in process.stdout:
            answer = json.loads(line)
            results.append(answer)
            print(
                f"{answer['task']}: {answer['steps']:,} steps in "
                f"{answer['seconds']:.1f} s (and {answer['compile_seconds']:.1f} s of "
                f"compilation); mean return of {answer['episodes']} episodes: "
                + ", ".join(f"{value:.0f}" for value in answer["returns"]),
                flush=True,
            )
    if process.returncode:
        raise SystemExit(f"the training ended with status {process.returncode}")
    content = {"machine": describe(), "seed": options.seed, "tasks": results}
    out = Path(options.out)
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(json.dumps(content, indent=1) + "\n")
    print(f"written: {out}")


if __name__ == "__main__":
    main()
