"""How plants look: draw functions, found by the type of the system."""

from . import (
    _arms as _arms,
    _cars as _cars,
    _cart_pole as _cart_pole,
    _lung as _lung,
    _masses as _masses,
    _motor as _motor,
    _mountain_car as _mountain_car,
    _planar_quadrotor as _planar_quadrotor,
    _quadrotor as _quadrotor,
    _states as _states,
    _tanks as _tanks,
)
from ._registry import (
    Drawing as Drawing,
    drawing_for as drawing_for,
    register_drawing as register_drawing,
)
