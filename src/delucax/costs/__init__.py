"""Stage and final costs; a cost is minus a reward."""

from ._base import (
    AbstractCost as AbstractCost,
    Function as Function,
    Rate as Rate,
    Scaled as Scaled,
    Sum as Sum,
)
from ._classic_control import (
    AcrobotHeight as AcrobotHeight,
    Arrival as Arrival,
    PendulumCost as PendulumCost,
)
from ._quadratic import Quadratic as Quadratic, Tracking as Tracking
