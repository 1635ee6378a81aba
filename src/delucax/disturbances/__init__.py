"""Sequences of disturbances, drawn for a whole horizon at once."""

from ._base import AbstractDisturbance as AbstractDisturbance
from ._compose import shock as shock, Sum as Sum, Window as Window
from ._deterministic import (
    Constant as Constant,
    FromArray as FromArray,
    Sinusoid as Sinusoid,
    Square as Square,
    Zero as Zero,
)
from ._random import (
    Brownian as Brownian,
    Gaussian as Gaussian,
    RandomWalk as RandomWalk,
    Uniform as Uniform,
)
