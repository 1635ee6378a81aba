"""Disturbances: sequences that are drawn for a whole episode at once."""

from ._base import AbstractDisturbance as AbstractDisturbance, Sum as Sum
from ._deterministic import (
    Constant as Constant,
    FromArray as FromArray,
    shock as shock,
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
