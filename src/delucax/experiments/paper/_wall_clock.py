"""The wall-clock table: how long a step of the pendulum takes, with no control."""

import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..._extras import extra
from ...controllers import Zero
from ...environments import pendulum
from ...simulation import rollout
from ._finding import Claim, Finding


LANES = 1024


def wall_clock(small: bool = False) -> Finding:
    """Ten million steps in one call; Gymnasium beside it, if it is installed."""
    steps, runs = (10**6, 3) if small else (10**7, 10)
    chain, batch = _seconds(steps, None, runs), _seconds(1000, LANES, runs)
    ours = np.array(chain[1]) / steps
    each = np.array(batch[1]) / (1000 * LANES)
    rows: list[dict[str, Any]] = [
        _row("delucax, one after the other", chain[0], ours),
        _row(f"delucax, {LANES} at a time", batch[0], each),
    ]
    theirs = _gymnasium(10**4 if small else 10**5, 3 if small else 10)
    rows.append(_row("Gymnasium", None, theirs))
    ratios = {
        "in one chain": float(np.mean(theirs) / np.mean(ours)),
        f"{LANES} at a time": float(np.mean(theirs) / np.mean(each)),
    }
    claims = [
        Claim(
            f"A compiled step is more than 1000 times as fast as Gymnasium's, {label}",
            f"{ratio:,.0f} times",
            ratio > 1000,
        )
        for label, ratio in ratios.items()
    ]
    notes = (
        f"{steps:,} steps with all controls zero, compilation apart; mean and standard "
        f"deviation over {runs} runs. Gymnasium has become several times as fast since "
        "the paper's 54 us."
    )
    return Finding(
        "Simulation wall-clock time", claims, {"Time a step": rows}, {}, notes
    )


def _seconds(steps: int, lanes: int | None, runs: int) -> tuple[float, list[float]]:
    """Seconds to compile, and of each run."""
    env = pendulum()

    def final(x0):
        key, still = jax.random.key(0), Zero(1)
        run = rollout(env, still, key=key, x0=x0, horizon=steps, keep=(), throw=False)
        return run.final_state

    shape = (2,) if lanes is None else (lanes, 2)
    x0 = jnp.full(shape, 0.5)
    start = time.perf_counter()
    run = jax.jit(final if lanes is None else jax.vmap(final)).lower(x0).compile()
    compiled = time.perf_counter() - start
    jax.block_until_ready(run(x0))
    taken = []
    for _ in range(runs):
        start = time.perf_counter()
        jax.block_until_ready(run(x0))
        taken.append(time.perf_counter() - start)
    return compiled, taken


def _gymnasium(steps: int, runs: int) -> np.ndarray:
    """Seconds a step of its own pendulum in each run."""
    env = extra("gymnasium", "gymnasium").make("Pendulum-v1").unwrapped
    env.reset(seed=0)
    action, taken = np.zeros(1, np.float32), []
    for _ in range(runs):
        start = time.perf_counter()
        for _ in range(steps):
            env.step(action)
        taken.append((time.perf_counter() - start) / steps)
    return np.array(taken)


def _row(name: str, compiled: float | None, seconds: np.ndarray) -> dict[str, Any]:
    return {
        "simulator": name,
        "start-up, ms": None if compiled is None else 1e3 * compiled,
        "ns a step": 1e9 * seconds.mean(),
        "standard deviation": 1e9 * seconds.std(ddof=1),
    }
