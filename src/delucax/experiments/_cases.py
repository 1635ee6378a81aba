"""Cases: combinations of parameters, with ids and marks. Expressions select cases."""

import dataclasses
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from ._fingerprint import fingerprint


@dataclasses.dataclass(frozen=True)
class Mark:
    """A label of a case, such as `experiment.mark.skip("does not converge")`. `slow`,
    `skip` and `xfail` change how a case is run. Other names serve to select cases."""

    name: str
    reason: str = ""


@dataclasses.dataclass(frozen=True)
class Param:
    """One value for each name of an axis, with its own id and marks."""

    values: tuple
    id: str | None = None
    marks: tuple[Mark, ...] = ()


class Choice(NamedTuple):
    """One of the values of an axis: its index, what the table shows, and its hash."""

    index: int
    param: Param
    shown: Mapping[str, Any]
    hash: str


@dataclasses.dataclass(frozen=True)
class Axis:
    """One `parametrize`: the names of arguments, and their values with ids."""

    names: tuple[str, ...]
    params: tuple[Param, ...]

    def choices(self, where: str) -> Iterator[Choice]:
        """The choices of this axis. Errors name `where`."""
        for index, param in enumerate(self.params):
            shown, hashes = {}, []
            for name, value in zip(self.names, param.values, strict=True):
                shown[name] = self._shown(value, param)
                try:
                    hashes.append((name, fingerprint(value)))
                except (TypeError, RecursionError) as error:
                    raise ValueError(
                        f"{where}: the parameter {name!r} of case {param.id!r} cannot "
                        f"be identified by its content: it holds {error}. Pass a name "
                        "instead, and make the object in the function or in a fixture."
                    ) from error
            yield Choice(index, param, shown, fingerprint(hashes))

    def _shown(self, value: Any, param: Param) -> Any:
        """A value as the table shows it: itself if it is simple, else its name or
        id."""
        value = _as_python(value)
        if isinstance(value, _SIMPLE):
            return value
        return (_label(value) if len(self.names) > 1 else None) or param.id


@dataclasses.dataclass(frozen=True)
class Case:
    """One case of an experiment: a value of each axis. It is run for all seeds."""

    experiment: str
    id: str
    index: tuple[int, ...]
    shown: Mapping[str, Any]
    marks: tuple[Mark, ...]
    hash: str

    @property
    def key(self) -> tuple[str, str]:
        """Its key in the results store."""
        return self.experiment, self.id

    @property
    def described(self) -> dict[str, Any]:
        """Its columns in a line of the store."""
        return {
            "experiment": self.experiment,
            "case": self.id,
            "order": self.index,
            "hash": self.hash,
            "parameters": self.shown,
        }

    def mark(self, name: str) -> Mark | None:
        """The mark of that name, or `None` if the case does not have it."""
        return next((mark for mark in self.marks if mark.name == name), None)

    def matches(self, word: str) -> bool:
        """Whether a word is in the name of the case, in upper or lower case."""
        return word.lower() in self.id.lower()


def axis_of(names: Any, values: Any, ids: Any) -> Axis:
    """Check the arguments of `parametrize`, and make their axis."""
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
    params = [_as_param(value, names) for value in values]
    if not params:
        raise ValueError(f"{where}: {', '.join(names)} must have a value.")
    for param in params:
        if len(param.values) != len(names):
            raise ValueError(
                f"{where}: each value must have {len(names)} parts, for "
                f"{', '.join(names)}; got {param.values!r}."
            )
    pairs = zip(params, _ids(params, names, ids, where), strict=True)
    return Axis(names, tuple(dataclasses.replace(p, id=label) for p, label in pairs))


def _as_param(value: Any, names: tuple[str, ...]) -> Param:
    if isinstance(value, Param):
        return value
    several = len(names) > 1 and isinstance(value, tuple | list)
    return Param(tuple(value) if several else (value,))


def _ids(params: list[Param], names: tuple, ids: Any, where: str) -> list[str]:
    if callable(ids):
        ids = [ids(*param.values) for param in params]
    if ids is not None:
        ids = list(ids)
        if len(ids) != len(params) or not all(isinstance(i, str) for i in ids):
            raise ValueError(
                f"{where}: ids must be {len(params)} strings, one for each value, got "
                f"{ids!r}."
            )
    labels = []
    for k, param in enumerate(params):
        pairs = zip(param.values, names, strict=True)
        words = (f"{n}{k}" if (w := _label(v)) is None else w for v, n in pairs)
        labels.append(param.id or ("-".join(words) if ids is None else ids[k]))
    counts = Counter(labels)
    for label, param in zip(labels, params, strict=True):
        if counts[label] > 1 and (ids is not None or param.id is not None):
            raise ValueError(f"{where}: the id {label!r} is given twice.")
    return [
        f"{label}{labels[:k].count(label)}" if counts[label] > 1 else label
        for k, label in enumerate(labels)
    ]


_SIMPLE = bool | int | float | str | None
"""The types of values that a table can hold."""


def _as_python(value: Any) -> Any:
    """Convert a NumPy scalar to a Python number."""
    return value.item() if isinstance(value, np.generic) else value


def _label(value: Any) -> str | None:
    """The label of a value that is simple or has a name, else `None`."""
    value = _as_python(value)
    if isinstance(value, _SIMPLE):
        return str(value)
    label = getattr(value, "__name__", None)
    return label if isinstance(label, str) and label != "<lambda>" else None


def as_seeds(seeds: Any, where: str) -> tuple[int, ...]:
    """Check seeds. A single number is a number of seeds, which count from 0."""
    is_whole = lambda s: isinstance(s, int | np.integer) and not isinstance(s, bool)
    several = range(seeds) if is_whole(seeds) else seeds
    chosen = tuple(several) if isinstance(several, Iterable) else ()
    if not chosen or not all(is_whole(seed) and 0 <= seed < 2**31 for seed in chosen):
        raise ValueError(
            f"{where}: seeds must be a number of seeds, at least 1, or whole numbers "
            f"from 0 to 2**31 - 1, got {seeds!r}."
        )
    if len(set(chosen)) < len(chosen):
        raise ValueError(f"{where}: seeds must differ, got {seeds!r}.")
    return tuple(int(s) for s in chosen)


_OPERATORS = ("and", "or", "not")
_TOKEN = re.compile(r"[()]|[^\s()]+")


def selector(
    expression: str, argument: str, where: str
) -> Callable[[Callable[[str], Any]], Any]:
    """Compile an expression of words into a function.

    The function takes a test of single words and returns whether the expression holds.
    Words are joined by `and`, `or`, `not` and parentheses, as in pytest's `-k`. An
    empty expression always holds.

    **Raises:** `ValueError` if the expression cannot be read. It names the place.
    """
    if not isinstance(expression, str):
        raise ValueError(
            f"{where}: {argument} must be a string such as 'lqr and not cartpole', got "
            f"{expression!r}."
        )
    tokens = [t.lower() if t.lower() in _OPERATORS else t for t in words(expression)]
    if not tokens:
        return lambda holds: True
    # Convert it to a Python expression, which has the same operators. Words are quoted,
    # so that `eval` is safe.
    python: list[str] = []
    depth, wants_word = 0, True
    for token in (*tokens, ""):
        python.append(token)
        if wants_word and token in ("not", "("):
            depth += token == "("
        elif wants_word and token not in ("and", "or", ")", ""):
            python[-1], wants_word = f"holds({token!r})", False
        elif not wants_word and token in ("and", "or"):
            wants_word = True
        elif not wants_word and token == ")" and depth:
            depth -= 1
        elif wants_word or token or depth:
            joint = "')'" if depth else "'and' or 'or'"
            raise ValueError(
                f"{where}: {argument} must be words joined by and, or, not and "
                f"parentheses, got {expression!r}: expected "
                f"{'a word' if wants_word else joint} instead of "
                f"{repr(token) if token else 'the end'}."
            )
    code = compile(" ".join(python), "<expression>", "eval")
    return lambda holds: eval(code, {"holds": holds})


def words(expression: str) -> list[str]:
    """The words and parentheses of an expression."""
    return _TOKEN.findall(expression)
