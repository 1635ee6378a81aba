"""Reference signals `r(t)`. These are a few examples; any function of time works."""

from ._signals import (
    Constant as Constant,
    FigureEight as FigureEight,
    Sequence as Sequence,
)
