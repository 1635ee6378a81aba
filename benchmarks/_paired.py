"""Methods that met the same starts: interquartile means, and ratios of pairs."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from delucax.experiments import compare, interquartile_mean, Results


def paired(values: Mapping[str, Any], baseline: str) -> pd.DataFrame:
    """A row for each method: `iqm` with its 95% interval, and the ratio to the
    baseline's with that of the pairs."""
    rows = [
        {
            "experiment": "study",
            "case": f"{name}, {seed}",
            "method": name,
            "seed": seed,
            "status": "passed",
            "value": float(value),
        }
        for name, found in values.items()
        for seed, value in enumerate(np.asarray(found))
    ]
    results = Results(rows, metrics=("value",), parameters=("method",))
    return compare(results, by="method", baseline=baseline, ratio=True)


def spread(values: Any) -> list[float]:
    """The interquartile mean, and the ends of its 95% interval by the bootstrap."""
    table = paired({"all": values}, "all")
    return [float(table.loc["all", name]) for name in ("iqm", "low", "high")]


def middle(values: Any) -> float:
    """The interquartile mean."""
    return float(interquartile_mean(values))
