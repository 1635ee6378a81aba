"""Vector fields `dx/dt = f(t, x, u, w)`. They know of no step, cost or solver."""

from ._base import AbstractSystem as AbstractSystem
from ._function import FunctionSystem as FunctionSystem, system as system
from ._linear import LinearSystem as LinearSystem
from ._pendulum import Pendulum as Pendulum
