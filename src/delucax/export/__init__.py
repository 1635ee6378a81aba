"""Controllers, plants and functions as programs in C."""

from ._c import c as c
from ._report import Report as Report
