"""Feedback laws."""

from ._basic import (
    Constant as Constant,
    Linear as Linear,
    Random as Random,
    Sequence as Sequence,
    Zero as Zero,
)
