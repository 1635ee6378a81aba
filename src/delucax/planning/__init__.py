"""Trajectory optimisation over dynamics and a cost."""

from ._cem import cem as cem
from ._constraints import Constraints as Constraints
from ._count import count_evaluations as count_evaluations, Evaluations as Evaluations
from ._ilqr import ilqr as ilqr
from ._mppi import mppi as mppi
from ._plan import Plan as Plan
from ._start import default_start as default_start, Start as Start
