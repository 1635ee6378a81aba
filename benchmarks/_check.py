"""`python -m benchmarks._check`: do all contenders simulate the same pendulum?

Compares the peers with each other, then races everyone at small sizes. These short runs
show that the instrument works; they aren't results.
"""

import functools
from typing import Any

import numpy as np
import pandas as pd

from benchmarks._peers import c, gymnasium_peer, gymnax_peer, raw
from benchmarks._problem import Case
from benchmarks._timing import Missing, race


# Of the largest value. Float32 against float64, and lanes that start near the upright
# amplify rounding; a wrong coefficient shows as ten times more.
TOLERANCE = 3e-3


def compare(steps: int = 150) -> pd.DataFrame:
    """The largest error of each peer in each output, relative to the largest value.

    One chain is compared with Gymnasium in float64, except for gradients, and batches
    with raw JAX. **Raises:** `AssertionError` above the tolerance.
    """
    step_env = functools.partial(gymnax_peer.simulate, stepping="step_env")
    peers: dict[str, Any] = {
        "raw": raw.simulate,
        "raw, checkpoint": functools.partial(raw.simulate, checkpoint=True),
        "C": c.simulate,
        "gymnax step": gymnax_peer.simulate,
        "gymnax step_env": step_env,
    }
    rows = []
    for workload in ("trajectory", "cost", "gradient", "free"):
        for case in (Case(workload, steps), Case(workload, steps, 64)):
            exact = case.lanes is None and workload != "gradient"
            truth = (gymnasium_peer if exact else raw).simulate(case)
            for name, simulate in peers.items():
                if workload == "gradient" and name in ("C", "gymnax step"):
                    continue
                found = simulate(case)
                if found is None:
                    continue
                for key in truth:
                    scale = np.abs(truth[key]).max()
                    error = np.abs(found[key] - truth[key]).max() / scale
                    rows.append((case.label, key, name, error))
    frame = pd.DataFrame(rows, columns=["case", "output", "peer", "error"])
    frame = frame.pivot(index=["case", "output"], columns="peer", values="error")
    assert not (frame > TOLERANCE).to_numpy().any(), frame
    return frame


def small_race(case: Case, rounds: int = 7) -> pd.DataFrame:
    """Race everyone who can take part in a case, and name those who can't."""
    entries = [
        gymnasium_peer.contender(case),
        gymnax_peer.contender(case, stepping="step"),
        gymnax_peer.contender(case, stepping="step_env"),
        gymnax_peer.contender(case, stepping="raw"),
        c.contender(case),
        raw.contender(case),
    ]
    if case.workload == "gradient":
        entries.append(raw.contender(case, checkpoint=True, name="raw, checkpoint"))
    missing = [entry for entry in entries if isinstance(entry, Missing)]
    timings = race(
        [entry for entry in entries if not isinstance(entry, Missing)], rounds=rounds
    )
    reference = next(timing for timing in timings if timing.name == raw.NAME)
    rows = [timing.row(reference) for timing in timings]
    rows += [{"contender": entry.name, "missing": entry.reason} for entry in missing]
    return pd.DataFrame(rows)


def main() -> None:
    """Print the comparison and the small races."""
    print(compare().to_string(float_format="%.1e", na_rep=""))
    compiled = c.library()
    print("\nC:", compiled if isinstance(compiled, str) else compiled.vector_sine)
    print("gymnax:", gymnax_peer.versions())
    cases = [
        Case(workload, steps, lanes)
        for workload in ("trajectory", "cost", "gradient", "free")
        for lanes, steps in ((None, 20_000), (1024, 200))
    ]
    cases += [
        Case(workload, 200, 1024, method)
        for method in ("rk4", "tsit5")
        for workload in ("trajectory", "gradient", "free")
    ]
    for case in cases:
        print(f"\n{case.label}")
        table = small_race(case)
        print(table.to_string(index=False, float_format="%.3g", na_rep=""))


if __name__ == "__main__":
    main()
