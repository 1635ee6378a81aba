"""Convex quadratic programs, dense and in stages, by one interior-point method."""

from ._constraints import Rows as Rows, Soft as Soft
from ._dense_problem import Dense as Dense, DenseMultipliers as DenseMultipliers
from ._solution import Solution as Solution
from ._solve import solve as solve
from ._staged_problem import Staged as Staged, StagedMultipliers as StagedMultipliers
