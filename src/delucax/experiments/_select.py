"""Which cases to run, by an expression: `"lqr and not cartpole"`."""

import re
from collections.abc import Callable


_TOKEN = re.compile(r"\s*(?:([()])|([^\s()]+))")


def selector(
    expression: str, argument: str, where: str
) -> Callable[[Callable[[str], bool]], bool]:
    """A function of a test of single words to whether the whole holds.

    Words are joined by `and`, `or`, `not` and parentheses, as in pytest's `-k`. An
    empty expression holds always.

    **Raises:** `ValueError` naming the place where the expression cannot be read.
    """
    tokens = _tokens(expression, argument, where)
    if not tokens:
        return lambda holds: True
    position = 0

    def fail(expected: str) -> ValueError:
        got = repr(tokens[position]) if position < len(tokens) else "the end"
        return ValueError(
            f"{where}: {argument} must be words joined by and, or, not and "
            f"parentheses, got {expression!r}: expected {expected} instead of {got}."
        )

    def take(token: str) -> bool:
        nonlocal position
        if position < len(tokens) and tokens[position] == token:
            position += 1
            return True
        return False

    def either() -> Callable:
        parts = [both()]
        while take("or"):
            parts.append(both())
        return lambda holds: any(part(holds) for part in parts)

    def both() -> Callable:
        parts = [negated()]
        while take("and"):
            parts.append(negated())
        return lambda holds: all(part(holds) for part in parts)

    def negated() -> Callable:
        nonlocal position
        if take("not"):
            inner = negated()
            return lambda holds: not inner(holds)
        if take("("):
            inner = either()
            if not take(")"):
                raise fail("')'")
            return inner
        if position == len(tokens) or tokens[position] in ("and", "or", ")"):
            raise fail("a word")
        word = tokens[position]
        position += 1
        return lambda holds: holds(word)

    found = either()
    if position < len(tokens):
        raise fail("'and' or 'or'")
    return found


def words(expression: str) -> list[str]:
    """What an expression is made of, without its parentheses."""
    return [word for _, word in _TOKEN.findall(expression) if word]


def _tokens(expression: str, argument: str, where: str) -> list[str]:
    if not isinstance(expression, str):
        raise ValueError(
            f"{where}: {argument} must be a string such as 'lqr and not cartpole', got "
            f"{expression!r}."
        )
    found = []
    for parenthesis, word in _TOKEN.findall(expression):
        low = word.lower()
        found.append(parenthesis or (low if low in ("and", "or", "not") else word))
    return found
