"""Environments in gymnax's protocol, both ways. Needs no extra: gymnax is not used."""

from ._from import from_gymnax as from_gymnax, GymnaxDynamics as GymnaxDynamics
from ._to import (
    GymnaxEnv as GymnaxEnv,
    GymnaxParams as GymnaxParams,
    GymnaxState as GymnaxState,
    to_gymnax as to_gymnax,
)
