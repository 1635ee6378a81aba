"""Parameters: their names, values, ids and marks."""

import dataclasses
from collections.abc import Iterable
from typing import Any

import numpy as np

from ._hash import fingerprint


@dataclasses.dataclass(frozen=True)
class Mark:
    """What is known of a case beforehand; made by `experiment.mark`.

    **Arguments:**

    - `name`: `"slow"`, `"skip"`, `"xfail"`, or a name of your own to select by.
    - `reason`: why; nothing by default.

    !!! example

        ```python
        from delucax.experiments import experiment

        tired = experiment.mark.skip("does not converge")
        hard = experiment.param(3.0, marks=tired)
        ```
    """

    name: str
    reason: str = ""

    def __call__(self, what: Any) -> Any:
        """The mark with the reason `what`, or the experiment `what` with the mark."""
        if isinstance(what, str):
            return dataclasses.replace(self, reason=what)
        from ._experiment import as_experiment

        made = as_experiment(what)
        return dataclasses.replace(made, marks=(*made.marks, self))


class Marks:
    """`experiment.mark.slow`, and any other name."""

    def __getattr__(self, name: str) -> Mark:
        if name.startswith("_"):
            raise AttributeError(name)
        return Mark(name)


@dataclasses.dataclass(frozen=True)
class Param:
    """A value of each name of an axis, with an id or marks of its own."""

    values: tuple
    id: str | None
    marks: tuple[Mark, ...]


@dataclasses.dataclass(frozen=True)
class Axis:
    """One `parametrize`: names, and for each of its values an id and marks."""

    names: tuple[str, ...]
    values: tuple[tuple, ...]
    ids: tuple[str, ...]
    marks: tuple[tuple[Mark, ...], ...]


def axis_of(names: Any, values: Any, ids: Any) -> Axis:
    """The axis of a `parametrize`, checked."""
    where = "experiment.parametrize"
    if isinstance(names, str):
        names = [name.strip() for name in names.split(",") if name.strip()]
    names = tuple(names)
    if not names or not all(isinstance(n, str) and n.isidentifier() for n in names):
        raise ValueError(
            f"{where}: names must be names of arguments, such as "
            f"'controller, environment', got {names!r}."
        )
    if len(set(names)) < len(names):
        raise ValueError(f"{where}: a name is given twice in {names!r}.")
    if isinstance(values, str) or not isinstance(values, Iterable):
        raise ValueError(f"{where}: values must be a list, got {values!r}.")
    found: list[Param] = []
    for value in values:
        if not isinstance(value, Param):
            one = (value,) if len(names) == 1 else value
            if not isinstance(one, tuple | list):
                one = (one,)
            value = Param(tuple(one), None, ())
        if len(value.values) != len(names):
            raise ValueError(
                f"{where}: each value must have {len(names)} parts, for "
                f"{', '.join(names)}; got {value.values!r}."
            )
        found.append(value)
    if not found:
        raise ValueError(f"{where}: {', '.join(names)} must have a value.")
    labels = _ids(found, names, ids, where)
    return Axis(
        names,
        tuple(value.values for value in found),
        labels,
        tuple(value.marks for value in found),
    )


def _ids(found: list[Param], names: tuple, ids: Any, where: str) -> tuple[str, ...]:
    if callable(ids):
        make = ids
        ids = [make(*value.values) for value in found]
    if ids is not None:
        ids = list(ids)
        if len(ids) != len(found) or not all(isinstance(i, str) for i in ids):
            raise ValueError(
                f"{where}: ids must be {len(found)} strings, one for each value, got "
                f"{ids!r}."
            )
    labels = []
    for k, value in enumerate(found):
        auto = "-".join(
            _label(v, name, k) for v, name in zip(value.values, names, strict=True)
        )
        labels.append(value.id or (ids[k] if ids is not None else auto))
    if len(set(labels)) < len(labels):
        for label, value in zip(labels, found, strict=True):
            if labels.count(label) > 1 and (ids is not None or value.id is not None):
                raise ValueError(f"{where}: the id {label!r} is given twice.")
        labels = [
            f"{label}{labels[:k].count(label)}" if labels.count(label) > 1 else label
            for k, label in enumerate(labels)
        ]
    return tuple(labels)


def _label(value: Any, name: str, k: int) -> str:
    if value is None or isinstance(value, bool | int | float | str):
        return str(value)
    if isinstance(value, np.generic):
        return str(value.item())
    label = getattr(value, "__name__", None)
    if isinstance(label, str) and label != "<lambda>":
        return label
    return f"{name}{k}"


def shown_values(axis: Axis) -> list[dict[str, Any]]:
    """What the table shows of each value: itself if it is simple, or its id."""
    rows = []
    for values, label in zip(axis.values, axis.ids, strict=True):
        row = {}
        for name, value in zip(axis.names, values, strict=True):
            if isinstance(value, np.generic):
                value = value.item()
            if value is None or isinstance(value, bool | int | float | str):
                row[name] = value
            elif len(axis.names) == 1:
                row[name] = label
            else:
                k = len(rows)
                alone = _label(value, name, k)
                row[name] = label if alone == f"{name}{k}" else alone
        rows.append(row)
    return rows


def hashes_of(axis: Axis, where: str) -> list[str]:
    """What tells each value from the others by its content."""
    found = []
    for values, label in zip(axis.values, axis.ids, strict=True):
        for name, value in zip(axis.names, values, strict=True):
            try:
                found_one = fingerprint(value)
            except (TypeError, RecursionError) as error:
                raise ValueError(
                    f"{where}: the parameter {name!r} of case {label!r} cannot be "
                    f"written down: it holds {error}. Give a name instead, and make "
                    "the thing in the function or in a fixture."
                ) from error
            found.append((label, name, found_one))
    size = len(axis.names)
    parts = [found[k : k + size] for k in range(0, len(found), size)]
    return [fingerprint([(name, h) for _, name, h in part]) for part in parts]
