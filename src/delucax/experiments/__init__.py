"""Experiments as pytest writes tests, and whole ones ready to run."""

from ._axes import Mark as Mark
from ._demo import demo as demo
from ._experiment import Experiment as Experiment, experiment as experiment
from ._results import Results as Results
from ._run import run as run
from ._statistics import (
    compare as compare,
    interquartile_mean as interquartile_mean,
)
from ._swing_up import holds_upright as holds_upright, train_swing_up as train_swing_up
from .paper import reproduce as reproduce
