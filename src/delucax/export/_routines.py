"""Routines of C that programs call. A file holds only the routines that it calls.

In their text, `T` is the type of the entries, `S` is the suffix of its name, `F` is the
suffix of the functions of `math.h`, and `U` is the unsigned integer of the same size.
"""

import re
from typing import Any

import numpy as np

from ._expressions import c_type


def suffix(dtype: Any) -> str:
    """The short name of a type."""
    dtype = np.dtype(dtype)
    return "b" if dtype.kind == "b" else f"{dtype.kind}{8 * dtype.itemsize}"


_ORDER = """
/* The ascending order of n keys. NaN comes last. Equal keys keep their order. */
static void order_S(int n, const T *key, int step, int32_t *order) {
  for (int i = 1; i < n; ++i) {
    const int32_t moved = order[i];
    const T x = key[moved * step];
    int k = i;
    for (; k > 0; --k) {
      const T y = key[order[k - 1] * step];
      if (x >= y || x != x) break;
      order[k] = order[k - 1];
    }
    order[k] = moved;
  }
}"""

_SCALAR = {
    "order": _ORDER,
    "square": "static T square_S(T x) { return x * x; }",
    "one_minus_square": """
static T one_minus_square_S(T x) { return (1 - x) * (1 + x); }""",
    "maximum": """
/* The larger number, or NaN if one of them is NaN. */
static T maximum_S(T a, T b) { return a > b || a != a ? a : b; }""",
    "minimum": """
/* The smaller number, or NaN if one of them is NaN. */
static T minimum_S(T a, T b) { return a < b || a != a ? a : b; }""",
    "sign": "static T sign_S(T x) { return x > 0 ? 1 : x < 0 ? -1 : x; }",
    "precedes": """
/* Whether a comes before b. NaN comes last. */
static int precedes_S(T a, T b) { return a < b || (a == a && b != b); }""",
    "erf_inv": """
/* The inverse of erf: Winitzki's estimate, then three steps of Halley's method. */
static T erf_inv_S(T x) {
  const T a = fabsF(x), rest = 1 - a;
  if (!(a < 1)) return a == 1 ? x * INFINITY : NAN;
  const T k = (T)4.33, l = logF(rest * (1 + a)), h = k + l / 2;
  T y = sqrtF(sqrtF(h * h - l * (T)6.802721088435374) - h);
  for (int i = 0; i < 3; ++i) {
    const T off = a < (T)0.5 ? erfF(y) - a : rest - erfcF(y);
    const T step = off * expF(y * y) * (T)0.886226925452758014;
    y -= step / (1 + y * step);
  }
  return x < 0 ? -y : y;
}""",
    "digamma": """
/* The derivative of log gamma: recurrence, then Stirling's series. */
static T digamma_S(T x) {
  const T pi = (T)3.14159265358979323846;
  T y = 0;
  if (x <= 0) {
    if (x == floorF(x)) return NAN;
    y = -pi / tanF(pi * x);
    x = 1 - x;
  }
  for (int i = 0; i < 10 && x < 10; ++i, x += 1) y -= 1 / x;
  const T z = 1 / (x * x);
  const T tail = z * ((T)(1.0 / 12) - z * ((T)(1.0 / 120) - z * ((T)(1.0 / 252)
      - z * ((T)(1.0 / 240) - z * ((T)(1.0 / 132) - z * (T)(691.0 / 32760))))));
  return y + logF(x) - 1 / (2 * x) - tail;
}""",
    "rounded": """
/* x rounded to the given number of bits of the mantissa. */
static T rounded_S(T x, int bits) {
  int exponent;
  if (x - x != 0) return x;
  const T unit = ldexpF(1, (frexpF(x, &exponent), exponent - 1 - bits));
  return rintF(x / unit) * unit;
}""",
}

_INTEGER = {
    # Without the test for NaN: Clang warns of an integer compared with itself.
    "order": _ORDER.replace(" || x != x", ""),
    "square": "static T square_S(T x) { return (T)(1u * (U)x * (U)x); }",
    "maximum": "static T maximum_S(T a, T b) { return a > b ? a : b; }",
    "minimum": "static T minimum_S(T a, T b) { return a < b ? a : b; }",
    "sign": "static T sign_S(T x) { return (x > 0) - (x < 0); }",
    "absolute": "static T absolute_S(T x) { return x < 0 ? (T)(0 - (U)x) : x; }",
    "quotient": """
/* If the quotient is not defined, the result is the one of XLA. */
static T quotient_S(T a, T b) {
  if (b == 0) return (T)-1;
  return b == (T)-1 ? (T)(0 - (U)a) : a / b;
}""",
    "remainder": """
/* If the remainder is not defined, the result is the one of XLA. */
static T remainder_S(T a, T b) {
  if (b == 0) return a;
  return b == (T)-1 ? 0 : a % b;
}""",
    "shift_left": """
static T shift_left_S(T a, T n) {
  return (U)n < 8 * sizeof(T) ? (T)((U)a << n) : 0;
}""",
    "shift_right": """
static T shift_right_S(T a, T n) {
  return (U)n < 8 * sizeof(T) ? (T)((U)a >> n) : 0;
}""",
    "shift_signed": """
static T shift_signed_S(T a, T n) {
  const T most = 8 * sizeof(T) - 1, k = (U)n < (U)most ? n : most;
  return a < 0 ? (T)~(~(U)a >> k) : (T)((U)a >> k);
}""",
}
_UNSIGNED = _INTEGER | {
    "sign": "static T sign_S(T x) { return x > 0; }",
    "absolute": "static T absolute_S(T x) { return x; }",
    "quotient": "static T quotient_S(T a, T b) { return b == 0 ? (T)-1 : a / b; }",
    "remainder": "static T remainder_S(T a, T b) { return b == 0 ? a : a % b; }",
    "shift_signed": """
static T shift_signed_S(T a, T n) { return n < 8 * sizeof(T) ? (T)(a >> n) : 0; }""",
}

_THREEFRY = """
/* Threefry-2x32, JAX's random generator: two words from a key and a counter. */
static uint64_t threefry_S(T key0, T key1, T x, T y) {
  static const int turns[8] = {13, 15, 26, 6, 17, 29, 16, 24};
  const T key[3] = {key0, key1, key0 ^ key1 ^ 0x1BD11BDAu};
  x += key[0];
  y += key[1];
  for (T i = 0; i < 5; ++i) {
    for (int k = 0; k < 4; ++k) {
      const int turn = turns[4 * (i % 2) + k];
      x += y;
      y = (y << turn | y >> (32 - turn)) ^ x;
    }
    x += key[(i + 1) % 3];
    y += key[(i + 2) % 3] + i + 1;
  }
  return (uint64_t)x << 32 | y;
}"""

_OTHERS = {
    "threefry": _THREEFRY,
    "cholesky": """
/* The lower Cholesky factor. All NaN if the matrix is not positive definite. */
static void cholesky_S(int n, const T *a, T *l) {
  for (int i = 0; i < n; ++i) {
    for (int j = 0; j <= i; ++j) {
      T sum = a[i * n + j];
      for (int k = 0; k < j; ++k) sum -= l[i * n + k] * l[j * n + k];
      if (i != j) {
        l[i * n + j] = sum / l[j * n + j];
      } else if (sum > 0) {
        l[i * n + i] = sqrtF(sum);
      } else {
        for (int k = 0; k < n * n; ++k) l[k] = NAN;
        return;
      }
    }
    for (int j = i + 1; j < n; ++j) l[i * n + j] = 0;
  }
}""",
    "triangular": """
/* Solves A X = B in place. A is lower or upper triangular, with ones on the diagonal if
   unit. The strides of rows and columns are (ar, ac) in A, and (br, bc) in B. */
static void triangular_S(int n, int m, const T *a, int ar, int ac, int lower, int unit,
                         T *b, int br, int bc) {
  for (int r = 0; r < n; ++r) {
    const int i = lower ? r : n - 1 - r;
    const int first = lower ? 0 : i + 1, last = lower ? i : n;
    T *const row = b + i * br;
    for (int k = first; k < last; ++k) {
      const T factor = a[i * ar + k * ac];
      const T *const other = b + k * br;
      for (int j = 0; j < m; ++j) row[j * bc] -= factor * other[j * bc];
    }
    if (!unit) {
      const T pivot = a[i * (ar + ac)];
      for (int j = 0; j < m; ++j) row[j * bc] /= pivot;
    }
  }
}""",
    "lu": """
/* The LU factors of an m by n matrix, in place, with partial pivoting. */
static void lu_S(int m, int n, T *a, int32_t *pivots, int32_t *order) {
  for (int i = 0; i < m; ++i) order[i] = i;
  for (int k = 0; k < m && k < n; ++k) {
    int best = k;
    for (int i = k + 1; i < m; ++i)
      if (fabsF(a[i * n + k]) > fabsF(a[best * n + k])) best = i;
    pivots[k] = best;
    if (best != k) {
      const int32_t moved = order[k];
      order[k] = order[best];
      order[best] = moved;
      for (int j = 0; j < n; ++j) {
        const T x = a[k * n + j];
        a[k * n + j] = a[best * n + j];
        a[best * n + j] = x;
      }
    }
    if (a[k * n + k] == 0) continue;
    for (int i = k + 1; i < m; ++i) {
      const T factor = a[i * n + k] / a[k * n + k];
      a[i * n + k] = factor;
      for (int j = k + 1; j < n; ++j) a[i * n + j] -= factor * a[k * n + j];
    }
  }
}""",
    "permutation": """
/* The order of n rows after k exchanges of rows. */
static void permutation_S(int n, int k, const T *pivots, T *order) {
  for (int i = 0; i < n; ++i) order[i] = i;
  for (int i = 0; i < k; ++i) {
    const T moved = order[i];
    order[i] = order[pivots[i]];
    order[pivots[i]] = moved;
  }
}""",
    "reflections": """
/* The Householder reflections of an m by n matrix, stored in place as in LAPACK. */
static void reflections_S(int m, int n, T *a, T *tau) {
  for (int k = 0; k < m && k < n; ++k) {
    T rest = 0;
    for (int i = k + 1; i < m; ++i) rest += a[i * n + k] * a[i * n + k];
    tau[k] = 0;
    if (rest == 0) continue;
    const T alpha = a[k * n + k], norm = sqrtF(alpha * alpha + rest);
    const T beta = -copysignF(norm, alpha);
    tau[k] = (beta - alpha) / beta;
    a[k * n + k] = beta;
    for (int i = k + 1; i < m; ++i) a[i * n + k] /= alpha - beta;
    for (int j = k + 1; j < n; ++j) {
      T sum = a[k * n + j];
      for (int i = k + 1; i < m; ++i) sum += a[i * n + k] * a[i * n + j];
      sum *= tau[k];
      a[k * n + j] -= sum;
      for (int i = k + 1; i < m; ++i) a[i * n + j] -= sum * a[i * n + k];
    }
  }
}""",
    "orthogonal": """
/* The first c columns of the product of k reflections. q is m by c, a is m by n. */
static void orthogonal_S(int m, int c, int n, int k, const T *a, const T *tau, T *q) {
  for (int i = 0; i < m; ++i)
    for (int j = 0; j < c; ++j) q[i * c + j] = i == j;
  for (int r = k - 1; r >= 0; --r) {
    for (int j = r; j < c; ++j) {
      T sum = q[r * c + j];
      for (int i = r + 1; i < m; ++i) sum += a[i * n + r] * q[i * c + j];
      sum *= tau[r];
      q[r * c + j] -= sum;
      for (int i = r + 1; i < m; ++i) q[i * c + j] -= sum * a[i * n + r];
    }
  }
}""",
}

_BITS = """
/* The number with these bits. */
static R bits_S(T x) {
  R y;
  memcpy(&y, &x, sizeof y);
  return y;
}"""

_TO_INTEGER = """
/* Rounds towards zero, and clamps to the integers of the type. NaN becomes 0. */
static R to_integer_S(T x) {
  if (x != x) return 0;
  if (x < (T)LOW) return LOWEST;
  if (x >= (T)HIGH) return HIGHEST;
  return (R)x;
}"""


def routine(name: str, dtype: Any, out: Any = None) -> tuple[str, str]:
    """The name of a routine in C, and its text."""
    dtype = np.dtype(dtype)
    if name == "to_integer":
        return _to_integer(dtype, np.dtype(out))
    if name == "bits":
        label = f"{suffix(dtype)}_{suffix(out)}"
        return f"bits_{label}", _word(_typed(_BITS, dtype, label), "R", c_type(out))
    if name.startswith("power"):
        text = _power(int(name[5:]), dtype)
    elif name in _OTHERS:
        text = _OTHERS[name]
    else:
        kinds = {"f": _SCALAR, "u": _UNSIGNED}
        text = kinds.get(dtype.kind, _INTEGER)[name]
    return f"{name}_{suffix(dtype)}", _typed(text, dtype)


def _typed(text: str, dtype: np.dtype, label: str | None = None) -> str:
    words = {"_S(": f"_{label or suffix(dtype)}("}
    kind, function = c_type(dtype, stored=True), "f" if dtype == np.float32 else ""
    names = "fabs log sqrt exp erf erfc floor tan ldexp frexp rint copysign"
    for name in names.split():
        words[f"{name}F("] = f"{name}{function}("
    for old, new in words.items():
        text = text.replace(old, new)
    if dtype.kind in "iu":
        text = _word(text, "U", c_type(f"uint{8 * dtype.itemsize}"))
    return _word(text, "T", kind).strip("\n")


def _word(text: str, old: str, new: str) -> str:
    return re.sub(rf"\b{old}\b", new, text)


def _power(exponent: int, dtype: np.dtype) -> str:
    lines, left, have = [], exponent, False
    # Integers of XLA wrap around, so compute in unsigned ones. Without `1u *`, C would
    # promote short ones to int.
    wraps = dtype.kind in "iu"
    kind, one = ("U", "1u * ") if wraps else ("T", "")
    while left:
        if left & 1:
            lines.append(f"y = {one}y * x;" if have else "y = x;")
            have = True
        left >>= 1
        if left:
            lines.append(f"x = {one}x * x;")
    body = f"{kind} x = ({kind})base, y; {' '.join(lines)}"
    return f"static T power{exponent}_S(T base) {{ {body} return (T)y; }}"


def _to_integer(dtype: np.dtype, out: np.dtype) -> tuple[str, str]:
    bits, label = 8 * out.itemsize, f"{suffix(dtype)}_{suffix(out)}"
    kind = "INT" if out.kind == "i" else "UINT"
    low = f"{kind}{bits}_MIN" if out.kind == "i" else "0"
    text = _typed(_TO_INTEGER, dtype, label)
    ends = dict(LOWEST=low, HIGHEST=f"{kind}{bits}_MAX", LOW=low)
    ends["HIGH"] = repr(float(2 ** (bits - (out.kind == "i"))))
    for old, new in ends.items():
        text = _word(text, old, new)
    return f"to_integer_{label}", _word(text, "R", c_type(out))
