"""Feedback laws."""

from ._basic import (
    Constant as Constant,
    Linear as Linear,
    Random as Random,
    Zero as Zero,
)
