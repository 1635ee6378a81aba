"""Names for what has none of its own."""


def indexed_names(letter: str, size: int) -> tuple[str, ...]:
    """`("x0", "x1", ...)`."""
    return tuple(f"{letter}{i}" for i in range(size))
