"""Environments in gymnax's protocol, both ways. Needs no extra: gymnax is not used."""

from ._from import from_gymnax as from_gymnax, GymnaxDynamics as GymnaxDynamics
from ._params import GymnaxParams as GymnaxParams, GymnaxState as GymnaxState
from ._to import GymnaxEnv as GymnaxEnv, to_gymnax as to_gymnax
