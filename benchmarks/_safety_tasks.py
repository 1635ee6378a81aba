"""Plants at the edge of what is safe, and filters for them by hand, in plain `jnp`.

A mass before a wall that moves, a pendulum that must not spin fast, and a unicycle
among discs.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import delucax as dlx


c = dlx.controllers
AHEAD = 0.15
"""From the axle of the unicycle to the point that is steered, in m."""
DISCS = np.array([[0.9, 0.42, 0.3], [-0.38, 0.48, 0.3], [0.1, -0.98, 0.3]])
"""The centres and radii of the discs, in m."""


@dataclass(frozen=True, eq=False)
class Task:
    """A plant, a controller that does not know of barriers, and these."""

    system: Any
    controller: Any
    barriers: Callable[..., Any]
    options: dict[str, Any]
    dt: float
    states: tuple[Any, Any]
    times: tuple[float, float] | None
    draw: Callable[..., Any]
    cost: Callable[..., Any]
    worst: Callable[..., Any]
    by_hand: Callable[..., Any]

    def filter(self) -> Any:
        """The filter without a margin for the hold."""
        given = self.controller, self.system, self.barriers
        return c.SafetyFilter(*given, **self.options)

    def margin(self) -> Any:
        """The filter with it."""
        return self.filter().held(self.dt, self.states, times=self.times)


class Follow(dlx.AbstractController):
    """A law of time and state."""

    law: Callable[..., Any]

    def __call__(self, t, y, state):
        return self.law(t, y), state


def projected(n, value, a, weight, low, high):
    """The nearest control to `n` with `value + a (u - n) >= 0`, clipped."""
    push = jnp.maximum(-value, 0) / jnp.sum(a * a / weight)
    return jnp.clip(n + push * a / weight, low, high)


def mass_before_a_wall() -> Task:
    """A mass is to be 1.3 m out, and a wall moves between 0.8 m and 1.2 m."""
    wall = lambda t: 1 + 0.2 * jnp.sin(2 * t)
    field = lambda t, x, u, w: jnp.stack([x[1], u[0] + w[0]])

    def draw(key):
        x = jax.random.uniform(key, (2,), minval=-0.5, maxval=0.5)
        return x

    def by_hand(t, x, n, decay, margin):
        b, db = wall(t) - x[0], 0.4 * jnp.cos(2 * t) - x[1]
        value = -0.8 * jnp.sin(2 * t) - n[0] + 2 * decay * db + decay**2 * b
        return jnp.clip(n + jnp.minimum(value - margin, 0), -8.0, 8.0)

    return Task(
        system=dlx.system(field, states=2, controls=1, disturbances=1),
        controller=Follow(lambda t, x: 6 * (1.3 - x[:1]) - 4 * x[1:]),
        barriers=lambda t, x: wall(t) - x[0],
        options=dict(decay=3.0, bounds=(-8.0, 8.0), disturbance=0.3),
        dt=0.02,
        states=([-0.6, -2.0], [1.2, 2.0]),
        times=(0.0, np.pi),
        draw=draw,
        cost=lambda t, x, u: (x[0] - 1.3) ** 2,
        worst=lambda t, x: jnp.full(1, 0.3),
        by_hand=by_hand,
    )


def spun_pendulum() -> Task:
    """A pendulum is to turn at 5 rad/s, and must not at more than 4 rad/s."""
    field = lambda t, x, u, w: jnp.stack([x[1], 15 * jnp.sin(x[0]) + 3 * u[0] + w[0]])

    def draw(key):
        low, high = jnp.array([-np.pi, 0.0]), jnp.array([np.pi, 3.5])
        return jax.random.uniform(key, (2,), minval=low, maxval=high)

    def by_hand(t, x, n, decay, margin):
        most = (decay * (4 - x[1]) - margin - 15 * jnp.sin(x[0])) / 3
        return jnp.clip(jnp.minimum(n, most), -8.0, 8.0)

    return Task(
        system=dlx.system(field, states=2, controls=1, disturbances=1),
        controller=Follow(lambda t, x: 3 * (5 - x[1:]) - 5 * jnp.sin(x[:1])),
        barriers=lambda t, x: 4 - x[1],
        options=dict(decay=4.0, bounds=(-8.0, 8.0), disturbance=0.5),
        dt=0.01,
        states=([-np.pi, -1.0], [np.pi, 4.0]),
        times=None,
        draw=draw,
        cost=lambda t, x, u: (x[1] - 5) ** 2,
        worst=lambda t, x: jnp.full(1, 0.5),
        by_hand=by_hand,
    )


def unicycle_among_discs() -> Task:
    """A point ahead of a unicycle is to follow another one around a circle that leads
    through discs."""
    forward = lambda x: jnp.stack([jnp.cos(x[2]), jnp.sin(x[2])])
    aside = lambda x: AHEAD * jnp.stack([-jnp.sin(x[2]), jnp.cos(x[2])])
    point = lambda x: x[:2] + AHEAD * forward(x)
    goal = lambda t: 0.8 * jnp.stack([jnp.cos(0.8 * t), jnp.sin(0.8 * t)])
    # A change of the control costs what it changes the speed of the point by.
    top, weight = np.array([1.0, 4.0]), np.array([1.0, AHEAD**2])

    def field(t, x, u, w):
        return jnp.concatenate([u[0] * forward(x) + w, u[1:]])

    def steered(t, x):
        # In the frame of the unicycle the point moves by (v, ahead omega).
        turned = jnp.stack([forward(x), aside(x) / AHEAD])
        away = turned @ (3 * (goal(t) - point(x)))
        return jnp.clip(away / np.array([1.0, AHEAD]), -top, top)

    def far(t, x):
        away = point(x) - DISCS[:, :2]
        return dlx.math.safe_norm(away) - DISCS[:, 2]

    def draw(key):
        """Of 64 states the first one off the discs."""
        low, high = np.array([-1.2, -1.2, -np.pi]), np.array([1.2, 1.2, np.pi])
        x = jax.random.uniform(key, (64, 3), minval=low, maxval=high)
        free = jax.vmap(lambda x: jnp.min(far(0.0, x)) > 0.05)(x)
        return x[jnp.argmax(free)]

    def nearest(x):
        away = point(x) - DISCS[:, :2]
        distance = jnp.sqrt(jnp.sum(away**2, 1))
        b = distance - DISCS[:, 2]
        i = jnp.argmin(b)
        return away[i] / distance[i], b[i]

    def by_hand(t, x, n, decay, margin):
        out, b = nearest(x)
        a = jnp.stack([out @ forward(x), out @ aside(x)])
        return projected(n, a @ n + decay * b - margin, a, weight, -top, top)

    return Task(
        system=dlx.system(field, states=3, controls=2, disturbances=2),
        controller=Follow(steered),
        barriers=far,
        options=dict(decay=3.0, bounds=(-top, top), disturbance=0.1, weight=weight),
        dt=0.02,
        states=([-1.5, -1.5, -np.pi], [1.5, 1.5, np.pi]),
        times=None,
        draw=draw,
        cost=lambda t, x, u: jnp.sum((point(x) - goal(t)) ** 2),
        worst=lambda t, x: -0.1 * jnp.sign(nearest(x)[0]),
        by_hand=by_hand,
    )


TASKS = {
    "double integrator": mass_before_a_wall,
    "pendulum": spun_pendulum,
    "unicycle": unicycle_among_discs,
}
