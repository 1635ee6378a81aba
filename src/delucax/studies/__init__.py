"""End-to-end studies: the paper, the demo, the scoreboard, the ventilator."""

from ._demo import demo as demo
from ._swing_up import holds_upright as holds_upright, train_swing_up as train_swing_up
from .paper import reproduce as reproduce
from .ventilator import lung_study as lung_study
