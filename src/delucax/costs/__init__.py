"""Stage and final costs. A cost is minus a reward."""

from typing import TYPE_CHECKING

from .._lazy import lazily as _lazily
from ._base import (
    AbstractCost as AbstractCost,
    Function as Function,
    Rate as Rate,
    Scaled as Scaled,
    Sum as Sum,
)
from ._quadratic import Quadratic as Quadratic, Tracking as Tracking


if TYPE_CHECKING:
    from ._classic_control import (
        AcrobotHeight as AcrobotHeight,
        Arrival as Arrival,
        PendulumCost as PendulumCost,
    )
else:
    __getattr__, __dir__ = _lazily(
        __name__, {"_classic_control": "AcrobotHeight Arrival PendulumCost"}
    )
del TYPE_CHECKING
