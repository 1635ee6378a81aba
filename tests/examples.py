"""The examples of the pages and of the docstrings, and what is printed under them."""

import ast
import contextlib
import io
import re


_NUMBER = r"(?<![\w.])[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?(?!\w)"
_TOKEN = re.compile(rf"{_NUMBER}|\w+|\.\.\.|\S")


def output_of(code, namespace, name="example"):
    """What a notebook shows under a cell: prints, and the value of the last line."""
    *body, last = ast.parse(code).body
    is_value = isinstance(last, ast.Expr)
    body = ast.Module(body if is_value else [*body, last], type_ignores=[])
    shown = io.StringIO()
    with contextlib.redirect_stdout(shown):
        exec(compile(body, name, "exec"), namespace)
        if is_value:
            value = eval(compile(ast.Expression(last.value), name, "eval"), namespace)
            if value is not None:
                print(repr(value))
    return shown.getvalue()


def check_output(shown, printed):
    """The words under an example are those that it shows, and each number is within one
    unit of its last printed digit. `...` on a page stands for anything. Spaces follow
    the width of the numbers, and are not compared."""
    pattern, numbers = [], []
    for token in _TOKEN.findall(printed):
        if token == "...":
            pattern.append(".*?")
        elif re.fullmatch(_NUMBER, token):
            numbers.append(token)
            pattern.append(f"({_NUMBER})")
        else:
            pattern.append(re.escape(token))
    match = re.fullmatch(r"\s*".join(["", *pattern, ""]), shown, re.DOTALL)
    assert match, f"the page prints\n{printed}\nand the example\n{shown}"
    for text, value in zip(numbers, match.groups(), strict=True):
        is_near = abs(float(value) - float(text)) <= 1.01 * _unit(text)
        assert is_near, f"the page prints {text}, and the example {value}, in\n{shown}"


def _unit(text):
    """The unit of the last printed digit; 0 for a count such as 200."""
    mantissa, _, exponent = text.lower().partition("e")
    if "." not in mantissa and not exponent:
        return 0.0
    return 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))
