"""Trajectory optimisation: planners that minimise a cost along the dynamics."""

from ._constraints import (
    Constraints as Constraints,
    SoftConstraint as SoftConstraint,
)
from ._count import count_evaluations as count_evaluations
from ._ilqr import ILQR as ILQR, ilqr as ilqr
from ._iterative_learning import igpc as igpc, ilc as ilc
from ._multipliers import Multipliers as Multipliers
from ._plan import Plan as Plan
from ._planner import AbstractPlanner as AbstractPlanner
from ._problem import Problem as Problem
from ._sampling import CEM as CEM, MPPI as MPPI
from ._sqp import SQP as SQP
from ._start import Start as Start
from ._unknowns import Unknowns as Unknowns
