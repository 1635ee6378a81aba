"""Settings of the study: its size, lungs and peak pressures."""

from typing import NamedTuple


SEEN = (10.0, 15.0, 20.0, 25.0, 30.0, 35.0)
"""Peak pressures that controllers are trained at."""
UNSEEN = (12.5, 17.5, 22.5, 27.5, 32.5)
SHOWN = 27.5
"""The peak pressure of the breaths in the figures, one of those."""
INSPIRATION, BREATH = 29, 100
"""Steps of an inspiration that is learned from, and of a whole breath."""
ABORT = 60.0
"""The pressure that no controller is to reach [cmH2O]."""
LUNGS = tuple((R, C) for R in (5.0, 20.0, 50.0) for C in (10.0, 20.0, 50.0))
"""Lungs of the public data set, (R, C)."""
BETWEEN = ((10.0, 15.0), (10.0, 35.0), (35.0, 15.0), (35.0, 35.0))
"""Lungs between those that are trained on, (R, C)."""
SENSOR_DELAY = 2
"""Samples that the sensor is late."""


class Size(NamedTuple):
    """How much of everything; the full study by default.

    `shared_network` are hidden units of the network for all lungs, and how many
    controls it is given; `tuned` is how many PIDs with feed-forward are drawn;
    `extras` are those rows that the claims do not need.
    """

    breaths: int = 480
    teacher_steps: int = 1000
    simulator_steps: int = 1200
    physics_steps: int = 200
    controller_steps: int = 400
    shared_steps: int = 500
    shared_network: tuple[int, int] = (48, 6)
    pid_steps: int = 150
    tuned: int = 2000
    bound_steps: int = 500
    seeds: int = 3
    noises: int = 5
    lungs: tuple[tuple[float, float], ...] = LUNGS
    between: tuple[tuple[float, float], ...] = BETWEEN
    physics: tuple[str, ...] = (
        "single compartment",
        "balloon",
        "double compartment",
        "neural ODE",
        "grey box",
    )
    extras: bool = True
    sensor_delay: int = SENSOR_DELAY


FULL = Size()
SMALL = Size(
    breaths=96,
    teacher_steps=0,
    simulator_steps=600,
    physics_steps=40,
    controller_steps=100,
    shared_steps=250,
    shared_network=(32, 4),
    pid_steps=20,
    tuned=0,
    bound_steps=0,
    seeds=1,
    noises=2,
    lungs=((5.0, 20.0), (50.0, 20.0)),
    between=BETWEEN[2:3],
    physics=("single compartment",),
    extras=False,
)
