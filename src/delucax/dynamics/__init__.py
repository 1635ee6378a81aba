"""Plants in discrete time, `x_next = F(t, x, u, w)`: discretised, linear and linearised
systems."""

from .._integration import RK4 as RK4
from ._base import (
    AbstractDiscretization as AbstractDiscretization,
    AbstractDynamics as AbstractDynamics,
    AbstractWrapper as AbstractWrapper,
    open_loop as open_loop,
)
from ._conversion import c2d as c2d, d2c as d2c
from ._delays import Delayed as Delayed, TransportDelay as TransportDelay
from ._discretized import Discretized as Discretized
from ._event_record import Events as Events
from ._linear import LinearDynamics as LinearDynamics
from ._linearize import linearize as linearize, OperatingPoint as OperatingPoint
from ._method_of_steps import MethodOfSteps as MethodOfSteps
from ._trim import trim as trim
from ._wrappers import WorstCase as WorstCase
