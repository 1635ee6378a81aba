"""The problems of `delucax.problems` as plain functions, for peers: `np` is the module
that computes, NumPy or CasADi."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Optimal:
    """A problem: `field(np, x, u, rates)`, bounds, and ends by entries."""

    field: Callable[..., Any]
    objective: Callable[..., Any]  # (states, duration), to be minimised
    limits: tuple[float, float] | None = None
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()
    end: dict[int, float] = field(default_factory=dict)
    duration: tuple[float, float] | None = None
    substeps: int = 1
    rates: int = 0


def steering(np: Any, x: Any, u: Any, rates: Any) -> list[Any]:
    return [x[2], x[3], 100 * np.cos(u[0]), 100 * np.sin(u[0])]


def robot(np: Any, x: Any, u: Any, rates: Any) -> list[Any]:
    lift = ((5 - x[0]) ** 3 + x[0] ** 3) / 3
    turn = lift * np.sin(x[2]) ** 2
    return [x[3], x[4], x[5], u[0] / 5, u[1] / turn, u[2] / lift]


def rocket(np: Any, x: Any, u: Any, rates: Any) -> list[Any]:
    drag = 310 * x[1] ** 2 * np.exp(-500 * (x[0] - 1))
    return [x[1], (u[0] - drag) / x[2] - 1 / x[0] ** 2, -2 * u[0]]


def glider(np: Any, x: Any, u: Any, rates: Any) -> list[Any]:
    r = (x[0] / 100 - 2.5) ** 2
    w = x[3] - 2.5 * (1 - r) * np.exp(-r)
    v = np.sqrt(x[2] ** 2 + w**2)
    pressure = 0.5 * 1.13 * 14 * v**2
    drag = (0.034 + 0.069662 * u[0] ** 2) * pressure
    lift = u[0] * pressure
    sin, cos = w / v, x[2] / v
    return [
        x[2],
        x[3],
        (-lift * sin - drag * cos) / 100,
        (lift * cos - drag * sin) / 100 - 9.81,
    ]


def catalyst(np: Any, x: Any, u: Any, rates: Any) -> list[Any]:
    back = u[0] * (10 * x[1] - x[0])
    return [back, -back - (1 - u[0]) * x[1]]


def chain(np: Any, x: Any, u: Any, rates: Any) -> list[Any]:
    length = np.sqrt(1 + u[0] ** 2)
    return [u[0], length, x[0] * length]


def gas_oil(np: Any, x: Any, u: Any, k: Any) -> list[Any]:
    return [-(k[0] + k[2]) * x[0] ** 2, k[0] * x[0] ** 2 - k[1] * x[1]]


def methanol(np: Any, x: Any, u: Any, k: Any) -> list[Any]:
    q = (k[1] + k[4]) * x[0] + x[1]
    return [
        -(2 * k[1] - k[0] * x[1] / q + k[2] + k[3]) * x[0],
        k[0] * x[0] * (k[1] * x[0] - x[1]) / q + k[2] * x[0],
        k[0] * x[0] * (x[1] + k[4] * x[0]) / q + k[3] * x[0],
    ]


def pinene(np: Any, x: Any, u: Any, k: Any) -> list[Any]:
    return [
        -(k[0] + k[1]) * x[0],
        k[0] * x[0],
        k[1] * x[0] - (k[2] + k[3]) * x[2] + k[4] * x[4],
        k[2] * x[2],
        k[3] * x[2] - k[4] * x[4],
    ]


INF = math.inf
LEAST_TIME: Any = lambda states, duration: duration
PROBLEMS = {
    "particle_steering": Optimal(
        steering,
        LEAST_TIME,
        (-math.pi / 2, math.pi / 2),
        end={1: 5.0, 2: 45.0, 3: 0.0},
        duration=(0.01, 10.0),
    ),
    "robot_arm": Optimal(
        robot,
        LEAST_TIME,
        (-1.0, 1.0),
        (0.0, -math.pi, 0.0, -INF, -INF, -INF),
        (5.0, math.pi, math.pi, INF, INF, INF),
        {0: 4.5, 1: 2 * math.pi / 3, 2: math.pi / 4, 3: 0.0, 4: 0.0, 5: 0.0},
        (0.1, 100.0),
    ),
    "goddard_rocket": Optimal(
        rocket,
        lambda states, duration: -states[-1][0],
        (0.0, 3.5),
        (1.0, 0.0, -INF),
        (INF, INF, INF),
        {2: 0.6},
        (0.01, 1.0),
    ),
    "hang_glider": Optimal(
        glider,
        lambda states, duration: -states[-1][0],
        (0.0, 1.4),
        (0.0, -INF, 0.0, -INF),
        (INF, INF, INF, INF),
        {1: 900.0, 2: 13.23, 3: -1.288},
        (10.0, 200.0),
        substeps=4,
    ),
    "catalyst_mixing": Optimal(
        catalyst,
        lambda states, duration: -1 + states[-1][0] + states[-1][1],
        (0.0, 1.0),
    ),
    "hanging_chain": Optimal(
        chain, lambda states, duration: states[-1][2], end={0: 3.0, 1: 4.0}
    ),
    "gas_oil_cracking": Optimal(gas_oil, None, substeps=4, rates=3),
    "methanol_to_hydrocarbons": Optimal(methanol, None, substeps=4, rates=5),
    "alpha_pinene": Optimal(pinene, None, substeps=8, rates=5),
}
"""Without an objective: the squares of the differences of the states and a record."""
