"""Signals `r(t)` to follow. Any function of time will do; these are the common ones."""

from ._signals import (
    Constant as Constant,
    FigureEight as FigureEight,
    Sequence as Sequence,
)
