"""Methods that met the same starts: interquartile means, and ratios of pairs."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from delucax.experiments import Bootstrap, interquartile_mean


def paired(values: Mapping[str, Any], baseline: str) -> pd.DataFrame:
    """A row for each method: `iqm` with its 95% interval, and the ratio to the
    baseline's with that of the pairs."""
    columns = ("iqm", "low", "high", "ratio", "ratio_low", "ratio_high")
    pairs = {
        name: np.stack([found, values[baseline]], axis=1, dtype=float)
        for name, found in values.items()
    }
    rows = {
        name: (*spread(pair[:, 0]), *Bootstrap().paired([pair], ratio=True))
        for name, pair in pairs.items()
    }
    return pd.DataFrame.from_dict(rows, orient="index", columns=columns)


def spread(values: Any) -> tuple[float, float, float]:
    """The interquartile mean, and the ends of its 95% interval by the bootstrap."""
    return Bootstrap().interval([np.asarray(values, float)])


def middle(values: Any) -> float:
    """The interquartile mean."""
    return float(interquartile_mean(values))
