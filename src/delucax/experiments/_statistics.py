"""Interquartile means, and comparisons of pairs."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, TypeGuard

import numpy as np

from .._check import check_range
from .._extras import extra
from ._results import Results
from ._store import PASSED


def interquartile_mean(values: Any, axis: int | None = None) -> Any:
    """The mean of the middle half of some values.

    It is as robust as the median and uses more of the data. Where a quarter of the
    values is no whole number, the values at the edges count in part.

    Source: Agarwal, Schwarzer, Castro, Courville and Bellemare, 2021.

    **Arguments:**

    - `values`: numbers; infinite ones may be among the outer quarters.
    - `axis`: over which; all by default.

    **Returns:** a number, or an array without that axis.

    **Raises:** `ValueError` if there are none.

    !!! example

        ```python
        from delucax import experiments

        assert experiments.interquartile_mean([1.0, 2.0, 3.0, 1000.0]) == 2.5
        ```
    """
    array = np.asarray(values, np.float64)
    array = array.reshape(-1) if axis is None else np.moveaxis(array, axis, -1)
    count = array.shape[-1] if array.ndim else 0
    if count == 0:
        raise ValueError("interquartile_mean: values must have at least one entry.")
    cut = count / 4
    place = np.arange(count)
    # The k-th sorted value fills [k, k + 1] of [0, count]; what of it lies between the
    # quartiles, count / 4 and 3 count / 4, is its weight.
    weight = np.clip(place + 1 - cut, 0, 1) * np.clip(count - cut - place, 0, 1)
    if count == 1:
        weight = np.ones(1)
    # Not a product with zero, which would make NaN of an infinite value outside.
    inside = weight > 0
    ordered = np.sort(array, axis=-1)[..., inside]
    mean = ordered @ weight[inside] / weight.sum()
    return float(mean) if mean.ndim == 0 else mean


def is_number(value: Any) -> TypeGuard[float]:
    """Whether a result is a number, which statistics can be made of."""
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
    """Each value of a parameter against one of them, on the same cases and seeds.

    Two values are compared where both passed: pairs that agree in all other parameters
    and in the seed. Intervals are those of a bootstrap that draws pairs, seeds within
    each case (within all cases, where a case has but one seed).

    Source: Agarwal, Schwarzer, Castro, Courville and Bellemare, 2021.

    **Arguments:**

    - `results`: from [`delucax.experiments.run`][].
    - `by`: the parameter, such as `"controller"`.
    - `baseline`: the value to compare with, as the table shows it.
    - `metric`: what to compare, `"value"` by default.
    - `ratio`: the quotient of the interquartile means rather than the difference.
    - `confidence`: of the intervals, 0.95 by default.
    - `resamples`: how many, 2000 by default.
    - `seed`: of the resampling.

    **Returns:** a `pandas.DataFrame`, a row for each value: `iqm`, `low`, `high` of its
    interquartile mean; `difference` (or `ratio`) to the baseline's over the common
    pairs, its `difference_low`, `difference_high`; `below`, the fraction of the pairs
    that are below the baseline; and `pairs`.

    **Raises:** `ValueError` if there is no such parameter, value or metric.

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
        assert table.loc["b", "difference"] == 1.0
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
    for row in [row for row in results.rows if row["status"] in PASSED]:
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
    # The same draws for all values of the parameter: what is shared by two of them does
    # not widen the interval of their difference.
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
    """Intervals by resampling: of a statistic of groups of values, and of what lies
    between the members of pairs, for which the same draws are made.

    Source: Efron, 1979.

    **Arguments:**

    - `confidence`: of the intervals, 0.95 by default.
    - `resamples`: how many, 2000 by default.
    - `seed`: of the resampling, 0 by default.
    - `statistic`: of an array over an `axis`; by default
        [`delucax.experiments.interquartile_mean`][].

    !!! example

        ```python
        import numpy as np
        from delucax.experiments import Bootstrap

        costs = np.random.default_rng(0).normal(2.0, 1.0, (40, 2))
        ratio, low, high = Bootstrap(statistic=np.mean).paired([costs], ratio=True)
        assert low < ratio < high
        ```
    """

    confidence: float = 0.95
    resamples: int = 2000
    seed: int = 0
    statistic: Callable[..., Any] = interquartile_mean

    def interval(self, groups: Sequence[np.ndarray]) -> tuple[float, float, float]:
        """The statistic of all values, and its interval.

        **Arguments:**

        - `groups`: vectors of values; each is resampled by itself.
        """
        value = self.statistic(np.concatenate(groups))
        return float(value), *self._ends(self.statistic(self._drawn(groups), axis=1))

    def paired(
        self, groups: Sequence[np.ndarray], ratio: bool = False
    ) -> tuple[float, float, float]:
        """The statistic of the first members of pairs less that of the second, or
        divided by it, and its interval; NaN if there are no pairs.

        **Arguments:**

        - `groups`: arrays of shape `(count, 2)`; each is resampled by itself.
        - `ratio`: whether to divide; false by default.
        """
        if not groups:
            return np.nan, np.nan, np.nan
        drawn, flat = self._drawn(groups), np.concatenate(groups)
        of = np.divide if ratio else np.subtract
        # A baseline of zero has no ratio: infinity or NaN, as the division says.
        with np.errstate(divide="ignore", invalid="ignore"):
            value = of(*self.statistic(flat, axis=0))
            resampled = of(*self.statistic(drawn, axis=1).T)
        return float(value), *self._ends(resampled)

    def _drawn(self, groups: Sequence[np.ndarray]) -> np.ndarray:
        rng = np.random.default_rng(self.seed)
        # A group of one would be drawn as it is, and the interval have no width.
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
        low, high = np.quantile(resampled, [tail, 1 - tail])
        return float(low), float(high)
