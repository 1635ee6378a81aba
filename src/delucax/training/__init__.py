"""Training of policies and models: the loop, losses and gradient estimators."""

from . import sysid as sysid
from ._actor_critic import actor_critic as actor_critic, ActorCritic as ActorCritic
from ._costs import (
    expected_cost as expected_cost,
    scored_cost as scored_cost,
    worst_case as worst_case,
)
from ._evolve import evolve as evolve
from ._fit import fit as fit, Fitted as Fitted
from ._gradient_estimators import (
    analytic as analytic,
    ClippedSamples as ClippedSamples,
    EvolutionStrategies as EvolutionStrategies,
    LikelihoodRatio as LikelihoodRatio,
)
from ._imitate import imitate as imitate
from ._ppo import PPO as PPO
from ._record import History as History
from ._shac import SHAC as SHAC
from ._steps import AbstractSurrogate as AbstractSurrogate
from ._synthesis import (
    Attempt as Attempt,
    Synthesis as Synthesis,
    synthesise as synthesise,
)
