"""Closed loops, step by step and over a whole horizon."""

from ._rollout import rollout as rollout
from ._simulate import simulate as simulate
from ._trajectory import Trajectory as Trajectory
