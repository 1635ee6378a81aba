"""Numerical helpers for vector fields and costs: fast, and with finite derivatives."""

from ._angles import cos as cos, sin as sin, wrap as wrap
from ._norms import clip as clip, safe_norm as safe_norm
from ._small import matvec as matvec, quadratic_form as quadratic_form
