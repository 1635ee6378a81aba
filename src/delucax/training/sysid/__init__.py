"""System identification: models of the dynamics from recorded data."""

from ._identified import Identified as Identified
from ._linear import arx as arx, linear as linear
from ._neural import (
    NeuralDynamics as NeuralDynamics,
    PredictionError as PredictionError,
    windows as windows,
)
from ._physical import physical as physical
from ._record import Record as Record
