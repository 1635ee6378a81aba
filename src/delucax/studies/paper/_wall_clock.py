"""The wall-clock table: how long a step of the pendulum takes, with no control."""

import time
from collections.abc import Callable
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
    """Time ten million steps in one call, and steps of Gymnasium beside it."""
    steps, runs = (10**6, 5) if small else (10**7, 10)
    python_steps = 10**4 if small else 10**5
    chain_start_up, chain = _compiled(steps, None)
    batch_start_up, batch = _compiled(1000, LANES)
    seconds = take_turns([chain, batch, gymnasium_run(python_steps)], runs)
    ours, each, theirs = (seconds / [steps, 1000 * LANES, python_steps]).T
    rows: list[dict[str, Any]] = [
        {
            "simulator": name,
            "start-up, ms": None if compiled is None else 1e3 * compiled,
            "ns a step": 1e9 * seconds.mean(),
            "standard deviation": 1e9 * seconds.std(ddof=1),
        }
        for name, compiled, seconds in (
            ("delucax, one after the other", chain_start_up, ours),
            (f"delucax, {LANES} at a time", batch_start_up, each),
            ("Gymnasium", None, theirs),
        )
    ]
    # The paper's limit is 1000. On a shared machine a chain may be only 500 times as
    # fast, so a small run has a lower limit, which still shows that it is compiled.
    cases = [
        ("in one chain", float(np.median(theirs / ours)), 100 if small else 1000),
        (f"{LANES} at a time", float(np.median(theirs / each)), 1000),
    ]
    claims = [
        Claim(
            f"A compiled step is more than {limit} times as fast as Gymnasium's, "
            f"{label}",
            f"{ratio:,.0f} times",
            ratio > limit,
        )
        for label, ratio, limit in cases
    ]
    notes = (
        f"The times are those of {steps:,} steps with zero control, without "
        f"compilation: the mean and standard deviation over {runs} runs. Ratios are "
        "medians. Gymnasium has become several times as fast since the paper's 54 us."
    )
    tables = {"Time a step": rows}
    return Finding("Simulation wall-clock time", claims, tables, notes=notes)


def _compiled(steps: int, lanes: int | None) -> tuple[float, Callable[[], Any]]:
    """The time to compile [s], and a function that runs the program."""
    env, key = pendulum(), jax.random.key(0)
    options: Any = dict(key=key, horizon=steps, keep=(), throw=False)
    final = lambda x0: rollout(env, Zero(1), x0=x0, **options).final_state
    shape = (2,) if lanes is None else (lanes, 2)
    x0 = jnp.full(shape, 0.5)
    start = time.perf_counter()
    run = jax.jit(final if lanes is None else jax.vmap(final)).lower(x0).compile()
    seconds = time.perf_counter() - start
    return seconds, lambda: jax.block_until_ready(run(x0))


def gymnasium_run(steps: int) -> Callable[[], Any]:
    """A function that runs Gymnasium's own pendulum.

    **Raises:** `ImportError` if it is not installed.
    """
    env = extra("gymnasium", "gymnasium").make("Pendulum-v1").unwrapped
    env.reset(seed=0)
    action = np.zeros(1, np.float32)

    def run():
        for _ in range(steps):
            env.step(action)

    return run


def take_turns(runs: list[Callable[[], Any]], rounds: int) -> np.ndarray:
    """The time of each run in each round [s]. The runs take turns, so that a changing
    load on the machine affects all of them, and hardly the ratios within a round."""
    for run in runs:
        run()
    taken = np.empty((rounds, len(runs)))
    for turn in taken:
        for k, run in enumerate(runs):
            start = time.perf_counter()
            run()
            turn[k] = time.perf_counter() - start
    return taken
