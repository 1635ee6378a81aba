"""System identification: models of the dynamics from recorded data."""

from ._bootstrap import Bootstrap as Bootstrap, bootstrap as bootstrap
from ._grey_box import grey_box as grey_box, GreyBox as GreyBox
from ._identified import Identified as Identified
from ._latent import Encoder as Encoder, LatentDynamics as LatentDynamics
from ._linear import arx as arx, linear as linear
from ._neural import (
    NeuralDynamics as NeuralDynamics,
    PredictionError as PredictionError,
    windows as windows,
)
from ._physical import physical as physical
from ._record import Record as Record
from ._state_space import state_space as state_space, StateSpace as StateSpace
from ._subspace import Subspace as Subspace, subspace as subspace
from ._tables import from_frame as from_frame, read_csv as read_csv
from ._validate import validate as validate, Validation as Validation
