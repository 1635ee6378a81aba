"""Controllers that learn while they run."""

from ._adaptive import Adaptive as Adaptive
from ._bpc import BPC as BPC
from ._explore import Explore as Explore
from ._gpc import drc as drc, gpc as gpc, neural_gpc as neural_gpc, sfc as sfc
from ._hindsight import best_in_hindsight as best_in_hindsight, regret as regret
from ._learner import OnlineLearner as OnlineLearner
from ._optimisers import adagrad_norm as adagrad_norm, online_newton as online_newton
