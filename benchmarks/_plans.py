"""The planning problems of the benchmark, written once for JAX and for CasADi.

Needs neither: each function takes the module whose `sin`, `cos`, `sqrt` and so on it is
to use, and arrays of that module.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np


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
    room: tuple[tuple[float, ...], tuple[float, ...]] | None = None  # of the states
    towards: tuple[float, ...] | None = None  # the end of a guess of the states

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


# The equilibrium with the hand at (1, 0, 0), which the benchmark checks.
SIDE, DEPTH, MIDDLE = 0.2435665195776434, -0.5154314417277843, -0.696318205571689
AT_REST = (SIDE, 0.0, DEPTH, 0.5, 0.0, MIDDLE, 1 - SIDE, 0.0, DEPTH, 1.0, 0.0, 0.0)
AT_REST += (0.0,) * 9
# After a second of the velocity (-1, 1, 1).
SWUNG = (-0.107901, 0.370719, -0.154041, -0.115926, 0.626601, -0.0680958, -0.0489389)
SWUNG += (0.818251, 0.30389, 0.0, 1.0, 1.0, -0.664315, 0.7355, 0.637243, -0.759788)
SWUNG += (0.736595, 0.705383, -1.00365, 1.0124, 1.03423)
WALL = -0.05


def pull(module: Any, x: Any, u: Any) -> Any:
    """A chain of five masses between a wall and a hand that moves with velocity `u`:
    the three free masses and the hand, then the velocities of the masses; two steps of
    Runge and Kutta.

    Source: Wirsching, Bock and Diehl, 2006; the parameters are those of acados.
    """
    mass, stiffness, length = 0.033, 1.0, 0.033
    # Links from the joints, the first of which stands still, and their sums by link.
    links = np.kron(np.eye(4) - np.eye(4, k=-1), np.eye(3))
    by_link = np.kron(np.eye(4), np.ones((1, 3)))
    between = np.kron(np.eye(3, 4, k=1) - np.eye(3, 4), np.eye(3)) * stiffness / mass
    weight = np.tile([0.0, 0.0, 9.81], 3)

    def rates(x: Any) -> Any:
        along = links @ x[:12]
        far = module.sqrt(by_link @ along**2)
        pulls = between @ (along * (by_link.T @ (1 - length / far))) - weight
        join = module.vertcat if hasattr(module, "vertcat") else module.hstack
        parts = [x[12:], u, pulls]
        return join(*parts) if hasattr(module, "vertcat") else join(parts)

    h = 0.2 / 2
    for _ in range(2):
        k1 = rates(x)
        k2 = rates(x + h / 2 * k1)
        k3 = rates(x + h / 2 * k2)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rates(x + h * k3))
    return x


def stilled(module: Any, x: Any, u: Any) -> Any:
    """The cost of a step of the chain: the hand counts four times."""
    weights = [4.0 if 9 <= i < 12 else 1.0 for i in range(21)]
    off = [x[i] - AT_REST[i] for i in range(21)]
    far = sum(w * e * e for w, e in zip(weights, off, strict=True))
    return far + 0.01 * squares(u, 3)


DISCS = (0.5, 0.6, 0.3), (1.0, 0.25, 0.25)


def discs(module: Any, x: Any) -> Any:
    """At most 0 outside."""
    values = [r * r - (x[0] - a) ** 2 - (x[1] - b) ** 2 for a, b, r in DISCS]
    return stack(module, values)


INFINITE = float("inf")
# Neither the masses nor the hand go through the wall.
BEFORE_WALL = tuple(WALL if i < 12 and i % 3 == 1 else -INFINITE for i in range(21))

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

# Problems of model predictive control, with limits on states.
LIMITED = {
    "cart-pole, track of 0.5 m": replace(
        CASES["cart-pole swing-up"],
        room=((-0.5, *[-INFINITE] * 3), (0.5, *[INFINITE] * 3)),
        towards=(0.0, 0.0, 0.0, 0.0),
    ),
    "chain of five masses, wall": Plans(
        SWUNG,
        3,
        40,
        0.2,
        pull,
        stilled,
        lambda module, x: stilled(module, x, [0.0] * 3),
        bound=1.0,
        room=(BEFORE_WALL, (INFINITE,) * 21),
        towards=AT_REST,
    ),
    "quadrotor among discs": replace(
        CASES["quadrotor"],
        x0=(1.5, 1.0, 0.0, 0.0, 0.0, 0.0),
        horizon=50,
        bounds=(0.0, 3 * HOVER),
        obstacle=discs,
        towards=(0.0,) * 6,
    ),
    "reactor, at most 352 K": CASES["reactor, at most 352 K"],
    "reactor, at most 349.5 K": CASES["reactor, at most 349.5 K"],
}
ALL = CASES | LIMITED
