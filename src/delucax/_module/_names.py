"""Default names: x0, x1, ..."""

from collections.abc import Sequence


def indexed_names(letter: str, size: int) -> tuple[str, ...]:
    """`("x0", "x1", ...)`."""
    return tuple(f"{letter}{i}" for i in range(size))


def names_of(
    given: int | Sequence[str], letter: str, argument: str, where: str
) -> tuple[str, ...]:
    """The given names, or indexed names if `given` is their number.

    **Raises:** `ValueError` if it is neither.
    """
    if isinstance(given, int) and not isinstance(given, bool) and given >= 0:
        return indexed_names(letter, given)
    if isinstance(given, tuple | list) and all(isinstance(n, str) for n in given):
        return tuple(given)
    raise ValueError(
        f"{where}: {argument} must be a whole number or a tuple of names, got "
        f"{given!r}."
    )
