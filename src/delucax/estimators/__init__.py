"""State estimators: Kalman filters, smoothers and moving-horizon estimation."""

from ._base import AbstractEstimator as AbstractEstimator, Belief as Belief
from ._kalman import (
    ExtendedKalmanFilter as ExtendedKalmanFilter,
    KalmanFilter as KalmanFilter,
    UnscentedKalmanFilter as UnscentedKalmanFilter,
)
from ._mhe import MHE as MHE
from ._random_walk import RandomWalk as RandomWalk
from ._record import run_estimator as run_estimator
from ._smoother import run_filter as run_filter, smooth as smooth
