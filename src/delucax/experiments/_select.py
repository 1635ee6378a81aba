"""Which cases to run, by an expression: `"lqr and not cartpole"`."""

import re
from collections.abc import Callable
from typing import Any


_OPERATORS = ("and", "or", "not")
_TOKEN = re.compile(r"[()]|[^\s()]+")


def selector(
    expression: str, argument: str, where: str
) -> Callable[[Callable[[str], Any]], Any]:
    """A function of a test of single words to whether the whole holds.

    Words are joined by `and`, `or`, `not` and parentheses, as in pytest's `-k`. An
    empty expression holds always.

    **Raises:** `ValueError` naming the place where the expression cannot be read.
    """
    if not isinstance(expression, str):
        raise ValueError(
            f"{where}: {argument} must be a string such as 'lqr and not cartpole', got "
            f"{expression!r}."
        )
    tokens = [t.lower() if t.lower() in _OPERATORS else t for t in words(expression)]
    if not tokens:
        return lambda holds: True
    # It becomes an expression of Python, which has the same operators; each word is
    # quoted, so that nothing else is evaluated.
    python: list[str | None] = []
    depth, wants_word = 0, True
    for token in (*tokens, None):
        python.append(token)
        if wants_word and token in ("not", "("):
            depth += token == "("
        elif wants_word and token not in ("and", "or", ")", None):
            python[-1], wants_word = f"holds({token!r})", False
        elif not wants_word and token in ("and", "or"):
            wants_word = True
        elif not wants_word and token == ")" and depth:
            depth -= 1
        elif wants_word or token is not None or depth:
            joint = "')'" if depth else "'and' or 'or'"
            got = "the end" if token is None else repr(token)
            raise ValueError(
                f"{where}: {argument} must be words joined by and, or, not and "
                f"parentheses, got {expression!r}: expected "
                f"{'a word' if wants_word else joint} instead of {got}."
            )
    code = compile(" ".join(filter(None, python)), "<expression>", "eval")
    return lambda holds: eval(code, {"holds": holds})


def words(expression: str) -> list[str]:
    """The words and parentheses of an expression."""
    return _TOKEN.findall(expression)
