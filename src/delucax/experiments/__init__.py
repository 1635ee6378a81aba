"""Experiments over parameters and seeds, declared as tests are declared in pytest."""

from ._experiment import Experiment as Experiment, experiment as experiment
from ._report import report as report
from ._results import Results as Results
from ._run import run as run
from ._statistics import (
    Bootstrap as Bootstrap,
    compare as compare,
    interquartile_mean as interquartile_mean,
)
