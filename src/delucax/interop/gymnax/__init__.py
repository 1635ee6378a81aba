"""Conversion to and from gymnax's protocol. Needs no extra: gymnax is not imported."""

from ._from_gymnax import from_gymnax as from_gymnax, GymnaxDynamics as GymnaxDynamics
from ._to_gymnax import (
    GymnaxEnv as GymnaxEnv,
    GymnaxParams as GymnaxParams,
    to_gymnax as to_gymnax,
)
