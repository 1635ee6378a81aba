"""The planning problems of the benchmark, written once for JAX and for CasADi.

Needs neither: each function takes the module whose `sin`, `cos`, `sqrt` and so on it is
to use, and arrays of that module.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any


@dataclass(frozen=True)
class Plans:
    """A problem: dynamics, costs, start, bounds."""

    x0: tuple[float, ...]
    controls: int
    horizon: int
    dt: float
    step: Callable[..., Any]
    stage: Callable[..., Any]
    final: Callable[..., Any]
    rest: float = 0.0  # the control to start from
    bound: float | None = None
    bounds: tuple[float, float] | None = None  # where they are not symmetric
    obstacle: Callable[..., Any] | None = None  # at most 0
    arrival: tuple[float, ...] | None = None

    @property
    def limits(self) -> tuple[float, float] | None:
        """Of the controls."""
        return self.bounds if self.bound is None else (-self.bound, self.bound)


def stack(module: Any, entries: list[Any]) -> Any:
    """A vector of the module."""
    if hasattr(module, "vertcat"):
        return module.vertcat(*entries)
    return module.stack(entries)


MASS, LENGTH, GRAVITY = 0.1, 0.2, 9.81
HOVER = MASS * GRAVITY / 2


def fly(module: Any, x: Any, u: Any) -> Any:
    """Euler's step of the planar quadrotor."""
    lift = (u[0] + u[1]) / MASS
    rates = [
        x[3],
        x[4],
        x[5],
        -lift * module.sin(x[2]),
        lift * module.cos(x[2]) - GRAVITY,
        (u[1] - u[0]) / (MASS * LENGTH),
    ]
    return x + 0.05 * stack(module, rates)


def squares(x: Any, count: int) -> Any:
    """The sum of the squares of the entries."""
    return sum(x[i] * x[i] for i in range(count))


def hovering(module: Any, x: Any, u: Any) -> Any:
    """`0.1 |x|^2 + 0.1 |u - hover|^2`."""
    effort = (u[0] - HOVER) ** 2 + (u[1] - HOVER) ** 2
    return 0.1 * squares(x, 6) + 0.1 * effort


def swing(module: Any, x: Any, u: Any) -> Any:
    """A pendulum of 1 kg and 1 m about the upright, semi-implicit Euler."""
    rate = x[1] + 0.05 * (9.81 * module.sin(x[0]) + u[0])
    return stack(module, [x[0] + 0.05 * rate, rate])


def cart(module: Any, x: Any, u: Any) -> Any:
    """A cart of 1 kg with a pole of 0.1 kg and 0.5 m, its angle from the upright."""
    s, c = module.sin(x[1]), module.cos(x[1])
    heavy, light, length = 1.0, 0.1, 0.5
    force = u[0] + light * length * x[3] * x[3] * s
    turn = (GRAVITY * s - c * force / (heavy + light)) / (
        length * (4 / 3 - light * c * c / (heavy + light))
    )
    push = (force - light * length * turn * c) / (heavy + light)
    return x + 0.05 * stack(module, [x[2], x[3], push, turn])


def glide(module: Any, x: Any, u: Any) -> Any:
    """A point of unit mass in the plane, held exactly."""
    dt = 0.1
    moved = [x[i] + dt * x[2 + i] + dt * dt / 2 * u[i] for i in range(2)]
    return stack(module, [*moved, x[2] + dt * u[0], x[3] + dt * u[1]])


def tip_cost(weight: float) -> Callable[..., Any]:
    """`weight` times the height that is missing and the squares of the rates."""

    def cost(module: Any, x: Any) -> Any:
        return weight * (1 - module.cos(x[0]) + 0.1 * x[1] * x[1])

    return cost


def cart_cost(weight: float) -> Callable[..., Any]:
    """Likewise for the cart, with its position."""

    def cost(module: Any, x: Any) -> Any:
        rates = 0.05 * (x[2] * x[2] + x[3] * x[3])
        return weight * (1 - module.cos(x[1]) + 0.2 * x[0] * x[0] + rates)

    return cost


COLDEST, HOTTEST = 280.0, 320.0
# At half the concentration of the feed.
MIXED = 8750 / math.log(7.2e10)
COOLANT = MIXED - (350.0 - MIXED + 209.2 * 0.5) / 2.092
# The cost to go of the LQR there, which the benchmark checks.
TO_GO = (553.2798101150212, 10.253882224314259, 0.3316803252438305)


def react(module: Any, x: Any, u: Any) -> Any:
    """A stirred tank about its unstable equilibrium, four steps of Runge and Kutta."""

    def rates(x: Any) -> Any:
        reaction = 7.2e10 * module.exp(-8750 / x[1]) * x[0]
        warming = 350 - x[1] + 209.2 * reaction
        return stack(module, [1 - x[0] - reaction, warming + 2.092 * (u[0] - x[1])])

    h = 0.05 / 4
    for _ in range(4):
        k1 = rates(x)
        k2 = rates(x + h / 2 * k1)
        k3 = rates(x + h / 2 * k2)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rates(x + h * k3))
    return x


def off(x: Any) -> tuple[Any, Any]:
    """How far a tank is from its equilibrium."""
    return x[0] - 0.5, x[1] - MIXED


def regulated(module: Any, x: Any, u: Any) -> Any:
    """The cost of a step of the tank."""
    c, T = off(x)
    return 10 * c * c + 0.01 * T * T + 0.01 * (u[0] - COOLANT) ** 2


def to_go(module: Any, x: Any) -> Any:
    """What the LQR would cost from there on."""
    (c, T), (cc, cT, TT) = off(x), TO_GO
    return cc * c * c + 2 * cT * c * T + TT * T * T


REACTOR = Plans(
    (0.6495, 346.71),
    1,
    30,
    0.05,
    react,
    regulated,
    to_go,
    rest=COOLANT,
    bounds=(COLDEST, HOTTEST),
)


CASES = {
    "reactor": REACTOR,
    "reactor, at most 352 K": replace(REACTOR, obstacle=lambda module, x: x[1] - 352.0),
    "reactor, at most 349.5 K": replace(
        REACTOR, obstacle=lambda module, x: x[1] - 349.5
    ),
    "quadrotor": Plans(
        (1.0, 1.0, 0.0, 0.0, 0.0, 0.0),
        2,
        100,
        0.05,
        fly,
        hovering,
        lambda module, x: 10 * squares(x, 6),
        rest=HOVER,
    ),
    "pendulum swing-up": Plans(
        (math.pi, 0.0),
        1,
        100,
        0.05,
        swing,
        lambda module, x, u: tip_cost(0.1)(module, x) + 0.01 * u[0] * u[0],
        tip_cost(100.0),
        bound=4.0,
        rest=0.1,
    ),
    "cart-pole swing-up": Plans(
        (0.0, math.pi, 0.0, 0.0),
        1,
        80,
        0.05,
        cart,
        lambda module, x, u: cart_cost(0.1)(module, x) + 0.001 * u[0] * u[0],
        cart_cost(100.0),
        bound=10.0,
        rest=0.1,
    ),
    "obstacle": Plans(
        (-1.0, 0.05, 0.0, 0.0),
        2,
        40,
        0.1,
        glide,
        lambda module, x, u: 0.01 * squares(x, 4) + 0.1 * squares(u, 2),
        lambda module, x: 0.0 * x[0],
        bound=2.5,
        obstacle=lambda module, x: 0.16 - x[0] * x[0] - x[1] * x[1],
        arrival=(1.0, 0.0, 0.0, 0.0),
    ),
}
