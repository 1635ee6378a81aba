"""Controllers: feedback laws, designed, trained or learned online."""

from .._controller import Tally as Tally
from ._basic import (
    Constant as Constant,
    Linear as Linear,
    OpenLoop as OpenLoop,
    Random as Random,
    Zero as Zero,
)
from ._composed import History as History, Scheduled as Scheduled
from ._finite_horizon import FiniteHorizonLQR as FiniteHorizonLQR
from ._hinfinity import HInfinity as HInfinity
from ._local import (
    local_lqr as local_lqr,
    local_model as local_model,
    local_mpc as local_mpc,
    LocalModel as LocalModel,
)
from ._local_lqg import local_lqg as local_lqg
from ._lqr import LQI as LQI, LQR as LQR
from ._mpc import MPC as MPC
from ._network import (
    GRU as GRU,
    MLP as MLP,
    mlp_policy as mlp_policy,
    Standardise as Standardise,
)
from ._output_feedback import LQG as LQG, OutputFeedback as OutputFeedback
from ._pid import LeakyPID as LeakyPID, PID as PID
from ._residual import Residual as Residual
from ._safety_filter import SafetyFilter as SafetyFilter
from ._sampled import lqrd as lqrd, sampled_weights as sampled_weights
from ._stochastic import Categorical as Categorical, Gaussian as Gaussian
from .online._adaptive import Adaptive as Adaptive
from .online._bpc import BPC as BPC
from .online._explore import Explore as Explore
from .online._gpc import drc as drc, gpc as gpc, neural_gpc as neural_gpc, sfc as sfc
from .online._hindsight import best_in_hindsight as best_in_hindsight, regret as regret
from .online._learner import OnlineLearner as OnlineLearner
from .online._optimisers import (
    adagrad_norm as adagrad_norm,
    online_newton as online_newton,
)
