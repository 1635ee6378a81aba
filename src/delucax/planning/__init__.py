"""Trajectory optimisation over dynamics and a cost."""

from ._constraints import Constraints as Constraints
from ._ilqr import ilqr as ilqr
from ._plan import Plan as Plan
