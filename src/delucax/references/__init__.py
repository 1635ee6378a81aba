"""Reference signals `r(t)`: a few examples, as any function of time will do."""

from ._signals import (
    Constant as Constant,
    FigureEight as FigureEight,
    Sequence as Sequence,
)
