"""Runs inside trajax's virtual environment: plans the quadrotor on request.

Reads one JSON request a line from standard input and answers each with one JSON line:

- `{"prepare": true}` -> `{"cost": 5.389, "iterations": 8}`
- `{"measure": true}` -> `{"seconds": 0.01}`
"""

import json
import sys
import time

import jax
import jax.numpy as jnp
from trajax import optimizers  # pyright: ignore[reportMissingImports]

from benchmarks._plans import CASES


def main() -> None:
    """Answer requests until standard input ends."""
    case = CASES["quadrotor"]
    x0 = jnp.asarray(case.x0)
    U = jnp.full((case.horizon, case.controls), case.rest)

    def cost(x, u, t):
        here = case.stage(jnp, x, u)
        return jnp.where(t == case.horizon, case.final(jnp, x), here)

    def dynamics(x, u, t):
        return case.step(jnp, x, u)

    solve = jax.jit(lambda x0, U: optimizers.ilqr(cost, dynamics, x0, U))
    for line in sys.stdin:
        request = json.loads(line)
        began = time.perf_counter()
        found = jax.block_until_ready(solve(x0, U))
        answer = {"seconds": time.perf_counter() - began}
        if "prepare" in request:
            answer = {"cost": float(found[2]), "iterations": int(found[-1])}
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
