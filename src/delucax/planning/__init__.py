"""Trajectory optimisation over dynamics and a cost."""

from ._count import count_evaluations as count_evaluations
from ._ilqr import ILQR as ILQR, ilqr as ilqr
from ._iterative_learning import igpc as igpc, ilc as ilc
from ._plan import Plan as Plan
from ._planner import AbstractPlanner as AbstractPlanner
from ._problem import Constraints as Constraints, Problem as Problem
from ._sampling import CEM as CEM, MPPI as MPPI
from ._start import Start as Start
