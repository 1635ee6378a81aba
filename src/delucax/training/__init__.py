"""Gradient estimators, and the loop that trains on them."""

from . import sysid as sysid
from ._actor_critic import actor_critic as actor_critic, ActorCritic as ActorCritic
from ._analytic import analytic as analytic
from ._costs import expected_cost as expected_cost, scored_cost as scored_cost
from ._evolution import EvolutionStrategies as EvolutionStrategies
from ._fit import fit as fit, Fitted as Fitted
from ._history import History as History
from ._likelihood import LikelihoodRatio as LikelihoodRatio
from ._ppo import PPO as PPO
from ._shac import SHAC as SHAC
from ._surrogate import AbstractSurrogate as AbstractSurrogate
from ._worst_case import Attack as Attack, worst_case as worst_case
