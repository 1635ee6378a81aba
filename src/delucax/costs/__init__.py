"""Stage and final costs, each minus a reward."""

from ._acrobot import AcrobotHeight as AcrobotHeight
from ._arrival import Arrival as Arrival
from ._base import AbstractCost as AbstractCost
from ._compose import (
    Function as Function,
    Rate as Rate,
    Scaled as Scaled,
    Sum as Sum,
)
from ._pendulum import PendulumCost as PendulumCost
from ._quadratic import Quadratic as Quadratic, Tracking as Tracking
