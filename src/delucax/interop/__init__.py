"""Conversions to and from other libraries, each an optional extra."""

from . import gymnax as gymnax
from ._matrix_files import read_linear as read_linear
from ._python_control import from_control as from_control, to_control as to_control
