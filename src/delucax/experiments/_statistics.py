"""Interquartile means, bootstrap intervals, and comparisons of pairs."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, TypeGuard

import numpy as np

from .._check import check_range
from .._extras import extra
from ._results import Results
from ._store import PASSED


def quantile(values: Any, shares: Any) -> Any:
    """Quantiles, also where some values are infinite: `numpy.quantile` then computes
    infinity times zero, or the difference of two infinities, and gives NaN."""
    with np.errstate(invalid="ignore"):
        between = np.quantile(values, shares)
    low, high = (np.quantile(values, shares, method=end) for end in ("lower", "higher"))
    return np.where(low == high, low, between)


def interquartile_mean(values: Any, axis: int | None = None) -> Any:
    """The interquartile mean: the mean of the values between the quartiles.

    The interquartile mean ignores outliers, as the median does, but uses more of the
    data. If the number of values is not a multiple of 4, the smallest and the largest
    value of the middle half have a reduced weight.

    **Arguments:**

    - `values`: numbers. Infinite values among the lowest and the highest quarter of the
        values have no effect. If a value is NaN, the mean is NaN.
    - `axis`: the axis to average over; all axes by default.

    **Returns:** a number if all axes are averaged, otherwise an array that lacks
    `axis`.

    **Raises:** `ValueError` if `values` is empty.

    Source: Agarwal, Schwarzer, Castro, Courville and Bellemare, 2021.

    !!! example

        ```python
        from delucax import experiments

        experiments.interquartile_mean([1.0, 2.0, 3.0, 1000.0])
        ```

        ```text
        2.5
        ```
    """
    array = np.asarray(values, np.float64)
    array = array.reshape(-1) if axis is None else np.moveaxis(array, axis, -1)
    count = array.shape[-1] if array.ndim else 0
    if count == 0:
        raise ValueError("interquartile_mean: values must have at least one entry.")
    cut = count / 4
    place = np.arange(count)
    # The k-th sorted value takes up [k, k + 1] of [0, count]. Its weight is the part of
    # this between the quartiles, count / 4 and 3 count / 4.
    weight = np.clip(place + 1 - cut, 0, 1) * np.clip(count - cut - place, 0, 1)
    if count == 1:
        weight = np.ones(1)
    # Values of weight zero are left out, because zero times infinity is NaN.
    inside = weight > 0
    ordered = np.sort(array, axis=-1)[..., inside]
    mean = ordered @ weight[inside] / weight.sum()
    # The sort puts NaN last, where its weight would be zero.
    mean = np.where(np.isnan(array).any(axis=-1), np.nan, mean)
    return float(mean) if mean.ndim == 0 else mean


def is_number(value: Any) -> TypeGuard[float]:
    """Whether a result is a number, so that it has statistics."""
    return isinstance(value, bool | int | float)


def compare(
    results: Results,
    *,
    by: str,
    baseline: Any,
    metric: str = "value",
    ratio: bool = False,
    confidence: float = 0.95,
    resamples: int = 2000,
    seed: int = 0,
) -> Any:
    """Compare each value of a parameter with a baseline, on the same cases and seeds.

    Each value is compared with the baseline in pairs of rows. Both rows of a pair have
    passed, and they have the same seed and the same values of all other parameters. The
    confidence intervals are computed by a bootstrap over the pairs. In each case, the
    bootstrap resamples the seeds. If each case has only one seed, the bootstrap
    resamples the cases.

    **Arguments:**

    - `results`: from [`delucax.experiments.run`][].
    - `by`: the parameter, such as `"controller"`.
    - `baseline`: the value of the parameter to compare with, written as in the table of
        the results.
    - `metric`: the name of the result to compare, `"value"` by default.
    - `ratio`: whether to give the ratio of the interquartile means instead of their
        difference; `False` by default.
    - `confidence`: the confidence level of the intervals, 0.95 by default.
    - `resamples`: the number of bootstrap samples, 2000 by default.
    - `seed`: the seed of the bootstrap, 0 by default.

    **Returns:** a `pandas.DataFrame` with a row for each value, and the columns

    - `iqm`, `low`, `high`: the interquartile mean and its confidence interval.
    - `difference`, `difference_low`, `difference_high`: the difference from the
        baseline, computed over the pairs, and its confidence interval. If `ratio` is
        true, these columns are called `ratio`, `ratio_low` and `ratio_high`.
    - `below`: the fraction of the pairs in which the result is lower than the result of
        the baseline.
    - `pairs`: the number of pairs.

    **Raises:** `ValueError` if `by`, `baseline` or `metric` does not exist in the
    results, or if the metric is not a number.

    Source: Agarwal, Schwarzer, Castro, Courville and Bellemare, 2021.

    !!! example

        ```python
        from delucax import experiments
        from delucax.experiments import experiment

        @experiment.parametrize("method", ["a", "b"])
        @experiment.seeds(10)
        def cost(method, seed):
            return seed + (1.0 if method == "b" else 0.0)

        results = experiments.run(cost, progress=False)
        table = experiments.compare(results, by="method", baseline="a")
        print(table.loc["b", "difference"])
        ```

        ```text
        1.0
        ```
    """
    pd = extra("pandas", "tables")
    where = "compare"
    for value, name, kind, known in (
        (by, "by", "parameter", results.parameters),
        (metric, "metric", "result", results.metrics),
    ):
        if value not in known:
            names = ", ".join(known) or "none"
            raise ValueError(
                f"{where}: {name} must be a {kind} ({names}), got {value!r}."
            )
    check_range(confidence, "confidence", where, 0, 1)
    samples: dict[Any, dict[tuple, dict[int, float]]] = {}
    # Other experiments of the results may lack the parameter.
    for row in [r for r in results.rows if r["status"] in PASSED and by in r]:
        value = row.get(metric)
        if not is_number(value):
            raise ValueError(
                f"{where}: metric {metric!r} must be a number in every row, got "
                f"{value!r} in {row['case']}."
            )
        others = (row.get(n) for n in ("experiment", *results.parameters) if n != by)
        group = samples.setdefault(row[by], {}).setdefault(tuple(others), {})
        group[row["seed"]] = float(value)
    if baseline not in samples:
        raise ValueError(
            f"{where}: baseline must be a value of {by!r} that passed "
            f"({', '.join(map(repr, samples))}), got {baseline!r}."
        )
    # The same draws for all values of the parameter, so that the variation they share
    # does not widen the intervals of their differences.
    bootstrap = Bootstrap(confidence, resamples, seed)
    rows = {}
    for label, groups in samples.items():
        own = [np.array(list(group.values())) for group in groups.values()]
        pairs = []
        for place, group in groups.items():
            against = samples[baseline].get(place, {})
            common = [s for s in group if s in against]
            if common:
                pairs.append(np.array([[group[s], against[s]] for s in common]))
        flat = np.concatenate(pairs) if pairs else np.zeros((0, 2))
        below = float(np.mean(flat[:, 0] < flat[:, 1])) if pairs else np.nan
        both = *bootstrap.interval(own), *bootstrap.paired(pairs, ratio)
        rows[label] = *both, below, len(flat)
    name = "ratio" if ratio else "difference"
    names = ["iqm", "low", "high", name, f"{name}_low", f"{name}_high"]
    names += ["below", "pairs"]
    frame = pd.DataFrame.from_dict(rows, orient="index", columns=names)
    return frame.rename_axis(by)


@dataclasses.dataclass(frozen=True)
class Bootstrap:
    """Bootstrap confidence intervals of a statistic, or of a comparison of paired
    values.

    The values are given in groups, and the bootstrap resamples each group separately.
    The two values of a pair are always drawn together.

    Source: Efron, 1979.

    **Arguments:**

    - `confidence`: the confidence level of the intervals, 0.95 by default.
    - `resamples`: the number of bootstrap samples, 2000 by default.
    - `seed`: the seed of the bootstrap, 0 by default.
    - `statistic`: the statistic, a function that takes an array and an argument `axis`;
        by default [`delucax.experiments.interquartile_mean`][].

    !!! example

        ```python
        import numpy as np
        from delucax.experiments import Bootstrap

        costs = np.random.default_rng(0).normal(2.0, 1.0, (40, 2))
        ratio, low, high = Bootstrap(statistic=np.mean).paired([costs], ratio=True)
        low < ratio < high
        ```

        ```text
        True
        ```
    """

    confidence: float = 0.95
    resamples: int = 2000
    seed: int = 0
    statistic: Callable[..., Any] = interquartile_mean

    def interval(self, groups: Sequence[np.ndarray]) -> tuple[float, float, float]:
        """The statistic of all values, and its confidence interval.

        **Arguments:**

        - `groups`: vectors of values. Each is resampled separately.

        **Returns:** `(value, low, high)`.
        """
        value = self.statistic(np.concatenate(groups))
        return float(value), *self._ends(self.statistic(self._drawn(groups), axis=1))

    def paired(
        self, groups: Sequence[np.ndarray], ratio: bool = False
    ) -> tuple[float, float, float]:
        """The difference or ratio of the statistic between the two values of pairs.

        This is the statistic of the first values minus the statistic of the second
        values, or their quotient with `ratio`.

        **Arguments:**

        - `groups`: arrays of pairs, shape `(count, 2)`. Each is resampled separately.
        - `ratio`: whether to compute the ratio instead of the difference; `False` by
            default.

        **Returns:** `(value, low, high)`; NaN if no pairs are given.
        """
        if not groups:
            return np.nan, np.nan, np.nan
        drawn, flat = self._drawn(groups), np.concatenate(groups)
        of = np.divide if ratio else np.subtract
        # A baseline of zero makes the ratio infinite or NaN, without a warning.
        with np.errstate(divide="ignore", invalid="ignore"):
            value = of(*self.statistic(flat, axis=0))
            resampled = of(*self.statistic(drawn, axis=1).T)
        return float(value), *self._ends(resampled)

    def _drawn(self, groups: Sequence[np.ndarray]) -> np.ndarray:
        rng = np.random.default_rng(self.seed)
        # A group of one value never changes, so the interval would have no width.
        if all(len(group) == 1 for group in groups):
            groups = [np.concatenate(groups)]
        parts = [
            group[rng.integers(len(group), size=(self.resamples, len(group)))]
            for group in groups
        ]
        return np.concatenate(parts, axis=1)

    def _ends(self, resampled: np.ndarray) -> tuple[float, float]:
        # Efron's percentile interval.
        tail = (1 - self.confidence) / 2
        low, high = quantile(resampled, [tail, 1 - tail])
        return float(low), float(high)
