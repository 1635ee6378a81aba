"""Numerics that users' own systems need too."""

from ._angles import wrap as wrap
from ._clip import clip as clip
from ._norms import safe_norm as safe_norm
from ._small import matvec as matvec, quadratic_form as quadratic_form
from ._trig import cos as cos, sin as sin
