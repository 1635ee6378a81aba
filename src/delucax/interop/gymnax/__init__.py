"""Environments in gymnax's protocol, both ways. Needs no extra: gymnax is not used."""

from .._episode import EpisodeState as EpisodeState
from ._from_gymnax import from_gymnax as from_gymnax, GymnaxDynamics as GymnaxDynamics
from ._params import GymnaxParams as GymnaxParams
from ._to_gymnax import GymnaxEnv as GymnaxEnv, to_gymnax as to_gymnax
