"""Whole experiments, each a function that the command line runs too."""

from ._demo import demo as demo
from ._swing_up import holds_upright as holds_upright, train_swing_up as train_swing_up
