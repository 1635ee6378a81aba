"""Controllers that learn while they run."""

from ._adaptive import Adaptive as Adaptive
from ._bpc import BPC as BPC
from ._drc import DRC as DRC
from ._explore import Explore as Explore
from ._fixed import FixedPolicy as FixedPolicy
from ._gpc import GPC as GPC
from ._hindsight import (
    best_in_hindsight as best_in_hindsight,
    Hindsight as Hindsight,
    regret as regret,
)
from ._learner import OnlineLearner as OnlineLearner
from ._neural import NeuralGPC as NeuralGPC
from ._newton import online_newton as online_newton
from ._spectral import DSC as DSC, SFC as SFC
from ._step_size import adagrad_norm as adagrad_norm
