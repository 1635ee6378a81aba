"""Simulation of closed loops, step by step (`rollout`) or in one solve (`simulate`)."""

from ._rollout import rollout as rollout
from ._simulate import simulate as simulate
from ._trajectory import Trajectory as Trajectory
