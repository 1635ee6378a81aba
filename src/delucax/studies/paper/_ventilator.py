"""The ventilator figures: a learned lung, and a controller that learns in it."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ..ventilator import lung_study
from ._finding import Claim, Finding


def ventilator(small: bool, out: Path, say: Callable[[str], Any]) -> Finding:
    """Run the ventilator study in the folder `out`, and check its claims."""
    lung_study(out, small=small, say=lambda line: say(f"  {line}"))
    summary = json.loads((out / "summary.json").read_text())
    simulators = summary["simulators"]
    # Of NumPy, because that of Python may pass over NaN, of a run that diverged.
    largest = lambda results: float(np.max([*results.values()]))
    worst = largest(simulators["learned"])
    relative = largest(summary["learned_over_wrong_physics"])
    gains, shared = summary["network_over_best_pid"], summary["shared_over_best_pid"]
    # A small study has no lungs between those it trains on.
    missing = {"between"} if math.isnan(shared["between"]) else set()
    whole = {name: value for name, value in shared.items() if name not in missing}
    highest, limit = summary["highest_pressure"], summary["abort"]
    claims = [
        Claim(
            "A simulator learned from breaths predicts open loop to 0.4 cmH2O on each "
            "lung",
            f"{worst:.3f} cmH2O at most",
            bool(worst <= 0.4),
        ),
        Claim(
            "Its error is at most half of the error of a model with the wrong physics",
            f"{relative:.2f} times at most",
            bool(relative <= 0.5),
        ),
        Claim(
            "A controller trained in the simulator errs at least 20% less than the "
            "best PID on each lung, at pressures not trained on",
            f"{largest(gains):.2f} times at most, "
            f"{sum(gains.values()) / len(gains):.2f} on average",
            bool(largest(gains) <= 0.8),
        ),
        Claim(
            "One controller for all lungs errs at least 20% less than the best PID for "
            "all",
            ", ".join(f"{name}: {value:.2f} times" for name, value in whole.items()),
            bool(largest(whole) <= 0.8),
        ),
        Claim(
            f"No pressure is above {limit:g} cmH2O",
            f"{highest:.1f} cmH2O",
            highest <= limit,
        ),
    ]
    rows: list[dict[str, Any]] = [
        {"lung": lung}
        | {f"{kind}: open loop": errors[lung] for kind, errors in simulators.items()}
        | {"network / best PID": gains[lung]}
        for lung in gains
    ]
    notes = (
        "Lungs of two compartments with valves that lag, a sensor that is two samples "
        "late, and noise of 0.2 cmH2O. breath.gif, the other images, the learned lungs "
        f"and the controllers are in {out}/, as `python -m delucax lung` writes them."
    )
    images = ("simulators.png", "controllers.png", "breath.gif")
    tables, figures = {"Lungs": rows}, {name: out / name for name in images}
    return Finding("Ventilator control and simulator", claims, tables, figures, notes)
