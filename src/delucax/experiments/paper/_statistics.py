"""Intervals over seeds."""

import numpy as np


def mean_and_half_width(values: np.ndarray) -> tuple[float, float]:
    """The mean, and half of its 95% interval."""
    half = 1.96 * values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else 0.0
    return float(values.mean()), float(half)


def paired_ratio(one: np.ndarray, other: np.ndarray) -> tuple[float, float, float]:
    """The ratio of the means over the same seeds, and its 95% interval by the
    bootstrap."""
    drawn = np.random.default_rng(0).integers(len(one), size=(5000, len(one)))
    ratios = one[drawn].mean(axis=1) / other[drawn].mean(axis=1)
    low, high = np.quantile(ratios, [0.025, 0.975])
    return float(one.mean() / other.mean()), float(low), float(high)
