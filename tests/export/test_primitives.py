"""Each operation that has a form in C, alone and in programs at random, against JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from c_programs import exported
from helpers import needs_compiler
from jax import lax
from jax.scipy import linalg, special


pytestmark = needs_compiler

UNARY = {
    "acos": (jnp.arccos, -1, 1),
    "acosh": (jnp.arccosh, 1, 5),
    "asin": (jnp.arcsin, -1, 1),
    "asinh": (jnp.arcsinh, -3, 3),
    "atan": (jnp.arctan, -3, 3),
    "atanh": (jnp.arctanh, -1, 1),
    "cbrt": (jnp.cbrt, -3, 3),
    "ceil": (jnp.ceil, -3, 3),
    "cos": (jnp.cos, -9, 9),
    "cosh": (jnp.cosh, -3, 3),
    "digamma": (special.digamma, -3.4, 5),
    "erf": (special.erf, -2, 2),
    "erf_inv": (special.erfinv, -1, 1),
    "erfc": (special.erfc, -2, 2),
    "exp": (jnp.exp, -3, 3),
    "exp2": (jnp.exp2, -3, 3),
    "expm1": (jnp.expm1, -3, 3),
    "floor": (jnp.floor, -3, 3),
    "lgamma": (special.gammaln, 0.1, 5),
    "log": (jnp.log, 0, 3),
    "log1p": (jnp.log1p, -1, 3),
    "logistic": (jax.nn.sigmoid, -5, 5),
    "negate": (jnp.negative, -3, 3),
    "power": (lambda x: (x**2, x**3, x**5, x**-1, x**-4, jnp.square(x)), -3, 3),
    "absolute": (jnp.abs, -3, 3),
    "reciprocal_root": (lax.rsqrt, 0.1, 3),
    "rounds": (jnp.round, -3, 3),
    "away": (lambda x: lax.round(x * 2, lax.RoundingMethod.AWAY_FROM_ZERO), -3, 3),
    "signs": (jnp.sign, -3, 3),
    "sine": (jnp.sin, -9, 9),
    "sinh": (jnp.sinh, -3, 3),
    "sinc": (jnp.sinc, -3, 3),
    "root": (jnp.sqrt, 0, 3),
    "tangent": (jnp.tan, -1, 1),
    "tanh": (jnp.tanh, -3, 3),
    "same_bits": (
        lambda x: lax.bitcast_convert_type(x, f"uint{8 * x.dtype.itemsize}"),
        -9,
        9,
    ),
    "integers": (lambda x: (x.astype(int), (x > 0).astype(x.dtype)), -9, 9),
    "fewer_digits": (lambda x: lax.reduce_precision(x, 8, 7), -9, 9),
    "finite": (lambda x: jnp.isfinite(1 / (x - x[0])), -3, 3),
}
PAIRS = {
    "sums": lambda x, y: (x + y, x - y, x * y, x / y),
    "extremes": lambda x, y: (jnp.maximum(x, y), jnp.minimum(x, y)),
    "angle": jnp.arctan2,
    "powers": lambda x, y: jnp.abs(x) ** y,
    "rest": lax.rem,
    "next": jnp.nextafter,
    "comparisons": lambda x, y: (x < y, x <= y, x > y, x >= y, x == y, x != y),
    "logic": lambda x, y: (
        (x > 0) & (y > 0),
        (x > 0) | (y > 0),
        (x > 0) ^ (y > 0),
        ~(x > 0),
    ),
    "choices": lambda x, y: (jnp.where(x > y, x, y * 2), jnp.clip(x, -0.5, y + 2)),
    "bits": lambda x, y: _bits((x * 9).astype(jnp.int32), (y * 9).astype(jnp.int32)),
    "unsigned": lambda x, y: _bits(
        (jnp.abs(x) * 9).astype(jnp.uint32), (jnp.abs(y) * 9).astype(jnp.uint32)
    ),
}


def _bits(x, y):
    shifts = [
        f(x, jnp.abs(y).astype(x.dtype) % 40)
        for f in (lax.shift_left, lax.shift_right_logical, lax.shift_right_arithmetic)
    ]
    parts = x & y, x | y, x ^ y, ~x, lax.div(x, y), lax.rem(x, y), x * y, x**2, x**5
    return *parts, *shifts, -x, jnp.abs(x), jnp.sign(x), jnp.maximum(x, y), x * x * y


def definite(x):
    return x @ x.mT + jnp.eye(x.shape[-2])


@jax.custom_jvp
def halved(x):
    return x / 2


halved.defjvps(lambda t, _, x: t / 2)


def looped(x):
    def body(carry, row):
        total, table, k = carry
        table = table.at[k].set(jnp.sum(row) + table[k - 1])
        return (total + row @ table[: row.size], table, k + 1), (row * total, k)

    start = jnp.zeros(()), jnp.zeros(x.shape[0] + 3), 1
    return lax.scan(body, start, x), lax.scan(body, start, x, reverse=True)


def swapped(x):
    """What is carried changes places."""

    def body(carry, _):
        a, b, c, d = carry
        return (b, a + c[:1].sum(), d + a, c * b), a

    return lax.scan(body, (x[0, 0], x[0, 1], x[0], x[1]), length=5)


def until(x):
    def body(carry):
        k, y, _ = carry
        return k + 1, 0.5 * y + jnp.roll(y, 1), jnp.sum(y) > 100

    return lax.while_loop(lambda c: (c[0] < 9) & ~c[2], body, (0, x[0], False))


def branches(x):
    k = jnp.argmax(x[0])
    one = lax.cond(x[0, 0] > 0, lambda x: x @ x.T, lambda x: jnp.eye(x.shape[0]), x)
    many = [lambda x: x[0] * 2, lambda x: jnp.sin(x[1]), lambda x: x[0] - x[1]]
    return one, lax.switch(k - 1, many, x)


def sampled(x):
    k = jnp.argmin(x, axis=1)
    at = x[jnp.arange(x.shape[0]), k]
    far = x.at[:, 7].get(mode="fill", fill_value=3.0)
    added = x.at[k, 0].add(jnp.arange(1.0, x.shape[0] + 1))
    scaled = x.at[k].multiply(2.0).at[0, k].max(1.0).at[90].set(1.0)
    return at, far, added, scaled, x[k], jnp.take(x, k + 2, axis=0, mode="clip")


def windows(x):
    k = jnp.sum(x[0] > 0)
    part = lax.dynamic_slice(x, (k, k - 1), (2, 2))
    return part, lax.dynamic_update_slice(x, part * 2, (k + 1, 0)), part.at[k, 0].set(9)


ARRAYS = {
    "moves": lambda x: (
        x.T,
        x[::-1],
        x[1:, ::2],
        jnp.roll(x, 1, 0),
        x.reshape(-1),
        x.reshape(x.shape[::-1]),
    ),
    "joins": lambda x: (
        jnp.concatenate([x, 2 * x], 1),
        jnp.stack([x, -x]),
        jnp.split(x, [1], 0),
    ),
    "pads": lambda x: (
        jnp.pad(x, 1, constant_values=2.0),
        lax.pad(x, 7.0, [(1, -1, 1), (-1, 2, 0)]),
        lax.pad(jnp.sin(x), x[0, 0] * 2, [(-2, 0, 2), (0, 0, 0)]),
    ),
    "copies": lambda x: (jnp.tile(x, (2, 1)), x[:, None] * x[0], jnp.exp(x[0]) + x),
    "totals": lambda x: (
        x.sum(),
        x.sum(0),
        jnp.exp(x).sum(1),
        x.max(1),
        x.min(),
        x.prod(0),
        x.mean(),
    ),
    "tests": lambda x: (
        jnp.any(x > 1, 0),
        jnp.all(x > -2),
        jnp.argmax(x),
        jnp.argmin(x, 0),
        jnp.argmax(x, 1),
    ),
    "running": lambda x: (
        jnp.cumsum(x, 0),
        jnp.cumprod(x, 1),
        lax.cummax(x, 0),
        lax.cummin(x, 1, reverse=True),
    ),
    "products": lambda x: (
        x @ x.T,
        x.T @ x,
        jnp.outer(x[0], x[1]),
        x @ x[0],
        x[0] @ x[0],
        jnp.einsum("ij,kj->ijk", x, x),
        jnp.einsum("ij,ik->ijk", x, x),
        x @ np.arange(x.shape[1] * 7.0).reshape(-1, 7),
        np.ones((9, x.shape[0])) @ x,
        np.arange(9.0 * x.shape[1]).reshape(9, -1) @ jnp.sin(x[0]),
    ),
    "order": lambda x: (
        jnp.argsort(x > 0),
        jnp.sort(jnp.round(x).astype(jnp.int32), axis=0),
        jnp.sort(x),
        jnp.argsort(x, axis=0),
        lax.sort((jnp.round(x), x), num_keys=2),
        jnp.searchsorted(jnp.sort(x[0]), x[1]),
        jnp.searchsorted(np.arange(4), jnp.round(x[0]).astype(jnp.int32), side="right"),
        jnp.interp(x[0], np.array([-1.0, 0, 2]), np.array([1.0, 4, 2])),
    ),
    "factors": lambda x: (
        jnp.linalg.cholesky(definite(x)),
        linalg.cho_solve(linalg.cho_factor(definite(x)), x),
        linalg.solve_triangular(definite(x), x, lower=True, trans=1),
        linalg.solve_triangular(definite(x), x, lower=False, unit_diagonal=True),
    ),
    "solves": lambda x: (
        linalg.lu_factor(definite(x)),
        jnp.linalg.solve(definite(x), x),
        jnp.linalg.inv(definite(x)),
        jnp.linalg.det(definite(x)),
        jnp.linalg.solve(jnp.stack([definite(x), definite(2 * x)]), jnp.stack([x, x])),
    ),
    "rotations": lambda x: (
        jnp.linalg.qr(x),
        jnp.linalg.qr(x.T),
        jnp.linalg.qr(x, "r"),
        jnp.linalg.qr(x.at[0, 0].set(0.0)),
    ),
    "empty": lambda x: (x[:0], jnp.sum(x[:0], 0), jnp.concatenate([x[:0], x])),
    "derivatives": lambda x: (
        jax.grad(lambda x: jnp.sum(jnp.tanh(x @ x.T)))(x),
        jax.jacfwd(lambda x: jnp.sin(x) * x[0])(x[1]),
        jax.vmap(halved)(x),
        jax.grad(lambda x: halved(x) ** 2)(x[0, 0]),
    ),
    "wrapped": lambda x: (jax.jit(jnp.sin)(x), jax.checkpoint(jnp.cos)(x)),
    "beyond": lambda x: (
        jnp.full(x.shape, jnp.nan).astype(jnp.int32) + (x > 0),
        jnp.concatenate([x[0], jnp.array([jnp.inf, -jnp.inf, 1e9])]).astype(jnp.int16),
    ),
    "ramps": lambda x: (
        jnp.arange(9) * x[0, 0],
        jnp.eye(*x.shape) + x,
        jnp.tri(9) * x[0, 1],
    ),
    "looped": looped,
    "swapped": swapped,
    "until": until,
    "branches": branches,
    "sampled": sampled,
    "windows": windows,
}
SHAPES = {"small": (2, 3), "large": (5, 4)}


def close(found, expected, tolerance):
    expected = np.asarray(expected)
    if expected.dtype.kind != "f":
        np.testing.assert_array_equal(found, expected)
        return
    scale = np.maximum(1, np.abs(expected))
    both = np.isnan(found) & np.isnan(expected) | (found == expected)
    off = np.where(both, 0, np.abs(found - expected) / scale)
    assert np.all(off <= tolerance), (found, expected)


def programs(dtype, arrays=True):
    """All of them, each on a small and on a large input."""
    rng, made = np.random.default_rng(0), {}
    draw = lambda low, high, shape: rng.uniform(low, high, shape).astype(dtype)
    for name, (function, low, high) in UNARY.items():
        made[name] = function, [(draw(low, high, size),) for size in (3, 20)]
    for name, function in PAIRS.items():
        made[name] = function, [tuple(draw(-2, 2, (2, size))) for size in (3, 20)]
    for name, function in ARRAYS.items() if arrays else ():
        inputs = [(rng.normal(size=shape).astype(dtype),) for shape in SHAPES.values()]
        made[name] = function, inputs
    # Without an end "acos" would be a name of C.
    return {f"{name}_": _twice(*each) for name, each in made.items()}


def _twice(function, inputs):
    """One program for both inputs, because to call a compiler takes long."""
    small, large = inputs
    count = len(small)
    return lambda *x: (function(*x[:count]), function(*x[count:])), (*small, *large)


def agree(folder, given, tolerance):
    for name, call in exported(folder, given).items():
        function, inputs = given[name]
        expected = jax.tree.leaves(jax.jit(lambda *a, f=function: f(*a))(*inputs))
        flag, found = call(*inputs)
        try:
            for a, b in zip(found, expected, strict=True):
                close(a, b, tolerance)
        except AssertionError as error:
            raise AssertionError(f"{name}: {error}") from error
        finite = all(np.all(np.isfinite(e)) for e in expected)
        assert flag == (0 if finite else 2), name


def test_each_operation(tmp_path):
    # Only the functions of numbers have other names in single precision.
    x64 = jax.config.jax_enable_x64  # pyright: ignore
    agree(tmp_path, programs(float, arrays=x64), 1e-12 if x64 else 2e-4)


# Programs at random: each line reads what was computed before, so that arrays have many
# readers, live long, and are changed in place.

MADE = {
    "sum": lambda r, a, b: a + b,
    "product": lambda r, a, b: jnp.tanh(a * b),
    "matrix": lambda r, a, b: jnp.sin(a @ b.T @ a),
    "scaled": lambda r, a, b: a * jnp.sum(b, 0) / (1 + jnp.max(jnp.abs(b))),
    "turned": lambda r, a, b: jnp.roll(a[::-1], r.integers(3), 1) - b,
    "joined": lambda r, a, b: jnp.concatenate([a, b])[r.integers(2) :: 2][: len(a)],
    "set": lambda r, a, b: a.at[r.integers(2)].set(b[0]).at[:, 1].add(b[:, 0]),
    "placed": lambda r, a, b: lax.dynamic_update_slice(
        a, b[:1, :2], (jnp.argmax(b[:, 0]), r.integers(3))
    ),
    "chosen": lambda r, a, b: jnp.where(a > b, a, b[:, :1]),
    "branch": lambda r, a, b: lax.cond(a[0, 0] > b[1, 1], jnp.sin, lambda a: a + b, a),
    "loop": lambda r, a, b: lax.scan(
        lambda c, row: (jnp.cos(c + row), c * row), a[0], b, reverse=bool(r.integers(2))
    )[1],
    "swap": lambda r, a, b: lax.fori_loop(
        0, 3, lambda k, c: (c[1] / 2, c[0].at[k % 2].add(k)), (a, b)
    )[0],
    "until": lambda r, a, b: lax.while_loop(
        lambda c: (c[0] < 5) & (c[1][0, 0] < 2),
        lambda c: (c[0] + 1, c[1] + a**2),
        (0, b),
    )[1],
    "factor": lambda r, a, b: jnp.linalg.solve(definite(a), b),
    "sorted": lambda r, a, b: jnp.sort(a, axis=r.integers(2)) + jnp.cumsum(b, 0),
    "taken": lambda r, a, b: a[jnp.argsort(b[:, 0])],
    "several": lambda r, a, b: jax.vmap(lambda a, b: a * jnp.sum(a * b))(a, b),
}


def program(seed):
    """A function of two matrices, of so many lines drawn at random."""
    kinds = np.random.default_rng(seed).choice(list(MADE), 14)

    def function(x, y):
        rng, values = np.random.default_rng(seed), [x, y]
        for kind in kinds:
            a, b = (values[k] for k in rng.integers(len(values), size=2))
            made = MADE[kind](rng, a, b)
            values.append(made / (1 + jnp.max(jnp.abs(made))))
        return values[-1], sum(values), [values[k] for k in rng.integers(9, size=2)]

    return function


def test_programs_at_random(tmp_path):
    rng = np.random.default_rng(0)
    shapes = [(2, 3), (4, 3), (5, 4)] * 6
    given = {
        f"program{k}": (program(k), tuple(np.asarray(rng.normal(size=(2, *s)), float)))
        for k, s in enumerate(shapes)
    }
    if not jax.config.jax_enable_x64:  # pyright: ignore
        pytest.skip("Single precision amplifies rounding in branches.")
    agree(tmp_path, given, 1e-10)
