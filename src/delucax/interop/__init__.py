"""Conversions to and from other libraries. The conversions to and from gymnax, and
files of linear models, need no extra."""

from . import gymnax as gymnax
from ._linear_models import (
    from_control as from_control,
    read_linear as read_linear,
    to_control as to_control,
)
