"""Operations on single entries: from a primitive of JAX to an expression of C.

In a template, `{0}` and `{1}` are the operands, `{f}` is the suffix of the functions of
`math.h`, and `@name` calls a routine. An operation that reads an operand twice is a
routine, so that the operand is computed once.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from ._expressions import c_type, Expr, literal, union


_FLOAT: dict[str, tuple[str, int]] = {
    "add": ("{0} + {1}", 1),
    "add_any": ("{0} + {1}", 1),
    "sub": ("{0} - {1}", 1),
    "mul": ("{0} * {1}", 1),
    "div": ("{0} / {1}", 1),
    "neg": ("-{0}", 1),
    "square": ("@square({0})", 1),
    "one_minus_square": ("@one_minus_square({0})", 3),
    "max": ("@maximum({0}, {1})", 1),
    "min": ("@minimum({0}, {1})", 1),
    "sign": ("@sign({0})", 1),
    "rem": ("fmod{f}({0}, {1})", 1),
    "pow": ("pow{f}({0}, {1})", 1),
    "atan2": ("atan2{f}({0}, {1})", 1),
    "nextafter": ("nextafter{f}({0}, {1})", 1),
    "abs": ("fabs{f}({0})", 1),
    "rsqrt": ("1 / sqrt{f}({0})", 2),
    "logistic": ("1 / (1 + exp{f}(-{0}))", 3),
    "is_finite": ("isfinite({0}) != 0", 1),
    "lt_to": ("@precedes({0}, {1})", 1),
    "le_to": ("!@precedes({1}, {0})", 1),
    "eq_to": ("!@precedes({1}, {0}) & !@precedes({0}, {1})", 3),
    "lgamma": ("lgamma{f}({0})", 1),
    "erf_inv": ("@erf_inv({0})", 20),
    "digamma": ("@digamma({0})", 20),
    "clamp": ("@minimum(@maximum({1}, {0}), {2})", 2),
    **{
        name: (f"{name}{{f}}({{0}})", 1)
        for name in (
            "acos acosh asin asinh atan atanh cbrt ceil cos cosh erf erfc exp exp2"
            " expm1 floor log log1p log2 sin sinh sqrt tan tanh"
        ).split()
    },
}

_INTEGER: dict[str, tuple[str, int]] = {
    "add": ("({t})(({u}){0} + ({u}){1})", 1),
    "add_any": ("({t})(({u}){0} + ({u}){1})", 1),
    "sub": ("({t})(({u}){0} - ({u}){1})", 1),
    "mul": ("({t})(({u}){0} * ({u}){1})", 1),
    "neg": ("({t})(0 - ({u}){0})", 1),
    "square": ("@square({0})", 1),
    "div": ("@quotient({0}, {1})", 1),
    "rem": ("@remainder({0}, {1})", 1),
    "max": ("@maximum({0}, {1})", 1),
    "min": ("@minimum({0}, {1})", 1),
    "abs": ("@absolute({0})", 1),
    "sign": ("@sign({0})", 1),
    "clamp": ("@minimum(@maximum({1}, {0}), {2})", 2),
    "lt_to": ("{0} < {1}", 1),
    "le_to": ("{0} <= {1}", 1),
    "eq_to": ("{0} == {1}", 1),
    "and": ("{0} & {1}", 1),
    "or": ("{0} | {1}", 1),
    "xor": ("{0} ^ {1}", 1),
    "not": ("({t})~{0}", 1),
    "shift_left": ("@shift_left({0}, {1})", 1),
    "shift_right_logical": ("@shift_right({0}, {1})", 1),
    "shift_right_arithmetic": ("@shift_signed({0}, {1})", 1),
}

_BOOLEAN: dict[str, tuple[str, int]] = {
    "and": ("{0} & {1}", 1),
    "or": ("{0} | {1}", 1),
    "xor": ("{0} ^ {1}", 1),
    "not": ("!{0}", 1),
    "max": ("{0} | {1}", 1),
    "min": ("{0} & {1}", 1),
    "add": ("{0} | {1}", 1),
    "mul": ("{0} & {1}", 1),
}

_COMPARED = {"eq": "==", "ne": "!=", "lt": "<", "le": "<=", "gt": ">", "ge": ">="}

Operation = Callable[[list[Expr]], Expr]


def operation(op: str, params: Any, dtypes: list[Any], out: Any, shared: Any) -> Any:
    """The function that makes the expression of an entry, and the number of operations
    in it. `None` if the operation does not act on single entries."""
    out, kind = np.dtype(out), dtypes[0]
    if op in _COMPARED:
        return (lambda given: _compared(op, given)), 1
    if op == "select_n":
        return _selected, 1
    if op == "convert_element_type":
        return (lambda given: _converted(given[0], out, shared)), 0
    if op == "bitcast_convert_type":
        if out.itemsize != kind.itemsize or "b" in (out.kind, kind.kind):
            return None
        return (lambda given: _same_bits(given[0], out, shared)), 0
    if op == "integer_pow":
        return (lambda given: _power(given[0], params["y"], shared)), 2
    if op == "round":
        half = "rint{f}" if int(params["rounding_method"]) else "round{f}"
        return (lambda given: _written(half + "({0})", 1, given, out, shared)), 1
    if op == "reduce_precision":
        full = np.finfo(kind)
        bits = params["exponent_bits"], params["mantissa_bits"]
        if bits == (full.bits - 1 - full.nmant, full.nmant):
            return (lambda given: given[0]), 0
        if out == np.float64 and bits[0] >= 8 or out == np.float32 and bits[0] == 8:
            return (lambda given: _rounded(given[0], bits[1], shared)), 3
        return None
    table = {"f": _FLOAT, "b": _BOOLEAN}.get(np.dtype(kind).kind, _INTEGER)
    if op not in table:
        return None
    template, cost = table[op]
    return (lambda given: _written(template, cost, given, out, shared)), cost


def _written(
    template: str, cost: int, given: list[Expr], out: np.dtype, shared: Any
) -> Expr:
    of = given[0].dtype
    words = dict(f="f" if of == np.float32 else "", t="", u="")
    low, high = -math.inf, math.inf
    if of.kind in "iu":
        # C would promote shorter types to int, and a product may overflow an int.
        bits = max(8 * of.itemsize, 32)
        words["t"], words["u"] = c_type(of), c_type(f"uint{bits}")
        low, high = _range(template, given, of)
        if low == high:
            return literal(low, out)
        limits = np.iinfo(of)
        if "({u})" in template and not (limits.min <= low and high <= limits.max):
            low, high = -math.inf, math.inf
        elif "({u})" in template:
            # The result cannot overflow, so it needs no casts to unsigned and back.
            template = template.replace("({t})", "").replace("({u})", "")[1:-1]
    if "@" in template:
        for name in _routines_in(template):
            template = template.replace(f"@{name}", shared.routine(name, of))
    text = template.format(*(e.text for e in given), **words)
    if not _is_call(template):
        text = f"({text})"
    total = cost + sum(e.cost for e in given)
    return Expr(text, out, union(e.reads for e in given), total, None, low, high)


def _routines_in(template: str) -> list[str]:
    parts = {part.split("(")[0] for part in template.split("@")[1:]}
    return sorted(parts, key=len, reverse=True)


def _is_call(template: str) -> bool:
    """Whether the template is a single call of a function."""
    return template.endswith(")") and template[0].isalpha() and " / " not in template


def _range(template: str, given: list[Expr], of: np.dtype) -> Any:
    """The ends of the interval in which the result lies."""
    (a, b), *more = ((e.low, e.high) for e in given)
    if not more:
        return -math.inf, math.inf
    c, d = more[0]
    if " + (" in template:
        return a + c, b + d
    if " - (" in template:
        return a - d, b - c
    if " * (" in template and np.isfinite([a, b, c, d]).all():
        ends = a * c, a * d, b * c, b * d
        return min(ends), max(ends)
    if template.startswith("@maximum"):
        return max(a, c), max(b, d)
    if template.startswith("@minimum(@maximum"):
        e, f = more[1]
        return min(max(a, c), e), min(max(b, d), f)
    if template.startswith("@minimum"):
        return min(a, c), min(b, d)
    del of
    return -math.inf, math.inf


def _compared(op: str, given: list[Expr]) -> Expr:
    a, b = given
    if a.dtype.kind == "u":
        a, b = a._replace(low=max(a.low, 0)), b._replace(low=max(b.low, 0))
    answer = None
    if a.dtype.kind in "iub":
        # The result is often known: loop counters are compared with their bounds.
        less, above = a.high < b.low, a.low > b.high
        if less or above:
            answer = {"eq": 0, "ne": 1, "lt": less, "le": less}.get(op, above)
        elif op in ("lt", "ge") and a.low >= b.high:
            answer = op == "ge"
        elif op in ("le", "gt") and a.high <= b.low:
            answer = op == "le"
    if answer is not None:
        return literal(bool(answer), bool)
    text = f"({a.text} {_COMPARED[op]} {b.text})"
    cost = 1 + a.cost + b.cost
    return Expr(text, np.dtype(bool), a.reads | b.reads, cost, None, 0, 1)


def _selected(given: list[Expr]) -> Expr:
    which, *cases = given
    if which.value is not None:
        return cases[int(which.value)]
    text = cases[-1].text
    if len(cases) == 2:
        text = f"({which.text} ? {cases[1].text} : {cases[0].text})"
    else:
        for k in reversed(range(len(cases) - 1)):
            text = f"({which.text} == {k} ? {cases[k].text} : {text})"
    cost = 1 + which.cost + sum(c.cost for c in cases)
    reads = union(e.reads for e in given)
    low, high = min(c.low for c in cases), max(c.high for c in cases)
    return Expr(text, cases[0].dtype, reads, cost, None, low, high)


def _converted(given: Expr, out: np.dtype, shared: Any) -> Expr:
    if given.dtype == out:
        return given
    if given.dtype.kind == "f" and out.kind in "iu":
        # Known numbers too, because NumPy converts NaN and infinity differently.
        name = shared.routine("to_integer", given.dtype, out)
        return Expr(f"{name}({given.text})", out, given.reads, given.cost + 1)
    if given.value is not None:
        with np.errstate(all="ignore"):
            return literal(np.asarray(given.value).astype(out), out)
    low, high = given.low, given.high
    if out.kind == "b":
        if given.dtype.kind == "b":
            return given._replace(dtype=out)
        return given._replace(
            text=f"({given.text} != 0)", dtype=out, low=0, high=1, cost=given.cost + 1
        )
    if out.kind in "iu":
        limits = np.iinfo(out)
        if low < limits.min or high > limits.max:
            low, high = -math.inf, math.inf
    text = f"(({c_type(out)}){given.text})"
    return Expr(text, out, given.reads, given.cost, None, low, high)


def _same_bits(given: Expr, out: np.dtype, shared: Any) -> Expr:
    name = shared.routine("bits", given.dtype, out)
    return Expr(f"{name}({given.text})", out, given.reads, given.cost)


def _power(given: Expr, exponent: int, shared: Any) -> Expr:
    if exponent == 0:
        return literal(1, given.dtype)
    name = shared.routine(f"power{abs(exponent)}", given.dtype)
    text = f"{name}({given.text})"
    cost = given.cost + max(1, 2 * abs(exponent).bit_length() - 2)
    if exponent < 0:
        text, cost = f"(1 / {text})", cost + 1
    return Expr(text, given.dtype, given.reads, cost)


def _rounded(given: Expr, bits: int, shared: Any) -> Expr:
    name = shared.routine("rounded", given.dtype)
    text = f"{name}({given.text}, {bits})"
    return Expr(text, given.dtype, given.reads, given.cost + 3)
