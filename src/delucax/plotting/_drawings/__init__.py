"""How plants look: draw functions, found by the type of the system."""

from ._canvas import Canvas as Canvas
from ._drawing import (
    Drawing as Drawing,
    Episode as Episode,
    States as States,
    Vector as Vector,
)
from ._registry import drawing_for as drawing_for, register_drawing as register_drawing
