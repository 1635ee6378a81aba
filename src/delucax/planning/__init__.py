"""Trajectory optimisation over dynamics and a cost."""

from ._cem import CEM as CEM
from ._constraints import Constraints as Constraints
from ._count import count_evaluations as count_evaluations, Evaluations as Evaluations
from ._igpc import igpc as igpc
from ._ilc import ilc as ilc
from ._ilqr import ILQR as ILQR, ilqr as ilqr
from ._mppi import MPPI as MPPI
from ._plan import Plan as Plan
from ._planner import AbstractPlanner as AbstractPlanner
from ._start import default_start as default_start, Start as Start
