"""Feedback laws."""

from ._basic import (
    Constant as Constant,
    Linear as Linear,
    Random as Random,
    Sequence as Sequence,
    Zero as Zero,
)
from ._gaussian import Gaussian as Gaussian
from ._lqr import LQR as LQR
from ._network import Deep as Deep, MLP as MLP
from ._pid import LeakyPID as LeakyPID, PID as PID
