"""Conversions to and from other libraries, each an optional extra."""

from . import gymnax as gymnax
from ._control import from_control as from_control, to_control as to_control
from ._files import read_linear as read_linear
